"""Everything a judgement needs to know of one trajectory, computed once."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from gran_bench.config.registry import METRICS
from gran_bench.config.rules import ConfigError, check_arguments
from gran_bench.metrics.angle_of_repose import angle_series
from gran_bench.metrics.energy import rotational_energy, sphere_masses, translational_energy
from gran_bench.metrics.measured import Measured, Series, within
from gran_bench.metrics.mixing import mixing_entropy
from gran_bench.metrics.outside import FailureCount, count_failures
from gran_bench.metrics.overlap import overlap_series
from gran_bench.metrics.speeds import depth_profile, sorted_frames, velocities
from gran_bench.scene import Scene
from gran_bench.state import FloatArray, Trajectory

PEAK_BEFORE = 3.0  # s; the first avalanche
STEADY_FROM = 3.5  # s
PATTERN_TIME = 2.5  # s; the paper's figures 2 and 3b


@dataclass(frozen=True)
class TrajectorySummary:
    """One trajectory, reduced to what is compared.

    Attributes:
        time: ``(F,)`` s.
        velocity_kind: definition of every speed in here.
        series: by name: ``surface_angle``, ``com_angle`` (deg), ``center_height`` (m), ``mean_speed`` (m/s),
            ``translational_energy``,
            ``rotational_energy`` (J), ``overlap_mean``, ``overlap_max``, ``wall_overlap_mean``,
            ``wall_overlap_max`` (m), ``mixing`` (−).
        sorted_speed: ``(F, N)`` float32 m/s, increasing in each state; NaN where a state is not finite.
        sorted_component: ``(3, F, N)`` float32 m/s, the components along x, y, z likewise.
        layer_speed: ``(K,)`` m/s, mean over the steady part in layers of d under the surface.
        layer_velocity: ``(K,)`` m/s, the same of the velocity along the surface, positive uphill.
        steady_undefined_because: why there is no steady part; empty where there is one.
        diameter: d, m.
        period: of the y axis, m.
        position: ``(F, N, 3)`` m; None for statistics without particles.
        failures: None for statistics without particles.
        registered: what each registered metric gave, by its name; empty for statistics without particles.
    """

    time: FloatArray
    velocity_kind: str
    series: dict[str, Series]
    sorted_speed: FloatArray
    sorted_component: FloatArray
    layer_speed: FloatArray
    layer_velocity: FloatArray
    steady_undefined_because: str
    diameter: float
    period: float
    position: FloatArray | None = None
    failures: FailureCount | None = field(default=None)
    registered: dict[str, Measured | Series] = field(default_factory=dict)

    @property
    def count(self) -> int:
        """Number of spheres N."""
        return self.sorted_speed.shape[1]

    @property
    def steady_speed(self) -> FloatArray:
        """All speeds of the finite states of the steady part, pooled and increasing, m/s."""
        steady = self.sorted_speed[within(self.time, STEADY_FROM, np.inf)]
        return np.sort(steady[np.isfinite(steady).all(axis=1)], axis=None)


def center_height(time: FloatArray, position: FloatArray, mass: FloatArray) -> Series:
    """Height of the centre of mass in each state, Σ m z / Σ m, m.

    Args:
        time: ``(F,)`` s.
        position: ``(F, N, 3)`` m.
        mass: ``(N,)`` kg.
    """
    with np.errstate(invalid="ignore", over="ignore"):
        height = position[..., 2].astype(np.float64) @ (mass / mass.sum())
    return Series(time, np.where(np.isfinite(height), height, np.nan), "m", invalid_because="not finite")


def why_no_steady_part(scene: Scene, time: FloatArray) -> str:
    """Why a scene has no steady part: its speed changes after 3.5 s, or it ends before; empty where it has one."""
    if scene.end_time < STEADY_FROM + 0.5 * scene.frame_interval:
        return f"the scene ends at {scene.end_time:g} s, before the steady part from {STEADY_FROM:g} s on"
    knots = [t for t in scene.rotation.times if STEADY_FROM < t < scene.end_time]
    speeds = {round(scene.rotation.angular_speed(t), 12) for t in (STEADY_FROM, *knots, scene.end_time)}
    if len(speeds) > 1:
        return f"the speed is not constant after {STEADY_FROM:g} s"
    return "" if within(time, STEADY_FROM, np.inf).any() else f"no state after {STEADY_FROM:g} s"


def summarise(trajectory: Trajectory, scene: Scene, velocity_kind: str | None = None) -> TrajectorySummary:
    """Reduce a trajectory to what is compared.

    Args:
        trajectory: of the scene; its frames may hold values that are not finite, which are then counted.
        scene: that it was made for.
        velocity_kind: definition of velocity to use; the trajectory's own where None.

    Raises:
        ValueError: instantaneous velocities asked of a trajectory of means.
    """
    check_arguments(trajectory=(trajectory, Trajectory), scene=(scene, Scene))
    time = trajectory.time
    velocity = velocities(trajectory, velocity_kind or trajectory.velocity_kind, scene.period)
    surface, center, lines = angle_series(trajectory, scene)
    mass = sphere_masses(trajectory.radius, scene.material.density)
    with np.errstate(invalid="ignore", over="ignore"):
        speed = np.sqrt(np.einsum("fnk,fnk->fn", velocity, velocity))
        mean_speed = speed.mean(axis=1, dtype=np.float64)
    why_not_steady = why_no_steady_part(scene, time)
    steady = np.flatnonzero(within(time, STEADY_FROM, np.inf)) if not why_not_steady else np.zeros(0, int)
    layers = (np.zeros(0), np.zeros(0))
    if scene.drum_radius is not None and scene.needs.gravity:
        layers = depth_profile(
            trajectory.position[steady].astype(np.float64), velocity[steady], [lines[i] for i in steady], scene
        )
    return TrajectorySummary(
        time=time,
        velocity_kind=velocity_kind or trajectory.velocity_kind,
        series={
            "surface_angle": surface,
            "com_angle": center,
            "center_height": center_height(time, trajectory.position, mass),
            "mean_speed": Series(
                time, np.where(np.isfinite(mean_speed), mean_speed, np.nan), "m/s", invalid_because="not finite"
            ),
            "translational_energy": translational_energy(time, velocity, mass),
            "rotational_energy": rotational_energy(time, trajectory.angular_velocity, mass, trajectory.radius),
            **overlap_series(trajectory, scene),
            "mixing": mixing_entropy(trajectory, scene),
        },
        sorted_speed=sorted_frames(speed),
        sorted_component=np.stack([sorted_frames(velocity[..., axis]) for axis in range(3)]),
        layer_speed=layers[0],
        layer_velocity=layers[1],
        steady_undefined_because=why_not_steady,
        diameter=scene.filling.diameter,
        period=scene.period,
        position=trajectory.position,
        failures=count_failures(trajectory, scene),
        registered={name: _measured(name, trajectory, scene) for name in METRICS},
    )


def _measured(name: str, trajectory: Trajectory, scene: Scene) -> Measured | Series:
    """What a registered metric gives, held against what it may give.

    Raises:
        ConfigError: something else than a number, a `Measured` or a `Series` in the metric's unit.
    """
    metric, whose = METRICS[name], f"metric {name} of {METRICS.owner(name)}"
    found = metric.measure(trajectory, scene)
    if isinstance(found, bool) or not isinstance(found, Measured | Series | int | float | np.number):
        raise ConfigError(f"{whose} gives a {type(found).__name__}; give a number, a Measured or a Series")
    if not isinstance(found, Measured | Series):
        return Measured.of(found, metric.unit)
    if found.unit != metric.unit:
        raise ConfigError(f"{whose} gives {found.unit!r} and was registered with {metric.unit!r}; give one unit")
    return found
