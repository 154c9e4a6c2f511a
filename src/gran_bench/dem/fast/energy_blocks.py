"""What the contacts of a block lose, and what walls do: the sums of energy.py, to which tests hold them (jitted).

They read what the laws left in a block and write nothing that the laws read, so that no bit of a trajectory depends on
them. ``books`` is what a thread writes, or None; with None the compiler leaves all of this out.
"""

import math
from typing import NamedTuple

import numpy as np

from gran_bench.dem.energy import (
    AT_LIMIT,
    BINS,
    BINS_A_DECADE,
    LOSSES,
    LOST_NORMAL,
    LOST_SHEAR,
    LOWEST_DECADE,
    OWNER,
    SPECTRA,
    SPRINGS,
    WORK,
    Work,
)
from gran_bench.dem.fast import contact_blocks as block
from gran_bench.dem.fast.rows import BLOCK
from gran_bench.neighbors.kernel import kernel
from gran_bench.state import FloatArray

# Of `Books`, as kernels index them: Numba leaves out what follows ``if books is not None`` only for plain arguments.
LOST, WALLS, COUNTS, AHEAD, RECALLED = range(5)
PAIR, WALL = range(2)
_DAMPING, _SLIDING, _TANGENTIAL, _RELEASE, _ROLLING = range(len(LOSSES))
_IMPACT, _NORMAL, _SHEAR = range(len(SPECTRA))


class Books(NamedTuple):
    """What a thread writes: the sums of each chunk, and what it needs for them."""

    lost: FloatArray  # ``(C, 2, 5)`` J, of pairs and walls
    walls: FloatArray  # ``(C, W, 7)`` as of `energy.Work`
    counts: np.ndarray  # ``(C, 2, 3, BINS)`` int64
    ahead: FloatArray  # ``(N + 2, 4)`` what spins still gain until the end of the step, rad/s
    recalled: np.ndarray  # ``(BLOCK,)`` row of the old history of each lane, 0 where it remembers nothing

    @classmethod
    def of_chunks(cls, chunks: int, walls: int, bodies: int) -> list["Books"]:
        """Books of as many threads as there may be, which share all but the last."""
        shared = (
            np.zeros((chunks, 2, len(LOSSES))), np.zeros((chunks, walls, 7)),
            np.zeros((chunks, 2, len(SPECTRA), BINS), np.int64), np.zeros((bodies, 4)),
        )  # fmt: skip
        return [cls(*shared, np.zeros(BLOCK, np.uint32)) for _ in range(chunks)]

    def take(self, steps: int) -> Work:
        """The sums of all chunks, which begin anew."""
        work = Work(steps, *(sums.sum(axis=0) for sums in self[:3]))
        for sums in self[:3]:
            sums[:] = 0
        return work


@kernel
def recall(books, lane, rows):
    """Notes the rows of the old history that four lanes have."""
    for k in range(4):
        books[RECALLED][lane + k] = rows[k]


@kernel
def pair_losses(
    buffer, filled, first, sphere, near_i, near_j, active, old_slot, slot_moment, old_ledger, ledger, books, chunk,
    tangential, rolling, unequal, full_radius, dt,
):  # fmt: skip
    """Counts what a block of pairs loses; after the laws and before `contact_blocks.torques`."""
    ahead, recalled = books[AHEAD], books[RECALLED]
    lost, counts = books[LOST][chunk, PAIR], books[COUNTS][chunk, PAIR]
    for k in range(filled):
        place = active[first + k]
        i, j = near_i[place], near_j[place]
        # Through float64, whatever the block is in: with float32 arms the sums would depend on the other lanes.
        one = np.float64(buffer[block.ARM_1 + k])
        other = np.float64(buffer[block.ARM_2 + k]) if unequal else one
        if full_radius:
            one, other = sphere[i, 3], sphere[j, 3]
        _lane_losses(
            buffer, k, first + k, i, recalled[k],
            one * ahead[i, 0] + other * ahead[j, 0], one * ahead[i, 1] + other * ahead[j, 1],
            one * ahead[i, 2] + other * ahead[j, 2],
            ahead[i, 0] - ahead[j, 0], ahead[i, 1] - ahead[j, 1], ahead[i, 2] - ahead[j, 2],
            old_slot, slot_moment, old_ledger, ledger, lost, counts, tangential, rolling, dt,
        )  # fmt: skip


