"""The choice of the time step: a stated fraction of the fastest process, and what is too large to be trusted."""

import math

import numpy as np

from gran_bench.config import DemConfig
from gran_bench.config.rules import checked
from gran_bench.dem.contact import hertz_impact, sphere_mass
from gran_bench.dem.integrate import pair_law, wall_law
from gran_bench.dem.rolling import CONTACT_INERTIA, rolling_drag, rolling_stiffness
from gran_bench.scene import Plane, Rotation, Scene

# Of min(Rayleigh time, contact time). `drum` gets 2e-4 s, with which every bulk figure stays within the scatter
# of nudged replicas; ten times as much biases its angle of repose by degrees.
TIME_STEP_FRACTION = 0.093
# Of the time in which damping alone would stop a pair, or its rolling: shorter below e = 0.1, or above about μ_r = 0.3.
# A sphere among six others is damped four times as fast as by one, so that a half is just stable at the hardest impact.
DAMPING_FRACTION = 0.5
WARNING_FRACTION = 0.1  # of the contact time; restitution starts to depend on the step
ERROR_FRACTION = 0.2  # of the contact time; a contact is no longer resolved
ROUNDING = 1e-9  # relative; what is within it of a bound is at the bound
# Height of fall that the impact speed is judged by where no drum states one.
NOMINAL_FALL = 20.0  # diameters


class TimeStepError(ValueError):
    """A time step that cannot resolve a contact; the message names the largest safe one."""


def rayleigh_time(radius: float, density: float, shear_modulus: float, poisson_ratio: float) -> float:
    """Time of a Rayleigh wave around a sphere, T_R = π r √(ρ/G) / (0.1631 ν + 0.8766), s; r in m, ρ in kg/m³, G in Pa.

    Source: Li, Xu & Thornton (2005), Powder Technology 160, eq. 10.
    """
    return math.pi * radius * math.sqrt(density / shear_modulus) / (0.1631 * poisson_ratio + 0.8766)


def impact_speed(scene: Scene) -> float:
    """Speed of the hardest impact to expect, m/s; 0 where nothing drives one.

    The largest of √(2 g D) with D the height that a sphere can fall, twice the speed of spheres that are placed, and
    the speed of the walls.
    """
    fall, turning, reaches = scene.fall_height or NOMINAL_FALL * scene.filling.diameter, 0.0, []
    speeds = [math.sqrt(2.0 * scene.gravity_strength * fall), *(2.0 * math.hypot(*v) for v in scene.filling.velocities)]
    for wall in scene.walls:
        motion = scene.motion_of(wall)
        if isinstance(motion, Rotation):
            turning = max(turning, motion.largest_angular_speed)
            if not isinstance(wall, Plane):
                size = wall.radius if wall.meridian is None else max(math.hypot(*end) for end in wall.meridian)
                reaches.append(math.dist(wall.point, motion.point) + size)
        elif motion is not None:
            speeds.append(float(np.linalg.norm(motion.extreme_velocities, axis=1).max()))
    return max(*speeds, turning * max(reaches, default=fall))


def contact_times(scene: Scene, radius: float | None = None, speed: float | None = None) -> tuple[float, float]:
    """Duration of an elastic impact and time of the damping at its deepest, s; the shortest of all meetings.

    The latter is m*/γ with γ = α √(m* K) δmax^{1/4}, or I*/C_r of rolling.py with I* = 2/5 m* r²; inf at speed 0.

    Where None, the radius of the smallest sphere, m, is the filling's and the speed, m/s, is :func:`impact_speed`.
    """
    speed = impact_speed(scene) if speed is None else speed
    r = scene.filling.smallest_radius if radius is None else radius
    if speed == 0.0:
        return math.inf, math.inf
    mass = [sphere_mass(material.density, r) for material in scene.materials]
    meetings, kinds = [], range(len(mass))
    for a in kinds:
        meetings += [(pair_law(scene, a, b), 0.5 * r, mass[a] * mass[b] / (mass[a] + mass[b])) for b in kinds if a <= b]
        if scene.needs.walls:
            meetings.append((wall_law(scene, a), r, mass[a]))
    elastic, damped = math.inf, math.inf
    for law, effective_radius, effective_mass in meetings:
        overlap, _, duration = hertz_impact(law.effective_modulus, effective_radius, effective_mass, speed)
        elastic = min(elastic, duration)
        if law.damping > 0:
            stiffness = 4.0 / 3.0 * law.effective_modulus * math.sqrt(effective_radius)
            damped = min(damped, math.sqrt(effective_mass / stiffness) / (law.damping * overlap**0.25))
        if scene.needs.rolling and law.rolling_friction > 0:
            stiffness = rolling_stiffness(law.effective_modulus, law.rolling_friction, effective_radius, overlap)
            inertia = effective_mass * r**2
            damped = min(damped, 0.4 * inertia / float(rolling_drag(CONTACT_INERTIA * inertia, stiffness)))
    return elastic, damped


