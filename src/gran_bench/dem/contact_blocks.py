"""Forces of many contacts at once: gathered in blocks, computed in SIMD, scattered (jitted).

A block of contacts is laid out as rows of one flat buffer. The laws are those of contact.py and rolling.py; tests hold
the two against each other to rounding.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from gran_bench.dem.contact import PREDICTION_FADE
from gran_bench.dem.contact_list import FORCE, MOMENT, OVERLAP, toward_wall

BLOCK = 128  # contacts of a block: its buffer stays in the first-level cache
# Rows of the buffer. Fixed offsets into one flat array let the compiler prove that rows do not overlap.
NX, NY, NZ, DELTA = 0 * BLOCK, 1 * BLOCK, 2 * BLOCK, 3 * BLOCK  # normal (first the offset), overlap
VX, VY, VZ = 4 * BLOCK, 5 * BLOCK, 6 * BLOCK  # velocity of the first centre relative to the second
GAIN = 7 * BLOCK  # what the velocity along the normal still gains until the step's end (first times the distance)
PX, PY, PZ = 8 * BLOCK, 9 * BLOCK, 10 * BLOCK  # spin of the first
QX, QY, QZ = 11 * BLOCK, 12 * BLOCK, 13 * BLOCK  # spin of the second
R1, R2 = 14 * BLOCK, 15 * BLOCK  # radii, then lever arms
RS, MS = 16 * BLOCK, 17 * BLOCK  # effective radius and mass
HX, HY, HZ, BEFORE = 18 * BLOCK, 19 * BLOCK, 20 * BLOCK, 21 * BLOCK  # history; overlap that it belongs to
FX, FY, FZ = 22 * BLOCK, 23 * BLOCK, 24 * BLOCK  # force on the first
TX, TY, TZ = 25 * BLOCK, 26 * BLOCK, 27 * BLOCK  # n × f_t
MX, MY, MZ = 28 * BLOCK, 29 * BLOCK, 30 * BLOCK  # rolling moment on the first
BUFFER_SIZE = 31 * BLOCK


@njit(error_model="numpy")
def pair_forces(
    sphere, motion, ahead, load, pair_i, pair_j, near, near_count, slot, touched, evaluation, active, buffer,
    law, density, period, tangential, rolling, dt,
):  # fmt: skip
    """Adds the forces and torques of all touching pairs to ``load`` and updates their slots.

    Args:
        sphere: ``(N, 4)`` x, y, z, r, m.
        motion: ``(N, 8)`` v, 1/m, ω, 1/I.
        ahead: ``(N, 4)`` what v still gains until the step's end, m/s.
        load: ``(N, 8)`` force and torque, added to.
        pair_i, pair_j: ``(M,)`` outer list.
        near, near_count: inner list, as places in the outer one, and its length.
        slot, touched: ``(M, 4 or 7)``, ``(M,)`` of the outer list.
        evaluation: number of this force evaluation; a contact that the last one did not touch remembers nothing.
        active, buffer: scratch.
        law: (4/3 E*, 8 G*, α, μ, μ_r).
        density: kg/m³.
        period: of y, m; 0 for none.
        tangential, rolling: what of the law is needed.
        dt: s over which histories are loaded.
    """
    touching = 0
    for q in range(near_count):
        p = near[q]
        i, j = pair_i[p], pair_j[p]
        dx = sphere[j, 0] - sphere[i, 0]
        dy = sphere[j, 1] - sphere[i, 1]
        dz = sphere[j, 2] - sphere[i, 2]
        if period > 0.0:
            dy -= period * np.rint(dy / period)
        reach = sphere[i, 3] + sphere[j, 3]
        active[touching] = p
        touching += dx * dx + dy * dy + dz * dz < reach * reach
    for begin in range(0, touching, BLOCK):
        size = min(BLOCK, touching - begin)
        for k in range(size):
            p = active[begin + k]
            i, j = pair_i[p], pair_j[p]
            dx = sphere[j, 0] - sphere[i, 0]
            dy = sphere[j, 1] - sphere[i, 1]
            dz = sphere[j, 2] - sphere[i, 2]
            if period > 0.0:
                dy -= period * np.rint(dy / period)
            buffer[NX + k], buffer[NY + k], buffer[NZ + k] = dx, dy, dz
            buffer[R1 + k], buffer[R2 + k] = sphere[i, 3], sphere[j, 3]
            buffer[VX + k] = motion[i, 0] - motion[j, 0]
            buffer[VY + k] = motion[i, 1] - motion[j, 1]
            buffer[VZ + k] = motion[i, 2] - motion[j, 2]
            buffer[GAIN + k] = (
                dx * (ahead[i, 0] - ahead[j, 0]) + dy * (ahead[i, 1] - ahead[j, 1]) + dz * (ahead[i, 2] - ahead[j, 2])
            )
            if tangential:
                buffer[PX + k], buffer[PY + k], buffer[PZ + k] = motion[i, 4], motion[i, 5], motion[i, 6]
                buffer[QX + k], buffer[QY + k], buffer[QZ + k] = motion[j, 4], motion[j, 5], motion[j, 6]
                buffer[HX + k], buffer[HY + k], buffer[HZ + k] = slot[p, FORCE], slot[p, FORCE + 1], slot[p, FORCE + 2]
                buffer[BEFORE + k] = slot[p, OVERLAP] if touched[p] == evaluation - 1 else 0.0
            if rolling:
                for axis in range(3):
                    buffer[MX + axis * BLOCK + k] = slot[p, MOMENT + axis]
        _pair_geometry(buffer, size, density)
        _law(buffer, size, law, tangential, dt)
        if rolling:
            _roll(buffer, size, law, dt)
        for k in range(size):
            p = active[begin + k]
            i, j = pair_i[p], pair_j[p]
            fx, fy, fz = buffer[FX + k], buffer[FY + k], buffer[FZ + k]
            load[i, 0] += fx
            load[i, 1] += fy
            load[i, 2] += fz
            load[j, 0] -= fx
            load[j, 1] -= fy
            load[j, 2] -= fz
            if tangential:
                tx, ty, tz = buffer[TX + k], buffer[TY + k], buffer[TZ + k]
                first_arm, second_arm = buffer[R1 + k], buffer[R2 + k]
                load[i, 4] += first_arm * tx
                load[i, 5] += first_arm * ty
                load[i, 6] += first_arm * tz
                load[j, 4] += second_arm * tx
                load[j, 5] += second_arm * ty
                load[j, 6] += second_arm * tz
                slot[p, FORCE], slot[p, FORCE + 1], slot[p, FORCE + 2] = buffer[HX + k], buffer[HY + k], buffer[HZ + k]
            if rolling:
                for axis in range(3):
                    moment = buffer[MX + axis * BLOCK + k]
                    load[i, 4 + axis] += moment
                    load[j, 4 + axis] -= moment
                    slot[p, MOMENT + axis] = moment
            slot[p, OVERLAP] = buffer[DELTA + k]
            touched[p] = evaluation


@njit(error_model="numpy")
def wall_forces(
    sphere, motion, ahead, load, wall_i, wall_w, slot, touched, evaluation, active, geometry, buffer,
    law, walls, axis, density, tangential, rolling, speed, dt,
):  # fmt: skip
    """Adds the forces and torques of all touching walls to ``load`` and updates their slots.

    Args:
        wall_i, wall_w: ``(M,)`` particle and wall of each contact in reach.
        walls: ``(W, 9)`` table.
        axis: ``(3,)`` of rotation.
        geometry: ``(≥ M + 1, 4)`` scratch: distance and direction of the touching ones.
        speed: of rotation, rad/s.
        The others: as in :func:`pair_forces`.
    """
    touching = 0
    for p in range(len(wall_i)):
        i = wall_i[p]
        distance, nx, ny, nz = toward_wall(walls, wall_w[p], sphere[i, 0], sphere[i, 1], sphere[i, 2])
        geometry[touching, 0], geometry[touching, 1] = distance, nx
        geometry[touching, 2], geometry[touching, 3] = ny, nz
        active[touching] = p
        touching += distance < sphere[i, 3]
    for begin in range(0, touching, BLOCK):
        size = min(BLOCK, touching - begin)
        for k in range(size):
            p = active[begin + k]
            i, w = wall_i[p], wall_w[p]
            x, y, z, radius = sphere[i, 0], sphere[i, 1], sphere[i, 2], sphere[i, 3]
            distance, nx = geometry[begin + k, 0], geometry[begin + k, 1]
            ny, nz = geometry[begin + k, 2], geometry[begin + k, 3]
            buffer[NX + k], buffer[NY + k], buffer[NZ + k] = nx, ny, nz
            buffer[DELTA + k] = radius - distance
            buffer[RS + k], buffer[MS + k] = radius, 4.0 / 3.0 * math.pi * density * radius**3
            buffer[R1 + k], buffer[R2 + k] = distance, 0.0
            vx, vy, vz = motion[i, 0], motion[i, 1], motion[i, 2]
            turning = speed * walls[w, 8]
            if turning != 0.0:
                cx, cy, cz = x + distance * nx, y + distance * ny, z + distance * nz
                vx -= turning * (axis[1] * cz - axis[2] * cy)
                vy -= turning * (axis[2] * cx - axis[0] * cz)
                vz -= turning * (axis[0] * cy - axis[1] * cx)
            buffer[VX + k], buffer[VY + k], buffer[VZ + k] = vx, vy, vz
            buffer[GAIN + k] = nx * ahead[i, 0] + ny * ahead[i, 1] + nz * ahead[i, 2]
            if tangential:
                buffer[PX + k], buffer[PY + k], buffer[PZ + k] = motion[i, 4], motion[i, 5], motion[i, 6]
                # No lever arm, so that it counts only as what a sphere rolls against.
                buffer[QX + k], buffer[QY + k], buffer[QZ + k] = turning * axis[0], turning * axis[1], turning * axis[2]
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


@njit(error_model="numpy")
def _pair_geometry(buffer, size, density):
    """Offsets and radii of a block → normal, overlap, lever arms, R* and m*."""
    for k in range(size):
        dx, dy, dz = buffer[NX + k], buffer[NY + k], buffer[NZ + k]
        r1, r2 = buffer[R1 + k], buffer[R2 + k]
        distance = math.sqrt(dx * dx + dy * dy + dz * dz)
        inverse = 1.0 / distance
        buffer[NX + k], buffer[NY + k], buffer[NZ + k] = dx * inverse, dy * inverse, dz * inverse
        buffer[GAIN + k] *= inverse
        buffer[DELTA + k] = r1 + r2 - distance
        # Both lever arms end on the plane of the circle in which the spheres intersect.
        arm = 0.5 * (distance + (r1 - r2) * (r1 + r2) * inverse)
        buffer[R1 + k], buffer[R2 + k] = arm, distance - arm
        buffer[RS + k] = r1 * r2 / (r1 + r2)
        m1, m2 = r1 * r1 * r1, r2 * r2 * r2
        buffer[MS + k] = 4.0 / 3.0 * math.pi * density * (m1 * m2 / (m1 + m2))


@njit(error_model="numpy")
def _law(buffer, size, law, tangential, dt):
    """Force on the first of each contact of a block, n × f_t, and the new history (see contact.py)."""
    modulus, shear, damping, friction = law[0], law[1], law[2], law[3]
    for k in range(size):
        nx, ny, nz, overlap = buffer[NX + k], buffer[NY + k], buffer[NZ + k], buffer[DELTA + k]
        vx, vy, vz = buffer[VX + k], buffer[VY + k], buffer[VZ + k]
        approach = vx * nx + vy * ny + vz * nz
        contact_radius = math.sqrt(buffer[RS + k] * overlap)
        stiffness = modulus * contact_radius  # K √δ
        drag = damping * math.sqrt(buffer[MS + k] * stiffness)  # α √(m* K) δ^(1/4)
        gain = buffer[GAIN + k] * max(0.0, 1.0 - PREDICTION_FADE * drag * dt / buffer[MS + k])
        normal = max(0.0, stiffness * overlap + drag * (approach + gain))
        buffer[FX + k], buffer[FY + k], buffer[FZ + k] = -normal * nx, -normal * ny, -normal * nz
        if tangential:
            r1, r2 = buffer[R1 + k], buffer[R2 + k]
            wx = r1 * buffer[PX + k] + r2 * buffer[QX + k]
            wy = r1 * buffer[PY + k] + r2 * buffer[QY + k]
            wz = r1 * buffer[PZ + k] + r2 * buffer[QZ + k]
            sx = vx - approach * nx + (wy * nz - wz * ny)
            sy = vy - approach * ny + (wz * nx - wx * nz)
            sz = vz - approach * nz + (wx * ny - wy * nx)
            # The history turns with the contact plane (what leaves the plane is removed, the length is kept) and
            # unloads with the contact's size; a new contact remembers nothing.
            before = buffer[BEFORE + k]
            hx, hy, hz = buffer[HX + k], buffer[HY + k], buffer[HZ + k]
            length = hx * hx + hy * hy + hz * hz
            out = hx * nx + hy * ny + hz * nz
            hx, hy, hz = hx - out * nx, hy - out * ny, hz - out * nz
            inside = (hx * hx + hy * hy + hz * hz) * before
            keep = math.sqrt(length * min(before, overlap) / inside) if inside > 0.0 else 0.0
            hx, hy, hz = (keep * hx, keep * hy, keep * hz) if before > 0.0 else (0.0, 0.0, 0.0)
            load = shear * 0.5 * (contact_radius + math.sqrt(buffer[RS + k] * min(before, overlap))) * dt
            hx, hy, hz = hx - load * sx, hy - load * sy, hz - load * sz
            fx, fy, fz = hx - drag * sx, hy - drag * sy, hz - drag * sz
            squared, limit = fx * fx + fy * fy + fz * fz, friction * normal
            slip = limit / math.sqrt(squared) if squared > limit * limit else 1.0
            fx, fy, fz = slip * fx, slip * fy, slip * fz
            buffer[HX + k], buffer[HY + k], buffer[HZ + k] = slip * hx, slip * hy, slip * hz
            buffer[FX + k] += fx
            buffer[FY + k] += fy
            buffer[FZ + k] += fz
            buffer[TX + k] = ny * fz - nz * fy
            buffer[TY + k] = nz * fx - nx * fz
            buffer[TZ + k] = nx * fy - ny * fx


@njit(error_model="numpy")
def _roll(buffer, size, law, dt):
    """Rolling moment on the first of each contact of a block (see rolling.py)."""
    modulus, coefficient = law[0], law[4]
    for k in range(size):
        nx, ny, nz, overlap = buffer[NX + k], buffer[NY + k], buffer[NZ + k], buffer[DELTA + k]
        radius = buffer[RS + k]
        contact_radius = math.sqrt(radius * overlap)
        limit = coefficient * radius * modulus * contact_radius * overlap
        # k_n = 2 E* √(R* δ), and the modulus is 4/3 E*.
        stiffness = 2.25 * 1.5 * modulus * contact_radius * (coefficient * radius) ** 2
        wx = buffer[PX + k] - buffer[QX + k]
        wy = buffer[PY + k] - buffer[QY + k]
        wz = buffer[PZ + k] - buffer[QZ + k]
        spin = wx * nx + wy * ny + wz * nz
        wx, wy, wz = wx - spin * nx, wy - spin * ny, wz - spin * nz
        known = buffer[BEFORE + k] > 0.0
        mx = buffer[MX + k] if known else 0.0
        my = buffer[MY + k] if known else 0.0
        mz = buffer[MZ + k] if known else 0.0
        out = mx * nx + my * ny + mz * nz
        mx = mx - out * nx - stiffness * dt * wx
        my = my - out * ny - stiffness * dt * wy
        mz = mz - out * nz - stiffness * dt * wz
        squared = mx * mx + my * my + mz * mz
        scale = limit / math.sqrt(squared) if squared > limit * limit else 1.0
        buffer[MX + k], buffer[MY + k], buffer[MZ + k] = scale * mx, scale * my, scale * mz
