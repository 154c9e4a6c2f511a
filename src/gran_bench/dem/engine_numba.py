"""The fast engine: a whole stretch of steps, neighbour searches included, in one jitted call.

What makes it fast, on one thread:

- Rows of 4 (x, y, z, r) and 8 doubles (v, 1/m, ω, 1/I; force, torque): a contact touches few cache lines.
- Particles are sorted in space when a stretch begins; pairs are flat half lists, pruned often, searched for rarely
  (contact_list.py).
- A branchless filter packs the touching pairs; blocks of them are gathered into one flat buffer, computed there in
  SIMD, and scattered (contact_blocks.py). ``error_model="numpy"`` is what allows SIMD: a division may then not raise.
- The history lives in the slot of its pair and moves only when pairs are searched for.

A stretch depends on nothing but the state that it starts from: order, lists and forces are made anew. So a run that
stops at a frame and goes on from its float64 state is bit for bit the run that did not stop.
"""

from __future__ import annotations

import hashlib
import math
from pathlib import Path

import numpy as np
from numba import njit

from gran_bench import neighbors
from gran_bench.dem.contact_blocks import BUFFER_SIZE, pair_forces
from gran_bench.dem.contact_list import (
    INNER_SHARE,
    largest_displacement,
    list_contacts,
    prune,
    touching_contacts,
)
from gran_bench.dem.integrate import Divergence, Physics
from gran_bench.dem.wall_contacts import near_walls, wall_forces
from gran_bench.neighbors import bin_cells
from gran_bench.state import ContactHistory, FloatArray, ParticleState


def advance(state: ParticleState, physics: Physics, time_step: float, walls: FloatArray) -> ParticleState:
    """The state after a stretch of steps, its contact history included.

    Args:
        state: where the stretch starts.
        physics: laws and gravity.
        time_step: Δt, s.
        walls: ``(steps + 1, W, 21)`` pose of each wall at each force evaluation (see walls.py).

    Raises:
        Divergence: a speed that crosses a quarter of a radius in a step, or is not finite.
    """
    count, history = state.count, state.history
    if count == 0:
        return state
    if len(physics.density) > 1:
        raise NotImplementedError("several particle materials need dem.engine=numpy")
    position = np.array(state.position, np.float64)
    velocity = np.array(state.velocity, np.float64)
    spin = np.array(state.angular_velocity, np.float64)
    culprit, done, first, second, known = _stretch(
        position, velocity, spin, np.array(state.radius, np.float64), np.array(state.material, np.uint8),
        np.array(history.first, np.int64), np.array(history.second, np.int64),
        np.column_stack((history.force, history.overlap, history.rolling_moment)),
        physics.pair_laws, physics.wall_laws, physics.gravity,
        physics.density, physics.period, physics.skin, physics.tangential, physics.rolling,
        float(time_step), np.ascontiguousarray(walls, np.float64),
    )  # fmt: skip
    if culprit >= 0:
        raise Divergence(int(culprit), int(done), position, velocity, spin)
    memory = ContactHistory(first, second, known[:, :3].copy(), known[:, 3].copy(), known[:, 4:].copy())
    time = state.time + done * time_step
    return ParticleState(position, velocity, spin, state.radius, time, memory, state.material)


def _keyed_stretch(sources: str):
    """The jitted stretch, cached on disk under the digest of everything that it is compiled from.

    Numba keys its cache by the file of the function alone; a kernel of another file that changed would be found
    under the old key. A closure's variables are part of the key.
    """

    @njit(cache=True, error_model="numpy")
    def stretch(
        position, velocity, spin, radius, material, first, second, known, pair_laws, wall_laws, gravity,
        density, period, skin, tangential, rolling, dt, walls,
    ):  # fmt: skip
        sources  # noqa: B018 (the key)
        return _advance(
            position, velocity, spin, radius, material, first, second, known, pair_laws, wall_laws, gravity,
            density, period, skin, tangential, rolling, dt, walls,
        )  # fmt: skip

    return stretch


