"""The loop of a stretch, as one thread runs it over its chunks (jitted).

pruned list, where something moved far → forces → meet → kick and drift → meet

It pauses between forces and kick, so a pause changes nothing. Chunk c adds the loads of its pairs to rows of its own,
``force[c]`` and ``torque[c]``; before a kick the owner of a particle takes over what earlier chunks left there.
"""

import math

import numpy as np

from gran_bench.dem.fast import lists
from gran_bench.dem.fast.barrier import meet
from gran_bench.dem.fast.contact_forces import pair_forces, wall_forces
from gran_bench.dem.fast.energy_blocks import AHEAD, PAIR, WALL, close_contacts
from gran_bench.dem.fast.rows import drift_row, kick_row, move_row, twist_row, twist_row_ahead
from gran_bench.neighbors.kernel import entry, kernel

# What threads tell each other. The last are a thread's own: how far the fastest went, in margins, since its inner list
# was made, infinite where its lists are new; how far the inner list reaches; and how far the fastest went in a step.
PACE, CULPRIT, SINCE_PRUNING, SINCE_SEARCH, TRAVELLED, SHARE, STRIDE = range(7)
# A thread's progress: the steps that the positions are at, at which to pause, of the first pose, whether the
# forces are still to come, whether the velocities are of a whole step, and one more than the pairs and the walls that
# the last evaluation found touching.
STEP, PAUSE, FIRST_POSE, DUE, WHOLE, PAIRS, WALLS = range(7)
# What the loop comes back with, beside a row that diverged.
PAUSED, SEARCH = -1, -2


@entry
def march(
    thread, threads, gate, bounds, reach, told, progress, sphere, velocity, spin, ahead, material, force, torque,
    pair_i, pair_j, start, memory, slot, moment, wall_i, wall_w, wall_memory, wall_start, wall_slot, wall_moment,
    margin, inverse_square, searched_at, pruned_at, inner_list, touching, wall_touching, geometry, near_start,
    buffer, wall_buffer, ledger, wall_ledger, pair_laws, wall_laws, walls, gravity, period, dt, fastest_allowed,
    tangential, rolling, unequal, several, full_radius, books,
):  # fmt: skip
    """One thread's share of the steps, until the next lists are needed or it is to pause.

    Evaluation k is of the positions after step k. Number 0 is of the state itself and loads no history. Histories come
    twice: an evaluation reads the one of the last and writes the other. Returns the row that diverged, or see above.

    Args:
        bounds, reach: ``(C + 1,)`` first particle of each chunk; ``(C,)`` end of what its pairs touch.
        told, progress: ``(threads, ≥ 7)`` and ``(7,)``, see above.
        sphere, …, material; pair_i, …, wall_ledger: of `Bodies`, which hold the state at the end; of `Lists`.
        force, torque: ``(C, N + 2, 4)`` zeros where forces are due; else a chunk's rows hold those of its particles.
        walls, fastest_allowed: ``(≥ steps + 1, W, 22)`` poses; m²/s², beyond which a particle diverges.
        tangential, …, full_radius: what is needed, as in :func:`contact_forces.pair_forces`.
        books: what a thread counts of energy, `Books`; None where nobody asks.
    """
    chunk, stop = thread * (len(bounds) - 1) // threads, (thread + 1) * (len(bounds) - 1) // threads
    begin, end = bounds[chunk], bounds[stop]
    near_i, near_j, near_memory = inner_list[lists.NEAR_I], inner_list[lists.NEAR_J], inner_list[lists.NEAR_MEMORY]
    step, travelled, left = progress[STEP], told[thread, TRAVELLED], 1.0
    share, stride = told[thread, SHARE], told[thread, STRIDE]
    remembered, walls_remembered = progress[PAIRS], progress[WALLS]
    # New lists know themselves which row is whose; places in the inner list were of the last ones.
    pairs = np.int64(1) if travelled == np.inf else progress[PAIRS]
    while True:
        if progress[DUE]:
            old, new = (step - 1) % 2, step % 2
            if travelled > share:
                # Only before an evaluation: what the outer list knows of histories lasts for one inner list.
                share = min(left, max(lists.INNER_SHARE, lists.INNER_STEPS * stride))
                _prune_chunks(
                    sphere, margin, share, pruned_at, bounds, reach, chunk, stop, start, pair_i, pair_j, memory,
                    inner_list, near_start, touching[old], pairs, period,
                )  # fmt: skip
                travelled = 0.0
            span = 0.0 if step == 0 else dt
            pairs, wall_contacts = np.int64(1), np.int64(1)
            for c in range(chunk, stop):
                pairs = pair_forces(
                    sphere, velocity, spin, ahead, material, force[c], torque[c], near_i, near_j, near_memory,
                    near_start[c - chunk], near_start[c - chunk + 1], touching[old], remembered, touching[new], pairs,
                    slot[old], slot[new], moment[old], moment[new],
                    buffer, pair_laws, period, tangential, rolling, unequal, several, full_radius, span,
                    ledger[old], ledger[new], books, c,
                )  # fmt: skip
                wall_contacts = wall_forces(
                    sphere, velocity, spin, ahead, material, force[c], torque[c], wall_i, wall_w, wall_memory,
                    wall_start[(c - chunk) * len(walls[0]) :], wall_touching[old], walls_remembered,
                    wall_touching[new], wall_contacts, geometry,
                    wall_slot[old], wall_slot[new], wall_moment[old], wall_moment[new],
                    wall_buffer, wall_laws, walls[step - progress[FIRST_POSE]], tangential, rolling, unequal, several,
                    full_radius, span, wall_ledger[old], wall_ledger[new], books, c,
                )  # fmt: skip
            if books is not None and span > 0.0:
                close_contacts(ledger[old], remembered, bounds, chunk, stop, books, PAIR)
                close_contacts(wall_ledger[old], walls_remembered, bounds, chunk, stop, books, WALL)
            remembered, walls_remembered = pairs, wall_contacts
            progress[PAIRS], progress[WALLS], progress[DUE] = pairs, wall_contacts, 0
            meet(gate, threads)
            _take_over(force, torque, bounds, reach, chunk, stop, tangential)
        if step == progress[PAUSE]:
            told[thread, TRAVELLED], told[thread, SHARE], told[thread, STRIDE] = travelled, share, stride
            return np.int64(PAUSED)
        told[thread, PACE], told[thread, CULPRIT] = kick(
            velocity, spin, ahead, force, torque, inverse_square, bounds, chunk, stop, gravity,
            0.0 if progress[WHOLE] else 0.5 * dt, 0.5 * dt, tangential, fastest_allowed, books,
        )  # fmt: skip
        progress[WHOLE] = 0
        drifts = told[thread, CULPRIT] < 0.0
        if drifts:
            _drift(sphere, velocity, begin, end, dt)
        meet(gate, threads)
        pace, culprit = 0.0, np.int64(PAUSED)
        for other in range(threads):
            pace = max(pace, told[other, PACE])
            if culprit < 0:
                culprit = np.int64(told[other, CULPRIT])
        if culprit >= 0:
            if drifts:
                _drift(sphere, velocity, begin, end, -dt)
            return culprit
        step += 1
        progress[STEP], progress[DUE] = step, 1
        # The path of whoever is fastest for its margin bounds all displacements at no cost; only when it leaves the
        # reach of the inner list are the true displacements looked at.
        stride = dt * math.sqrt(pace)
        travelled += stride
        if travelled > share:
            told[thread, SINCE_PRUNING] = travelled
            if travelled < np.inf:
                told[thread, SINCE_PRUNING] = lists.largest_displacement(sphere, pruned_at, inverse_square, begin, end)
            told[thread, SINCE_SEARCH] = lists.largest_displacement(sphere, searched_at, inverse_square, begin, end)
            meet(gate, threads)
            travelled, left = 0.0, 1.0
            for other in range(threads):
                travelled = max(travelled, told[other, SINCE_PRUNING])
                left = min(left, 1.0 - told[other, SINCE_SEARCH])
            if travelled > share and left < max(lists.LEAST_SHARE, 2.0 * stride):
                told[thread, SHARE], told[thread, STRIDE] = share, stride
                return np.int64(SEARCH)


