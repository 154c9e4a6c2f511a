"""Everything a judgement needs to know of one trajectory, computed once."""

from dataclasses import dataclass, replace

import numpy as np

from gran_bench.config.registry import METRICS
from gran_bench.config.rules import ConfigError, check_arguments
from gran_bench.metrics import power  # noqa: F401 — registers its metrics
from gran_bench.metrics.angle_of_repose import SurfaceAngle
from gran_bench.metrics.bed import overlap_series
from gran_bench.metrics.measured import Measured, Series, within
from gran_bench.metrics.outside import FailureCount, count_failures
from gran_bench.metrics.speeds import depth_profile, sorted_frames, speeds, velocities
from gran_bench.scene import Scene
from gran_bench.state import FloatArray, Trajectory

PEAK_BEFORE = 3.0  # s; the first avalanche
STEADY_FROM = 3.5  # s
PATTERN_TIME = 2.5  # s; the paper's figures 2 and 3b


@dataclass(frozen=True)
class TrajectorySummary:
    """One trajectory, reduced to what is compared."""

    time: FloatArray  # (F,) s
    velocity_kind: str  # definition of every speed in here
    # What each registered metric gave, by its name; statistics without particles have none of plugins.
    series: dict[str, Series | Measured]
    sorted_speed: FloatArray  # (F, N) float32 m/s, increasing in each state; NaN where a state is not finite
    sorted_component: FloatArray  # (3, F, N) float32 m/s, the components along x, y, z likewise
    layer_speed: FloatArray  # (K,) m/s, mean over the steady part in layers of d under the surface
    layer_velocity: FloatArray  # (K,) m/s, the same of the velocity along the surface, positive uphill
    steady_undefined_because: str  # why there is no steady part; empty where there is one
    diameter: float  # d, m
    period: float  # of the y axis, m
    position: FloatArray | None = None  # (F, N, 3) m; None for statistics without particles
    failures: FailureCount | None = None  # None for statistics without particles


def why_no_steady_part(scene: Scene, time: FloatArray) -> str:
    """Why a scene has no steady part: its speed changes after 3.5 s, or it ends before; empty where it has one."""
    if scene.end_time < STEADY_FROM + 0.5 * scene.frame_interval:
        return f"the scene ends at {scene.end_time:g} s, before the steady part from {STEADY_FROM:g} s on"
    knots = [t for t in scene.rotation.times if STEADY_FROM < t < scene.end_time]
    if len({round(scene.rotation.angular_speed(t), 12) for t in (STEADY_FROM, *knots, scene.end_time)}) > 1:
        return f"the speed is not constant after {STEADY_FROM:g} s"
    return "" if within(time, STEADY_FROM, np.inf).any() else f"no state after {STEADY_FROM:g} s"


def summarise(trajectory: Trajectory, scene: Scene, velocity_kind: str | None = None) -> TrajectorySummary:
    """Reduce a trajectory of a scene to what is compared; frames may hold what is not finite, which is then counted.

    ``velocity_kind`` is the definition of velocity that every metric uses; the trajectory's own where None.
    """
    check_arguments(trajectory=(trajectory, Trajectory), scene=(scene, Scene))
    kind = velocity_kind or trajectory.velocity_kind
    velocity = velocities(trajectory, kind, scene.period)
    # Four metrics share the overlaps, so they are carried along as the engine's own are.
    overlaps = {name: series.value for name, series in overlap_series(trajectory, scene).items()}
    run = replace(trajectory, diagnostics=trajectory.diagnostics | overlaps)
    if kind != trajectory.velocity_kind:
        run = replace(run, velocity=velocity, velocity_kind=kind)
    series = {name: _measured(name, run, scene) for name in METRICS}
    why_not_steady = why_no_steady_part(scene, run.time)
    surface, layers = series["surface_angle"], np.zeros((2, 0))
    if isinstance(surface, SurfaceAngle):
        steady = np.flatnonzero(within(run.time, STEADY_FROM, np.inf) & (not why_not_steady))
        position = run.position[steady].astype(np.float64)
        layers = depth_profile(position, velocity[steady], [surface.lines[i] for i in steady], scene)
    return TrajectorySummary(
        time=run.time,
        velocity_kind=kind,
        series=series,
        sorted_speed=sorted_frames(speeds(velocity)),
        sorted_component=np.stack([sorted_frames(velocity[..., axis]) for axis in range(3)]),
        layer_speed=layers[0],
        layer_velocity=layers[1],
        steady_undefined_because=why_not_steady,
        diameter=scene.filling.diameter,
        period=scene.period,
        position=run.position,
        failures=count_failures(trajectory, scene),
    )


def _measured(name: str, trajectory: Trajectory, scene: Scene) -> Measured | Series:
    """What a metric gives: a `Measured` or a `Series` in the metric's unit, or a number, which becomes one."""
    metric, whose = METRICS[name], f"metric {name} of {METRICS.owner(name)}"
    found = metric.measure(trajectory, scene)
    if isinstance(found, bool) or not isinstance(found, Measured | Series | int | float | np.number):
        raise ConfigError(f"{whose} gives a {type(found).__name__}; give a number, a Measured or a Series")
    if not isinstance(found, Measured | Series):
        return Measured.of(found, metric.unit)
    if found.unit != metric.unit:
        raise ConfigError(f"{whose} gives {found.unit!r} and was registered with {metric.unit!r}; give one unit")
    return found
