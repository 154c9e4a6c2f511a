"""Contacts of spheres with walls: what they do (jitted).

Walls are rows of a pose table (walls.py). Each contact of a block has the law of its own material and wall.
"""

from __future__ import annotations

from gran_bench.dem.fast.contact_blocks import (
    AHEAD,
    ARM_1,
    AX,
    AY,
    AZ,
    BLOCK,
    DELTA,
    FORCE,
    GAIN,
    INERTIA,
    INVERSE_MS,
    MOMENT,
    MS,
    NX,
    NY,
    NZ,
    OFFSET,
    PX,
    PY,
    PZ,
    RESISTANCE,
    RS,
    SLOT,
    SPIN_SUM,
    TORQUE,
    VELOCITY,
    VX,
    VY,
    VZ,
    WX,
    WY,
    WZ,
    contact_laws,
    contact_torques,
    fill_law,
    watch,
)  # fmt: skip
from gran_bench.dem.fast.rows import (
    four_from,
    four_of,
    four_on,
    four_remembered,
    gather_rows,
    scatter_rows,
    scatter_sum,
)
from gran_bench.dem.fast.wall_list import shape_of, toward_wall
from gran_bench.dem.rolling import CONTACT_INERTIA
from gran_bench.dem.seams import another_answers, hand_over
from gran_bench.neighbors.kernel import kernel


@kernel
def wall_forces(
    sphere, velocity, spin, ahead, material, force, torque, wall_i, wall_w, memory, start, touched, remembered, active,
    contacts, geometry, old_slot, slot, old_moment, moment, buffer, laws, walls, tangential, rolling, full_radius, dt,
):  # fmt: skip
    """Adds the forces and torques of the touching walls of a chunk.

    Args:
        wall_i, wall_w: particle and wall of each contact in reach; place 0 is spare.
        memory: row of history of each of them when it last touched, 0 for never.
        start: ``(W + 1,)`` place of the chunk's first contact with each wall, and of the end of the last.
        geometry: ``(≥ M + 4, 4)`` scratch: direction and distance of the touching ones.
        laws: ``(S, W, 5)`` of each material with each wall.
        walls: ``(W, 22)`` poses of this evaluation.
        The others: as in :func:`contact_blocks.pair_forces`.

    Returns:
        ``contacts`` and the number of touching walls.
    """
    found = contacts
    for w in range(len(walls)):
        shape, pieces = shape_of(walls, w), walls[w, 21] != 0.0
        for p in range(start[w], start[w + 1]):
            i = wall_i[p]
            distance, nx, ny, nz = toward_wall(shape, sphere[i, 0], sphere[i, 1], sphere[i, 2])
            geometry[found, 0] = nx
            geometry[found, 1] = ny
            geometry[found, 2] = nz
            geometry[found, 3] = distance
            active[found] = p
            touches = distance < sphere[i, 3]
            if pieces and touches:
                x, y, z, r = sphere[i, 0], sphere[i, 1], sphere[i, 2], sphere[i, 3]
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
            place = four_from(active, first + k)
            body, rows = four_of(wall_i, place), four_remembered(memory, place, touched, remembered)
            gather_rows(buffer, OFFSET, k, geometry, four_on(first + k))
            gather_rows(buffer, VELOCITY, k, velocity, body)
            gather_rows(buffer, AHEAD, k, ahead, body)
            if tangential:
                gather_rows(buffer, SPIN_SUM, k, spin, body)
                gather_rows(buffer, SLOT, k, old_slot, rows)
            if rolling:
                gather_rows(buffer, MOMENT, k, old_moment, rows)
        for k in range(filled):
            p = active[first + k]
            i, w = wall_i[p], wall_w[p]
            nx, ny, nz, distance = buffer[NX + k], buffer[NY + k], buffer[NZ + k], geometry[first + k, 3]
            # The wall's surface moves with v + ω × (x − c) at the contact point.
            cx = sphere[i, 0] + distance * nx - walls[w, 17]
            cy = sphere[i, 1] + distance * ny - walls[w, 18]
            cz = sphere[i, 2] + distance * nz - walls[w, 19]
            w0, w1, w2 = walls[w, 14], walls[w, 15], walls[w, 16]
            buffer[VX + k] -= walls[w, 11] + (w1 * cz - w2 * cy)
            buffer[VY + k] -= walls[w, 12] + (w2 * cx - w0 * cz)
            buffer[VZ + k] -= walls[w, 13] + (w0 * cy - w1 * cx)
            buffer[DELTA + k] = sphere[i, 3] - distance
            buffer[ARM_1 + k] = sphere[i, 3] if full_radius else distance
            buffer[RS + k] = sphere[i, 3]
            buffer[MS + k] = 1.0 / velocity[i, 3]
            buffer[INVERSE_MS + k] = velocity[i, 3]
            buffer[INERTIA + k] = CONTACT_INERTIA * sphere[i, 3] * sphere[i, 3] / velocity[i, 3]
            buffer[GAIN + k] = nx * buffer[AX + k] + ny * buffer[AY + k] + nz * buffer[AZ + k]
            fill_law(buffer, k, laws[material[i], w])
            if rolling:
                # What rolls on a turning wall rolls against the wall's own rotation.
                buffer[PX + k] = buffer[WX + k] - w0
                buffer[PY + k] = buffer[WY + k] - w1
                buffer[PZ + k] = buffer[WZ + k] - w2
            memory[p] = first + k
        for k in range(size if tangential else 0):
            arm = buffer[ARM_1 + k]
            buffer[WX + k] *= arm
            buffer[WY + k] *= arm
            buffer[WZ + k] *= arm
        contact_laws(buffer, size, tangential, rolling, dt)
        watch(buffer, filled, RS, buffer.dtype.type(2.0))  # the lanes beyond hold nothing
        contact_torques(buffer, size)
        for k in range(0, size, 4):
            body, rows = four_of(wall_i, four_from(active, first + k)), four_on(first + k)
            scatter_sum(force, body, buffer, FORCE, k)
            if tangential:
                scatter_sum(torque, body, buffer, TORQUE, k)
            if rolling:
                scatter_sum(torque, body, buffer, RESISTANCE, k)
                scatter_rows(moment, rows, buffer, MOMENT, k)
            scatter_rows(slot, rows, buffer, SLOT, k)
    return found
