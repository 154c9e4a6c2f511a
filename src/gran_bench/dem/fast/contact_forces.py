"""Forces of touching pairs and walls: blocks of contacts are gathered, computed in SIMD, and scattered (jitted)."""

import numpy as np

from gran_bench.dem.fast import contact_blocks as block
from gran_bench.dem.fast import rows
from gran_bench.dem.fast.contact_blocks import BLOCK, contact_laws, fill_law, pair_geometry, slip_spins, torques, watch
from gran_bench.dem.fast.energy_blocks import pair_losses, recall, wall_losses
from gran_bench.dem.fast.lists import overlapping
from gran_bench.dem.fast.wall_list import shape_of, toward_wall
from gran_bench.dem.rolling import CONTACT_INERTIA
from gran_bench.dem.seams import another_answers, hand_over
from gran_bench.neighbors.kernel import kernel


@kernel
def pair_forces(
    sphere, velocity, spin, ahead, material, force, torque, near_i, near_j, memory, begin, end, touched, remembered,
    active, contacts, old_slot, slot, old_moment, moment, buffer, laws, period, tangential, rolling, unequal, several,
    full_radius, dt, old_ledger, ledger, books, chunk,
):  # fmt: skip
    """Adds the forces and torques of the touching pairs among places ``begin … end − 1`` of an inner list.

    Bodies N and N + 1, and place 0 of the list, fill the lanes that a block does not need; row 0 of the old histories
    is zero, for pairs that remember nothing. Returns ``contacts`` and the number of touching pairs.

    Args:
        sphere, …, material; force, torque: of `Bodies`; ``(N + 2, 4)``, added to.
        near_i, near_j, memory: inner list; row of history of each of its pairs when it last touched, 0 for never.
        touched, remembered: place of the pair of each old row; end of the old rows.
        active, contacts: place of each touching pair, written from ``contacts`` ≥ 1 on, as rows of the new histories.
        old_slot, …, buffer: histories of the last evaluation and of this one, and scratch, as in `Lists`.
        laws, dt: ``(S, S, 5)`` (4/3 E*, 8 G*, α, μ, μ_r); s over which histories are loaded.
        tangential, …, full_radius: friction, rolling model, unequal sizes or masses, several materials, LAMMPS' slip.
        old_ledger, …, chunk: as old_slot and slot, what contacts have lost; `Books`, or None; their chunk.
    """
    found = overlapping(sphere, near_i, near_j, begin, end, period, active, contacts)
    for row in range(found, found + 3):
        active[row] = 0
    for first in range(contacts, found, BLOCK):
        filled = min(BLOCK, found - first)
        size = (filled + 3) // 4 * 4
        for k in range(0, size, 4):
            q = rows.four_from(active, first + k)
            i, j = rows.four_of(near_i, q), rows.four_of(near_j, q)
            old = rows.four_remembered(memory, q, touched, remembered)
            rows.gather_difference(buffer, block.OFFSET, k, sphere, j, i)
            rows.gather_difference(buffer, block.VELOCITY, k, velocity, i, j)
            rows.gather_difference(buffer, block.AHEAD, k, ahead, i, j)
            if books is not None:
                recall(books, k, old)
            if tangential:
                rows.gather_sum(buffer, block.SPIN_SUM, k, spin, i, j)
                rows.gather_rows(buffer, block.SLOT, k, old_slot, old)
            if rolling or unequal:
                rows.gather_difference(buffer, block.SPIN_DIFFERENCE, k, spin, i, j)
            if rolling:
                rows.gather_rows(buffer, block.MOMENT, k, old_moment, old)
        if unequal:
            for k in range(size):
                a, b = near_i[active[first + k]], near_j[active[first + k]]
                r1, r2, inverse_mass = sphere[a, 3], sphere[b, 3], velocity[a, 3] + velocity[b, 3]
                inertia = CONTACT_INERTIA / (velocity[a, 3] / (r1 * r1) + velocity[b, 3] / (r2 * r2))
                buffer[block.REACH + k], buffer[block.SKEW + k] = r1 + r2, (r1 - r2) * (r1 + r2)
                buffer[block.RS + k], buffer[block.INERTIA + k] = r1 * r2 / (r1 + r2), inertia
                buffer[block.MS + k], buffer[block.INVERSE_MS + k] = 1.0 / inverse_mass, inverse_mass
        if several:
            for k in range(size):
                a, b = near_i[active[first + k]], near_j[active[first + k]]
                fill_law(buffer, k, laws[material[a], material[b]])
        if period > 0.0:
            for k in range(size):
                buffer[block.NY + k] -= period * np.rint(buffer[block.NY + k] / period)
        pair_geometry(buffer, size)
        if tangential:
            slip_spins(buffer, size, unequal, full_radius)
        contact_laws(buffer, size, tangential, rolling, dt)
        watch(buffer, size, block.REACH, buffer.dtype.type(1.0), unequal)
        if books is not None:
            pair_losses(
                buffer, filled, first, sphere, near_i, near_j, active, old_slot, old_moment, old_ledger, ledger, books,
                chunk, tangential, rolling, unequal, full_radius, dt,
            )  # fmt: skip
        torques(buffer, size, unequal)
        for k in range(0, size, 4):
            q = rows.four_from(active, first + k)
            i, j = rows.four_of(near_i, q), rows.four_of(near_j, q)
            rows.scatter_opposite(force, i, j, buffer, block.FORCE, k)
            if tangential:
                second = block.TORQUE_2 if unequal else block.TORQUE
                rows.scatter_both(torque, i, j, buffer, block.TORQUE, second, k)
            if rolling:
                rows.scatter_opposite(torque, i, j, buffer, block.RESISTANCE, k)
                rows.scatter_rows(moment, rows.four_on(first + k), buffer, block.MOMENT, k)
            rows.scatter_rows(slot, rows.four_on(first + k), buffer, block.SLOT, k)
        for row in range(first, first + filled):
            memory[active[row]] = row
    return found


