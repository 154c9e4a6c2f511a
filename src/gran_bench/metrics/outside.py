"""What a rollout got wrong outright: centres outside the container, and values that are not finite. All counted."""

from dataclasses import dataclass

import numpy as np

from gran_bench.config.rules import check_arguments
from gran_bench.metrics.bed import wall_overlap
from gran_bench.scene import Scene
from gran_bench.state import FloatArray, Trajectory

TOLERATED = 0.1  # diameters; the soft walls of the DEM let some 0.06 through


@dataclass(frozen=True)
class FailureCount:
    """Failures of one trajectory; a sphere-state is one sphere in one stored state."""

    states: int
    expected_states: int  # that the scene asks for
    spheres: int
    non_finite_states: int  # states with any value that is not finite
    non_finite_sphere_states: int
    first_non_finite: float | None  # s, time of the first such state
    outside: int  # sphere-states whose centre lies beyond R − r or L/2 − r
    outside_tolerated: int  # of these, by more than 0.1 d
    outside_radius: int  # of these, by more than the sphere's radius
    outside_spheres: int  # different spheres that were outside by more than their radius
    farthest: float  # m, largest distance outside; 0 where none was

    @property
    def missing_states(self) -> int:
        """How many states the scene asks for and the trajectory lacks."""
        return max(0, self.expected_states - self.states)

    @property
    def diverged(self) -> bool:
        """Whether a value is not finite, or a state is missing."""
        return self.non_finite_states > 0 or self.missing_states > 0

    def share(self, count: int) -> float:
        """``count`` of all F N sphere-states, in per cent."""
        return 100.0 * count / max(self.states * self.spheres, 1)

    def lines(self, dem_outside: float | None = None) -> tuple[str, str]:
        """The counts for people, beside the share of sphere-states that the DEM has outside (per cent), if known."""
        since = f" (from {self.first_non_finite:g} s)" if self.first_non_finite is not None else ""
        soft = "" if dem_outside is None else f" (of the DEM, whose walls are soft: {dem_outside:.3g} %)"
        return (
            f"failures: {self.non_finite_states} of {self.states} states not finite{since}, "
            f"{self.missing_states} missing",
            f"  spheres that reach into a wall: {self.share(self.outside):.3g} % of sphere states{soft}, "
            f"{self.share(self.outside_tolerated):.3g} % by > {TOLERATED:g} d, {self.outside_radius} by > r "
            f"({counted(self.outside_spheres, 'sphere')}); deepest {1e3 * self.farthest:.3g} mm",
        )


def counted(number: int, what: str) -> str:
    """``1 sphere``, ``2 spheres``."""
    return f"{number} {what}" if number == 1 else f"{number} {what}s"


def distance_outside(position: FloatArray, radius: FloatArray, scene: Scene) -> FloatArray:
    """How far each centre, ``(..., N, 3)`` m, lies beyond its last place in the container, ``(..., N)`` m; ≤ 0 inside.

    Without walls that contain nothing is outside.
    """
    outside = np.full(position.shape[:-1], -np.inf)
    with np.errstate(invalid="ignore", over="ignore"):
        for wall in filter(lambda wall: wall.contains, scene.walls):
            outside = np.maximum(outside, wall_overlap(position, radius, wall))
    return outside


def count_failures(trajectory: Trajectory, scene: Scene) -> FailureCount:
    """Count what is not finite, and what is finite and outside, in every stored state of a trajectory."""
    check_arguments(trajectory=(trajectory, Trajectory), scene=(scene, Scene))
    parts = (trajectory.position, trajectory.velocity, trajectory.angular_velocity)
    finite = np.logical_and.reduce([np.isfinite(part).all(axis=-1) for part in parts if part is not None])
    broken = np.flatnonzero(~finite.all(axis=1))
    radius = trajectory.radius.astype(np.float64)
    tolerated = TOLERATED * scene.filling.diameter
    counts, farthest, escaped = np.zeros(3, np.int64), 0.0, np.zeros(len(radius), bool)
    for frame in trajectory.position:
        outside = distance_outside(frame.astype(np.float64), radius, scene)
        outside = np.where(np.isfinite(frame).all(axis=-1), outside, -np.inf)
        counts += [(outside > 0).sum(), (outside > tolerated).sum(), (outside > radius).sum()]
        escaped |= outside > radius
        farthest = max(farthest, float(outside.max(initial=0.0)))
    return FailureCount(
        states=trajectory.frame_count,
        expected_states=scene.frame_count,
        spheres=len(radius),
        non_finite_states=len(broken),
        non_finite_sphere_states=int((~finite).sum()),
        first_non_finite=float(trajectory.time[broken[0]]) if len(broken) else None,
        outside=int(counts[0]),
        outside_tolerated=int(counts[1]),
        outside_radius=int(counts[2]),
        outside_spheres=int(escaped.sum()),
        farthest=farthest,
    )
