"""Forces of many contacts at once: gathered in blocks, computed in SIMD, scattered (jitted).

A block of contacts is laid out as columns of one flat buffer, one lane a contact. Quantities that a body keeps as a row
of four come as four columns at once (rows.py). The laws are those of contact.py and rolling.py; tests hold the two
against each other to rounding.
"""

from __future__ import annotations

import math

import numpy as np

from gran_bench.dem.contact import PREDICTION_FADE
from gran_bench.dem.contact_list import closer
from gran_bench.dem.kernel import kernel
from gran_bench.dem.rows import (
    BLOCK,
    gather_difference,
    gather_rows,
    gather_sum,
    scatter_both,
    scatter_opposite,
    scatter_rows,
)

# Columns in groups of four, as rows.py moves them.
OFFSET, VELOCITY, AHEAD, SPIN_SUM, SPIN_DIFFERENCE, SLOT, FORCE, TORQUE, TORQUE_2, MOMENT = range(0, 40, 4)
# First elements of single columns. Fixed offsets into one flat array show the compiler that columns don't overlap.
NX, NY, NZ, DELTA = (k * BLOCK for k in range(OFFSET, OFFSET + 4))  # normal (first the offset), overlap
VX, VY, VZ, GAIN = (k * BLOCK for k in range(VELOCITY, VELOCITY + 4))  # of the first relative to the second
AX, AY, AZ = (k * BLOCK for k in range(AHEAD, AHEAD + 3))  # what that velocity still gains until the step's end
WX, WY, WZ, ARM_1 = (k * BLOCK for k in range(SPIN_SUM, SPIN_SUM + 4))  # ω₁ + ω₂, then Σ arm × ω; first lever arm
PX, PY, PZ, ARM_2 = (k * BLOCK for k in range(SPIN_DIFFERENCE, SPIN_DIFFERENCE + 4))  # ω₁ − ω₂; second lever arm
HX, HY, HZ, BEFORE = (k * BLOCK for k in range(SLOT, SLOT + 4))  # history, and the overlap that it belongs to
FX, FY, FZ = (k * BLOCK for k in range(FORCE, FORCE + 3))  # force on the first; the fourth column stays zero
TX, TY, TZ = (k * BLOCK for k in range(TORQUE, TORQUE + 3))  # n × f_t, then torque on the first
UX, UY, UZ = (k * BLOCK for k in range(TORQUE_2, TORQUE_2 + 3))  # torque on the second
MX, MY, MZ = (k * BLOCK for k in range(MOMENT, MOMENT + 3))  # rolling moment on the first
# Constants of each contact: filled once where all contacts share them, for each contact where they differ.
REACH, SKEW, RS, MS, INVERSE_MS = (k * BLOCK for k in range(40, 45))  # r₁ + r₂, r₁² − r₂², R*, m*, 1/m*
MODULUS, SHEAR, DAMPING, FRICTION, ROLLING = (k * BLOCK for k in range(45, 50))  # 4/3 E*, 8 G*, α, μ, μ_r
BUFFER_SIZE = 50 * BLOCK


@kernel
def fill_sizes(buffer, lane, r1, r2, inverse_mass):
    """Reach, skew, R* and m* of the contact of radii r₁ and r₂ into one lane; 1/m* is given."""
    buffer[REACH + lane], buffer[SKEW + lane] = r1 + r2, (r1 - r2) * (r1 + r2)
    buffer[RS + lane] = r1 * r2 / (r1 + r2)
    buffer[MS + lane], buffer[INVERSE_MS + lane] = 1.0 / inverse_mass, inverse_mass


@kernel
def fill_law(buffer, lane, law):
    """(4/3 E*, 8 G*, α, μ, μ_r) into one lane."""
    buffer[MODULUS + lane], buffer[SHEAR + lane], buffer[DAMPING + lane] = law[0], law[1], law[2]
    buffer[FRICTION + lane], buffer[ROLLING + lane] = law[3], law[4]


