"""The loop of a stretch, as one thread runs it over its chunks (jitted).

    kick and drift → meet → lists, where something moved far → forces → meet

Chunk c adds the loads of its pairs to rows of its own, ``force[c]`` and ``torque[c]``, for its particles and for those
of later chunks that its pairs reach. Before a kick the owner of a particle takes over what earlier chunks left there.
"""

from __future__ import annotations

import math

import numpy as np

from gran_bench.dem.barrier import meet
from gran_bench.dem.contact_blocks import BLOCK, BUFFER_SIZE, fill_law, fill_sizes, pair_forces
from gran_bench.dem.contact_list import (
    INNER_SHARE,
    closer,
    largest_displacement,
    list_contacts,
    touching_contacts,
)
from gran_bench.dem.kernel import kernel, never, places, quads
from gran_bench.dem.rows import kick_row, move_row, twist_row
from gran_bench.dem.wall_contacts import list_wall_contacts, wall_forces
from gran_bench.neighbors import bin_cells

# Edge of the cells that particles are sorted by, in diameters of the largest.
CELL_EDGE = 1.1
# What threads tell each other: places of a thread's row.
FASTEST, CULPRIT, SINCE_PRUNING, SINCE_SEARCH = range(4)


def run_chunks(
    thread, threads, gate, bounds, reach, told, position, linear, angular,
    order, sphere, velocity, spin, ahead, material, force, torque,
    first, second, known, pair_laws, wall_laws, walls, gravity, period, skin, dt, tangential, rolling, precision,
):  # fmt: skip
    """One thread's share of ``len(walls) − 1`` steps.

    Positions are wrapped only where the stretch ends, so that displacements stay true in between.

    Args:
        thread, threads: which of how many.
        gate: of barrier.py.
        bounds, reach: ``(C + 1,)`` first particle of each chunk; ``(C,)`` end of what its pairs touch.
        told: ``(threads, ≥ 4)`` what threads tell each other.
        position, linear, angular: ``(N, 3)`` position, velocity and spin at the end, written here.
        order: ``(N,)`` particle of each row.
        sphere, velocity, spin, ahead, material: rows in that order and two spare ones.
        force, torque: ``(C, N + 2, 4)`` zeros.
        first, second, known: ``(C,)``, ``(C,)``, ``(C, 7)`` contacts by particle.
        pair_laws, wall_laws: ``(S, S, 5)``, ``(S, W, 5)``.
        walls: ``(steps + 1, W, 21)`` poses.
        gravity, period, skin, dt: SI.
        tangential, rolling: what the scene needs.
        precision: an array whose dtype the contact laws are computed in.

    Returns:
        The row that diverged or −1, the completed steps, and this thread's touching contacts with their memory.
    """
    count, steps, inner = len(order), len(walls) - 1, INNER_SHARE * skin
    chunk, stop = thread * (len(bounds) - 1) // threads, (thread + 1) * (len(bounds) - 1) // threads
    begin, end = bounds[chunk], bounds[stop]
    rank = places(count)
    for row in range(count):
        rank[order[row]] = row
    first, second, known = first.copy(), second.copy(), known.copy()
    rename(first, second, known, rank)
    unequal, several = _sizes_differ(sphere, count), len(pair_laws) > 1
    buffer, wall_buffer = np.zeros(BUFFER_SIZE, precision.dtype), np.zeros(BUFFER_SIZE, precision.dtype)
    near_start = np.zeros(stop - chunk + 1, np.int64)
    for lane in range(BLOCK):
        fill_sizes(buffer, lane, sphere[0, 3], sphere[0, 3], 2.0 * velocity[0, 3])
        fill_law(buffer, lane, pair_laws[0, 0])

    # No lists yet: the first evaluation makes them.
    nobody, nothing = places(0), quads(0)
    pair_i, pair_j, start, everyone, near, active = nobody, nobody, nobody, nobody, nobody, nobody
    wall_i, wall_w, wall_active, wall_start = nobody, nobody, nobody, np.empty(0, np.int64)
    slot, moment, wall_slot, wall_moment, geometry = nothing, nothing, nothing, nothing, nothing
    searched_at, pruned_at, touched, wall_touched = nothing, nothing, never(0), never(0)
    culprit, done, travelled, since_search = np.int64(-1), 0, np.inf, np.inf
    fastest_allowed = (0.25 * _smallest_radius(sphere, count) / dt) ** 2
    # Evaluation 1 is of the state itself and loads no history. Number steps + 1 is the last of the stretch; after it
    # comes half a kick.
    for evaluation in range(1, steps + 3 if steps > 0 else 2):
        span = 0.0 if evaluation == 1 else dt
        if evaluation > 1:
            last = evaluation == steps + 2
            _take_over(force, torque, bounds, reach, chunk, stop, tangential)
            told[thread, FASTEST], told[thread, CULPRIT] = _kick(
                velocity, spin, ahead, force, torque, bounds, chunk, stop, gravity,
                0.5 * dt if evaluation == 2 or last else dt, 0.0 if last else 0.5 * dt, tangential, fastest_allowed,
            )  # fmt: skip
            drifts = not last and told[thread, CULPRIT] < 0.0
            if drifts:
                _drift(sphere, velocity, begin, end, dt)
            meet(gate, threads)
            fastest = 0.0
            for other in range(threads):
                fastest = max(fastest, told[other, FASTEST])
                if culprit < 0:
                    culprit = np.int64(told[other, CULPRIT])
            if culprit >= 0 and drifts:
                _drift(sphere, velocity, begin, end, -dt)
            if culprit >= 0 or last:
                break
            done += 1
            # The path of the fastest bounds all displacements at no cost; only when it leaves the reach of the
            # inner list is the true displacement looked at.
            travelled += dt * math.sqrt(fastest)
            if travelled > 0.5 * inner:
                told[thread, SINCE_PRUNING] = largest_displacement(sphere, pruned_at, begin, end)
                told[thread, SINCE_SEARCH] = largest_displacement(sphere, searched_at, begin, end)
                meet(gate, threads)
                travelled, since_search = 0.0, 0.0
                for other in range(threads):
                    travelled = max(travelled, told[other, SINCE_PRUNING])
                    since_search = max(since_search, told[other, SINCE_SEARCH])
        if travelled > 0.5 * inner:
            if since_search > 0.5 * (skin - inner):
                if evaluation > 1:
                    first, second, known = touching_contacts(
                        pair_i, pair_j, slot, moment, touched,
                        wall_i, wall_w, wall_slot, wall_moment, wall_touched, evaluation - 1,
                    )  # fmt: skip
                pair_i, pair_j, start, slot, moment, touched = list_contacts(
                    sphere, count, begin, end, skin, period, first, second, known, np.int64(evaluation - 1), rolling
                )
                wall_i, wall_w, wall_start, wall_slot, wall_moment, wall_touched = list_wall_contacts(
                    sphere, bounds, chunk, stop, walls, evaluation - 1, 0.5 * skin,
                    first, second, known, np.int64(evaluation - 1), rolling,
                )  # fmt: skip
                everyone, near, active = places(len(pair_i)), places(len(pair_i)), places(len(pair_i) + 4)
                for p in range(len(pair_i)):
                    everyone[p] = p
                wall_active, geometry = places(len(wall_i) + 4), quads(len(wall_i) + 4)
                searched_at, since_search = sphere[begin:end].copy(), 0.0
            found = 0
            for c in range(chunk, stop):
                low, high = start[bounds[c] - begin], start[bounds[c + 1] - begin]
                found += closer(sphere, pair_i, pair_j, everyone[low:high], inner, period, near[found:])
                near_start[c - chunk + 1] = found
                reach[c] = _end_of_reach(pair_j, near, near_start[c - chunk], found, bounds[c + 1])
            pruned_at, travelled = sphere[begin:end].copy(), 0.0
        for c in range(chunk, stop):
            pair_forces(
                sphere, velocity, spin, ahead, material, force[c], torque[c], pair_i, pair_j,
                near, near_start[c - chunk], near_start[c - chunk + 1], slot, moment, touched, evaluation,
                active, buffer, pair_laws, period, tangential, rolling, unequal, several, span,
            )  # fmt: skip
            wall_forces(
                sphere, velocity, spin, ahead, material, force[c], torque[c], wall_i, wall_w,
                wall_start[(c - chunk) * len(walls[0]) :], wall_slot, wall_moment, wall_touched, evaluation,
                wall_active, geometry, wall_buffer, wall_laws, walls[evaluation - 1], tangential, rolling, span,
            )  # fmt: skip
        meet(gate, threads)
    for row in range(begin, end):
        i = order[row]
        for k in range(3):
            position[i, k], linear[i, k], angular[i, k] = sphere[row, k], velocity[row, k], spin[row, k]
        if period > 0.0:
            position[i, 1] = _wrapped(position[i, 1], period)
    first, second, known = touching_contacts(
        pair_i, pair_j, slot, moment, touched, wall_i, wall_w, wall_slot, wall_moment, wall_touched, steps + 1
    )
    rename(first, second, known, order)
    return culprit, done, first, second, known


