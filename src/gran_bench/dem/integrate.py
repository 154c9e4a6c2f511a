"""What an engine integrates, and how: velocity Verlet with the half-step velocities in the damping.

    v_{n+1/2} = v_n + ½ a_n Δt,   x_{n+1} = x_n + v_{n+1/2} Δt,   v_{n+1} = v_{n+1/2} + ½ a_{n+1} Δt

with a_{n+1} from x_{n+1}, v_{n+1/2} and the walls' speed at the middle of the step; spin likewise. The damping of the
normal force takes v_{n+1/2} + ½ a_n Δt, the prediction of v_{n+1}. The two halves of a kick are rounded apart, so that
looking at v_n changes nothing. A run starts with the forces of its state alone: nothing is added to histories.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from gran_bench.config import DemConfig
from gran_bench.config.rules import checked
from gran_bench.dem.contact import ContactLaw
from gran_bench.dem.walls import check_walls
from gran_bench.neighbors import check_period
from gran_bench.scene import Scene
from gran_bench.state import FloatArray

# Verlet skin in diameters of the largest sphere: wide enough for tens of steps between searches, narrow enough that
# pruning its list stays cheap.
SKIN_DIAMETERS = 0.8
# What a short period must leave of it.
LEAST_SKIN_DIAMETERS = 0.05


class Divergence(ArithmeticError):
    """A particle that crosses a quarter of the smallest radius in a step, or is not finite, and what was found then."""

    def __init__(self, particle: int, steps: int, *moving: FloatArray) -> None:
        super().__init__(f"particle {particle} diverged")
        self.particle, self.steps, self.moving = particle, steps, moving
        self.position, self.velocity, self.angular_velocity = moving


def check_finite(steps: int, *moving: FloatArray) -> None:
    """Refuses positions, velocities and spins that are no numbers, or whose squares are none.

    Raises:
        Divergence: the first particle of which one is not finite.
    """
    position, velocity, spin = moving
    if all(np.isfinite(np.vdot(of, of)) for of in moving):
        return
    with np.errstate(over="ignore", invalid="ignore"):
        sound = np.isfinite(np.einsum("nk,nk->n", velocity, velocity))
    wild = np.flatnonzero(~(sound & np.isfinite(position).all(axis=1) & np.isfinite(spin).all(axis=1)))
    if len(wild):
        raise Divergence(int(wild[0]), steps, *moving)


class Peaks(NamedTuple):
    """The most of every contact in every step of some span."""

    overlap: float = 0.0  # of a pair, m
    wall_overlap: float = 0.0  # m
    share: float = 0.0  # of the pair's mean diameter, or of the diameter at a wall
    approach: float = 0.0  # of two surfaces that touch, along their normal, m/s


@dataclass(frozen=True)
class Physics:
    """A scene as the engines read it; a law is (4/3 E*, 8 G*, α, μ, μ_r) in SI."""

    pair_laws: FloatArray  # ``(S, S, 5)`` between particles of S materials
    wall_laws: FloatArray  # ``(S, W, 5)`` between particles and walls
    density: FloatArray  # ``(S,)`` of the materials, kg/m³
    gravity: FloatArray  # ``(3,)`` m/s²
    period: float  # length of the periodic y axis, m; 0 for none
    skin: float  # m by which the neighbour list reaches beyond contact, for the two fastest particles (lists.py)
    tangential: bool  # and rolling: whether friction, and with it spin, and the rolling model are computed
    rolling: bool
    threads: int = 1  # how many work together, where there are particles enough; changes no bit of the result
    single_precision: bool = False  # whether the contact laws, never positions and velocities, are computed in float32
    full_radius: bool = False  # whether slip is measured with full radii instead of at the contact point (contact.py).
    power: bool = False  # whether the work of walls and contacts is counted (energy.py); changes no bit of the result

    @classmethod
    def of(cls, scene: Scene, largest_radius: float, skin: float | None = None) -> Physics:
        """What ``scene`` needs, and nothing else, for particles of at most a radius, m.

        Args:
            skin: m; where None 0.8 diameters of the largest sphere, or less if the period is short.

        Raises:
            ValueError: a skin that is not positive, a period that is too short, or a wall that cannot turn.
        """
        if skin is None:
            diameter = 2.0 * largest_radius
            skin = SKIN_DIAMETERS * diameter
            if scene.period:
                # A period that leaves less is refused below.
                skin = max(LEAST_SKIN_DIAMETERS * diameter, min(skin, 0.5 * scene.period - diameter))
        skin = checked(DemConfig, "skin", skin)
        check_period(scene.period, 2.0 * largest_radius + skin)
        check_walls(scene)
        needs, kinds = scene.needs, range(len(scene.materials))
        wall_laws = [[wall_law(scene, kind).constants] * len(scene.walls) for kind in kinds]
        return cls(
            pair_laws=np.array([[pair_law(scene, a, b).constants for b in kinds] for a in kinds]),
            wall_laws=np.array(wall_laws).reshape(len(kinds), len(scene.walls), 5),
            density=np.array([material.density for material in scene.materials], np.float64),
            gravity=np.array(scene.gravity, np.float64),
            period=scene.period,
            skin=skin,
            tangential=needs.tangential,
            rolling=needs.rolling,
        )


def into_period(position: FloatArray, period: float) -> FloatArray:
    """Positions, ``(N, ≥ 3)`` m, with y brought into [−L/2, L/2) in place; L = 0 for none. The rest keeps all bits."""
    if period > 0.0:
        y = position[:, 1]
        outside = np.flatnonzero(~((-0.5 * period <= y) & (y < 0.5 * period)))
        moved = y[outside] - period * np.floor(y[outside] / period + 0.5)
        y[outside] = np.where(moved >= 0.5 * period, moved - period, moved)
    return position


def pair_law(scene: Scene, first: int, second: int) -> ContactLaw:
    """The law of contacts between particles of two of the scene's materials."""
    return ContactLaw.of(scene.materials[first], scene.materials[second], *scene.coefficients(first, second))


def wall_law(scene: Scene, kind: int) -> ContactLaw:
    """The law of contacts of one of the scene's particle materials with the walls, whose coefficients count."""
    return ContactLaw.between(scene.materials[kind], scene.wall_material)