@kernel
def pair_forces(
    sphere, velocity, spin, ahead, material, force, torque, pair_i, pair_j, near, begin, end,
    slot, moment, touched, evaluation, active, buffer, laws, period, tangential, rolling, unequal, several, dt,
):  # fmt: skip
    """Adds the forces and torques of the touching pairs among ``near[begin:end]`` and updates their slots.

    Bodies N and N + 1, and the last pair, are spare: they fill the lanes that a block does not need.

    Args:
        sphere: ``(N + 2, 4)`` x, y, z, r, m.
        velocity, spin: ``(N + 2, 4)`` v, 1/m and ω, 1/I.
        ahead: ``(N + 2, 4)`` what v still gains until the step's end, m/s.
        material: ``(N + 2,)`` index.
        force, torque: ``(N + 2, 4)``, added to.
        pair_i, pair_j: ``(M + 1,)`` outer list.
        near: inner list, as places in the outer one.
        slot, moment, touched: ``(M + 1, 4)``, ``(M + 1 or 1, 4)``, ``(M + 1,)`` of the outer list.
        evaluation: number of this force evaluation; a contact that the last one did not touch remembers nothing.
        active, buffer: scratch.
        laws: ``(S, S, 5)`` (4/3 E*, 8 G*, α, μ, μ_r).
        period: of y, m; 0 for none.
        tangential, rolling, unequal, several: what is needed: friction, rolling model, sizes and materials that differ.
        dt: s over which histories are loaded.
    """
    touching = closer(sphere, pair_i, pair_j, near[begin:end], 0.0, period, active)
    for lane in range(touching, touching + 3):
        active[lane] = len(pair_i) - 1
    for first in range(0, touching, BLOCK):
        size = (min(BLOCK, touching - first) + 3) // 4 * 4
        for k in range(0, size, 4):
            p0, p1, p2, p3 = active[first + k], active[first + k + 1], active[first + k + 2], active[first + k + 3]
            i0, i1, i2, i3 = pair_i[p0], pair_i[p1], pair_i[p2], pair_i[p3]
            j0, j1, j2, j3 = pair_j[p0], pair_j[p1], pair_j[p2], pair_j[p3]
            gather_difference(buffer, OFFSET, k, sphere, j0, j1, j2, j3, i0, i1, i2, i3)
            gather_difference(buffer, VELOCITY, k, velocity, i0, i1, i2, i3, j0, j1, j2, j3)
            gather_difference(buffer, AHEAD, k, ahead, i0, i1, i2, i3, j0, j1, j2, j3)
            if tangential:
                gather_sum(buffer, SPIN_SUM, k, spin, i0, i1, i2, i3, j0, j1, j2, j3)
                gather_rows(buffer, SLOT, k, slot, p0, p1, p2, p3)
            if rolling or unequal:
                gather_difference(buffer, SPIN_DIFFERENCE, k, spin, i0, i1, i2, i3, j0, j1, j2, j3)
            if rolling:
                gather_rows(buffer, MOMENT, k, moment, p0, p1, p2, p3)
        if tangential:
            for k in range(size):
                if touched[active[first + k]] != evaluation - 1:
                    buffer[HX + k], buffer[HY + k], buffer[HZ + k], buffer[BEFORE + k] = 0.0, 0.0, 0.0, 0.0
                    if rolling:
                        buffer[MX + k], buffer[MY + k], buffer[MZ + k] = 0.0, 0.0, 0.0
        if unequal:
            for k in range(size):
                i, j = pair_i[active[first + k]], pair_j[active[first + k]]
                fill_sizes(buffer, k, sphere[i, 3], sphere[j, 3], velocity[i, 3] + velocity[j, 3])
        if several:
            for k in range(size):
                p = active[first + k]
                fill_law(buffer, k, laws[material[pair_i[p]], material[pair_j[p]]])
        if period > 0.0:
            for k in range(size):
                buffer[NY + k] -= period * np.rint(buffer[NY + k] / period)
        pair_geometry(buffer, size, tangential, unequal)
        contact_law(buffer, size, tangential, dt)
        if rolling:
            rolling_law(buffer, size, dt)
        if tangential:
            pair_torques(buffer, size, unequal)
        for k in range(0, size, 4):
            p0, p1, p2, p3 = active[first + k], active[first + k + 1], active[first + k + 2], active[first + k + 3]
            i0, i1, i2, i3 = pair_i[p0], pair_i[p1], pair_i[p2], pair_i[p3]
            j0, j1, j2, j3 = pair_j[p0], pair_j[p1], pair_j[p2], pair_j[p3]
            scatter_opposite(force, i0, i1, i2, i3, j0, j1, j2, j3, buffer, FORCE, k)
            if tangential:
                second = TORQUE_2 if unequal else TORQUE
                scatter_both(torque, i0, i1, i2, i3, j0, j1, j2, j3, buffer, TORQUE, second, k)
            if rolling:
                scatter_opposite(torque, i0, i1, i2, i3, j0, j1, j2, j3, buffer, MOMENT, k)
                scatter_rows(moment, p0, p1, p2, p3, buffer, MOMENT, k)
            scatter_rows(slot, p0, p1, p2, p3, buffer, SLOT, k)
            touched[p0] = evaluation
            touched[p1] = evaluation
            touched[p2] = evaluation
            touched[p3] = evaluation


