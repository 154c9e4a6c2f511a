"""Experiments on the solver: scenes of a few bodies, runs of so many steps, many impacts side by side."""

import math
from dataclasses import dataclass, replace

import numpy as np

from gran_bench.config import DemConfig
from gran_bench.dem.simulate import SimulationResult, simulate
from gran_bench.scene import Filling, Material, PairCoefficients, Plane, Rotation, Scene, Wall
from gran_bench.state import FloatArray, ParticleState, Trajectory
from gran_bench.verification.theory import Body, Contact

FLOOR = Plane((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), turns=False)
RIGID = 1e6  # a rigid wall is so many times as stiff as the sphere; 1e-6 of E* is what it gives
RADIUS = 0.025  # m
GRAVITY = 9.81  # m/s²
DOWN = (0.0, 0.0, -GRAVITY)
SOFT, STIFF = 1e7, 7e10  # Pa
STEPS_PER_CONTACT = 200  # Δt = t_c / 200 in an impact, unless a case says otherwise


def sphere_material(
    youngs_modulus: float = SOFT, restitution: float = 1.0, friction: float = 0.0, rolling_friction: float = 0.0
) -> Material:
    """The material of the shipped scenes (ν = 0.3, 2500 kg/m³) at another stiffness, e or μ."""
    return Material(youngs_modulus, 0.3, 2500.0, restitution, friction, rolling_friction)


def on_wall(material: Material, radius: float = RADIUS) -> Contact:
    """A sphere on a wall of its own material."""
    return Contact(Body(material, radius), Body(material, math.inf))


def on_rigid_wall(material: Material, radius: float = RADIUS) -> Contact:
    """A sphere on a wall that does not yield."""
    rigid = replace(material, youngs_modulus=RIGID * material.youngs_modulus)
    return Contact(Body(material, radius), Body(rigid, math.inf))


def on_sphere(
    material: Material, radius: float = RADIUS, second_radius: float | None = None, second: Material | None = None
) -> Contact:
    """A sphere on another, of the same size and material unless told."""
    return Contact(Body(material, radius), Body(second or material, second_radius or radius))


def laboratory(
    material: Material, walls: tuple[Wall, ...] = (), *, wall_material: Material | None = None,
    gravity: tuple[float, float, float] = (0.0, 0.0, 0.0), rpm: float | None = None, radius: float = RADIUS,
    second: Material | None = None,
) -> Scene:  # fmt: skip
    """A scene with these walls, which turn with ``rpm`` about y where they turn, and nothing else.

    ``wall_material`` is the spheres' where None; ``radius`` is of the smallest sphere, m; ``second`` is the material of
    further spheres, whose e, μ and μ_r count where they meet the first.
    """
    pair = () if second is None else (
        PairCoefficients(0, 1, second.restitution, second.friction, second.rolling_friction),
    )  # fmt: skip
    return Scene(
        "laboratory", walls, Filling(1, 2.0 * radius), material, wall_material or material, gravity=gravity,
        rotation=Rotation() if rpm is None else Rotation((0.0,), (rpm,)), start_time=0.0, end_time=1.0,
        more_materials=() if second is None else (second,), pair_coefficients=pair,
    )  # fmt: skip


def spheres(
    position: FloatArray, velocity: FloatArray | None = None, spin: FloatArray | None = None, radius: object = RADIUS
) -> ParticleState:
    """Spheres at time 0; at rest and without spin unless told, all of one radius or each of its own."""
    position = np.array(position, float).reshape(-1, 3)
    moving = [np.zeros_like(position) if a is None else np.array(a, float).reshape(-1, 3) for a in (velocity, spin)]
    return ParticleState(position, *moving, np.broadcast_to(np.asarray(radius, float), len(position)).copy())


def mass_of(radius: FloatArray, density: float | FloatArray = 2500.0) -> FloatArray:
    """m = 4/3 π ρ R³ of each sphere, ``(N,)`` kg."""
    return 4.0 / 3.0 * np.pi * density * radius**3


