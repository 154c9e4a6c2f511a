"""The laws of many contacts at once, in SIMD: those of contact.py and rolling.py, to which tests hold them (jitted).

A block is laid out as columns of one flat buffer, one lane a contact. Loops are short: in long ones each contact would
wait for a chain of roots and divisions too long to overlap with the next ones.
"""

import math

import numpy as np

from gran_bench.dem.contact import PREDICTION_FADE
from gran_bench.dem.fast.rows import BLOCK
from gran_bench.dem.rolling import CONTACT_INERTIA
from gran_bench.neighbors.kernel import entry, kernel
from gran_bench.state import FloatArray

# Columns in groups of four, as rows.py moves them.
OFFSET, VELOCITY, AHEAD, SPIN_SUM, SPIN_DIFFERENCE, SLOT, FORCE, TORQUE, TORQUE_2, MOMENT, RESISTANCE = range(0, 44, 4)
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
MX, MY, MZ = (k * BLOCK for k in range(MOMENT, MOMENT + 3))  # elastic rolling moment on the first: history
QX, QY, QZ = (k * BLOCK for k in range(RESISTANCE, RESISTANCE + 3))  # rolling moment on the first, with its damping
# Constants of each contact: filled once where all contacts share them, for each contact where they differ.
REACH, SKEW, RS, MS, INVERSE_MS = (k * BLOCK for k in range(44, 49))  # r₁ + r₂, r₁² − r₂², R*, m*, 1/m*
INERTIA = 49 * BLOCK  # I_r of rolling.py
MODULUS, SHEAR, DAMPING, FRICTION, ROLLING = (k * BLOCK for k in range(50, 55))  # 4/3 E*, 8 G*, α, μ, μ_r
# What the tangential law takes from the normal one.
APPROACH, CONTACT_RADIUS, DRAG, LOAD = (k * BLOCK for k in range(55, 59))
RESCALE = 59 * BLOCK  # squared factor of the history that is turned
# Of each lane, the most that it has held since the buffer was made: overlap, its share of the mean diameter, approach.
PEAK_OVERLAP, PEAK_SHARE, PEAK_APPROACH = (k * BLOCK for k in range(60, 63))
BUFFER_SIZE = 63 * BLOCK