@kernel
def wall_losses(
    buffer, filled, first, sphere, wall_i, wall_w, active, geometry, walls, old_slot, slot_moment, old_ledger, ledger,
    books, chunk, tangential, rolling, dt,
):  # fmt: skip
    """The same of a block of contacts with walls; and what the walls do to the spheres."""
    ahead, recalled, sums = books[AHEAD], books[RECALLED], books[WALLS][chunk]
    lost, counts = books[LOST][chunk, WALL], books[COUNTS][chunk, WALL]
    for k in range(filled):
        place = active[first + k]
        i, w = wall_i[place], wall_w[place]
        arm = np.float64(buffer[block.ARM_1 + k])
        _lane_losses(
            buffer, k, first + k, i, recalled[k], arm * ahead[i, 0], arm * ahead[i, 1], arm * ahead[i, 2],
            ahead[i, 0], ahead[i, 1], ahead[i, 2],
            old_slot, slot_moment, old_ledger, ledger, lost, counts, tangential, rolling, dt,
        )  # fmt: skip
        distance = geometry[first + k, 3]
        x = sphere[i, 0] + distance * geometry[first + k, 0]
        y = sphere[i, 1] + distance * geometry[first + k, 1]
        z = sphere[i, 2] + distance * geometry[first + k, 2]
        cx, cy, cz = x - walls[w, 17], y - walls[w, 18], z - walls[w, 19]
        w0, w1, w2 = walls[w, 14], walls[w, 15], walls[w, 16]
        fx, fy, fz = dt * buffer[block.FX + k], dt * buffer[block.FY + k], dt * buffer[block.FZ + k]
        mx, my, mz = 0.0, 0.0, 0.0
        if rolling:
            mx, my, mz = dt * buffer[block.QX + k], dt * buffer[block.QY + k], dt * buffer[block.QZ + k]
        sums[w, 0] += fx
        sums[w, 1] += fy
        sums[w, 2] += fz
        sums[w, 3] += y * fz - z * fy + mx
        sums[w, 4] += z * fx - x * fz + my
        sums[w, 5] += x * fy - y * fx + mz
        sums[w, WORK] += (
            fx * (walls[w, 11] + (w1 * cz - w2 * cy))
            + fy * (walls[w, 12] + (w2 * cx - w0 * cz))
            + fz * (walls[w, 13] + (w0 * cy - w1 * cx))
            + (mx * w0 + my * w1 + mz * w2)
        )


@kernel
def close_contacts(old_ledger, rows, bounds, chunk, stop, books, kind):
    """Counts the contacts of rows 1 … rows − 1 that no contact took over, by what they have lost."""
    for row in range(1, rows):
        owner = old_ledger[row, OWNER]
        if owner < bounds[chunk] or owner >= bounds[stop]:  # taken over, or of another thread
            continue
        c = chunk
        while owner >= bounds[c + 1]:
            c += 1
        springs, counts = old_ledger[row, SPRINGS], books[COUNTS][c, kind]
        books[LOST][c, kind, _RELEASE] += springs
        counts[_NORMAL, _bin_of(old_ledger[row, LOST_NORMAL])] += 1
        counts[_SHEAR, _bin_of(old_ledger[row, LOST_SHEAR] + springs)] += 1


@kernel
def _bin_of(energy):
    if not energy > 0.0:
        return 0
    return min(max(math.floor(BINS_A_DECADE * (math.log10(energy) - LOWEST_DECADE)), 0), BINS - 1)