def bodies_in_order(position, velocity, spin, radius, material, density, period):
    """Particles cell by cell, slab after slab along the longest axis, and rows of four in that order.

    Two spare bodies that just touch follow, far away; they fill lanes that a block does not need.

    Returns:
        ``(N,)`` particle of each row; ``(N + 2, 4)`` rows (x, y, z, r), (v, 1/m), (ω, 1/I) and zeros; ``(N + 2,)``
        materials.
    """
    count = len(position)
    low, high, largest = position[0].copy(), position[0].copy(), 0.0
    for i in range(count):
        largest = max(largest, radius[i])
        for k in range(3):
            low[k], high[k] = min(low[k], position[i, k]), max(high[k], position[i, k])
    # Slabs across the longest axis meet in the fewest pairs. A periodic axis would make the first meet the last.
    axes = np.array([0, 1, 2])
    if high[0] - low[0] > high[2] - low[2]:
        axes[0], axes[2] = 2, 0
    if period == 0.0 and high[1] - low[1] > high[axes[2]] - low[axes[2]]:
        axes[1], axes[2] = axes[2], 1
    place = quads(count)
    for i in range(count):
        for k in range(3):
            place[i, k] = position[i, axes[k]]
    order = bin_cells(place, 2.0 * CELL_EDGE * largest, period)[0]
    sphere, rates, spins, ahead = quads(count + 2), quads(count + 2), quads(count + 2), quads(count + 2)
    ahead[:] = 0.0
    materials = np.zeros(count + 2, np.uint8)
    for row in range(count):
        i = order[row]
        mass = 4.0 / 3.0 * math.pi * density[material[i]] * radius[i] ** 3
        for k in range(3):
            sphere[row, k], rates[row, k], spins[row, k] = position[i, k], velocity[i, k], spin[i, k]
        sphere[row, 3], rates[row, 3], spins[row, 3] = radius[i], 1.0 / mass, 1.0 / (0.4 * mass * radius[i] ** 2)
        materials[row] = material[i]
    for spare in (count, count + 1):
        for k in range(4):
            sphere[spare, k], rates[spare, k], spins[spare, k] = sphere[0, k], 0.0, 0.0
        rates[spare, 3], spins[spare, 3] = rates[0, 3], spins[0, 3]
    sphere[count + 1, 0] += 2.0 * sphere[0, 3]
    return order, sphere, rates, spins, ahead, materials