def block_buffer(buffer: FloatArray, radius: float, inverse_mass: float, law: FloatArray) -> FloatArray:
    """A ``(BUFFER_SIZE,)`` buffer with the constants of contacts of equal spheres: r, m, 1/m, and their law."""
    inertia = CONTACT_INERTIA * radius * radius / (2.0 * inverse_mass)
    masses, effective_radius = (1.0 / (2.0 * inverse_mass), 2.0 * inverse_mass), radius * radius / (2.0 * radius)
    constants = np.array((2.0 * radius, 0.0, effective_radius, *masses, inertia, *law))
    buffer.reshape(-1, BLOCK)[REACH // BLOCK : ROLLING // BLOCK + 1] = constants[:, None]
    return buffer


def wall_buffer(buffer: FloatArray, radius: float, inverse_mass: float, law: FloatArray) -> FloatArray:
    """The same for contacts of equal spheres with walls."""
    constants = (radius, 1.0 / inverse_mass, inverse_mass, CONTACT_INERTIA * radius * radius / inverse_mass, *law)
    buffer.reshape(-1, BLOCK)[RS // BLOCK : ROLLING // BLOCK + 1] = np.array(constants)[:, None]
    return buffer


@kernel
def fill_law(buffer, lane, law):
    """(4/3 E*, 8 G*, α, μ, μ_r) into one lane."""
    buffer[MODULUS + lane], buffer[SHEAR + lane], buffer[DAMPING + lane] = law[0], law[1], law[2]
    buffer[FRICTION + lane], buffer[ROLLING + lane] = law[3], law[4]


@kernel
def pair_geometry(buffer, size):
    """Offsets of a block → normals, overlaps, gains along the normal, half distances as lever arms."""
    zero, half, one = buffer.dtype.type(0.0), buffer.dtype.type(0.5), buffer.dtype.type(1.0)
    for k in range(size):
        dx, dy, dz = buffer[NX + k], buffer[NY + k], buffer[NZ + k]
        distance = math.sqrt(dx * dx + dy * dy + dz * dz)
        inverse = one / distance
        nx, ny, nz = dx * inverse, dy * inverse, dz * inverse
        buffer[NX + k], buffer[NY + k], buffer[NZ + k] = nx, ny, nz
        buffer[GAIN + k] = buffer[AX + k] * nx + buffer[AY + k] * ny + buffer[AZ + k] * nz
        # Rounding may part what the filter found to touch.
        buffer[DELTA + k] = max(zero, buffer[REACH + k] - distance)
        buffer[ARM_1 + k] = half * distance


@kernel
def slip_spins(buffer, size, unequal, full_radius):
    """Σ ω of a block → Σ arm × ω, with which spins add to the slip; and the lever arms of unequal spheres.

    With arm₁ = ½ d + s, arm₂ = ½ d − s and s = (r₁² − r₂²) / 2 d this is ½ d (ω₁ + ω₂) + s (ω₁ − ω₂); with full radii,
    ½ (r₁ + r₂) (ω₁ + ω₂) + ½ (r₁ − r₂) (ω₁ − ω₂).
    """
    quarter, half = buffer.dtype.type(0.25), buffer.dtype.type(0.5)
    for k in range(size):
        mean = half * buffer[REACH + k] if full_radius else buffer[ARM_1 + k]
        wx, wy, wz = buffer[WX + k], buffer[WY + k], buffer[WZ + k]
        buffer[WX + k], buffer[WY + k], buffer[WZ + k] = wx * mean, wy * mean, wz * mean
    if unequal:
        for k in range(size):
            arm = buffer[ARM_1 + k]
            shift = quarter * buffer[SKEW + k] / arm
            excess = half * buffer[SKEW + k] / buffer[REACH + k] if full_radius else shift
            buffer[WX + k] += excess * buffer[PX + k]
            buffer[WY + k] += excess * buffer[PY + k]
            buffer[WZ + k] += excess * buffer[PZ + k]
            buffer[ARM_1 + k], buffer[ARM_2 + k] = arm + shift, arm - shift


@kernel
def normal_law(buffer, size, dt):
    """Normal force on the first of each contact of a block (see contact.py)."""
    zero, one, fade = buffer.dtype.type(0.0), buffer.dtype.type(1.0), buffer.dtype.type(PREDICTION_FADE * dt)
    for k in range(size):
        nx, ny, nz, overlap = buffer[NX + k], buffer[NY + k], buffer[NZ + k], buffer[DELTA + k]
        approach = buffer[VX + k] * nx + buffer[VY + k] * ny + buffer[VZ + k] * nz
        contact_radius = math.sqrt(buffer[RS + k] * overlap)
        stiffness = buffer[MODULUS + k] * contact_radius  # K √δ
        drag = buffer[DAMPING + k] * math.sqrt(buffer[MS + k] * stiffness)  # α √(m* K) δ^(1/4)
        gain = buffer[GAIN + k] * max(zero, one - fade * drag * buffer[INVERSE_MS + k])
        load = max(zero, stiffness * overlap + drag * (approach + gain))
        buffer[FX + k], buffer[FY + k], buffer[FZ + k] = -load * nx, -load * ny, -load * nz
        buffer[APPROACH + k], buffer[CONTACT_RADIUS + k] = approach, contact_radius
        buffer[DRAG + k], buffer[LOAD + k] = drag, load


@kernel
def slip_and_turn(buffer, size):
    """Slip velocity into the columns of the spins; the history turned with the contact plane, not yet of its length.

    ``RESCALE`` becomes the square of what restores the length. A new contact, with zero before, remembers nothing.
    """
    zero = buffer.dtype.type(0.0)
    for k in range(size):
        nx, ny, nz, approach = buffer[NX + k], buffer[NY + k], buffer[NZ + k], buffer[APPROACH + k]
        wx, wy, wz = buffer[WX + k], buffer[WY + k], buffer[WZ + k]
        buffer[WX + k] = buffer[VX + k] - approach * nx + (wy * nz - wz * ny)
        buffer[WY + k] = buffer[VY + k] - approach * ny + (wz * nx - wx * nz)
        buffer[WZ + k] = buffer[VZ + k] - approach * nz + (wx * ny - wy * nx)
        before = buffer[BEFORE + k]
        smaller = min(before, buffer[DELTA + k])
        hx, hy, hz = buffer[HX + k], buffer[HY + k], buffer[HZ + k]
        length = hx * hx + hy * hy + hz * hz
        out = hx * nx + hy * ny + hz * nz
        hx, hy, hz = hx - out * nx, hy - out * ny, hz - out * nz
        inside = (hx * hx + hy * hy + hz * hz) * before
        buffer[HX + k], buffer[HY + k], buffer[HZ + k] = hx, hy, hz
        buffer[RESCALE + k] = length * smaller / inside if inside > zero else zero


@kernel
def load_history(buffer, size, dt):
    """The history loaded by slip over the step; with its damping into the columns of n × f_t."""
    half_step = buffer.dtype.type(0.5 * dt)
    for k in range(size):
        sx, sy, sz = buffer[WX + k], buffer[WY + k], buffer[WZ + k]
        keep = math.sqrt(buffer[RESCALE + k])
        smaller = min(buffer[BEFORE + k], buffer[DELTA + k])
        mean_radius = buffer[CONTACT_RADIUS + k] + math.sqrt(buffer[RS + k] * smaller)  # twice the mean
        load, drag = half_step * buffer[SHEAR + k] * mean_radius, buffer[DRAG + k]
        hx, hy, hz = buffer[HX + k], buffer[HY + k], buffer[HZ + k]
        hx, hy, hz = keep * hx - load * sx, keep * hy - load * sy, keep * hz - load * sz
        buffer[HX + k], buffer[HY + k], buffer[HZ + k] = hx, hy, hz
        buffer[TX + k], buffer[TY + k], buffer[TZ + k] = hx - drag * sx, hy - drag * sy, hz - drag * sz


@kernel
def limit_friction(buffer, size):
    """Force and history of a contact that slips are cut to μ times the load."""
    one = buffer.dtype.type(1.0)
    for k in range(size):
        nx, ny, nz = buffer[NX + k], buffer[NY + k], buffer[NZ + k]
        tx, ty, tz = buffer[TX + k], buffer[TY + k], buffer[TZ + k]
        squared, limit = tx * tx + ty * ty + tz * tz, buffer[FRICTION + k] * buffer[LOAD + k]
        slip = limit / math.sqrt(squared) if squared > limit * limit else one
        tx, ty, tz = slip * tx, slip * ty, slip * tz
        hx, hy, hz = buffer[HX + k], buffer[HY + k], buffer[HZ + k]
        buffer[HX + k], buffer[HY + k], buffer[HZ + k] = hx * slip, hy * slip, hz * slip
        fx, fy, fz = buffer[FX + k], buffer[FY + k], buffer[FZ + k]
        buffer[FX + k], buffer[FY + k], buffer[FZ + k] = fx + tx, fy + ty, fz + tz
        buffer[TX + k], buffer[TY + k] = ny * tz - nz * ty, nz * tx - nx * tz
        buffer[TZ + k] = nx * ty - ny * tx


@kernel
def rolling_law(buffer, size, dt):
    """Rolling moment on the first of each contact of a block (see rolling.py), and its history; after normal_law."""
    zero, one, two, step = buffer.dtype.type(0.0), buffer.dtype.type(1.0), buffer.dtype.type(2.0), buffer.dtype.type(dt)
    for k in range(size):
        nx, ny, nz = buffer[NX + k], buffer[NY + k], buffer[NZ + k]
        overlap, before = buffer[DELTA + k], buffer[BEFORE + k]
        arm = buffer[ROLLING + k] * buffer[RS + k]
        contact_radius = buffer[CONTACT_RADIUS + k]
        limit = arm * buffer[MODULUS + k] * contact_radius * overlap
        # 2.25 k_n (μ_r R*)² with k_n = 2 E* √(R* δ), and the modulus is 4/3 E*.
        stiffness = buffer.dtype.type(3.375) * buffer[MODULUS + k] * contact_radius * arm * arm
        keep = math.sqrt(min(before, overlap) / before) if before > zero else zero
        wx, wy, wz = buffer[PX + k], buffer[PY + k], buffer[PZ + k]
        along = wx * nx + wy * ny + wz * nz
        wx, wy, wz = wx - along * nx, wy - along * ny, wz - along * nz
        mx, my, mz = buffer[MX + k], buffer[MY + k], buffer[MZ + k]
        out = mx * nx + my * ny + mz * nz
        load, drag = stiffness * step, two * math.sqrt(buffer[INERTIA + k] * stiffness)
        mx = keep * (mx - out * nx) - load * wx
        my = keep * (my - out * ny) - load * wy
        mz = keep * (mz - out * nz) - load * wz
        qx, qy, qz = mx - drag * wx, my - drag * wy, mz - drag * wz
        squared = qx * qx + qy * qy + qz * qz
        scale = limit / math.sqrt(squared) if squared > limit * limit else one
        buffer[MX + k], buffer[MY + k], buffer[MZ + k] = scale * mx, scale * my, scale * mz
        buffer[QX + k], buffer[QY + k], buffer[QZ + k] = scale * qx, scale * qy, scale * qz


@kernel
def torques(buffer, size, two_arms):
    """n × f_t of a block → torque on the first, and where lever arms differ on the second."""
    if two_arms:
        for k in range(size):
            tx, ty, tz, arm = buffer[TX + k], buffer[TY + k], buffer[TZ + k], buffer[ARM_2 + k]
            buffer[UX + k], buffer[UY + k], buffer[UZ + k] = arm * tx, arm * ty, arm * tz
    for k in range(size):
        tx, ty, tz, arm = buffer[TX + k], buffer[TY + k], buffer[TZ + k], buffer[ARM_1 + k]
        buffer[TX + k], buffer[TY + k], buffer[TZ + k] = arm * tx, arm * ty, arm * tz


@kernel
def contact_laws(buffer, size, tangential, rolling, dt):
    """What the contacts of a block do: force on the first, n × f_t, rolling moment, and what they remember."""
    normal_law(buffer, size, dt)
    if rolling:
        rolling_law(buffer, size, dt)
    if tangential:
        slip_and_turn(buffer, size)
        load_history(buffer, size, dt)
        limit_friction(buffer, size)
    for k in range(size):
        buffer[BEFORE + k] = buffer[DELTA + k]


@kernel
def watch(buffer, size, length, times, unequal):
    """Keeps the largest overlaps and approaches; ``times`` what the column ``length`` has is the mean diameter."""
    for k in range(size):
        buffer[PEAK_OVERLAP + k] = max(buffer[PEAK_OVERLAP + k], buffer[DELTA + k])
        buffer[PEAK_APPROACH + k] = max(buffer[PEAK_APPROACH + k], buffer[APPROACH + k])
    if unequal:
        for k in range(size):
            buffer[PEAK_SHARE + k] = max(buffer[PEAK_SHARE + k], buffer[DELTA + k] / (times * buffer[length + k]))


@entry
def take_peaks(buffer, peaks, diameter):
    """Brings to ``peaks``, ``(3,)``, the largest overlap, m, its share of the mean diameter, and approach, m/s.

    From now on the buffer counts anew. A ``diameter``, m, is of equal spheres; where it is 0 the buffer has the share.
    """
    for k, first in enumerate((PEAK_OVERLAP, PEAK_SHARE, PEAK_APPROACH)):
        for lane in range(first, first + BLOCK):
            peaks[k] = max(peaks[k], float(buffer[lane]))
            buffer[lane] = 0.0
    if diameter > 0.0:
        peaks[1] = max(peaks[1], peaks[0] / diameter)
