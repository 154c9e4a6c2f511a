"""Contacts of spheres with walls: which are near, and what they do (jitted).

Walls are rows of a pose table (walls.py). In a block of contacts one law holds.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from gran_bench.dem.contact_blocks import (
    BEFORE,
    BLOCK,
    DELTA,
    FX,
    FY,
    FZ,
    GAIN,
    HX,
    HY,
    HZ,
    MS,
    MX,
    NX,
    NY,
    NZ,
    PX,
    PY,
    PZ,
    QX,
    QY,
    QZ,
    R1,
    R2,
    RS,
    TX,
    TY,
    TZ,
    VX,
    VY,
    VZ,
    _law,
    _roll,
)  # fmt: skip
from gran_bench.dem.contact_list import FORCE, MOMENT, OVERLAP
from gran_bench.dem.walls import ABSENT, CYLINDER, PATH, PLANE


@njit(error_model="numpy")
def toward_wall(walls, w, x, y, z):
    """Distance of a point from wall w, and the unit vector to it; the rules of :func:`walls.wall_contact`.

    Args:
        walls: ``(W, 21)`` poses.
        w: which wall.
        x, y, z: m.
    """
    return _toward(
        walls[w, 0], walls[w, 1], walls[w, 2], walls[w, 3], walls[w, 4], walls[w, 5], walls[w, 6],
        walls[w, 7], walls[w, 8], walls[w, 9], walls[w, 10], x, y, z,
    )  # fmt: skip


@njit(error_model="numpy", inline="always")
def _toward(kind, px, py, pz, ax, ay, az, r0, s0, r1, s1, x, y, z):
    """The same of a wall that lies in registers: in a loop over points nothing is read from memory again."""
    ox, oy, oz = x - px, y - py, z - pz
    along = ox * ax + oy * ay + oz * az
    if kind == PLANE:
        distance, nx, ny, nz = along, -ax, -ay, -az
    else:
        ox, oy, oz = ox - along * ax, oy - along * ay, oz - along * az
        reach = math.sqrt(ox * ox + oy * oy + oz * oz)
        inverse = 1.0 / reach if reach > 0.0 else 0.0
        nx, ny, nz = ox * inverse, oy * inverse, oz * inverse
        distance = r0 - reach
        if kind != CYLINDER:
            distance, nx, ny, nz = _toward_revolution(kind, ax, ay, az, r0, s0, r1, s1, along, reach, nx, ny, nz)
    return distance, nx, ny, nz


@njit(error_model="numpy")
def _toward_revolution(kind, ax, ay, az, r0, s0, r1, s1, along, reach, ox, oy, oz):
    """The same for a surface of revolution, of which the point is ``along`` its axis and ``reach`` away, along o."""
    if kind == ABSENT:
        return np.inf, 0.0, 0.0, 0.0
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
def near_walls(sphere, species, kinds, walls, row, margin):
    """Particles and walls that may touch in the rest of a stretch, while no particle moves by more than ``margin``.

    Args:
        sphere: ``(N, 4)`` x, y, z, r, m.
        species: ``(N,)`` material of each.
        kinds: S, how many materials there are.
        walls: ``(steps + 1, W, 21)`` poses.
        row: of the poses that belong to these positions.
        margin: m.

    Returns:
        ``(M,)`` uint32 each, wall by wall, material by material.
    """
    count, poses = walls.shape[1], walls[row]
    room = len(sphere) * count + 1
    wall_i, wall_w = np.empty(room, np.uint32), np.empty(room, np.uint32)
    found = 0
    for w in range(count):
        shape, px, py, pz = poses[w, 0], poses[w, 1], poses[w, 2], poses[w, 3]
        ax, ay, az = poses[w, 4], poses[w, 5], poses[w, 6]
        r0, s0, r1, s1 = poses[w, 7], poses[w, 8], poses[w, 9], poses[w, 10]
        reach = margin
        for later in range(row + 1, len(walls)):
            reach += walls[later, w, PATH]
        for kind in range(kinds):
            for i in range(len(sphere)):
                distance = _toward(
                    shape, px, py, pz, ax, ay, az, r0, s0, r1, s1, sphere[i, 0], sphere[i, 1], sphere[i, 2]
                )[0]
                wall_i[found], wall_w[found] = i, w
                found += distance - sphere[i, 3] < reach and species[i] == kind
    return wall_i[:found].copy(), wall_w[:found].copy()


@njit(error_model="numpy")
def _same_law(one, other):
    """Whether two rows of constants are equal."""
    same = True
    for k in range(len(one)):
        same = same and one[k] == other[k]
    return same


@njit(error_model="numpy")
def wall_forces(
    sphere, motion, species, ahead, load, wall_i, wall_w, slot, touched, evaluation, active, geometry, buffer,
    laws, walls, density, tangential, rolling, dt,
):  # fmt: skip
    """Adds the forces and torques of all touching walls to ``load`` and updates their slots.

    Args:
        species: ``(N,)`` material of each particle.
        wall_i, wall_w: ``(M,)`` particle and wall of each contact in reach, wall by wall, material by material.
        geometry: ``(≥ M + 1, 4)`` scratch: distance and direction of the touching ones.
        laws: ``(S, W, 5)`` of each material with each wall.
        walls: ``(W, 21)`` poses of this evaluation.
        density: ``(S,)`` kg/m³.
        The others: as in :func:`contact_blocks.pair_forces`.
    """
    touching, place = 0, 0
    while place < len(wall_i):
        near = np.int64(wall_w[place])
        shape, px, py, pz = walls[near, 0], walls[near, 1], walls[near, 2], walls[near, 3]
        ax, ay, az = walls[near, 4], walls[near, 5], walls[near, 6]
        r0, s0, r1, s1 = walls[near, 7], walls[near, 8], walls[near, 9], walls[near, 10]
        while place < len(wall_i) and wall_w[place] == near:
            i = wall_i[place]
            distance, nx, ny, nz = _toward(
                shape, px, py, pz, ax, ay, az, r0, s0, r1, s1, sphere[i, 0], sphere[i, 1], sphere[i, 2]
            )
            geometry[touching, 0], geometry[touching, 1] = distance, nx
            geometry[touching, 2], geometry[touching, 3] = ny, nz
            active[touching] = place
            touching += distance < sphere[i, 3]
            place += 1
    begin = 0
    while begin < touching:
        w, kind = np.int64(-1), np.int64(-1)
        law = laws[species[wall_i[active[begin]]], wall_w[active[begin]]]
        mass, moves, size = 0.0, False, 0
        v0, v1, v2, w0, w1, w2, c0, c1, c2 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for k in range(min(BLOCK, touching - begin)):
            p = active[begin + k]
            i = wall_i[p]
            if wall_w[p] != w or species[i] != kind:
                w, kind = np.int64(wall_w[p]), np.int64(species[i])
                if not _same_law(law, laws[kind, w]):
                    break
                mass = 4.0 / 3.0 * math.pi * density[kind]
                v0, v1, v2 = walls[w, 11], walls[w, 12], walls[w, 13]
                w0, w1, w2 = walls[w, 14], walls[w, 15], walls[w, 16]
                c0, c1, c2 = walls[w, 17], walls[w, 18], walls[w, 19]
                moves = v0 != 0.0 or v1 != 0.0 or v2 != 0.0 or w0 != 0.0 or w1 != 0.0 or w2 != 0.0
            size += 1
            x, y, z, radius = sphere[i, 0], sphere[i, 1], sphere[i, 2], sphere[i, 3]
            distance, nx = geometry[begin + k, 0], geometry[begin + k, 1]
            ny, nz = geometry[begin + k, 2], geometry[begin + k, 3]
            buffer[NX + k], buffer[NY + k], buffer[NZ + k] = nx, ny, nz
            buffer[DELTA + k] = radius - distance
            buffer[RS + k], buffer[MS + k] = radius, mass * radius**3
            buffer[R1 + k], buffer[R2 + k] = distance, 0.0
            vx, vy, vz = motion[i, 0], motion[i, 1], motion[i, 2]
            if moves:
                cx, cy, cz = x + distance * nx - c0, y + distance * ny - c1, z + distance * nz - c2
                vx -= v0 + (w1 * cz - w2 * cy)
                vy -= v1 + (w2 * cx - w0 * cz)
                vz -= v2 + (w0 * cy - w1 * cx)
            buffer[VX + k], buffer[VY + k], buffer[VZ + k] = vx, vy, vz
            buffer[GAIN + k] = nx * ahead[i, 0] + ny * ahead[i, 1] + nz * ahead[i, 2]
            if tangential:
                buffer[PX + k], buffer[PY + k], buffer[PZ + k] = motion[i, 4], motion[i, 5], motion[i, 6]
                # No lever arm, so that it counts only as what a sphere rolls against.
                buffer[QX + k], buffer[QY + k], buffer[QZ + k] = w0, w1, w2
                buffer[HX + k], buffer[HY + k], buffer[HZ + k] = slot[p, FORCE], slot[p, FORCE + 1], slot[p, FORCE + 2]
                buffer[BEFORE + k] = slot[p, OVERLAP] if touched[p] == evaluation - 1 else 0.0
            if rolling:
                for c in range(3):
                    buffer[MX + c * BLOCK + k] = slot[p, MOMENT + c]
        _law(buffer, size, law, tangential, dt)
        if rolling:
            _roll(buffer, size, law, dt)
        for k in range(size):
            p = active[begin + k]
            i = wall_i[p]
            load[i, 0] += buffer[FX + k]
            load[i, 1] += buffer[FY + k]
            load[i, 2] += buffer[FZ + k]
            if tangential:
                arm = buffer[R1 + k]
                load[i, 4] += arm * buffer[TX + k]
                load[i, 5] += arm * buffer[TY + k]
                load[i, 6] += arm * buffer[TZ + k]
                slot[p, FORCE], slot[p, FORCE + 1], slot[p, FORCE + 2] = buffer[HX + k], buffer[HY + k], buffer[HZ + k]
            if rolling:
                for c in range(3):
                    load[i, 4 + c] += buffer[MX + c * BLOCK + k]
                    slot[p, MOMENT + c] = buffer[MX + c * BLOCK + k]
            slot[p, OVERLAP] = buffer[DELTA + k]
            touched[p] = evaluation
        begin += size
