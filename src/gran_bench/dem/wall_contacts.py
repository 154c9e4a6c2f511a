"""Contacts of spheres with walls: which are near, and what they do (jitted).

Walls are rows of a pose table (walls.py). A block of contacts is of one material and one wall, so that one law holds.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from gran_bench.dem.contact_blocks import (
    BEFORE, BLOCK, DELTA, FX, FY, FZ, GAIN, HX, HY, HZ, INVERSE_MS, MS, MX, NX, NY, NZ, PX, PY, PZ,
    RS, TX, TY, TZ, VX, VY, VZ, WX, WY, WZ,
    contact_law, fill_law, rolling_law,
)  # fmt: skip
from gran_bench.dem.contact_list import ROLLING_MOMENT
from gran_bench.dem.walls import ABSENT, CYLINDER, PATH, PLANE


@njit(error_model="numpy")
def toward_wall(walls, w, x, y, z):
    """Distance of a point from wall w, and the unit vector to it; the rules of :func:`walls.wall_contact`.

    Args:
        walls: ``(W, 21)`` poses.
        w: which wall.
        x, y, z: m.
    """
    kind = walls[w, 0]
    if kind == ABSENT:
        return np.inf, 0.0, 0.0, 0.0
    ox, oy, oz = x - walls[w, 1], y - walls[w, 2], z - walls[w, 3]
    ax, ay, az = walls[w, 4], walls[w, 5], walls[w, 6]
    along = ox * ax + oy * ay + oz * az
    if kind == PLANE:
        return along, -ax, -ay, -az
    ox, oy, oz = ox - along * ax, oy - along * ay, oz - along * az
    reach = math.sqrt(ox * ox + oy * oy + oz * oz)
    inverse = 1.0 / reach if reach > 0.0 else 0.0
    ox, oy, oz = ox * inverse, oy * inverse, oz * inverse
    if kind == CYLINDER:
        return walls[w, 7] - reach, ox, oy, oz
    r0, s0 = walls[w, 7], walls[w, 8]
    dr, ds = walls[w, 9] - r0, walls[w, 10] - s0
    share = ((reach - r0) * dr + (along - s0) * ds) / (dr * dr + ds * ds)
    share = min(1.0, max(0.0, share))
    across, up = r0 + share * dr - reach, s0 + share * ds - along
    distance = math.sqrt(across * across + up * up)
    if reach == 0.0:
        ox, oy, oz = _any_normal_to(ax, ay, az)
    inverse = 1.0 / distance if distance > 0.0 else 0.0
    across, up = across * inverse, up * inverse
    return distance, across * ox + up * ax, across * oy + up * ay, across * oz + up * az


@njit(error_model="numpy")
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


@njit(error_model="numpy")
def list_wall_contacts(
    sphere, material, begin, end, kinds, walls, row, margin, known_first, known_second, known, evaluation, rolling
):  # fmt: skip
    """Particles ``begin … end − 1`` and walls that may touch in the rest of a stretch, with what they remember.

    Args:
        sphere, material: ``(N + 2, 4)`` x, y, z, r, m; ``(N + 2,)`` index.
        begin, end: range of particles.
        kinds: S, how many materials there are.
        walls: ``(steps + 1, W, 21)`` poses.
        row: of the poses that belong to these positions.
        margin: m that no particle moves further than while the list lives.
        known_first, known_second, known, evaluation, rolling: as in :func:`contact_list.list_contacts`.

    Returns:
        ``(M + 1,)`` particle and wall, wall by wall, material by material; ``(M + 1, 4)`` slots, ``(M + 1 or 1, 4)``
        rolling moments and ``(M + 1,)`` number of the evaluation that last touched. The last place is spare.
    """
    count = walls.shape[1]
    room = (end - begin) * count + 1
    wall_i, wall_w = np.empty(room, np.uint32), np.empty(room, np.uint32)
    found = 0
    for w in range(count):
        reach = margin
        for later in range(row + 1, len(walls)):
            reach += walls[later, w, PATH]
        for kind in range(kinds):
            for i in range(begin, end):
                distance = toward_wall(walls[row], w, sphere[i, 0], sphere[i, 1], sphere[i, 2])[0]
                wall_i[found], wall_w[found] = i, w
                found += distance - sphere[i, 3] < reach and material[i] == kind
    wall_i, wall_w = wall_i[: found + 1].copy(), wall_w[: found + 1].copy()
    slot, touched = np.zeros((found + 1, 4)), np.full(found + 1, -1, np.int32)
    moment = np.zeros((found + 1 if rolling else 1, 4))
    # Known wall contacts of each particle as a chain.
    head, following = np.full(end - begin, -1, np.int32), np.empty(len(known_first), np.int32)
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
    return wall_i, wall_w, slot, moment, touched


@njit(error_model="numpy")
def wall_forces(
    sphere, velocity, spin, ahead, material, force, torque, bounds, chunk, wall_i, wall_w, slot, moment, touched,
    evaluation, active, geometry, buffer, laws, walls, tangential, rolling, dt,
):  # fmt: skip
    """Adds the forces and torques of all touching walls and updates their slots.

    Args:
        force, torque: ``(C, N + 2, 4)`` of all chunks; a particle's load goes to its own.
        bounds, chunk: first particle of each chunk; the first chunk of this thread.
        wall_i, wall_w: ``(M + 1,)`` particle and wall of each contact in reach, wall by wall, material by material.
        active: ``(≥ M + 1,)`` scratch.
        geometry: ``(≥ M + 1, 4)`` scratch: distance and direction of the touching ones.
        laws: ``(S, W, 5)`` of each material with each wall.
        walls: ``(W, 21)`` poses of this evaluation.
        The others: as in :func:`contact_blocks.pair_forces`.
    """
    touching = 0
    for p in range(len(wall_i) - 1):
        i = wall_i[p]
        distance, nx, ny, nz = toward_wall(walls, wall_w[p], sphere[i, 0], sphere[i, 1], sphere[i, 2])
        geometry[touching, 0], geometry[touching, 1] = distance, nx
        geometry[touching, 2], geometry[touching, 3] = ny, nz
        active[touching] = p
        touching += distance < sphere[i, 3]
    begin = 0
    while begin < touching:
        w, kind = wall_w[active[begin]], material[wall_i[active[begin]]]
        size = 1
        while (
            size < BLOCK
            and begin + size < touching
            and wall_w[active[begin + size]] == w
            and material[wall_i[active[begin + size]]] == kind
        ):
            size += 1
        v0, v1, v2 = walls[w, 11], walls[w, 12], walls[w, 13]
        w0, w1, w2 = walls[w, 14], walls[w, 15], walls[w, 16]
        c0, c1, c2 = walls[w, 17], walls[w, 18], walls[w, 19]
        moves = v0 != 0.0 or v1 != 0.0 or v2 != 0.0 or w0 != 0.0 or w1 != 0.0 or w2 != 0.0
        for k in range(size):
            p = active[begin + k]
            i = wall_i[p]
            x, y, z, radius = sphere[i, 0], sphere[i, 1], sphere[i, 2], sphere[i, 3]
            distance, nx = geometry[begin + k, 0], geometry[begin + k, 1]
            ny, nz = geometry[begin + k, 2], geometry[begin + k, 3]
            buffer[NX + k], buffer[NY + k], buffer[NZ + k], buffer[DELTA + k] = nx, ny, nz, radius - distance
            buffer[RS + k] = radius
            buffer[MS + k], buffer[INVERSE_MS + k] = 1.0 / velocity[i, 3], velocity[i, 3]
            fill_law(buffer, k, laws[kind, w])
            vx, vy, vz = velocity[i, 0], velocity[i, 1], velocity[i, 2]
            if moves:
                cx, cy, cz = x + distance * nx - c0, y + distance * ny - c1, z + distance * nz - c2
                vx -= v0 + (w1 * cz - w2 * cy)
                vy -= v1 + (w2 * cx - w0 * cz)
                vz -= v2 + (w0 * cy - w1 * cx)
            buffer[VX + k], buffer[VY + k], buffer[VZ + k] = vx, vy, vz
            buffer[GAIN + k] = nx * ahead[i, 0] + ny * ahead[i, 1] + nz * ahead[i, 2]
            if tangential:
                sx, sy, sz = spin[i, 0], spin[i, 1], spin[i, 2]
                buffer[WX + k], buffer[WY + k], buffer[WZ + k] = distance * sx, distance * sy, distance * sz
                # What rolls on a turning wall rolls against the wall's own rotation.
                buffer[PX + k], buffer[PY + k], buffer[PZ + k] = sx - w0, sy - w1, sz - w2
                known = touched[p] == evaluation - 1
                buffer[HX + k], buffer[HY + k], buffer[HZ + k] = slot[p, 0], slot[p, 1], slot[p, 2]
                buffer[BEFORE + k] = slot[p, 3] if known else 0.0
                if rolling:
                    for c in range(3):
                        buffer[MX + c * BLOCK + k] = moment[p, c] if known else 0.0
        contact_law(buffer, size, tangential, dt)
        if rolling:
            rolling_law(buffer, size, dt)
        home = chunk
        for k in range(size):
            p = active[begin + k]
            i = wall_i[p]
            while i >= bounds[home + 1]:
                home += 1
            force[home, i, 0] += buffer[FX + k]
            force[home, i, 1] += buffer[FY + k]
            force[home, i, 2] += buffer[FZ + k]
            if tangential:
                arm = geometry[begin + k, 0]
                torque[home, i, 0] += arm * buffer[TX + k]
                torque[home, i, 1] += arm * buffer[TY + k]
                torque[home, i, 2] += arm * buffer[TZ + k]
                slot[p, 0], slot[p, 1], slot[p, 2] = buffer[HX + k], buffer[HY + k], buffer[HZ + k]
            if rolling:
                for c in range(3):
                    torque[home, i, c] += buffer[MX + c * BLOCK + k]
                    moment[p, c] = buffer[MX + c * BLOCK + k]
            slot[p, 3] = buffer[DELTA + k]
            touched[p] = evaluation
        begin += size