@kernel
def _lane_losses(
    buffer, k, row, owner, old, gx, gy, gz, rx, ry, rz, old_slot, old_moment, old_ledger, ledger, lost, counts,
    tangential, rolling, dt,
):  # fmt: skip
    """What one contact loses (see energy.py), and its new row; g and r are what Σ arm × ω and ω₁ − ω₂ still gain."""
    nx, ny, nz, overlap = buffer[block.NX + k], buffer[block.NY + k], buffer[block.NZ + k], buffer[block.DELTA + k]
    load, radius, gain = buffer[block.LOAD + k], buffer[block.CONTACT_RADIUS + k], buffer[block.GAIN + k]
    approach = np.float64(buffer[block.APPROACH + k])
    damping = (load - buffer[block.MODULUS + k] * radius * overlap) * (approach + gain) * dt
    shear, springs = 0.0, 0.0
    if tangential:
        hx, hy, hz, before = old_slot[old, 0], old_slot[old, 1], old_slot[old, 2], old_slot[old, 3]
        kx, ky, kz = buffer[block.HX + k], buffer[block.HY + k], buffer[block.HZ + k]
        sx, sy, sz = buffer[block.WX + k], buffer[block.WY + k], buffer[block.WZ + k]
        tx = buffer[block.FX + k] + load * nx
        ty = buffer[block.FY + k] + load * ny
        tz = buffer[block.FZ + k] + load * nz
        # The slip at the end of the step.
        ex = sx + buffer[block.AX + k] - gain * nx + (gy * nz - gz * ny)
        ey = sy + buffer[block.AY + k] - gain * ny + (gz * nx - gx * nz)
        ez = sz + buffer[block.AZ + k] - gain * nz + (gx * ny - gy * nx)
        compliance = 0.5 / buffer[block.SHEAR + k]
        squared, out = hx * hx + hy * hy + hz * hz, hx * nx + hy * ny + hz * nz
        fx, fy, fz = hx - out * nx, hy - out * ny, hz - out * nz
        inside = fx * fx + fy * fy + fz * fz
        turned = math.sqrt(squared / inside) if inside > 0.0 else 0.0
        stored = compliance * squared / math.sqrt(buffer[block.RS + k] * before) if before > 0.0 else 0.0
        kept = compliance * (kx * kx + ky * ky + kz * kz) / radius if radius > 0.0 else 0.0
        spring = -0.5 * dt * (turned * (fx * sx + fy * sy + fz * sz) + (kx * sx + ky * sy + kz * sz)) - (kept - stored)
        damped = -dt * ((tx - kx) * ex + (ty - ky) * ey + (tz - kz) * ez)
        limit = AT_LIMIT * buffer[block.FRICTION + k] * load
        springs = kept
        if dt > 0.0:
            shear = spring + damped
            if tx * tx + ty * ty + tz * tz >= limit * limit:
                smaller = min(1.0, overlap / before) if before > 0.0 else 0.0
                released = stored - (compliance * squared * smaller / radius if radius > 0.0 else 0.0)
                lost[_SLIDING] += spring + damped - released
                lost[_RELEASE] += released
            else:
                lost[_TANGENTIAL] += damped
                lost[_RELEASE] += spring
    if rolling:
        before = old_slot[old, 3]
        arm = buffer[block.ROLLING + k] * buffer[block.RS + k]
        stiffness = 3.375 * buffer[block.MODULUS + k] * arm * arm  # k_r / a
        px, py, pz = buffer[block.PX + k], buffer[block.PY + k], buffer[block.PZ + k]
        along, rise = px * nx + py * ny + pz * nz, rx * nx + ry * ny + rz * nz
        px, py, pz = px - along * nx, py - along * ny, pz - along * nz
        mx, my, mz = buffer[block.MX + k], buffer[block.MY + k], buffer[block.MZ + k]
        ox, oy, oz = old_moment[old, 0], old_moment[old, 1], old_moment[old, 2]
        holds, stored = 0.0, 0.0
        if stiffness > 0.0:
            if radius > 0.0:
                holds = 0.5 * (mx * mx + my * my + mz * mz) / (stiffness * radius)
            if before > 0.0:
                stored = 0.5 * (ox * ox + oy * oy + oz * oz) / (stiffness * math.sqrt(buffer[block.RS + k] * before))
        work = 0.5 * ((ox + mx) * px + (oy + my) * py + (oz + mz) * pz)
        work += (buffer[block.QX + k] - mx) * (px + rx - rise * nx)
        work += (buffer[block.QY + k] - my) * (py + ry - rise * ny)
        work += (buffer[block.QZ + k] - mz) * (pz + rz - rise * nz)
        if dt > 0.0:
            lost[_ROLLING] += -dt * work - (holds - stored)
        springs += holds
    lost[_DAMPING] += damping
    if old == 0 and dt > 0.0:
        impact = 0.5 * buffer[block.MS + k] * approach * approach
        counts[_IMPACT, _bin_of(impact if approach > 0.0 else 0.0)] += 1
    ledger[row, LOST_NORMAL] = old_ledger[old, LOST_NORMAL] + damping
    ledger[row, LOST_SHEAR] = old_ledger[old, LOST_SHEAR] + shear
    ledger[row, SPRINGS], ledger[row, OWNER] = springs, owner
    if old != 0:
        old_ledger[old, OWNER] = -1.0