def _digest_of_sources() -> str:
    files = [*sorted(Path(__file__).parent.glob("*.py")), Path(neighbors.__file__)]
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()


@njit(error_model="numpy")
def _advance(
    position, velocity, spin, radius, material, first, second, known, pair_laws, wall_laws, gravity,
    density, period, skin, tangential, rolling, dt, walls,
):  # fmt: skip
    """One stretch of ``len(walls) − 1`` steps; position, velocity and spin are advanced in place.

    Returns the particle that diverged or −1, the completed steps, and the touching contacts with their memory.
    """
    steps, inner = len(walls) - 1, INNER_SHARE * skin
    order, rank = _order_in_space(position, radius, skin, period)
    sphere, motion, species, smallest = _packed(position, velocity, spin, radius, material, density, order)
    ahead, load = np.zeros((len(order), 4)), np.zeros((len(order), 8))
    fastest_allowed = (0.25 * smallest / dt) ** 2
    first, second, known = _renamed(first, second, known, rank)

    wall_i, wall_w = near_walls(sphere, species, len(density), walls, 0, 0.5 * skin)
    pair_i, pair_j, pair_slot, pair_touched, wall_i, wall_w, wall_slot, wall_touched = list_contacts(
        sphere, wall_i, wall_w, skin, period, first, second, known, np.int64(0), rolling
    )
    searched_at, pruned_at, travelled = sphere.copy(), sphere.copy(), 0.0
    near, active, geometry = _room(pair_i, wall_i)
    near_count = prune(sphere, pair_i, pair_j, inner, period, near)
    buffer = np.empty(BUFFER_SIZE)
    culprit, done = -1, 0
    # Evaluation 1 is of the state itself and loads no history; the last one of a stretch is number steps + 1.
    for evaluation in range(1, steps + 2):
        span = 0.0 if evaluation == 1 else dt
        if evaluation > 1:
            kick = 0.5 * dt if evaluation == 2 else dt
            fastest, culprit = _kick(motion, ahead, load, gravity, kick, 0.5 * dt, tangential, fastest_allowed)
            if culprit >= 0:
                break
            _drift(sphere, motion, dt)
            done += 1
            # The path of the fastest bounds all displacements at no cost; only when it leaves the reach of the
            # inner list is the true displacement looked at.
            travelled += dt * math.sqrt(fastest)
            if travelled > 0.5 * inner:
                travelled = largest_displacement(sphere, pruned_at)
                if travelled > 0.5 * inner:
                    if largest_displacement(sphere, searched_at) > 0.5 * (skin - inner):
                        first, second, known = touching_contacts(
                            pair_i, pair_j, pair_slot, pair_touched,
                            wall_i, wall_w, wall_slot, wall_touched, evaluation - 1,
                        )  # fmt: skip
                        _wrap(sphere, period)
                        wall_i, wall_w = near_walls(sphere, species, len(density), walls, evaluation - 1, 0.5 * skin)
                        (
                            pair_i, pair_j, pair_slot, pair_touched,
                            wall_i, wall_w, wall_slot, wall_touched,
                        ) = list_contacts(
                            sphere, wall_i, wall_w, skin, period, first, second, known, evaluation - 1, rolling
                        )  # fmt: skip
                        near, active, geometry = _room(pair_i, wall_i)
                        searched_at = sphere.copy()
                    near_count = prune(sphere, pair_i, pair_j, inner, period, near)
                    pruned_at = sphere.copy()
                    travelled = 0.0
            load[:] = 0.0
        pair_forces(
            sphere, motion, ahead, load, pair_i, pair_j, near, near_count, pair_slot, pair_touched, evaluation,
            active, buffer, pair_laws[0, 0], density[0], period, tangential, rolling, span,
        )  # fmt: skip
        wall_forces(
            sphere, motion, species, ahead, load, wall_i, wall_w, wall_slot, wall_touched, evaluation,
            active, geometry, buffer, wall_laws, walls[evaluation - 1], density, tangential, rolling, span,
        )  # fmt: skip
    if steps > 0 and culprit < 0:
        _, culprit = _kick(motion, ahead, load, gravity, 0.5 * dt, 0.0, tangential, fastest_allowed)

    _wrap(sphere, period)
    for row in range(len(order)):
        i = order[row]
        for k in range(3):
            position[i, k], velocity[i, k], spin[i, k] = sphere[row, k], motion[row, k], motion[row, 4 + k]
    first, second, known = touching_contacts(
        pair_i, pair_j, pair_slot, pair_touched, wall_i, wall_w, wall_slot, wall_touched, steps + 1
    )
    first, second, known = _renamed(first, second, known, order)
    return order[culprit] if culprit >= 0 else -1, done, first, second, known


