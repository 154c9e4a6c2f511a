"""Contacts of spheres with walls: which are near, and what they do (jitted).

Walls are rows of a pose table (walls.py). Each contact of a block has the law of its own material and wall.
"""

from __future__ import annotations

import math

import numpy as np

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
from gran_bench.dem.contact_list import ROLLING_MOMENT
from gran_bench.dem.kernel import kernel, never, places, quads
from gran_bench.dem.rows import four_from, four_of, gather_rows, scatter_rows, scatter_sum
from gran_bench.dem.walls import ABSENT, CYLINDER, PATH, PLANE


@kernel
def shape_of(walls, w):
    """Kind, point, direction and sizes of wall w of ``(W, 21)`` poses, as a tuple that stays in registers."""
    return (
        walls[w, 0], walls[w, 1], walls[w, 2], walls[w, 3], walls[w, 4], walls[w, 5], walls[w, 6],
        walls[w, 7], walls[w, 8], walls[w, 9], walls[w, 10],
    )  # fmt: skip


@kernel
def toward_wall(shape, x, y, z):
    """Distance of a point from a wall, and the unit vector to it; the rules of :func:`walls.wall_contact`.

    Args:
        shape: of :func:`shape_of`.
        x, y, z: m.
    """
    kind, px, py, pz, ax, ay, az, r0, s0, r1, s1 = shape
    ox, oy, oz = x - px, y - py, z - pz
    along = ox * ax + oy * ay + oz * az
    if kind == PLANE:
        return along, -ax, -ay, -az
    if kind == ABSENT:
        return np.inf, 0.0, 0.0, 0.0
    ox, oy, oz = ox - along * ax, oy - along * ay, oz - along * az
    reach = math.sqrt(ox * ox + oy * oy + oz * oz)
    inverse = 1.0 / reach if reach > 0.0 else 0.0
    ox, oy, oz = ox * inverse, oy * inverse, oz * inverse
    if kind == CYLINDER:
        return r0 - reach, ox, oy, oz
    dr, ds = r1 - r0, s1 - s0
    share = ((reach - r0) * dr + (along - s0) * ds) / (dr * dr + ds * ds)
    share = min(1.0, max(0.0, share))
    across, up = r0 + share * dr - reach, s0 + share * ds - along
    distance = math.sqrt(across * across + up * up)
    if reach == 0.0:
        ox, oy, oz = _any_normal_to(ax, ay, az)
    inverse = 1.0 / distance if distance > 0.0 else 0.0
    across, up = across * inverse, up * inverse
    return distance, across * ox + up * ax, across * oy + up * ay, across * oz + up * az


@kernel
def _any_normal_to(ax, ay, az):
    """A unit vector across a unit vector; the one of :func:`walls.any_normal_to`."""
    if abs(ax) <= abs(ay) and abs(ax) <= abs(az):
        x, y, z = 0.0, az, -ay
    elif abs(ay) <= abs(az):
        x, y, z = -az, 0.0, ax
    else:
        x, y, z = ay, -ax, 0.0
    inverse = 1.0 / math.sqrt(x * x + y * y + z * z)
    return inverse * x, inverse * y, inverse * z


@kernel
def list_wall_contacts(
    sphere, bounds, chunk, stop, walls, row, margin, known_first, known_second, known, evaluation, rolling
):  # fmt: skip
    """Particles of ``chunk … stop − 1`` and walls that may touch in the rest of a stretch, with what they remember.

    Args:
        sphere: ``(N + 2, 4)`` x, y, z, r, m.
        bounds: ``(C + 1,)`` first particle of each chunk.
        chunk, stop: range of chunks.
        walls: ``(steps + 1, W, 21)`` poses.
        row: of the poses that belong to these positions.
        margin: m that no particle moves further than while the list lives.
        known_first, known_second, known, evaluation, rolling: as in :func:`contact_list.list_contacts`.

    Returns:
        ``(M + 1,)`` particle and wall, chunk by chunk, wall by wall; ``(chunks W + 1,)`` place of the first contact of
        each chunk and wall; ``(M + 1, 4)`` slots, ``(M + 1 or 1, 4)`` rolling moments and ``(M + 1,)`` number of the
        evaluation that last touched. The last place is spare: the spare body N at the first wall.
    """
    begin, end, count = bounds[chunk], bounds[stop], walls.shape[1]
    wall_i, wall_w = places((end - begin) * count + 1), places((end - begin) * count + 1)
    start = np.zeros((stop - chunk) * count + 1, np.int64)
    found = 0
    for c in range(chunk, stop):
        for w in range(count):
            shape, reach = shape_of(walls[row], w), margin
            for later in range(row + 1, len(walls)):
                reach += walls[later, w, PATH]
            for i in range(bounds[c], bounds[c + 1]):
                wall_i[found], wall_w[found] = i, w
                found += toward_wall(shape, sphere[i, 0], sphere[i, 1], sphere[i, 2])[0] - sphere[i, 3] < reach
            start[(c - chunk) * count + w + 1] = found
    wall_i, wall_w = wall_i[: found + 1].copy(), wall_w[: found + 1].copy()
    wall_i[found], wall_w[found] = len(sphere) - 2, 0
    slot, touched = quads(found + 1), never(found + 1)
    moment = quads(found + 1 if rolling else 1)
    moment[:] = 0.0
    # Known wall contacts of each particle as a chain.
    head, following = never(end - begin), never(len(known_first))
    for c in range(len(known_first)):
        i = known_first[c] - begin
        if 0 <= i < end - begin and known_second[c] < 0:
            following[c] = head[i]
            head[i] = c
    for p in range(found):
        c = head[wall_i[p] - begin]
        while c >= 0 and known_second[c] != -1 - np.int64(wall_w[p]):
            c = following[c]
        if c >= 0:
            for k in range(4):
                slot[p, k] = known[c, k]
            if rolling:
                for k in range(3):
                    moment[p, k] = known[c, ROLLING_MOMENT + k]
            touched[p] = evaluation
    return wall_i, wall_w, start, slot, moment, touched


@kernel
def wall_forces(
    sphere, velocity, spin, ahead, material, force, torque, wall_i, wall_w, start, slot, moment, touched,
    evaluation, active, geometry, buffer, laws, walls, tangential, rolling, dt,
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
            buffer[ARM_1 + k] = distance
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
