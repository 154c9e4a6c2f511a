"""The contact network: what it conserves, what it sees of walls, its memory, and that the fused kernel is the same."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch

from gran_bench.config import ContactModelConfig, ContainerConfig, FillingConfig, SceneConfig
from gran_bench.neighbors import tree_pairs
from gran_bench.scene import Plane, Scene, build_scene
from gran_bench.surrogate import compiling
from gran_bench.surrogate.contact import ContactNetwork
from gran_bench.surrogate.contact_geometry import find_contacts, wall_displacement_matrix, wall_surfaces
from gran_bench.surrogate.contact_memory import ContactMemory, follow_memory, warm_memory
from gran_bench.surrogate.kernels.contact_frame import frame_adjoint, frame_forward
from gran_bench.surrogate.kernels.contact_springs import SPRING_CAP
from gran_bench.surrogate.step import FrameState

DIAMETER = 0.05
VARIANTS = ({}, {"memory": True}, {"velocity": "instantaneous"}, {"memory": True, "velocity": "instantaneous"})


def drum(count: int = 60, periodic: bool = False, speed_rpm: float = 30.0) -> Scene:
    """A short, narrow drum."""
    container = ContainerConfig(diameter=0.26, length=0.2, periodic_axis=periodic)
    return build_scene(SceneConfig("small", container, FillingConfig(count, DIAMETER))).at_speed(speed_rpm)


def nowhere(gravity: bool = False) -> Scene:
    """No walls."""
    strength = -9.81 if gravity else 0.0
    return build_scene(SceneConfig("free", ContainerConfig(kind="none"), gravity=[0.0, 0.0, strength]))


def network(scene: Scene, seed: int = 0, **choices) -> ContactNetwork:
    """A network whose weights are far from their quiet start, so that every term acts."""
    torch.manual_seed(seed)
    model = ContactNetwork(ContactModelConfig(**{"iterations": 3, "backend": "torch"} | choices), scene)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter += 0.15 * torch.randn_like(parameter)
    return model


def cluster(scene: Scene, count: int, seed: int = 0, dtype: torch.dtype = torch.float32) -> FrameState:
    """Spheres on a jittered lattice with gaps of both signs, lively velocities and spins, a few at each wall."""
    rng = np.random.default_rng(seed)
    edge = int(np.ceil(count ** (1 / 3)))
    site = np.stack(np.meshgrid(*[np.arange(edge)] * 3, indexing="ij"), -1).reshape(-1, 3)[:count]
    position = (site - 0.5 * (edge - 1)) * DIAMETER * 1.01 + rng.uniform(-0.002, 0.002, (count, 3))
    if scene.drum_radius is not None:
        reach = scene.drum_radius - 0.5 * DIAMETER
        radial = np.hypot(position[:, 0], position[:, 2])
        far = radial > reach
        position[far] *= np.where([True, False, True], reach / radial[far, None], 1.0)
        position[:, 1] = np.clip(position[:, 1], -0.5 * scene.length + 0.024, 0.5 * scene.length - 0.024)
    velocity, spin = rng.normal(0.0, 0.3, (count, 3)), rng.normal(0.0, 8.0, (count, 3))
    return FrameState(*(torch.tensor(a, dtype=dtype) for a in (position, velocity, spin)))


def with_memory(model: ContactNetwork, scene: Scene, state: FrameState) -> FrameState:
    """The state with springs at half of its contacts."""
    if model.has_memory:
        contacts = find_contacts(scene, state.position.detach().numpy(), DIAMETER * 1.1, 0.01)
        keys = contacts.keys(len(state.position))[::2]
        spring = np.random.default_rng(5).normal(0.0, 0.3, (len(keys), 3)).astype(np.float32)
        state.memory = ContactMemory(keys, spring)
    return state


class TestDefinition:
    def test_four_iterations_have_3372_weights(self):
        assert network(drum(), iterations=4).parameter_count == 3372

    def test_a_lone_sphere_flies_ballistically(self):
        scene = nowhere(gravity=True)
        velocity, spin = torch.tensor([[0.3, 0.1, -0.2]]), torch.tensor([[1.0, 2.0, 3.0]])
        state = FrameState(torch.zeros(1, 3), velocity, spin)
        model = network(scene)
        with torch.no_grad():
            model.mix_bias.zero_()  # a lone sphere's channels are then zero, and it takes nothing of gravity back
            after = model(state, scene, 0.0)
        expected = velocity + 0.01 * torch.tensor([0.0, 0.0, -9.81])
        assert torch.allclose(after.velocity, expected, atol=1e-6)
        assert torch.allclose(after.position, 0.01 * expected, atol=1e-8)
        assert torch.allclose(after.angular_velocity, spin, atol=1e-5)

    def test_an_instantaneous_velocity_falls_half_as_far(self):
        scene = nowhere(gravity=True)
        state = FrameState(torch.zeros(1, 3), torch.zeros(1, 3), torch.zeros(1, 3))
        model = network(scene, velocity="instantaneous")
        with torch.no_grad():
            model.mix_bias.zero_()
            after = model(state, scene, 0.0)
        assert after.position[0, 2].item() == pytest.approx(-0.5 * 9.81 * 0.01**2, rel=1e-5)
        assert after.velocity[0, 2].item() == pytest.approx(-9.81 * 0.01, rel=1e-5)

    def test_a_pair_entering_its_reach_feels_nothing_yet(self):
        scene = nowhere()
        model = network(scene)
        edge = model.config.radius

        def speed_after(distance: float) -> float:
            position = torch.tensor([[0.0, 0.0, 0.0], [distance, 0.0, 0.0]], dtype=torch.float64)
            state = FrameState(position, torch.zeros_like(position), torch.zeros_like(position))
            return model.double()(state, scene, 0.0).velocity.abs().max().item()

        assert speed_after(edge - 1e-9) < 1e-6 < speed_after(edge - 1e-3)

    @pytest.mark.parametrize(
        ("choices", "named"),
        [
            ({"radius": 0.05}, "model.radius=0.05"),
            ({"velocity": "median"}, "model.velocity='median'"),
            ({"backend": "cuda"}, "model.backend='cuda'"),
            ({"backend": "fused", "hidden": 24}, "model.hidden=24 .* model.backend=torch"),
        ],
    )
    def test_an_impossible_choice_is_named(self, choices, named):
        with pytest.raises(ValueError, match=named):
            ContactNetwork(ContactModelConfig(**choices), drum())


class TestContactList:
    @pytest.mark.parametrize("periodic", [False, True])
    def test_it_lists_what_a_tree_finds(self, periodic):
        scene = drum(periodic=periodic)
        position = cluster(scene, 60).position.numpy()
        listed = find_contacts(scene, position, 0.06, 0.01)
        assert np.array_equal(listed.pairs, tree_pairs(position, 0.06, scene.period))
        assert set(listed.wall) == set(range(len(scene.walls)))
        assert (np.diff(listed.keys(60)) > 0).all()

    def test_a_position_that_is_not_finite_ends_in_a_frame_that_is_not(self):
        scene = drum()
        state = cluster(scene, 60)
        state.position[3, 0] = torch.nan
        with torch.no_grad():
            assert not network(scene, backend="fused")(state, scene, 1.5).position.isfinite().all()


class TestConservation:
    @pytest.mark.parametrize("choices", VARIANTS)
    def test_pair_contacts_conserve_linear_momentum(self, choices):
        scene = nowhere()
        model = network(scene, **choices).double()
        state = with_memory(model, scene, cluster(scene, 27, dtype=torch.float64))
        after = model(state, scene, 0.0)
        changed = (after.velocity - state.velocity).abs().max()
        assert changed > 1e-3  # something happened
        assert torch.allclose(after.velocity.sum(0), state.velocity.sum(0), atol=1e-12 * 27)
        assert torch.allclose(
            after.position.mean(0) - state.position.mean(0), 0.01 * state.velocity.mean(0), atol=1e-12
        )

    def test_a_rotated_bed_moves_the_same_rotated(self):
        scene = nowhere()
        model = network(scene).double()
        state = cluster(scene, 27, dtype=torch.float64)
        turn = torch.linalg.matrix_exp(torch.tensor([[0.0, -0.3, 0.9], [0.3, 0.0, -0.5], [-0.9, 0.5, 0.0]]).double())
        turned = FrameState(state.position @ turn.T, state.velocity @ turn.T, state.angular_velocity @ turn.T)
        after, after_turned = model(state, scene, 0.0), model(turned, scene, 0.0)
        assert torch.allclose(after.position @ turn.T, after_turned.position, atol=1e-12)
        assert torch.allclose(after.angular_velocity @ turn.T, after_turned.angular_velocity, atol=1e-9)

    @pytest.mark.parametrize("choices", VARIANTS)
    def test_a_mirrored_bed_moves_the_same_mirrored(self, choices):
        scene = drum()
        model = network(scene, **choices).double()
        state = with_memory(model, scene, cluster(scene, 60, dtype=torch.float64))
        flip = torch.tensor([1.0, -1.0, 1.0], dtype=torch.float64)
        mirrored = FrameState(state.position * flip, state.velocity * flip, -state.angular_velocity * flip)
        if model.has_memory:
            mirrored.memory = state.memory.mirrored(scene, 60)
        after, image = model(state, scene, 1.5), model(mirrored, scene, 1.5)
        assert torch.allclose(after.position * flip, image.position, atol=1e-12)
        assert torch.allclose(-after.angular_velocity * flip, image.angular_velocity, atol=1e-9)
        if model.has_memory:
            expected = after.memory.mirrored(scene, 60)
            assert np.array_equal(expected.keys, image.memory.keys)
            assert np.allclose(expected.spring, image.memory.spring, atol=1e-4)

    def test_a_periodic_bed_does_not_know_where_it_is_cut(self):
        scene = drum(periodic=True)
        model = network(scene).double()
        state = cluster(scene, 60, dtype=torch.float64)
        shift = torch.tensor([0.0, 0.07, 0.0], dtype=torch.float64)
        moved = state.position + shift
        moved[:, 1] -= 0.2 * torch.floor(moved[:, 1] / 0.2 + 0.5)
        after = model(state, scene, 1.5)
        shifted = model(FrameState(moved, state.velocity, state.angular_velocity), scene, 1.5)
        assert torch.allclose(after.velocity, shifted.velocity, atol=1e-10)
        assert shifted.position[:, 1].abs().max() <= 0.1


class TestWalls:
    def test_a_sphere_that_turns_with_the_drum_neither_slips_nor_approaches(self):
        scene = drum(speed_rpm=45.0)
        theta, matrix = scene.rotation.angle(1.6, 1.61), wall_displacement_matrix(scene, scene.walls[0], 1.6)
        end = torch.tensor([[105.0, 20.0, 0.0], [-63.0, 0.0, -84.0]], dtype=torch.float64)
        displacement = end @ torch.tensor(matrix).T
        spin = torch.tensor([[0.0, 25.0 * theta, 0.0]], dtype=torch.float64).expand(2, 3)
        seen = wall_surfaces(scene.walls[0], matrix, end, displacement, spin, 25.0)
        assert seen.gap.numpy() == pytest.approx(0.0, abs=1e-9)
        # What is left is of second order in the angle turned.
        assert seen.slip.abs().max() < 25.0 * theta**2
        assert seen.approach.abs().max() < 25.0 * theta**2

    def test_the_bottom_of_the_drum_carries_spheres_towards_minus_x(self):
        scene = drum(count=1)
        bottom = torch.tensor([[0.0, 0.0, -0.1055]])
        model = network(scene)
        with torch.no_grad():
            model.output_weight.zero_()
            model.output_bias.zero_()
            model.output_bias[:, 1, 1] = 1.0  # walls answer with a unit of friction, b = 1
        after = model(FrameState(bottom, torch.zeros(1, 3), torch.zeros(1, 3)), scene, 1.5)
        assert after.velocity[0, 0] < -0.01
        assert after.angular_velocity[0, 1] > 0.1  # rolling on it, it turns as the drum does

    def test_a_resting_wall_does_not_move(self):
        scene = drum().at_rest()
        assert not wall_displacement_matrix(scene, scene.walls[0], 1.5).any()

    def test_a_cap_pushes_a_sphere_back_in(self):
        scene = drum(count=1).at_rest()
        cap = next(w for w in scene.walls if isinstance(w, Plane))
        inside = torch.tensor(cap.point) + 0.0245 * torch.tensor(cap.normal)  # half a millimetre of overlap
        model = network(scene)
        with torch.no_grad():
            for parameter in model.parameters():
                parameter.zero_()
            model.stiffness.fill_(1.0)
        state = FrameState(inside[None].float(), torch.zeros(1, 3), torch.zeros(1, 3))
        gain = (model(state, scene, 1.0).position - state.position)[0] @ torch.tensor(cap.normal)
        assert gain.item() == pytest.approx(0.0005, rel=1e-3)


class TestGradients:
    @pytest.mark.parametrize("choices", VARIANTS)
    def test_derivatives_of_the_reference_are_right(self, choices):
        scene = drum(count=8)
        model = network(scene, iterations=2, hidden=3, channels=2, **choices).double()
        start = with_memory(model, scene, cluster(scene, 8, seed=3, dtype=torch.float64))
        names = list(dict(model.named_parameters()))

        def frame(position, velocity, spin, *weights):
            # In mm and mm per frame, so that one step of the finite differences suits all inputs.
            state = FrameState(1e-3 * position, 0.1 * velocity, 4.0 * spin, start.memory)
            after = torch.func.functional_call(model, dict(zip(names, weights, strict=True)), (state, scene, 1.5))
            return 1e3 * after.position, 10.0 * after.velocity, 0.25 * after.angular_velocity

        inputs = (1e3 * start.position, 10.0 * start.velocity, 0.25 * start.angular_velocity)
        leaves = [leaf.detach().requires_grad_() for leaf in (*inputs, *model.parameters())]
        assert torch.autograd.gradcheck(frame, leaves, eps=1e-7, atol=1e-5, fast_mode=True)


class TestMemory:
    def slide(self, steps: int, slip: float, overlap: float = 0.5) -> list[ContactMemory]:
        """Two spheres pressed together; the second slides past the first by ``slip`` mm a frame along y."""
        scene = nowhere()
        offset = np.zeros((steps, 2, 3))
        offset[:, 1, 1] = 1e-3 * slip * np.arange(steps)
        offset[:, 1, 0] = np.sqrt((DIAMETER - 1e-3 * overlap) ** 2 - offset[:, 1, 1] ** 2)
        return list(follow_memory(scene, 0.01 * np.arange(steps), offset, np.zeros((steps, 2, 3))))

    def test_a_touching_contact_gathers_its_slip(self):
        memories = self.slide(4, slip=0.02)
        lengths = [np.linalg.norm(m.spring) for m in memories[1:]]
        assert np.allclose(lengths, [0.02, 0.04, 0.06], rtol=1e-3)
        assert memories[-1].spring[0, 1] > 0

    def test_a_spring_is_capped_at_a_share_of_the_overlap(self):
        assert np.linalg.norm(self.slide(4, slip=0.5)[-1].spring) == pytest.approx(SPRING_CAP * 0.5, rel=1e-3)

    def test_spheres_apart_remember_nothing(self):
        assert len(self.slide(4, slip=0.02, overlap=-0.1)[-1].keys) == 0

    def test_rolling_on_each_other_is_no_slip(self):
        scene = nowhere()
        positions = np.tile(np.array([[0.0, 0.0, 0.0], [0.0495, 0.0, 0.0]]), (3, 1, 1))
        spins = np.tile(np.array([[0.0, 0.0, 3.0], [0.0, 0.0, -3.0]]), (3, 1, 1))
        assert np.abs(warm_memory(scene, 0.01 * np.arange(3), positions, spins).spring).max() < 1e-6

    def test_a_spring_turns_with_its_contact_and_keeps_its_length(self):
        scene = nowhere()
        angle, distance, slip = 0.3, 0.0495, 0.0001
        positions, spins = np.zeros((3, 2, 3)), np.zeros((3, 2, 3))
        positions[:2, 1, 0] = distance
        positions[2, 1] = distance * np.cos(angle), distance * np.sin(angle), 0.0
        # First the spheres turn on the spot and slip along y; then the pair turns, and they roll with it.
        frame = 0.5 * DIAMETER * scene.frame_interval  # of a mean of two spins
        spins[1, :, 2] = -slip / frame
        spins[2, :, 2] = (slip + distance * np.sin(angle)) / frame
        _, before, after = follow_memory(scene, 0.01 * np.arange(3), positions, spins)
        assert before.spring[0] == pytest.approx([0.0, 0.1, 0.0], abs=1e-5)
        assert after.spring[0] == pytest.approx([-0.1 * np.sin(angle), 0.1 * np.cos(angle), 0.0], abs=1e-4)

    def test_a_sphere_carried_by_the_drum_gathers_nothing_and_one_that_stays_behind_does(self):
        scene = drum(count=1)
        angles = [scene.rotation.angle(1.5, 1.5 + 0.01 * k) for k in range(4)]
        carried = np.array([[[-0.1055 * np.sin(a), 0.0, -0.1055 * np.cos(a)]] for a in angles])
        spin = np.zeros_like(carried)
        spin[:, :, 1] = scene.rotation.angular_speed(1.6)
        times = 1.5 + 0.01 * np.arange(4)
        # The surfaces of an overlap turn at slightly different speeds, by overlap × angle.
        assert np.abs(warm_memory(scene, times, carried, spin).spring).max() < 0.5 * angles[-1] * 1.1
        behind = np.broadcast_to(carried[:1], carried.shape)
        left = warm_memory(scene, times, behind, np.zeros_like(spin))
        assert left.spring[0, 0] == pytest.approx(-SPRING_CAP * 0.5, rel=1e-2)  # the wall moves on towards −x

    def test_the_network_carries_it_from_frame_to_frame_as_the_data_give_it(self):
        scene = drum()
        torch.manual_seed(0)
        model = ContactNetwork(ContactModelConfig(memory=True, backend="torch"), scene)
        state = cluster(scene, 60)
        state = model.begin(scene, state.position, state.velocity, state.angular_velocity)
        assert len(state.memory.keys) == 0
        frames = [state]
        with torch.no_grad():
            for k in range(3):
                frames.append(model(frames[-1], scene, 1.5 + 0.01 * k))
        positions = np.stack([f.position.numpy() for f in frames])
        spins = np.stack([f.angular_velocity.numpy() for f in frames])
        warmed = warm_memory(scene, 1.5 + 0.01 * np.arange(4), positions, spins)
        held = frames[-1].memory
        assert len(held.keys) > 20
        assert np.array_equal(warmed.keys, held.keys)
        # A graze that only one of the two lists foresees is all that may differ.
        assert np.abs(warmed.spring - held.spring).max() < 2e-3

    def test_springs_change_the_motion(self):
        scene = drum()
        model = network(scene, memory=True)
        state = with_memory(model, scene, cluster(scene, 60))
        bare = FrameState(state.position, state.velocity, state.angular_velocity, ContactMemory.empty())
        assert not torch.allclose(model(state, scene, 1.5).velocity, model(bare, scene, 1.5).velocity, atol=1e-4)


class TestFusedKernel:
    """The jitted forward and its hand-written adjoint against the reference and autograd, in float32."""

    @pytest.mark.parametrize("choices", VARIANTS)
    @pytest.mark.parametrize("periodic", [False, True])
    def test_frames_and_all_gradients_are_those_of_the_reference(self, choices, periodic):
        scene = drum(periodic=periodic)
        reference = network(scene, **choices)
        fused = network(scene, **choices, backend="fused")
        generator = torch.Generator().manual_seed(1)
        pull = [torch.randn((60, 3), generator=generator) for _ in range(3)]

        def frame(model):
            state = with_memory(model, scene, cluster(scene, 60))
            leaves = [state.position, state.velocity, state.angular_velocity]
            for leaf in leaves:
                leaf.requires_grad_()
            after = model(state, scene, 1.5)
            outputs = 1e3 * after.position, 10.0 * after.velocity, 0.25 * after.angular_velocity
            sum((o * p).sum() for o, p in zip(outputs, pull, strict=True)).backward()
            scales = (1e3, 10.0, 0.25)  # so that all gradients are per mm, or mm a frame
            return outputs, [leaf.grad / s for leaf, s in zip(leaves, scales, strict=True)]

        expected, expected_gradients = frame(reference)
        found, found_gradients = frame(fused)
        for e, f in zip(expected, found, strict=True):
            assert torch.allclose(e, f, rtol=1e-4, atol=1e-4)
        for e, f in zip(expected_gradients, found_gradients, strict=True):
            assert (e - f).norm() < 2e-4 * e.norm()
        for name, weight in reference.named_parameters():
            gradient = dict(fused.named_parameters())[name].grad
            assert (weight.grad - gradient).norm() < 2e-4 * weight.grad.norm(), name

    def test_threads_that_work_at_once_give_the_same_bits(self):
        scene = drum()
        model = network(scene, backend="fused", memory=True)

        def gradient(_):
            state = with_memory(model, scene, cluster(scene, 60))
            after = model(state, scene, 1.5)
            return torch.autograd.grad(after.position.sum() + after.velocity.sum(), list(model.parameters()))

        alone = gradient(0)
        with ThreadPoolExecutor(2) as pool:
            for together in pool.map(gradient, range(6)):
                assert all(torch.equal(a, b) for a, b in zip(alone, together, strict=True))


def test_kernels_compiled_ahead_are_the_ones_that_a_run_calls(monkeypatch):
    # Compiled in the run's own process they would sum in another order, and the first run would train other weights.
    compiling.main()
    kinds = len(frame_forward.signatures), len(frame_adjoint.signatures)
    filling = FillingConfig(count=40)
    scene = build_scene(SceneConfig(container=ContainerConfig(diameter=0.4, length=0.2), filling=filling))
    start = scene.fresh_filling(0)
    position, velocity, spin = (
        torch.tensor(array, dtype=torch.float32) for array in (start.position, start.velocity, start.angular_velocity)
    )
    model = ContactNetwork(ContactModelConfig(iterations=4, memory=True, velocity="instantaneous"), scene)
    frame = model.begin(scene, position, velocity, spin)
    model(model(frame, scene, 0.0), scene, scene.frame_interval).position.sum().backward()
    assert (len(frame_forward.signatures), len(frame_adjoint.signatures)) == kinds
    calls = []
    monkeypatch.setattr(compiling, "MARK", "nothing.compiled")
    monkeypatch.setattr(compiling.subprocess, "run", lambda words, **_: calls.append(words[-1]) or Failed)
    assert compiling.kernels_missing("contact")
    assert not compiling.kernels_missing("radial")
    compiling.compile_kernels("contact")
    assert calls == ["gran_bench.surrogate.compiling"]
    assert compiling.kernels_missing("contact")  # it failed, so the run compiles for itself


class Failed:
    """What a process leaves that could not do it."""

    returncode = 1