@kernel
def pair_geometry(buffer, size, tangential, unequal):
    """Offsets of a block → normals, overlaps, gains along the normal, lever arms and surface spins."""
    half = buffer.dtype.type(0.5)
    for k in range(size):
        dx, dy, dz = buffer[NX + k], buffer[NY + k], buffer[NZ + k]
        distance = math.sqrt(dx * dx + dy * dy + dz * dz)
        inverse = buffer.dtype.type(1.0) / distance
        nx, ny, nz = dx * inverse, dy * inverse, dz * inverse
        buffer[NX + k], buffer[NY + k], buffer[NZ + k] = nx, ny, nz
        buffer[GAIN + k] = buffer[AX + k] * nx + buffer[AY + k] * ny + buffer[AZ + k] * nz
        # Rounding may part what the filter found to touch.
        buffer[DELTA + k] = max(buffer.dtype.type(0.0), buffer[REACH + k] - distance)
        # Both lever arms end on the plane of the circle in which the spheres intersect.
        arm = half * distance
        if tangential:
            wx, wy, wz = arm * buffer[WX + k], arm * buffer[WY + k], arm * buffer[WZ + k]
            if unequal:
                shift = half * buffer[SKEW + k] * inverse
                wx += shift * buffer[PX + k]
                wy += shift * buffer[PY + k]
                wz += shift * buffer[PZ + k]
                buffer[ARM_2 + k] = arm - shift
                arm += shift
            buffer[WX + k], buffer[WY + k], buffer[WZ + k], buffer[ARM_1 + k] = wx, wy, wz, arm


