"""The contact network's lists: the same pairs however old a list is, and no more memory than the contacts need."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
import torch
from contact_beds import DIAMETER, cluster, drum, furnished, network, nowhere, with_memory

from gran_bench.config import ContactModelConfig
from gran_bench.dem.walls import wall_contact
from gran_bench.neighbors import tree_pairs
from gran_bench.surrogate.contact.constants import SKIN
from gran_bench.surrogate.contact.geometry import find_contacts
from gran_bench.surrogate.contact.network import ContactNetwork
from gran_bench.surrogate.step import FrameState, wrap
from gran_bench.surrogate.walls import frame_walls

REACH, WALL_REACH = 1.2 * DIAMETER, 0.01


@pytest.mark.parametrize("periodic", [False, True])
def test_a_list_of_any_age_gives_the_pairs_of_a_tree_in_their_order(periodic):
    scene, rng = drum(periodic=periodic), np.random.default_rng(3)
    now, drift, known, lives = cluster(scene, 60).position.numpy(), rng.normal(0.0, 1.0, (60, 3)), None, []
    for _ in range(40):
        before, now = now, now + 0.02 * SKIN * DIAMETER * drift + rng.normal(0.0, 1e-4, now.shape)
        now = wrap(torch.tensor(now), scene.period).numpy()
        listed = find_contacts(scene, 1.5, now, REACH, WALL_REACH, before, known)
        assert np.array_equal(listed.pairs, tree_pairs(now, REACH, scene.period))
        lives.append(1 if listed.near is not known else lives.pop() + 1)
        known = listed.near
    assert len(lives) > 2  # it was made anew
    assert max(lives) > 4  # and lived on


def test_where_spheres_are_fast_no_longer_list_is_made():
    scene = drum()
    now = cluster(scene, 60).position.numpy()
    slow, fast = (find_contacts(scene, 1.5, now, REACH, 0.01, now - step) for step in (0.0, 0.3 * SKIN * DIAMETER))
    assert fast.near.reach == pytest.approx(REACH)
    assert slow.near.reach == pytest.approx(REACH + SKIN * DIAMETER)
    assert np.array_equal(slow.pairs, fast.pairs)


def test_who_is_near_a_wall_is_what_the_walls_say():
    scene = replace(furnished(), walls=furnished().walls[:6])
    position = np.random.default_rng(2).uniform(-0.5, 0.5, (500, 3))
    listed, shapes = find_contacts(scene, 1.5, position, REACH, WALL_REACH), frame_walls(scene, 1.5).after
    near = [np.flatnonzero(wall_contact(shape, position)[0] < 0.5 * DIAMETER + WALL_REACH) for shape in shapes]
    assert np.array_equal(listed.wall_particle, np.concatenate(near))
    assert np.array_equal(listed.wall, np.repeat(np.arange(len(near)), [len(n) for n in near]))


@pytest.mark.parametrize("backend", ["fused", "torch"])
def test_a_rollout_that_keeps_its_lists_has_the_bits_of_one_that_does_not(backend):
    scene = nowhere()
    model = network(scene, backend=backend, memory=True)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter *= 0.1  # slow enough for a list to live
        state = with_memory(model, scene, cluster(scene, 60))
        kept = fresh = FrameState(state.position, 0.1 * state.velocity, state.angular_velocity, state.memory)
        shared = 0
        for k in range(6):
            near, kept = kept.near, model(kept, scene, 0.01 * k)
            fresh = model(replace(fresh, near=None), scene, 0.01 * k)
            shared += kept.near is near
            assert torch.equal(kept.position, fresh.position)
            assert np.array_equal(kept.memory.spring, fresh.memory.spring)
    assert shared > 2


def test_particles_under_other_numbers_move_the_same():
    scene = drum()
    model = network(scene, backend="fused", memory=True, velocity="instantaneous")
    state, order = with_memory(model, scene, cluster(scene, 60)), torch.randperm(60, generator=torch.manual_seed(1))
    memory = state.memory
    # A pair's first particle is the one with the lower number: springs of pairs that change sides turn round.
    bare = FrameState(state.position, state.velocity, state.angular_velocity)
    with torch.no_grad():
        after = model(bare, scene, 1.5)
        other = model(bare.of_each(lambda values: values[order]), scene, 1.5)
    assert len(memory.keys) > 0
    assert torch.allclose(after.position[order], other.position, atol=2e-8)
    assert torch.allclose(after.velocity[order], other.velocity, atol=2e-6)
    assert torch.allclose(after.angular_velocity[order], other.angular_velocity, atol=2e-4)


def test_a_frame_of_many_spheres_needs_memory_for_its_contacts_alone():
    scene, edge = nowhere(gravity=True), 30
    sites = np.stack(np.meshgrid(*[np.arange(edge)] * 3, indexing="ij"), -1).reshape(-1, 3)
    position = torch.tensor(sites * 1.02 * DIAMETER, dtype=torch.float32)
    model = ContactNetwork(ContactModelConfig(memory=True), scene)
    state = model.begin(scene, position, torch.zeros_like(position), torch.zeros_like(position))
    with torch.no_grad():
        model(state, scene, 0.0)  # compiled
        tracemalloc.start()
        model(state, scene, 0.0)
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
    assert peak < 1500 * len(position)  # bytes; three contacts a sphere
