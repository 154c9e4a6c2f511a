"""The loop of a stretch, as one thread runs it over its chunks (jitted).

pruned list, where something moved far → forces → meet → kick and drift → meet

Chunk c adds the loads of its pairs to rows of its own, ``force[c]`` and ``torque[c]``, for its particles and for those
of later chunks that its pairs reach. Before a kick the owner of a particle takes over what earlier chunks left there.
"""

from __future__ import annotations

import math

import numpy as np

from gran_bench.dem.barrier import meet
from gran_bench.dem.contact_blocks import BLOCK, fill_law, fill_sizes, pair_forces
from gran_bench.dem.contact_list import INNER_SHARE, closer, largest_displacement
from gran_bench.dem.kernel import entry, kernel
from gran_bench.dem.rows import kick_row, move_row, twist_row
from gran_bench.dem.wall_contacts import wall_forces

# What threads tell each other: places of a thread's row.
FASTEST, CULPRIT, SINCE_PRUNING, SINCE_SEARCH = range(4)
# Places of a thread's progress.
EVALUATION, DONE = range(2)
# What the loop comes back with, beside a row that diverged.
FINISHED, SEARCH = -1, -2


@entry(nogil=True)
def march(
    thread, threads, gate, bounds, reach, told, progress, position, linear, angular,
    order, sphere, velocity, spin, ahead, material, force, torque,
    pair_i, pair_j, start, slot, moment, touched, wall_i, wall_w, wall_start, wall_slot, wall_moment, wall_touched,
    everyone, near, active, wall_active, geometry, searched_at, pruned_at, near_start, buffer, wall_buffer,
    pair_laws, wall_laws, walls, gravity, period, skin, dt, fastest_allowed, tangential, rolling, unequal, full_radius,
):  # fmt: skip
    """One thread's share of the steps from new lists to where the next ones are needed, or to the stretch's end.

    Evaluation 1 is of the state itself and loads no history. Number steps + 1 is the last of the stretch; after it
    comes half a kick. Positions are wrapped only where the stretch ends, so that displacements stay true in between.

    Args:
        thread, threads: which of how many.
        gate: of barrier.py.
        bounds, reach: ``(C + 1,)`` first particle of each chunk; ``(C,)`` end of what its pairs touch.
        told: ``(threads, ≥ 4)`` what threads tell each other.
        progress: ``(2,)`` number of the evaluation whose forces come next, and of the completed steps.
        position, linear, angular: ``(N, 3)`` position, velocity and spin at the end, written here.
        order: ``(N,)`` particle of each row.
        sphere, velocity, spin, ahead, material: rows in that order and two spare ones.
        force, torque: ``(C, N + 2, 4)`` zeros where the stretch begins.
        pair_i, …, wall_touched: of :func:`search.search`, from these positions.
        everyone, near, active: ``(≥ M,)``, ``(≥ M,)``, ``(≥ M + 4,)`` 0 … M − 1 for M pairs with the spare one, room.
        wall_active, geometry: ``(≥ M + 4,)``, ``(≥ M + 4, 4)`` room for M wall contacts.
        searched_at, pruned_at: ``(n, 4)`` rows of these positions, and room for others.
        near_start: ``(chunks + 1,)`` zeros.
        buffer, wall_buffer: ``(BUFFER_SIZE,)`` zeros of the dtype that the contact laws are computed in.
        pair_laws, wall_laws: ``(S, S, 5)``, ``(S, W, 5)``.
        walls: ``(steps + 1, W, 21)`` poses.
        gravity, period, skin, dt: SI.
        fastest_allowed: m²/s², beyond which a particle diverges.
        tangential, rolling: what the scene needs.
        unequal: whether sizes differ.
        full_radius: whether slip is measured with full radii.

    Returns:
        The row that diverged, ``FINISHED`` or ``SEARCH``.
    """
    steps, inner, several = len(walls) - 1, INNER_SHARE * skin, len(pair_laws) > 1
    chunk, stop = thread * (len(bounds) - 1) // threads, (thread + 1) * (len(bounds) - 1) // threads
    begin, end = bounds[chunk], bounds[stop]
    for lane in range(BLOCK):
        fill_sizes(buffer, lane, sphere[0, 3], sphere[0, 3], 2.0 * velocity[0, 3])
        fill_law(buffer, lane, pair_laws[0, 0])
    evaluation, culprit, travelled = progress[EVALUATION], np.int64(FINISHED), np.inf
    while True:
        if travelled > 0.5 * inner:
            found = 0
            for c in range(chunk, stop):
                low, high = start[bounds[c] - begin], start[bounds[c + 1] - begin]
                found += closer(sphere, pair_i, pair_j, everyone[low:high], inner, period, near[found:])
                near_start[c - chunk + 1] = found
                reach[c] = _end_of_reach(pair_j, near, near_start[c - chunk], found, bounds[c + 1])
            for i in range(begin, end):
                for k in range(3):
                    pruned_at[i - begin, k] = sphere[i, k]
            travelled = 0.0
        span = 0.0 if evaluation == 1 else dt
        for c in range(chunk, stop):
            pair_forces(
                sphere, velocity, spin, ahead, material, force[c], torque[c], pair_i, pair_j,
                near, near_start[c - chunk], near_start[c - chunk + 1], slot, moment, touched, evaluation,
                active, buffer, pair_laws, period, tangential, rolling, unequal, several, full_radius, span,
            )  # fmt: skip
            wall_forces(
                sphere, velocity, spin, ahead, material, force[c], torque[c], wall_i, wall_w,
                wall_start[(c - chunk) * len(walls[0]) :], wall_slot, wall_moment, wall_touched, evaluation,
                wall_active, geometry, wall_buffer, wall_laws, walls[evaluation - 1], tangential, rolling, full_radius,
                span,
            )  # fmt: skip
        meet(gate, threads)
        if steps == 0:
            break
        evaluation += 1
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
        progress[DONE] += 1
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
            if travelled > 0.5 * inner and since_search > 0.5 * (skin - inner):
                progress[EVALUATION] = evaluation
                return np.int64(SEARCH)
    for row in range(begin, end):
        i = order[row]
        for k in range(3):
            position[i, k], linear[i, k], angular[i, k] = sphere[row, k], velocity[row, k], spin[row, k]
        if period > 0.0:
            position[i, 1] = _wrapped(position[i, 1], period)
    return culprit


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