@kernel
def contact_law(buffer, size, tangential, dt):
    """Force on the first of each contact of a block, n × f_t, and the new history (see contact.py)."""
    zero, half, one = buffer.dtype.type(0.0), buffer.dtype.type(0.5), buffer.dtype.type(1.0)
    step, fade = buffer.dtype.type(dt), buffer.dtype.type(PREDICTION_FADE * dt)
    for k in range(size):
        nx, ny, nz, overlap = buffer[NX + k], buffer[NY + k], buffer[NZ + k], buffer[DELTA + k]
        vx, vy, vz = buffer[VX + k], buffer[VY + k], buffer[VZ + k]
        approach = vx * nx + vy * ny + vz * nz
        contact_radius = math.sqrt(buffer[RS + k] * overlap)
        stiffness = buffer[MODULUS + k] * contact_radius  # K √δ
        drag = buffer[DAMPING + k] * math.sqrt(buffer[MS + k] * stiffness)  # α √(m* K) δ^(1/4)
        gain = buffer[GAIN + k] * max(zero, one - fade * drag * buffer[INVERSE_MS + k])
        normal = max(zero, stiffness * overlap + drag * (approach + gain))
        fx, fy, fz = -normal * nx, -normal * ny, -normal * nz
        if tangential:
            wx, wy, wz = buffer[WX + k], buffer[WY + k], buffer[WZ + k]
            sx = vx - approach * nx + (wy * nz - wz * ny)
            sy = vy - approach * ny + (wz * nx - wx * nz)
            sz = vz - approach * nz + (wx * ny - wy * nx)
            # The history turns with the contact plane (what leaves the plane is removed, the length is kept) and
            # unloads with the contact's size; a new contact, whose overlap before is zero, remembers nothing.
            before = buffer[BEFORE + k]
            hx, hy, hz = buffer[HX + k], buffer[HY + k], buffer[HZ + k]
            length = hx * hx + hy * hy + hz * hz
            out = hx * nx + hy * ny + hz * nz
            hx, hy, hz = hx - out * nx, hy - out * ny, hz - out * nz
            inside = (hx * hx + hy * hy + hz * hz) * before
            smaller = min(before, overlap)
            keep = math.sqrt(length * smaller / inside) if inside > zero else zero
            load = half * step * buffer[SHEAR + k] * (contact_radius + math.sqrt(buffer[RS + k] * smaller))
            hx, hy, hz = keep * hx - load * sx, keep * hy - load * sy, keep * hz - load * sz
            tx, ty, tz = hx - drag * sx, hy - drag * sy, hz - drag * sz
            squared, limit = tx * tx + ty * ty + tz * tz, buffer[FRICTION + k] * normal
            slip = limit / math.sqrt(squared) if squared > limit * limit else one
            tx, ty, tz = slip * tx, slip * ty, slip * tz
            buffer[HX + k], buffer[HY + k], buffer[HZ + k] = slip * hx, slip * hy, slip * hz
            fx, fy, fz = fx + tx, fy + ty, fz + tz
            buffer[TX + k] = ny * tz - nz * ty
            buffer[TY + k] = nz * tx - nx * tz
            buffer[TZ + k] = nx * ty - ny * tx
        buffer[FX + k], buffer[FY + k], buffer[FZ + k] = fx, fy, fz
        buffer[BEFORE + k] = overlap


@kernel
def rolling_law(buffer, size, dt):
    """Rolling moment on the first of each contact of a block (see rolling.py); after contact_law."""
    zero, one, step = buffer.dtype.type(0.0), buffer.dtype.type(1.0), buffer.dtype.type(dt)
    for k in range(size):
        nx, ny, nz, overlap = buffer[NX + k], buffer[NY + k], buffer[NZ + k], buffer[DELTA + k]
        arm = buffer[ROLLING + k] * buffer[RS + k]
        contact_radius = math.sqrt(buffer[RS + k] * overlap)
        limit = arm * buffer[MODULUS + k] * contact_radius * overlap
        # 2.25 k_n (μ_r R*)² with k_n = 2 E* √(R* δ), and the modulus is 4/3 E*.
        load = buffer.dtype.type(3.375) * buffer[MODULUS + k] * contact_radius * arm * arm * step
        wx, wy, wz = buffer[PX + k], buffer[PY + k], buffer[PZ + k]
        along = wx * nx + wy * ny + wz * nz
        wx, wy, wz = wx - along * nx, wy - along * ny, wz - along * nz
        mx, my, mz = buffer[MX + k], buffer[MY + k], buffer[MZ + k]
        out = mx * nx + my * ny + mz * nz
        mx = mx - out * nx - load * wx
        my = my - out * ny - load * wy
        mz = mz - out * nz - load * wz
        squared = mx * mx + my * my + mz * mz
        scale = limit / math.sqrt(squared) if squared > max(zero, limit * limit) else one
        buffer[MX + k], buffer[MY + k], buffer[MZ + k] = scale * mx, scale * my, scale * mz


@kernel
def pair_torques(buffer, size, unequal):
    """n × f_t of a block → torque on the first, and on the second where its lever arm is another."""
    for k in range(size):
        tx, ty, tz, arm = buffer[TX + k], buffer[TY + k], buffer[TZ + k], buffer[ARM_1 + k]
        buffer[TX + k], buffer[TY + k], buffer[TZ + k] = arm * tx, arm * ty, arm * tz
        if unequal:
            arm = buffer[ARM_2 + k]
            buffer[UX + k], buffer[UY + k], buffer[UZ + k] = arm * tx, arm * ty, arm * tz