def step_bound(scene: Scene, radius: float | None = None) -> tuple[float, str]:
    """What the automatic step may not exceed, s, and which time sets it, in words; ``radius`` as of contact_times."""
    contact_time, damping_time = contact_times(scene, radius)
    r = scene.filling.smallest_radius if radius is None else radius
    rayleigh, modulus = min(
        (rayleigh_time(r, m.density, m.shear_modulus, m.poisson_ratio), m.youngs_modulus) for m in scene.materials
    )
    stiffness, impact = f"at E = {modulus:.3g} Pa", f"an impact at {impact_speed(scene):.3g} m/s"
    wave = f"{rayleigh:.3g} s that a wave takes around the smallest sphere {stiffness}"
    return min(
        (TIME_STEP_FRACTION * rayleigh, f"{TIME_STEP_FRACTION:g} of the {wave}"),
        (
            TIME_STEP_FRACTION * contact_time,
            f"{TIME_STEP_FRACTION:g} of the {contact_time:.3g} s of {impact} {stiffness}",
        ),
        (
            DAMPING_FRACTION * damping_time,
            f"{DAMPING_FRACTION:g} of the {damping_time:.3g} s in which damping stops {impact}",
        ),
    )


def choose_time_step(
    scene: Scene, requested: float | None = None, allow_unsafe: bool = False, radius: float | None = None
) -> tuple[float, tuple[str, ...]]:
    """The largest step, s, that is safe and of which the frame interval is a whole multiple, and its warnings.

    Args:
        scene: materials, walls, motion and frame interval.
        requested: step to use instead of the automatic one, s; shortened to divide the frame interval.
        allow_unsafe: turns the error of a step beyond 0.2 t_c into a warning.
        radius: of the smallest sphere, m; the filling's where None.

    Raises:
        ConfigError: a step that is not positive and finite.
        TimeStepError: one beyond 0.2 t_c that is not allowed.
    """
    if requested is None:
        return dividing_step(scene.frame_interval, step_bound(scene, radius)[0]), ()
    requested = checked(DemConfig, "time_step", requested)
    step, given, shortened = dividing_step(scene.frame_interval, requested), f"dem.time_step={requested:g} s", ()
    if step < requested * (1.0 - ROUNDING):
        whole = f"a whole fraction of the frame interval {scene.frame_interval:g} s"
        shortened = (f"{given} was shortened to {step:.6g} s, {whole}",)
        given += f", shortened to {step:.6g} s,"
    return step, shortened + unresolved(scene, step, given, allow_unsafe, radius)


def largest_allowed_step(scene: Scene) -> float:
    """The largest step that the DEM takes without being told to: just under 0.2 of the contact time, s."""
    return dividing_step(scene.frame_interval, ERROR_FRACTION * contact_times(scene)[0] * (1.0 - 1e-6))


def unresolved(
    scene: Scene, step: float, given: str, allow_unsafe: bool, radius: float | None, speed: float | None = None
) -> tuple[str, ...]:
    """A warning that begins with ``given`` if a step, s, is too long for :func:`contact_times`, else nothing.

    Raises:
        TimeStepError: a step beyond 0.2 t_c that is not allowed.
    """
    contact_time, _ = contact_times(scene, radius, speed)
    share = step / contact_time * (1.0 + ROUNDING)
    if share < WARNING_FRACTION:
        return ()
    fatal, safe = share >= ERROR_FRACTION, WARNING_FRACTION * contact_time * (1.0 - 1e-6)
    said = (
        f"{given} is {share:.2g} of the shortest contact time {contact_time:.3g} s and "
        f"{'cannot resolve it' if fatal else 'lets restitution depend on the step'}; set dem.time_step to less: "
        f"the largest safe step is {dividing_step(scene.frame_interval, safe):.10g} s"
    )
    if fatal and not allow_unsafe:
        raise TimeStepError(f"{said} (dem.allow_unsafe_step=true runs it all the same)")
    return (said,)


def dividing_step(interval: float, largest: float) -> float:
    """The largest step ≤ ``largest`` of which ``interval`` is a whole multiple, s."""
    # The tolerance lets 1e-2 / 2e-4 be 50 steps, not 51. Fifteen digits are one step whatever interval it divides;
    # digits of the mantissa, so that half the interval has half the step, bit for bit.
    mantissa, exponent = math.frexp(interval / max(1, math.ceil(interval / largest * (1.0 - ROUNDING))))
    return math.ldexp(float(f"{mantissa:.15g}"), exponent)
