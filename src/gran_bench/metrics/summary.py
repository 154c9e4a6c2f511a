"""Everything a judgement needs to know of one trajectory, computed once."""

from dataclasses import dataclass, replace

import numpy as np

from gran_bench.config.registry import METRICS
from gran_bench.config.rules import ConfigError, check_arguments
from gran_bench.dem.outlet import taking_part
from gran_bench.metrics import power  # noqa: F401 — registers its metrics
from gran_bench.metrics.angle_of_repose import SurfaceAngle
from gran_bench.metrics.bed import overlap_series, sphere_masses
from gran_bench.metrics.measured import Measured, Series, within
from gran_bench.metrics.outside import FailureCount, count_failures
from gran_bench.metrics.phases import Phases, find_phases
from gran_bench.metrics.speeds import depth_profile, layer_sums, sorted_frames, speeds, velocities
from gran_bench.neighbors import nearest_image
from gran_bench.scene import Scene
from gran_bench.state import FloatArray, Trajectory


@dataclass(frozen=True)
class TrajectorySummary:
    """One trajectory, reduced to what is compared."""

    time: FloatArray  # (F,) s
    velocity_kind: str  # definition of every speed in here
    # What each registered metric gave, by its name; statistics without particles have none of plugins.
    series: dict[str, Series | Measured]
    sorted_speed: FloatArray  # (F, N) float32 m/s, increasing in each state; NaN where a state is not finite
    sorted_component: FloatArray  # (3, F, N) float32 m/s, the components along x, y, z likewise
    layers: FloatArray  # (3, F, K) `layer_sums` under the surface; no layer where the scene has no drum
    phases: Phases  # when the flow is steady; of this run, until runs that are compared get those of the DEM
    diameter: float  # d, m
    volume: float  # of all spheres, m³
    period: float  # of the y axis, m
    position: FloatArray | None = None  # (F, N, 3) m; None for statistics without particles
    jump: float = np.nan  # d, mean of what a frame's displacement is off its velocities; NaN where one is not finite
    failures: FailureCount | None = None  # None for statistics without particles

    @property
    def layer_speed(self) -> FloatArray:
        """``(K,)`` m/s, mean over the steady part in layers of d under the surface; NaN without a steady part."""
        return self._profile[0]

    @property
    def layer_velocity(self) -> FloatArray:
        """``(K,)`` m/s, the same of the velocity along the surface, positive uphill."""
        return self._profile[1]

    @property
    def _profile(self) -> tuple[FloatArray, FloatArray]:
        start = np.inf if self.phases.steady_from is None else self.phases.steady_from
        return depth_profile(self.layers[:, within(self.time, start, np.inf)])


def summarise(trajectory: Trajectory, scene: Scene, velocity_kind: str | None = None) -> TrajectorySummary:
    """Reduce a trajectory of a scene to what is compared; frames may hold what is not finite, which is then counted.

    ``velocity_kind`` is the definition of velocity that every metric uses; the trajectory's own where None.
    """
    check_arguments(trajectory=(trajectory, Trajectory), scene=(scene, Scene))
    kind = velocity_kind or trajectory.velocity_kind
    velocity = velocities(trajectory, kind, scene.period)
    if kind != trajectory.velocity_kind and scene.needs.outlet:
        _hold_discharged(velocity, trajectory.position, scene)
    # Four metrics share the overlaps, so they are carried along as the engine's own are.
    overlaps = {name: series.value for name, series in overlap_series(trajectory, scene).items()}
    run = replace(trajectory, diagnostics=trajectory.diagnostics | overlaps)
    if kind != trajectory.velocity_kind:
        run = replace(run, velocity=velocity, velocity_kind=kind)
    series = {name: _measured(name, run, scene) for name in METRICS}
    surface, layers = series["surface_angle"], np.zeros((3, run.frame_count, 0))
    if isinstance(surface, SurfaceAngle):
        layers = layer_sums(run.position.astype(np.float64), velocity, surface.lines, scene)
    return TrajectorySummary(
        time=run.time,
        velocity_kind=kind,
        series=series,
        sorted_speed=sorted_frames(speeds(velocity)),
        sorted_component=np.stack([sorted_frames(velocity[..., axis]) for axis in range(3)]),
        layers=layers,
        phases=find_phases([series], scene),
        diameter=scene.filling.diameter,
        volume=float(sphere_masses(trajectory.radius, 1.0).sum()),
        period=scene.period,
        position=run.position,
        jump=_jump(run.position, velocity, kind, scene),
        failures=count_failures(trajectory, scene),
    )


def _hold_discharged(velocity: FloatArray, position: FloatArray, scene: Scene) -> None:
    """Let spheres beyond the outlet keep their last velocity, as every stored state of theirs does.

    They stand still in the frames, so means over a frame would be 0 in the DEM and not in a rollout.
    """
    for frame in range(1, len(velocity)):
        gone = ~taking_part(scene, position[frame - 1].astype(np.float64))
        velocity[frame, gone] = velocity[frame - 1, gone]


def _jump(position: FloatArray, velocity: FloatArray, kind: str, scene: Scene) -> float:
    """Mean over spheres and frames of ‖Δx − v̄ Δt‖ / d, v̄ the mean of the velocities at both ends of a frame."""
    if len(position) < 2:
        return np.nan
    between = velocity[1:] if kind == "mean" else 0.5 * (velocity[1:] + velocity[:-1])
    with np.errstate(invalid="ignore", over="ignore"):
        step = nearest_image(np.diff(position.astype(np.float64), axis=0), scene.period)
        off = np.sqrt(((step - between * scene.frame_interval) ** 2).sum(axis=2))
        if scene.needs.outlet:  # a sphere beyond it stands still and keeps its velocity
            before = position[:-1].astype(np.float64)
            off = off[np.array([taking_part(scene, state) for state in before]) | ~np.isfinite(before).all(axis=2)]
        return float(off.mean() / scene.filling.diameter) if off.size else np.nan


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


ONE_BED = 0.1  # relative; runs whose spheres differ less in volume are of one bed


def of_one_bed(a: TrajectorySummary, b: TrajectorySummary) -> bool:
    """Whether the spheres of one run can stand for those of another, as coarse-grained ones do: by their volume."""
    return abs(a.volume - b.volume) < ONE_BED * b.volume
