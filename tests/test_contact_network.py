"""The contact network: what it conserves, what it sees of walls, and that its derivatives are right."""

import numpy as np
import pytest
import torch
from contact_beds import VARIANTS, at_walls, cluster, drum, furnished, network, nowhere, with_memory

from gran_bench.config import ContactModelConfig
from gran_bench.neighbors import tree_pairs
from gran_bench.scene import Plane
from gran_bench.surrogate.contact.constants import PAIR
from gran_bench.surrogate.contact.geometry import find_contacts
from gran_bench.surrogate.contact.network import ContactNetwork
from gran_bench.surrogate.contact.solver import contact_groups
from gran_bench.surrogate.step import FrameState
from gran_bench.surrogate.walls import frame_walls


class TestDefinition:
    def test_four_iterations_have_3372_weights(self):
        assert network(drum(), iterations=4).parameter_count == 3372

    def test_a_pair_entering_its_reach_feels_nothing_yet(self):
        scene = nowhere()
        model = network(scene)
        edge = model.reaches[0]

        def speed_after(distance: float) -> float:
            position = torch.tensor([[0.0, 0.0, 0.0], [distance, 0.0, 0.0]], dtype=torch.float64)
            state = FrameState(position, torch.zeros_like(position), torch.zeros_like(position))
            return model.double()(state, scene, 0.0).velocity.abs().max().item()

        assert speed_after(edge - 1e-9) < 1e-6 < speed_after(edge - 1e-3)

    def test_gravity_is_taken_back_as_far_as_the_nearest_contact_is_in_reach(self):
        scene = nowhere(gravity=True)
        model = network(scene).double()
        with torch.no_grad():
            model.output_weight.zero_()  # contacts answer nothing; the channels' biases alone take gravity back
            model.output_bias.zero_()
            model.stiffness.zero_()
        reach, width = (1e-3 * length for length in model.fades[PAIR])

        def lifted(gap: float) -> float:
            position = torch.tensor([[0.0, 0.0, 0.0], [0.05 + gap, 0.0, 0.0]], dtype=torch.float64)
            state = FrameState(position, torch.zeros_like(position), torch.zeros_like(position))
            return model(state, scene, 0.0).velocity[0, 2].item() + 9.81 * 0.01

        whole = lifted(0.0)
        assert abs(whole) > 1e-4
        assert lifted(reach - width) == pytest.approx(whole)
        assert lifted(reach - 0.25 * width) == pytest.approx(0.25 * whole)
        assert lifted(reach) == lifted(1.0) == pytest.approx(0.0, abs=1e-15)

    @pytest.mark.parametrize(
        ("choices", "named"),
        [
            ({"radius_m": 0.05}, "model.radius_m=0.05"),
            ({"velocity": "median"}, "model.velocity=median"),
            ({"backend": "cuda"}, "model.backend=cuda"),
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
        listed = find_contacts(scene, 1.5, position, 0.06, 0.01)
        assert np.array_equal(listed.pairs, tree_pairs(position, 0.06, scene.period))
        assert set(listed.wall) == set(range(len(scene.walls)))
        assert (np.diff(listed.keys) > 0).all()

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
        theta = scene.rotation.angle(1.6, 1.61)
        end = torch.tensor([[105.0, 20.0, 0.0], [-63.0, 0.0, -84.0]], dtype=torch.float64)
        contacts = find_contacts(scene, 1.6, 1e-3 * end.numpy(), 0.06, 0.01)
        displacement = end @ torch.tensor(contacts.walls.turn[0]).T
        spin = torch.tensor([[0.0, 25.0 * theta, 0.0]], dtype=torch.float64).expand(2, 3)
        seen = contact_groups(contacts, "cpu")[1].surfaces(end, displacement, spin, 50.0)
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
        walls = frame_walls(scene, 1.5)
        assert not walls.turn.any()
        assert not walls.shift.any()

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
    @pytest.mark.parametrize("room", ["drum", "every wall"])
    def test_derivatives_of_the_reference_are_right(self, choices, room):
        scene = furnished() if room == "every wall" else drum(count=8)
        model = network(scene, iterations=2, hidden=3, channels=2, **choices).double()
        bed = at_walls(scene, torch.float64) if room == "every wall" else cluster(scene, 8, 3, torch.float64)
        start = with_memory(model, scene, bed)
        names = list(dict(model.named_parameters()))

        def frame(position, velocity, spin, *weights):
            # In mm and mm per frame, so that one step of the finite differences suits all inputs.
            state = FrameState(1e-3 * position, 0.1 * velocity, 4.0 * spin, start.memory)
            after = torch.func.functional_call(model, dict(zip(names, weights, strict=True)), (state, scene, 1.51))
            return 1e3 * after.position, 10.0 * after.velocity, 0.25 * after.angular_velocity

        inputs = (1e3 * start.position, 10.0 * start.velocity, 0.25 * start.angular_velocity)
        leaves = [leaf.detach().requires_grad_() for leaf in (*inputs, *model.parameters())]
        assert torch.autograd.gradcheck(frame, leaves, eps=1e-7, atol=1e-5, fast_mode=True)