@kernel
def rename(first, second, known, name):
    """Calls the particles of contacts ``name[i]`` instead of i, in place; the lower name first, walls as they are."""
    for c in range(len(first)):
        a, b = name[first[c]], second[c]
        if b >= 0:
            b = name[b]
            if b < a:
                a, b = b, a
                for k in (0, 1, 2, 4, 5, 6):
                    known[c, k] = -known[c, k]
        first[c], second[c] = a, b


@kernel
def _sizes_differ(sphere, count):
    different = 0
    for i in range(count):
        different += sphere[i, 3] != sphere[0, 3]
    return different > 0


@kernel
def _smallest_radius(sphere, count):
    smallest = np.inf
    for i in range(count):
        smallest = min(smallest, sphere[i, 3])
    return smallest


@kernel
def _end_of_reach(pair_j, near, begin, end, furthest):
    """One more than the last particle that these pairs touch, and at least ``furthest``."""
    for q in range(begin, end):
        furthest = max(furthest, np.int64(pair_j[near[q]]) + 1)
    return furthest


@kernel
def _take_over(force, torque, bounds, reach, chunk, stop, tangential):
    """Moves what earlier chunks left for the particles of ``chunk … stop − 1`` to the loads of their own chunk."""
    for c in range(chunk, stop):
        for earlier in range(c):
            for i in range(bounds[c], min(reach[earlier], bounds[c + 1])):
                move_row(force[earlier], force[c], i)
                if tangential:
                    move_row(torque[earlier], torque[c], i)


@kernel
def _kick(velocity, spin, ahead, force, torque, bounds, chunk, stop, gravity, dt, rest, tangential, fastest_allowed):
    """Velocities forward by dt, and in ``ahead`` what the same acceleration adds in the ``rest`` of the step.

    Returns the largest squared speed and the first row that is too fast or not finite.
    """
    fastest, culprit = 0.0, -1.0
    gx, gy, gz = gravity[0], gravity[1], gravity[2]
    for c in range(chunk, stop):
        for i in range(bounds[c], bounds[c + 1]):
            kick_row(velocity, force[c], i, gx, gy, gz, dt, ahead, rest)
            squared = velocity[i, 0] ** 2 + velocity[i, 1] ** 2 + velocity[i, 2] ** 2
            fastest = max(fastest, squared)
            if not squared <= fastest_allowed and culprit < 0.0:
                culprit = float(i)
        if tangential:
            for i in range(bounds[c], bounds[c + 1]):
                twist_row(spin, torque[c], i, dt)
    return fastest, culprit


@kernel
def _drift(sphere, velocity, begin, end, dt):
    for i in range(begin, end):
        sphere[i, 0] += dt * velocity[i, 0]
        sphere[i, 1] += dt * velocity[i, 1]
        sphere[i, 2] += dt * velocity[i, 2]


@kernel
def _wrapped(y, period):
    """y in [−L/2, L/2)."""
    if not -0.5 * period <= y < 0.5 * period:
        y -= period * math.floor(y / period + 0.5)
        if y >= 0.5 * period:
            y -= period
    return y