@njit(error_model="numpy")
def _order_in_space(position, radius, skin, period):
    """Particles cell by cell, and the rank of each, ``(N,)`` both."""
    # Loops, not slices: they compile in a fraction of the time.
    sphere, largest = np.empty((len(position), 4)), 0.0
    for i in range(len(position)):
        sphere[i, 0], sphere[i, 1], sphere[i, 2] = position[i, 0], position[i, 1], position[i, 2]
        largest = max(largest, radius[i])
    order = bin_cells(sphere, 2.0 * largest + skin, period)[0]
    rank = np.empty(len(order), np.int64)
    for row in range(len(order)):
        rank[order[row]] = row
    return order, rank


@njit(error_model="numpy")
def _packed(position, velocity, spin, radius, material, density, order):
    """Rows (x, y, z, r) and (v, 1/m, ω, 1/I) in the given order, the material of each, and the smallest radius."""
    sphere, motion, smallest = np.empty((len(order), 4)), np.empty((len(order), 8)), np.inf
    species = np.empty(len(order), np.uint8)
    for row in range(len(order)):
        i = order[row]
        species[row] = material[i]
        mass = 4.0 / 3.0 * math.pi * density[material[i]] * radius[i] ** 3
        for k in range(3):
            sphere[row, k], motion[row, k], motion[row, 4 + k] = position[i, k], velocity[i, k], spin[i, k]
        sphere[row, 3] = radius[i]
        motion[row, 3], motion[row, 7] = 1.0 / mass, 1.0 / (0.4 * mass * radius[i] ** 2)
        smallest = min(smallest, radius[i])
    return sphere, motion, species, smallest


@njit(error_model="numpy")
def _renamed(first, second, known, name):
    """Contacts with their particles called ``name[i]`` instead of i; the lower name first, walls as they are."""
    new_first, new_second, new_known = np.empty_like(first), np.empty_like(second), known.copy()
    for c in range(len(first)):
        a = name[first[c]]
        b = name[second[c]] if second[c] >= 0 else second[c]
        if 0 <= b < a:
            a, b = b, a
            for k in (0, 1, 2, 4, 5, 6):
                new_known[c, k] = -known[c, k]
        new_first[c], new_second[c] = a, b
    return new_first, new_second, new_known


@njit(error_model="numpy")
def _room(pair_i, wall_i):
    """Scratch of the inner list and of the filters; one more than can be kept, for the last write."""
    pairs, walls = len(pair_i) + 1, len(wall_i) + 1
    return np.empty(pairs, np.uint32), np.empty(max(pairs, walls), np.uint32), np.empty((walls, 4))


@njit(error_model="numpy")
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


@njit(error_model="numpy")
def _drift(sphere, motion, dt):
    for i in range(len(sphere)):
        sphere[i, 0] += dt * motion[i, 0]
        sphere[i, 1] += dt * motion[i, 1]
        sphere[i, 2] += dt * motion[i, 2]


@njit(error_model="numpy")
def _wrap(sphere, period):
    """y into [−L/2, L/2); only where lists are made, so that displacements stay true in between."""
    if period > 0.0:
        for i in range(len(sphere)):
            if not -0.5 * period <= sphere[i, 1] < 0.5 * period:
                sphere[i, 1] -= period * math.floor(sphere[i, 1] / period + 0.5)
                if sphere[i, 1] >= 0.5 * period:
                    sphere[i, 1] -= period


_stretch = _keyed_stretch(_digest_of_sources())
