"""The contact network's memory: springs that gather slip, turn with their contacts and go from frame to frame."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from contact_beds import DIAMETER, cluster, drum, network, nowhere, with_memory

from gran_bench.config import ContactModelConfig
from gran_bench.scene import Disc, Spin, Translation
from gran_bench.shipped import shipped_scene
from gran_bench.surrogate.contact.constants import SPRING_CAP
from gran_bench.surrogate.contact.memory import ContactMemory, follow_memory
from gran_bench.surrogate.contact.network import ContactNetwork
from gran_bench.surrogate.step import FrameState
from gran_bench.surrogate.walls import frame_walls


def warm_memory(*stored) -> ContactMemory:
    """The memory at the last of stored frames."""
    return list(follow_memory(*stored))[-1]


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
        assert state.memory is None
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

    def test_a_sphere_carried_by_any_moving_wall_gathers_nothing(self):
        # A tilted disc that turns end over end about a point of its own, and one that is pushed along itself.
        turning = Disc((0.0, 0.0, 0.0), (0.6, 0.0, 0.8), 0.3, motion=Spin((0.0,), (30.0,), center=(0.1, 0.0, 0.2)))
        pushed = Disc((0.0, 0.0, 0.0), (0.6, 0.0, 0.8), 0.3, motion=Translation((0.0,), ((0.08, 0.0, -0.06),)))
        for wall, slides in ((turning, False), (pushed, False), (replace(pushed, motion=None), True)):
            scene = replace(nowhere(), walls=(wall,))
            moves = frame_walls(scene, 0.0)
            start = np.array([0.05, 0.02, 0.0]) - 0.05 * 0.6 * np.array([0.6, 0.0, 0.8])
            start = start + 0.0248 * np.array([0.6, 0.0, 0.8])  # 0.2 mm into it
            rate = np.array([0.0, math.pi, 0.0]) if wall is turning else np.zeros(3)
            if wall is turning:  # the frame's inverse: c is where x goes, x = c − M c − t
                end = np.linalg.solve(np.eye(3) - moves.turn[0], start + moves.shift[0])
            else:
                end = start + np.array([0.0008, 0.0, -0.0006])
            spins = np.tile(rate, (2, 1, 1))
            held = warm_memory(scene, [0.0, 0.01], np.array([[start], [end]]), spins)
            assert len(held.keys) == 1
            assert (np.linalg.norm(held.spring) > 0.05) == slides

    def test_a_memory_follows_its_particles_under_other_numbers(self):
        scene = drum()
        model = network(scene, memory=True)
        memory = with_memory(model, scene, cluster(scene, 60)).memory
        inside = np.arange(60) % 4 != 0
        numbers = np.where(inside, np.cumsum(inside) - 1, -1)
        part = memory.renumbered(numbers, inside.sum())
        assert 0 < len(part.keys) < len(memory.keys)
        assert (np.diff(part.keys) > 0).all()
        back = part.renumbered(np.flatnonzero(inside), 60)
        kept = np.isin(memory.keys, back.keys)
        assert np.array_equal(memory.keys[kept], back.keys)
        assert np.array_equal(memory.spring[kept], back.spring)
        of_pair = memory.keys < 60 * 60
        first, second = np.divmod(memory.keys, 60)
        assert np.array_equal(kept, inside[second] & (~of_pair | inside[np.where(of_pair, first, 0)]))

    def test_every_wall_of_a_hopper_is_its_own_mirror_image_and_a_drum_swaps_its_caps(self):
        hopper, small = shipped_scene("hopper"), drum()
        for scene, images in ((hopper, [0, 1, 2]), (small, [0, 2, 1])):
            keys = np.arange(3) * 1 + 1
            memory = ContactMemory(keys, np.eye(3, dtype=np.float32))
            found = memory.mirrored(scene, 1)
            assert np.array_equal(found.spring, np.eye(3, dtype=np.float32)[images] * np.float32([1, -1, 1]))
        lopsided = replace(hopper, walls=(Disc((0.0, 0.0, 0.0), (0.0, 0.6, 0.8), 0.1, turns=False),))
        with pytest.raises(ValueError, match=r"no mirror image; switch rollout\.mirror off"):
            ContactMemory.empty().mirrored(lopsided, 1)

    def test_springs_change_the_motion(self):
        scene = drum()
        model = network(scene, memory=True)
        state = with_memory(model, scene, cluster(scene, 60))
        bare = FrameState(state.position, state.velocity, state.angular_velocity, ContactMemory.empty())
        assert not torch.allclose(model(state, scene, 1.5).velocity, model(bare, scene, 1.5).velocity, atol=1e-4)
