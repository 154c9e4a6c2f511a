"""Contacts of spheres with walls: what they do (jitted).

Walls are rows of a pose table (walls.py). Each contact of a block has the law of its own material and wall.
"""

from __future__ import annotations

from gran_bench.dem.contact_blocks import (
    AHEAD,
    ARM_1,
    AX,
    AY,
    AZ,
    BLOCK,
    DELTA,
    FORCE,
    GAIN,
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
    fill_law,
    forget,
    surface_spins,
)  # fmt: skip
from gran_bench.dem.kernel import kernel
from gran_bench.dem.rows import four_from, four_of, gather_rows, scatter_rows, scatter_sum
from gran_bench.dem.wall_list import shape_of, toward_wall


@kernel
def wall_forces(
    sphere, velocity, spin, ahead, material, force, torque, wall_i, wall_w, start, slot, moment, touched,
    evaluation, active, geometry, buffer, laws, walls, tangential, rolling, full_radius, dt,
):  # fmt: skip
    """Adds the forces and torques of the touching walls of a chunk and updates their slots.

    Args:
        wall_i, wall_w: ``(M + 1,)`` particle and wall of each contact in reach.
        start: ``(W + 1,)`` place of the chunk's first contact with each wall, and of the end of the last.
        active: ``(≥ M + 4,)`` scratch.
        geometry: ``(≥ M + 4, 4)`` scratch: direction and distance of the touching ones.
        laws: ``(S, W, 5)`` of each material with each wall.
        walls: ``(W, 21)`` poses of this evaluation.
        The others: as in :func:`contact_blocks.pair_forces`.
    """
    touching = 0
    for w in range(len(walls)):
        shape = shape_of(walls, w)
        for p in range(start[w], start[w + 1]):
            i = wall_i[p]
            distance, nx, ny, nz = toward_wall(shape, sphere[i, 0], sphere[i, 1], sphere[i, 2])
            geometry[touching, 0] = nx
            geometry[touching, 1] = ny
            geometry[touching, 2] = nz
            geometry[touching, 3] = distance
            active[touching] = p
            touching += distance < sphere[i, 3]
    for lane in range(touching, touching + 3):
        active[lane] = len(wall_i) - 1
    for first in range(0, touching, BLOCK):
        contacts = min(BLOCK, touching - first)
        size = (contacts + 3) // 4 * 4
        for k in range(0, size, 4):
            place = four_from(active, first + k)
            body = four_of(wall_i, place)
            gather_rows(buffer, OFFSET, k, geometry, (first + k, first + k + 1, first + k + 2, first + k + 3))
            gather_rows(buffer, VELOCITY, k, velocity, body)
            gather_rows(buffer, AHEAD, k, ahead, body)
            if tangential:
                gather_rows(buffer, SPIN_SUM, k, spin, body)
                gather_rows(buffer, SLOT, k, slot, place)
            if rolling:
                gather_rows(buffer, MOMENT, k, moment, place)
        for k in range(contacts):
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
            buffer[GAIN + k] = nx * buffer[AX + k] + ny * buffer[AY + k] + nz * buffer[AZ + k]
            fill_law(buffer, k, laws[material[i], w])
            if rolling:
                # What rolls on a turning wall rolls against the wall's own rotation.
                buffer[PX + k] = buffer[WX + k] - w0
                buffer[PY + k] = buffer[WY + k] - w1
                buffer[PZ + k] = buffer[WZ + k] - w2
            if touched[p] != evaluation - 1:
                forget(buffer, k, rolling)
            touched[p] = evaluation
        if tangential:
            surface_spins(buffer, size)
        contact_laws(buffer, size, tangential, rolling, False, dt)
        for k in range(0, size, 4):
            place = four_from(active, first + k)
            body = four_of(wall_i, place)
            scatter_sum(force, body, buffer, FORCE, k)
            if tangential:
                scatter_sum(torque, body, buffer, TORQUE, k)
            if rolling:
                scatter_sum(torque, body, buffer, MOMENT, k)
                scatter_rows(moment, place, buffer, MOMENT, k)
            scatter_rows(slot, place, buffer, SLOT, k)