@kernel
def _prune_chunks(
    sphere, margin, share, pruned_at, bounds, reach, chunk, stop, start, pair_i, pair_j, memory, inner_list, near_start,
    touched, rows, period,
):  # fmt: skip
    """Makes the inner list of chunks anew; ``touched``, whose rows end at ``rows``, has its places before and after."""
    begin = bounds[chunk]
    near, near_i, near_j = inner_list[lists.NEAR], inner_list[lists.NEAR_I], inner_list[lists.NEAR_J]
    near_memory = inner_list[lists.NEAR_MEMORY]
    # The outer list knows the rows of history only while the inner one is made.
    for row in range(1, rows):
        memory[near[touched[row]]] = row
    for i in range(begin, len(margin)):
        for k in range(3):
            pruned_at[i, k] = sphere[i, k]
        pruned_at[i, 3] = sphere[i, 3] + share * margin[i]
    for c in range(chunk, stop):
        low, high = np.int64(start[bounds[c] - begin]), np.int64(start[bounds[c + 1] - begin])
        first, furthest = near_start[c - chunk], bounds[c + 1]
        last = lists.overlapping(pruned_at, pair_i, pair_j, low, high, period, near, first)
        for q in range(first, last):
            p = near[q]
            near_i[q], near_j[q], near_memory[q] = pair_i[p], pair_j[p], memory[p]
            furthest = max(furthest, np.int64(pair_j[p]) + 1)
        near_start[c - chunk + 1], reach[c] = last, furthest
    for q in range(1, near_start[stop - chunk]):
        touched[near_memory[q]] = q
    memory[: np.int64(start[bounds[stop] - begin])] = 0  # also of pairs that touched and are out of reach: they forget


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
def kick(
    velocity, spin, ahead, force, torque, inverse_square, bounds, chunk, stop, gravity, closing, opening, tangential,
    fastest_allowed, books,
):  # fmt: skip
    """Velocities forward by what is left of a step and, in a kick of its own, by what opens the next: ``ahead``.

    Returns the largest squared speed in margins, 1/s², and the first row that is too fast or not finite.
    """
    pace, culprit = 0.0, -1.0
    gx, gy, gz = gravity[0], gravity[1], gravity[2]
    for c in range(chunk, stop):
        for i in range(bounds[c], bounds[c + 1]):
            kick_row(velocity, force[c], i, gx, gy, gz, closing, ahead, opening)
            squared = velocity[i, 0] ** 2 + velocity[i, 1] ** 2 + velocity[i, 2] ** 2
            pace = max(pace, squared * inverse_square[i])
            if not squared <= fastest_allowed and culprit < 0.0:
                culprit = float(i)
        if tangential:
            for i in range(bounds[c], bounds[c + 1]):
                if books is None:
                    twist_row(spin, torque[c], i, closing, opening)
                else:
                    twist_row_ahead(spin, torque[c], i, closing, books[AHEAD], opening)
    return pace, culprit


@kernel
def _drift(sphere, velocity, begin, end, dt):
    for i in range(begin, end):
        drift_row(sphere, velocity, i, dt)