def run(
    scene: Scene, state: ParticleState, time_step: float, steps: int, stride: int | None = None, engine: str = "numba",
    power: bool = False,
) -> SimulationResult:  # fmt: skip
    """Run ``steps`` steps of ``time_step``, with a frame every ``stride`` steps (at the end alone where None)."""
    stride = stride or steps
    scene = replace(scene, frame_interval=stride * time_step)
    dem = DemConfig(engine=engine, time_step=time_step, allow_unsafe_step=True, power=power)
    return simulate(scene, state, state.time + steps // stride * scene.frame_interval, dem=dem)


def watch(scene: Scene, state: ParticleState, time_step: float, duration: float, interval: float) -> Trajectory:
    """Run for at least ``duration`` (s) with a frame about every ``interval`` (s)."""
    stride = max(1, round(interval / time_step))
    return run(scene, state, time_step, math.ceil(duration / time_step / stride) * stride, stride).trajectory


@dataclass
class Impacts:
    """P impacts of a sphere on what lies under it (−z), a wall or a sphere at rest, in the x–z plane, spins about y.

    Numbers are broadcast to as many impacts as the longest array has.
    """

    contact: Contact  # the bodies
    normal: FloatArray  # ``(P,)`` approach v_n > 0, m/s
    tangential: FloatArray | float = 0.0  # ``(P,)`` v_t of the first along x, m/s
    first_spin: FloatArray | float = 0.0  # ``(P,)`` about y, rad/s
    second_spin: FloatArray | float = 0.0  # ``(P,)`` about y, rad/s

    def __post_init__(self) -> None:
        names = ("normal", "tangential", "first_spin", "second_spin")
        arrays = np.broadcast_arrays(*(np.atleast_1d(getattr(self, name)) for name in names))
        for name, values in zip(names, arrays, strict=True):
            setattr(self, name, np.array(values, float))


@dataclass(frozen=True)
class Rebounds:
    """What P impacts left."""

    normal: FloatArray  # ``(P,)`` relative speed along z when they part, m/s
    tangential: FloatArray  # ``(P,)`` relative speed along x, m/s
    first_spin: FloatArray  # ``(P,)`` rad/s
    second_spin: FloatArray  # ``(P,)`` rad/s
    energy: FloatArray  # ``(P,)`` kinetic energy over that before, in the frame in which the second body rested, −
    overlap: float  # largest overlap of any impact, m
    result: SimulationResult  # of all bodies, the first P being the first bodies


def collide(
    impacts: Impacts, *, steps_per_contact: float = STEPS_PER_CONTACT, phase: FloatArray | float = 0.0,
    stride: int | None = None,
) -> Rebounds:  # fmt: skip
    """Let all impacts happen side by side in one run, long enough for the slowest to part.

    The step is the shortest elastic contact time over ``steps_per_contact``; ``phase``, ``(P,)`` of a step, is between
    the last state apart and the first touch; ``stride`` is in steps between frames, or None (the end alone).
    """
    contact, count = impacts.contact, len(impacts.normal)
    first, second = contact.first, contact.second
    time_step = contact.duration(float(impacts.normal.max())) / steps_per_contact
    # What is overdamped creeps apart; a restitution of 0.05 takes four elastic contact times.
    longest = (1.6 + 4.0 * (1.0 - second.material.restitution)) * contact.duration(float(impacts.normal.min()))
    steps = math.ceil(longest / time_step) + 5
    if stride:
        steps = math.ceil(steps / stride) * stride
    largest = max(first.radius, 0.0 if second.is_wall else second.radius)
    apart = 8.0 * largest + 2.0 * float(np.abs(impacts.tangential).max()) * steps * time_step
    # Both start back along their path, so that they touch where they would without a phase.
    early = np.broadcast_to(np.asarray(phase, float) * time_step + 1e-13 * first.radius / impacts.normal, count)
    zero, line = np.zeros(count), apart * np.arange(count)
    height = first.radius + early * impacts.normal + (0.0 if second.is_wall else second.radius)
    position = np.stack((-early * impacts.tangential, line, height), axis=1)
    velocity = np.stack((impacts.tangential, zero, -impacts.normal), axis=1)
    spin, radius = np.stack((zero, impacts.first_spin, zero), axis=1), np.full(count, first.radius)
    if not second.is_wall:
        position = np.concatenate((position, np.stack((zero, line, zero), axis=1)))
        velocity = np.concatenate((velocity, np.zeros_like(velocity)))
        spin = np.concatenate((spin, np.stack((zero, impacts.second_spin, zero), axis=1)))
        radius = np.concatenate((radius, np.full(count, second.radius)))
    two = not second.is_wall and second.material != first.material
    scene = laboratory(
        first.material, (FLOOR,) if second.is_wall else (), wall_material=second.material,
        radius=float(radius.min()), second=second.material if two else None,
    )  # fmt: skip
    kind = np.repeat(np.arange(len(radius) // count, dtype=np.uint8), count) * np.uint8(two)
    state = replace(spheres(position, velocity, spin, radius), material=kind)
    result = run(scene, state, time_step, steps, stride)
    mass = mass_of(radius, np.array([material.density for material in scene.materials])[kind])

    def energy(state: ParticleState) -> FloatArray:
        moving = 0.5 * mass * np.square(state.velocity).sum(axis=1)
        moving += 0.2 * mass * state.radius**2 * np.square(state.angular_velocity).sum(axis=1)
        return moving.reshape(-1, count).sum(axis=0)

    v, w = result.final.velocity, result.final.angular_velocity[:, 1]
    relative = v if second.is_wall else v[:count] - v[count:]
    deepest = max(result.trajectory.diagnostics[name].max() for name in ("overlap_max", "wall_overlap_max"))
    return Rebounds(
        relative[:, 2], relative[:, 0], w[:count], zero if second.is_wall else w[count:],
        energy(result.final) / energy(state), float(deepest), result,
    )  # fmt: skip