@kernel
def wall_forces(
    sphere, velocity, spin, ahead, material, force, torque, wall_i, wall_w, memory, start, touched, remembered, active,
    contacts, geometry, old_slot, slot, old_moment, moment, buffer, laws, walls, tangential, rolling, unequal, several,
    full_radius, dt, old_ledger, ledger, books, chunk,
):  # fmt: skip
    """As :func:`pair_forces` of the touching walls of a chunk, whose contacts with each wall begin at ``start``;
    ``geometry`` gets direction and distance of the touching ones.
    """
    found = contacts
    for w in range(len(walls)):
        shape, pieces = shape_of(walls, w), walls[w, 21] != 0.0
        for p in range(start[w], start[w + 1]):
            i = wall_i[p]
            x, y, z, r = sphere[i, 0], sphere[i, 1], sphere[i, 2], sphere[i, 3]
            distance, nx, ny, nz = toward_wall(shape, x, y, z)
            geometry[found, 0], geometry[found, 1], geometry[found, 2], geometry[found, 3] = nx, ny, nz, distance
            active[found] = p
            touches = distance < r
            if pieces and touches:
                touches = not another_answers(walls, w, x, y, z, r, distance, nx, ny, nz)
                row = memory[p]
                if touches and not (0 < row < remembered and touched[row] == p):
                    hand_over(walls, w, p, x, y, z, r, distance, wall_i, start, memory, touched, remembered)
            found += touches
    for row in range(found, found + 3):
        active[row] = 0
    for first in range(contacts, found, BLOCK):
        filled = min(BLOCK, found - first)
        size = (filled + 3) // 4 * 4
        for k in range(0, size, 4):
            place = rows.four_from(active, first + k)
            body, old = rows.four_of(wall_i, place), rows.four_remembered(memory, place, touched, remembered)
            rows.gather_rows(buffer, block.OFFSET, k, geometry, rows.four_on(first + k))
            rows.gather_rows(buffer, block.VELOCITY, k, velocity, body)
            rows.gather_rows(buffer, block.AHEAD, k, ahead, body)
            if books is not None:
                recall(books, k, old)
            if tangential:
                rows.gather_rows(buffer, block.SPIN_SUM, k, spin, body)
                rows.gather_rows(buffer, block.SLOT, k, old_slot, old)
            if rolling:
                rows.gather_rows(buffer, block.MOMENT, k, old_moment, old)
        for k in range(filled):
            p = active[first + k]
            i, w = wall_i[p], wall_w[p]
            r, inverse_mass, distance = sphere[i, 3], velocity[i, 3], geometry[first + k, 3]
            nx, ny, nz = buffer[block.NX + k], buffer[block.NY + k], buffer[block.NZ + k]
            # The wall's surface moves with v + ω × (x − c) at the contact point.
            cx = sphere[i, 0] + distance * nx - walls[w, 17]
            cy = sphere[i, 1] + distance * ny - walls[w, 18]
            cz = sphere[i, 2] + distance * nz - walls[w, 19]
            w0, w1, w2 = walls[w, 14], walls[w, 15], walls[w, 16]
            buffer[block.VX + k] -= walls[w, 11] + (w1 * cz - w2 * cy)
            buffer[block.VY + k] -= walls[w, 12] + (w2 * cx - w0 * cz)
            buffer[block.VZ + k] -= walls[w, 13] + (w0 * cy - w1 * cx)
            buffer[block.DELTA + k] = r - distance
            buffer[block.ARM_1 + k] = r if full_radius else distance
            if unequal:
                buffer[block.RS + k] = r
                buffer[block.MS + k], buffer[block.INVERSE_MS + k] = 1.0 / inverse_mass, inverse_mass
                buffer[block.INERTIA + k] = CONTACT_INERTIA * r * r / inverse_mass
            ax, ay, az = buffer[block.AX + k], buffer[block.AY + k], buffer[block.AZ + k]
            buffer[block.GAIN + k] = nx * ax + ny * ay + nz * az
            if several:
                fill_law(buffer, k, laws[material[i], w])
            if rolling:
                # What rolls on a turning wall rolls against the wall's own rotation.
                buffer[block.PX + k] = buffer[block.WX + k] - w0
                buffer[block.PY + k] = buffer[block.WY + k] - w1
                buffer[block.PZ + k] = buffer[block.WZ + k] - w2
            memory[p] = first + k
        if tangential:
            slip_spins(buffer, size, False, False)
        contact_laws(buffer, size, tangential, rolling, dt)
        watch(buffer, filled, block.RS, buffer.dtype.type(2.0), unequal)  # the lanes beyond hold nothing
        if books is not None:
            wall_losses(
                buffer, filled, first, sphere, wall_i, wall_w, active, geometry, walls, old_slot, old_moment,
                old_ledger, ledger, books, chunk, tangential, rolling, dt,
            )  # fmt: skip
        torques(buffer, size, False)
        for k in range(0, size, 4):
            body, new = rows.four_of(wall_i, rows.four_from(active, first + k)), rows.four_on(first + k)
            rows.scatter_sum(force, body, buffer, block.FORCE, k)
            if tangential:
                rows.scatter_sum(torque, body, buffer, block.TORQUE, k)
            if rolling:
                rows.scatter_sum(torque, body, buffer, block.RESISTANCE, k)
                rows.scatter_rows(moment, new, buffer, block.MOMENT, k)
            rows.scatter_rows(slot, new, buffer, block.SLOT, k)
    return found
