"""The fast engine: a whole stretch of steps, neighbour rebuilds included, in one jitted call.

What makes it fast, on one thread:

- Rows of 4 (x, y, z, r) and 8 doubles (v, 1/m, ω, 1/I and force, torque): a contact touches few cache lines.
- Particles are sorted in space when a stretch begins; pairs are a flat half list with a Verlet skin.
- A branchless filter packs the touching pairs; blocks of them are gathered into one flat buffer, computed there
  in SIMD, and scattered. ``error_model="numpy"`` is what allows SIMD: a division may then not raise.
- The history lives in the slot of its pair and moves only when the list is rebuilt.

A stretch depends on nothing but the state that it starts from: order, lists and forces are made anew. So a run
that stops at a frame and goes on from its float64 state is bit for bit the run that did not stop.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from gran_bench.dem.contact import PREDICTION_FADE
from gran_bench.dem.integrate import Divergence, Physics
from gran_bench.dem.walls import CYLINDER
from gran_bench.neighbors import bin_cells, list_pairs
from gran_bench.state import ContactHistory, FloatArray, ParticleState

BLOCK = 128  # contacts of a block: its buffer stays in the first-level cache
# Rows of the block buffer. Fixed offsets into one flat array let the compiler prove that rows do not overlap.
NX, NY, NZ, OVERLAP = 0 * BLOCK, 1 * BLOCK, 2 * BLOCK, 3 * BLOCK  # normal (first the offset), overlap
VX, VY, VZ = 4 * BLOCK, 5 * BLOCK, 6 * BLOCK  # relative velocity of the centres, then of the contact points
PX, PY, PZ = 7 * BLOCK, 8 * BLOCK, 9 * BLOCK  # spin of the first
QX, QY, QZ = 10 * BLOCK, 11 * BLOCK, 12 * BLOCK  # spin of the second
R1, R2 = 13 * BLOCK, 14 * BLOCK  # radii, then lever arms
RS, MS = 15 * BLOCK, 16 * BLOCK  # effective radius and mass
HX, HY, HZ, BEFORE = 17 * BLOCK, 18 * BLOCK, 19 * BLOCK, 20 * BLOCK  # history
FX, FY, FZ = 21 * BLOCK, 22 * BLOCK, 23 * BLOCK  # force on the first
TX, TY, TZ = 24 * BLOCK, 25 * BLOCK, 26 * BLOCK  # n × f_t
MX, MY, MZ = 27 * BLOCK, 28 * BLOCK, 29 * BLOCK  # rolling moment: history in, moment on the first out
AX, AY, AZ = 30 * BLOCK, 31 * BLOCK, 32 * BLOCK  # what the relative velocity still gains until the step's end
ROWS = 33

FINISHED, DIVERGED = 0, 1


def advance(state: ParticleState, physics: Physics, time_step: float, wall_speed: FloatArray) -> ParticleState:
    """The state after a stretch of steps, its contact history included.

    Args:
        state: where the stretch starts.
        physics: laws, walls and gravity.
        time_step: Δt, s.
        wall_speed: ``(steps + 1,)`` angular speed of the walls, rad/s: at the start, then at the middle of each step.

    Raises:
        Divergence: a speed that crosses a quarter of a radius in a step, or is not finite.
    """
    count, history = state.count, state.history
    if count == 0:
        return state
    position = np.array(state.position, np.float64)
    velocity = np.array(state.velocity, np.float64)
    spin = np.array(state.angular_velocity, np.float64)
    radius = np.ascontiguousarray(state.radius, np.float64)
    status, particle, done, first, second, force, overlap, rolling = _advance(
        position, velocity, spin, radius,
        history.first, history.second, history.force, history.overlap, history.rolling_moment,
        physics.pair_constants, physics.wall_constants, physics.walls, physics.axis, physics.gravity,
        physics.density, physics.period, physics.skin, physics.tangential, physics.rolling,
        time_step, np.ascontiguousarray(wall_speed, np.float64),
    )  # fmt: skip
    if status == DIVERGED:
        raise Divergence(int(particle), int(done), position, velocity, spin)
    memory = ContactHistory(first, second, force, overlap, rolling)
    return ParticleState(position, velocity, spin, state.radius, state.time + done * time_step, memory)


@njit(cache=True, error_model="numpy")
def _advance(
    position, velocity, spin, radius, first, second, force, overlap, rolling_moment,
    pair_law, wall_law, walls, axis, gravity, density, period, skin, tangential, rolling, dt, wall_speed,
):  # fmt: skip
    """One stretch of ``len(wall_speed) − 1`` steps; the first three arrays are advanced in place."""
    count, steps = len(position), len(wall_speed) - 1
    sphere, motion, load = np.empty((count, 4)), np.empty((count, 8)), np.empty((count, 8))
    ahead = np.zeros((count, 4))
    order = _order_in_space(position, radius, skin, period)
    rank_of = np.empty(count, np.int64)
    smallest = np.inf
    for rank in range(count):
        i = order[rank]
        rank_of[i] = rank
        sphere[rank, 0], sphere[rank, 1], sphere[rank, 2] = position[i, 0], position[i, 1], position[i, 2]
        sphere[rank, 3] = radius[i]
        mass = 4.0 / 3.0 * math.pi * density * radius[i] ** 3
        motion[rank, 3], motion[rank, 7] = 1.0 / mass, 1.0 / (0.4 * mass * radius[i] ** 2)
        for k in range(3):
            motion[rank, k], motion[rank, 4 + k] = velocity[i, k], spin[i, k]
        smallest = min(smallest, radius[i])

    # The history in ranks, first < second; a wall is a negative second.
    memory = len(first)
    known_first, known_second = np.empty(memory, np.int64), np.empty(memory, np.int64)
    known = np.empty((memory, 7))
    for c in range(memory):
        a = rank_of[first[c]]
        b = rank_of[second[c]] if second[c] >= 0 else second[c]
        sign = 1.0
        if 0 <= b < a:
            a, b, sign = b, a, -1.0
        known_first[c], known_second[c] = a, b
        for k in range(3):
            known[c, k], known[c, 4 + k] = sign * force[c, k], sign * rolling_moment[c, k]
        known[c, 3] = overlap[c]

    pair_i, pair_j, wall_i, wall_w, pair_slot, wall_slot, pair_roll, wall_roll = _lists(
        sphere, walls, skin, period, known_first, known_second, known, rolling
    )
    reference = sphere.copy()
    buffer, active = np.empty(ROWS * BLOCK), np.empty(max(len(pair_i), len(wall_i)) + 1, np.uint32)
    status, culprit, done = FINISHED, -1, 0
    travelled, fastest_allowed = 0.0, (0.25 * smallest / dt) ** 2
    load[:] = 0.0
    _pair_forces(
        sphere, motion, ahead, load, pair_i, pair_j, pair_slot, pair_roll, active, buffer,
        pair_law, density, period, tangential, rolling, 0.0,
    )  # fmt: skip
    _wall_forces(
        sphere, motion, ahead, load, wall_i, wall_w, wall_slot, wall_roll, active, buffer,
        wall_law, walls, axis, density, tangential, rolling, wall_speed[0], 0.0,
    )  # fmt: skip
    for step in range(steps):
        kick = 0.5 * dt if step == 0 else dt
        fastest, culprit = _kick(motion, ahead, load, gravity, kick, 0.5 * dt, tangential, fastest_allowed)
        if culprit >= 0:
            status = DIVERGED
            break
        for i in range(count):
            sphere[i, 0] += dt * motion[i, 0]
            sphere[i, 1] += dt * motion[i, 1]
            sphere[i, 2] += dt * motion[i, 2]
        done = step + 1
        # The path of the fastest bounds all displacements at no cost; only when it crosses half the skin is the
        # true displacement looked at.
        travelled += dt * math.sqrt(fastest)
        if travelled > 0.5 * skin:
            travelled = _largest_displacement(sphere, reference)
            if travelled > 0.5 * skin:
                known_first, known_second, known = _touching(
                    pair_i, pair_j, pair_slot, pair_roll, wall_i, wall_w, wall_slot, wall_roll, rolling
                )
                _wrap(sphere, period)
                pair_i, pair_j, wall_i, wall_w, pair_slot, wall_slot, pair_roll, wall_roll = _lists(
                    sphere, walls, skin, period, known_first, known_second, known, rolling
                )
                if len(active) <= max(len(pair_i), len(wall_i)):
                    active = np.empty(max(len(pair_i), len(wall_i)) + 1, np.uint32)
                reference[:] = sphere
                travelled = 0.0
        load[:] = 0.0
        _pair_forces(
            sphere, motion, ahead, load, pair_i, pair_j, pair_slot, pair_roll, active, buffer,
            pair_law, density, period, tangential, rolling, dt,
        )  # fmt: skip
        _wall_forces(
            sphere, motion, ahead, load, wall_i, wall_w, wall_slot, wall_roll, active, buffer,
            wall_law, walls, axis, density, tangential, rolling, wall_speed[step + 1], dt,
        )  # fmt: skip
    if steps > 0 and status == FINISHED:
        fastest, culprit = _kick(motion, ahead, load, gravity, 0.5 * dt, 0.0, tangential, fastest_allowed)
        if culprit >= 0:
            status = DIVERGED

    known_first, known_second, known = _touching(
        pair_i, pair_j, pair_slot, pair_roll, wall_i, wall_w, wall_slot, wall_roll, rolling
    )
    _wrap(sphere, period)
    for rank in range(count):
        i = order[rank]
        for k in range(3):
            position[i, k], velocity[i, k], spin[i, k] = sphere[rank, k], motion[rank, k], motion[rank, 4 + k]
    memory = len(known_first)
    new_force, new_overlap, new_rolling = np.empty((memory, 3)), np.empty(memory), np.empty((memory, 3))
    for c in range(memory):
        a = order[known_first[c]]
        b = order[known_second[c]] if known_second[c] >= 0 else known_second[c]
        sign = 1.0
        if 0 <= b < a:
            a, b, sign = b, a, -1.0
        known_first[c], known_second[c], new_overlap[c] = a, b, known[c, 3]
        for k in range(3):
            new_force[c, k], new_rolling[c, k] = sign * known[c, k], sign * known[c, 4 + k]
    who = order[culprit] if culprit >= 0 else -1
    return status, who, done, known_first, known_second, new_force, new_overlap, new_rolling


@njit(cache=True, error_model="numpy")
def _order_in_space(position, radius, skin, period):
    sphere = np.empty((len(position), 4))
    largest = 0.0
    for i in range(len(position)):
        sphere[i, 0], sphere[i, 1], sphere[i, 2] = position[i, 0], position[i, 1], position[i, 2]
        largest = max(largest, radius[i])
    return bin_cells(sphere, 2.0 * largest + skin, period)[0]


@njit(cache=True, error_model="numpy")
def _kick(motion, ahead, load, gravity, dt, rest, tangential, fastest_allowed):
    """Velocities forward by dt, and in ``ahead`` what the same acceleration adds in the ``rest`` of the step.

    Returns the largest squared speed and the first row that is too fast or not finite.
    """
    fastest, culprit = 0.0, -1
    gx, gy, gz = gravity[0], gravity[1], gravity[2]
    for i in range(len(motion)):
        inverse_mass = motion[i, 3]
        ax, ay, az = inverse_mass * load[i, 0] + gx, inverse_mass * load[i, 1] + gy, inverse_mass * load[i, 2] + gz
        vx, vy, vz = motion[i, 0] + dt * ax, motion[i, 1] + dt * ay, motion[i, 2] + dt * az
        motion[i, 0], motion[i, 1], motion[i, 2] = vx, vy, vz
        ahead[i, 0], ahead[i, 1], ahead[i, 2] = rest * ax, rest * ay, rest * az
        squared = vx * vx + vy * vy + vz * vz
        fastest = max(fastest, squared)
        if not squared <= fastest_allowed and culprit < 0:
            culprit = i
    if tangential:
        for i in range(len(motion)):
            twist = dt * motion[i, 7]
            motion[i, 4] += twist * load[i, 4]
            motion[i, 5] += twist * load[i, 5]
            motion[i, 6] += twist * load[i, 6]
    return fastest, culprit


@njit(cache=True, error_model="numpy")
def _largest_displacement(sphere, reference):
    largest = 0.0
    for i in range(len(sphere)):
        dx, dy, dz = sphere[i, 0] - reference[i, 0], sphere[i, 1] - reference[i, 1], sphere[i, 2] - reference[i, 2]
        largest = max(largest, dx * dx + dy * dy + dz * dz)
    return math.sqrt(largest)


@njit(cache=True, error_model="numpy")
def _wrap(sphere, period):
    if period > 0.0:
        for i in range(len(sphere)):
            if not -0.5 * period <= sphere[i, 1] < 0.5 * period:
                sphere[i, 1] -= period * math.floor(sphere[i, 1] / period + 0.5)
                if sphere[i, 1] >= 0.5 * period:
                    sphere[i, 1] -= period


@njit(cache=True, error_model="numpy")
def _lists(sphere, walls, skin, period, known_first, known_second, known, rolling):
    """Pairs and wall contacts within the skin, with the history of those that touch in their slots."""
    pair_i, pair_j = list_pairs(sphere, skin, period)
    wall_i, wall_w = _near_walls(sphere, walls, 0.5 * skin)
    # Known contacts of each first particle as a chain.
    head, following = np.full(len(sphere), -1, np.int64), np.empty(len(known_first), np.int64)
    for c in range(len(known_first)):
        following[c] = head[known_first[c]]
        head[known_first[c]] = c
    pair_slot, wall_slot = np.zeros((len(pair_i), 4)), np.zeros((len(wall_i), 4))
    pair_roll = np.zeros((len(pair_i) if rolling else 0, 3))
    wall_roll = np.zeros((len(wall_i) if rolling else 0, 3))
    if len(known_first) > 0:
        for p in range(len(pair_i)):
            c = head[pair_i[p]]
            while c >= 0 and known_second[c] != pair_j[p]:
                c = following[c]
            if c >= 0:
                _remember(pair_slot, pair_roll, p, known, c, rolling)
        for p in range(len(wall_i)):
            c = head[wall_i[p]]
            while c >= 0 and known_second[c] != -1 - wall_w[p]:
                c = following[c]
            if c >= 0:
                _remember(wall_slot, wall_roll, p, known, c, rolling)
    return pair_i, pair_j, wall_i, wall_w, pair_slot, wall_slot, pair_roll, wall_roll


@njit(cache=True, error_model="numpy")
def _remember(slot, roll, p, known, c, rolling):
    for k in range(4):
        slot[p, k] = known[c, k]
    if rolling:
        for k in range(3):
            roll[p, k] = known[c, 4 + k]


@njit(cache=True, error_model="numpy")
def _touching(pair_i, pair_j, pair_slot, pair_roll, wall_i, wall_w, wall_slot, wall_roll, rolling):
    """The contacts that touched at the last force evaluation: first, second, and rows (force, overlap, moment)."""
    touching = 0
    for p in range(len(pair_i)):
        touching += pair_slot[p, 3] > 0.0
    for p in range(len(wall_i)):
        touching += wall_slot[p, 3] > 0.0
    first, second, known = np.empty(touching, np.int64), np.empty(touching, np.int64), np.zeros((touching, 7))
    c = 0
    for p in range(len(pair_i)):
        if pair_slot[p, 3] > 0.0:
            first[c], second[c] = pair_i[p], pair_j[p]
            known[c, :4] = pair_slot[p]
            if rolling:
                known[c, 4:] = pair_roll[p]
            c += 1
    for p in range(len(wall_i)):
        if wall_slot[p, 3] > 0.0:
            first[c], second[c] = wall_i[p], -1 - np.int64(wall_w[p])
            known[c, :4] = wall_slot[p]
            if rolling:
                known[c, 4:] = wall_roll[p]
            c += 1
    return first, second, known


@njit(cache=True, error_model="numpy")
def _toward_wall(wall, x, y, z):
    """Distance of a point from a wall and the unit vector to it (zero on a cylinder's axis)."""
    ox, oy, oz = x - wall[1], y - wall[2], z - wall[3]
    along = ox * wall[4] + oy * wall[5] + oz * wall[6]
    if wall[0] != CYLINDER:
        return along, -wall[4], -wall[5], -wall[6]
    ox, oy, oz = ox - along * wall[4], oy - along * wall[5], oz - along * wall[6]
    reach = math.sqrt(ox * ox + oy * oy + oz * oz)
    inverse = 1.0 / reach if reach > 0.0 else 0.0
    return wall[7] - reach, ox * inverse, oy * inverse, oz * inverse


@njit(cache=True, error_model="numpy")
def _near_walls(sphere, walls, margin):
    """Particles and walls whose surfaces are closer than ``margin``, ``(M,)`` uint32 each."""
    room = len(sphere) * len(walls)
    wall_i, wall_w = np.empty(room, np.uint32), np.empty(room, np.uint32)
    found = 0
    for w in range(len(walls)):
        for i in range(len(sphere)):
            distance = _toward_wall(walls[w], sphere[i, 0], sphere[i, 1], sphere[i, 2])[0]
            wall_i[found], wall_w[found] = i, w
            found += distance - sphere[i, 3] < margin
    return wall_i[:found].copy(), wall_w[:found].copy()


@njit(cache=True, error_model="numpy")
def _pair_forces(
    sphere,
    motion,
    ahead,
    load,
    pair_i,
    pair_j,
    slot,
    roll,
    active,
    buffer,
    law,
    density,
    period,
    tangential,
    rolling,
    dt,
):
    """Adds the forces and torques of all touching pairs to ``load`` and updates their history."""
    touching = 0
    for p in range(len(pair_i)):
        i, j = pair_i[p], pair_j[p]
        dx = sphere[j, 0] - sphere[i, 0]
        dy = sphere[j, 1] - sphere[i, 1]
        dz = sphere[j, 2] - sphere[i, 2]
        if period > 0.0:
            dy -= period * np.rint(dy / period)
        reach = sphere[i, 3] + sphere[j, 3]
        near = dx * dx + dy * dy + dz * dz < reach * reach
        active[touching] = p
        touching += near
        slot[p, 3] *= near  # a contact that opened forgets
    for begin in range(0, touching, BLOCK):
        size = min(BLOCK, touching - begin)
        for k in range(size):
            p = active[begin + k]
            i, j = pair_i[p], pair_j[p]
            buffer[NX + k] = sphere[j, 0] - sphere[i, 0]
            buffer[NY + k] = sphere[j, 1] - sphere[i, 1]
            buffer[NZ + k] = sphere[j, 2] - sphere[i, 2]
            buffer[R1 + k], buffer[R2 + k] = sphere[i, 3], sphere[j, 3]
            buffer[VX + k] = motion[i, 0] - motion[j, 0]
            buffer[VY + k] = motion[i, 1] - motion[j, 1]
            buffer[VZ + k] = motion[i, 2] - motion[j, 2]
            buffer[AX + k] = ahead[i, 0] - ahead[j, 0]
            buffer[AY + k] = ahead[i, 1] - ahead[j, 1]
            buffer[AZ + k] = ahead[i, 2] - ahead[j, 2]
            if tangential:
                buffer[PX + k], buffer[PY + k], buffer[PZ + k] = motion[i, 4], motion[i, 5], motion[i, 6]
                buffer[QX + k], buffer[QY + k], buffer[QZ + k] = motion[j, 4], motion[j, 5], motion[j, 6]
                buffer[HX + k], buffer[HY + k], buffer[HZ + k] = slot[p, 0], slot[p, 1], slot[p, 2]
                buffer[BEFORE + k] = slot[p, 3]
            if rolling:
                buffer[MX + k], buffer[MY + k], buffer[MZ + k] = roll[p, 0], roll[p, 1], roll[p, 2]
        if period > 0.0:
            for k in range(size):
                buffer[NY + k] -= period * np.rint(buffer[NY + k] / period)
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
            slot[p, 3] = buffer[OVERLAP + k]
            if tangential:
                tx, ty, tz = buffer[TX + k], buffer[TY + k], buffer[TZ + k]
                first_arm, second_arm = buffer[R1 + k], buffer[R2 + k]
                load[i, 4] += first_arm * tx
                load[i, 5] += first_arm * ty
                load[i, 6] += first_arm * tz
                load[j, 4] += second_arm * tx
                load[j, 5] += second_arm * ty
                load[j, 6] += second_arm * tz
                slot[p, 0], slot[p, 1], slot[p, 2] = buffer[HX + k], buffer[HY + k], buffer[HZ + k]
            if rolling:
                for k3 in range(3):
                    moment = buffer[MX + k3 * BLOCK + k]
                    load[i, 4 + k3] += moment
                    load[j, 4 + k3] -= moment
                    roll[p, k3] = moment


@njit(cache=True, error_model="numpy")
def _wall_forces(
    sphere, motion, ahead, load, wall_i, wall_w, slot, roll, active, buffer,
    law, walls, axis, density, tangential, rolling, speed, dt,
):  # fmt: skip
    """Adds the forces and torques of all touching walls to ``load`` and updates their history."""
    touching = 0
    for p in range(len(wall_i)):
        i = wall_i[p]
        distance = _toward_wall(walls[wall_w[p]], sphere[i, 0], sphere[i, 1], sphere[i, 2])[0]
        near = distance < sphere[i, 3]
        active[touching] = p
        touching += near
        slot[p, 3] *= near
    for begin in range(0, touching, BLOCK):
        size = min(BLOCK, touching - begin)
        for k in range(size):
            p = active[begin + k]
            i, w = wall_i[p], wall_w[p]
            x, y, z, radius = sphere[i, 0], sphere[i, 1], sphere[i, 2], sphere[i, 3]
            distance, nx, ny, nz = _toward_wall(walls[w], x, y, z)
            buffer[NX + k], buffer[NY + k], buffer[NZ + k] = nx, ny, nz
            buffer[OVERLAP + k] = radius - distance
            buffer[RS + k], buffer[MS + k] = radius, 4.0 / 3.0 * math.pi * density * radius**3
            # The wall is a partner that does not spin; its material point moves with ω × x.
            buffer[R1 + k], buffer[R2 + k] = distance, 0.0
            vx, vy, vz = motion[i, 0], motion[i, 1], motion[i, 2]
            if walls[w, 8] != 0.0 and speed != 0.0:
                cx, cy, cz = x + distance * nx, y + distance * ny, z + distance * nz
                vx -= speed * (axis[1] * cz - axis[2] * cy)
                vy -= speed * (axis[2] * cx - axis[0] * cz)
                vz -= speed * (axis[0] * cy - axis[1] * cx)
            buffer[VX + k], buffer[VY + k], buffer[VZ + k] = vx, vy, vz
            buffer[AX + k], buffer[AY + k], buffer[AZ + k] = ahead[i, 0], ahead[i, 1], ahead[i, 2]
            if tangential:
                buffer[PX + k], buffer[PY + k], buffer[PZ + k] = motion[i, 4], motion[i, 5], motion[i, 6]
                buffer[HX + k], buffer[HY + k], buffer[HZ + k] = slot[p, 0], slot[p, 1], slot[p, 2]
                buffer[BEFORE + k] = slot[p, 3]
                buffer[QX + k], buffer[QY + k], buffer[QZ + k] = 0.0, 0.0, 0.0
            if rolling:
                # What rolls on a turning wall rolls against the wall's own rotation.
                turning = speed * walls[w, 8]
                buffer[QX + k], buffer[QY + k], buffer[QZ + k] = turning * axis[0], turning * axis[1], turning * axis[2]
                buffer[MX + k], buffer[MY + k], buffer[MZ + k] = roll[p, 0], roll[p, 1], roll[p, 2]
        _law(buffer, size, law, tangential, dt)
        if rolling:
            _roll(buffer, size, law, dt)
        for k in range(size):
            p = active[begin + k]
            i = wall_i[p]
            load[i, 0] += buffer[FX + k]
            load[i, 1] += buffer[FY + k]
            load[i, 2] += buffer[FZ + k]
            slot[p, 3] = buffer[OVERLAP + k]
            if tangential:
                arm = buffer[R1 + k]
                load[i, 4] += arm * buffer[TX + k]
                load[i, 5] += arm * buffer[TY + k]
                load[i, 6] += arm * buffer[TZ + k]
                slot[p, 0], slot[p, 1], slot[p, 2] = buffer[HX + k], buffer[HY + k], buffer[HZ + k]
            if rolling:
                for k3 in range(3):
                    load[i, 4 + k3] += buffer[MX + k3 * BLOCK + k]
                    roll[p, k3] = buffer[MX + k3 * BLOCK + k]


@njit(cache=True, error_model="numpy")
def _pair_geometry(buffer, size, density):
    """Offsets and radii of a block → normal, overlap, lever arms, R* and m*."""
    for k in range(size):
        dx, dy, dz = buffer[NX + k], buffer[NY + k], buffer[NZ + k]
        r1, r2 = buffer[R1 + k], buffer[R2 + k]
        distance = math.sqrt(dx * dx + dy * dy + dz * dz)
        inverse = 1.0 / distance
        buffer[NX + k], buffer[NY + k], buffer[NZ + k] = dx * inverse, dy * inverse, dz * inverse
        buffer[OVERLAP + k] = r1 + r2 - distance
        # Both lever arms end on the plane of the circle in which the spheres intersect.
        arm = 0.5 * (distance + (r1 - r2) * (r1 + r2) * inverse)
        buffer[R1 + k], buffer[R2 + k] = arm, distance - arm
        buffer[RS + k] = r1 * r2 / (r1 + r2)
        m1, m2 = r1 * r1 * r1, r2 * r2 * r2
        buffer[MS + k] = 4.0 / 3.0 * math.pi * density * (m1 * m2 / (m1 + m2))


@njit(cache=True, error_model="numpy")
def _law(buffer, size, law, tangential, dt):
    """Force on the first of each contact of a block, n × f_t, and the new history (see contact.py)."""
    modulus, shear, damping, friction = law[0], law[1], law[2], law[3]
    for k in range(size):
        nx, ny, nz, overlap = buffer[NX + k], buffer[NY + k], buffer[NZ + k], buffer[OVERLAP + k]
        vx, vy, vz = buffer[VX + k], buffer[VY + k], buffer[VZ + k]
        approach = vx * nx + vy * ny + vz * nz
        contact_radius = math.sqrt(buffer[RS + k] * overlap)
        stiffness = modulus * contact_radius  # K √δ
        drag = damping * math.sqrt(buffer[MS + k] * stiffness)  # α √(m* K) δ^(1/4)
        gain = buffer[AX + k] * nx + buffer[AY + k] * ny + buffer[AZ + k] * nz
        gain *= max(0.0, 1.0 - PREDICTION_FADE * drag * dt / buffer[MS + k])
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
            # The history turns with the contact plane: what leaves the plane is removed, the length is kept.
            before = buffer[BEFORE + k]
            hx, hy, hz = buffer[HX + k], buffer[HY + k], buffer[HZ + k]
            length = hx * hx + hy * hy + hz * hz
            out = hx * nx + hy * ny + hz * nz
            hx, hy, hz = hx - out * nx, hy - out * ny, hz - out * nz
            inside = hx * hx + hy * hy + hz * hz
            keep = math.sqrt(length / inside) if inside > 0.0 else 0.0
            # It unloads with the contact's size; a new contact remembers nothing.
            keep *= math.sqrt(min(1.0, overlap / before)) if before > 0.0 else 0.0
            load = shear * contact_radius * dt
            hx, hy, hz = keep * hx - load * sx, keep * hy - load * sy, keep * hz - load * sz
            fx, fy, fz = hx - drag * sx, hy - drag * sy, hz - drag * sz
            size_of_force = fx * fx + fy * fy + fz * fz
            limit = friction * normal
            slip = limit / math.sqrt(size_of_force) if size_of_force > limit * limit else 1.0
            fx, fy, fz = slip * fx, slip * fy, slip * fz
            buffer[HX + k], buffer[HY + k], buffer[HZ + k] = slip * hx, slip * hy, slip * hz
            buffer[FX + k] += fx
            buffer[FY + k] += fy
            buffer[FZ + k] += fz
            buffer[TX + k] = ny * fz - nz * fy
            buffer[TY + k] = nz * fx - nx * fz
            buffer[TZ + k] = nx * fy - ny * fx


@njit(cache=True, error_model="numpy")
def _roll(buffer, size, law, dt):
    """Rolling moment on the first of each contact of a block (see rolling.py)."""
    modulus, rolling = law[0], law[4]
    for k in range(size):
        nx, ny, nz, overlap = buffer[NX + k], buffer[NY + k], buffer[NZ + k], buffer[OVERLAP + k]
        radius = buffer[RS + k]
        contact_radius = math.sqrt(radius * overlap)
        # The stiffness belongs to the elastic normal force, the limit too: damping does not resist rolling.
        elastic = modulus * contact_radius * overlap
        limit = rolling * radius * elastic
        stiffness = 2.25 * 1.5 * modulus * contact_radius * (rolling * radius) ** 2
        wx = buffer[PX + k] - buffer[QX + k]
        wy = buffer[PY + k] - buffer[QY + k]
        wz = buffer[PZ + k] - buffer[QZ + k]
        spin = wx * nx + wy * ny + wz * nz
        wx, wy, wz = wx - spin * nx, wy - spin * ny, wz - spin * nz
        known = 1.0 if buffer[BEFORE + k] > 0.0 else 0.0
        mx, my, mz = known * buffer[MX + k], known * buffer[MY + k], known * buffer[MZ + k]
        out = mx * nx + my * ny + mz * nz
        mx = mx - out * nx - stiffness * dt * wx
        my = my - out * ny - stiffness * dt * wy
        mz = mz - out * nz - stiffness * dt * wz
        squared = mx * mx + my * my + mz * mz
        scale = limit / math.sqrt(squared) if squared > limit * limit else 1.0
        buffer[MX + k], buffer[MY + k], buffer[MZ + k] = scale * mx, scale * my, scale * mz
