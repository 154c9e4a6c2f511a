"""Windows of the training cases: a start frame and the frames ahead of it, drawn so that a run can resume."""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from gran_bench.config import SEED, RolloutConfig, TrainerConfig
from gran_bench.config.rules import checked, checked_value
from gran_bench.dataset.case_file import Case, read_attributes
from gran_bench.dataset.case_spec import DatasetError
from gran_bench.dataset.mixture import Mixture
from gran_bench.scene import Scene
from gran_bench.state import FloatArray


@dataclass(frozen=True)
class Window:
    """A start frame (index 0) and A frames ahead of one case; views into the case, not copies."""

    scene: Scene
    case: int  # index of the case
    start: int  # index of the start frame in it
    time: float  # s, of the start frame
    position: FloatArray  # (A + 1, N, 3) float32, m
    velocity: FloatArray  # (A + 1, N, 3) float32, instantaneous, m/s
    angular_velocity: FloatArray  # (A + 1, N, 3) float32, rad/s
    previous_position: FloatArray | None  # (N, 3) float32, a frame before the start, m; None at the settled state
    mean_overlap: FloatArray  # (A + 1,) the DEM's mean overlap of a contact, pairs and walls, m; 0 without contacts

    def velocity_at(self, frame: int, kind: str) -> FloatArray:
        """Velocity at a frame of the window, ``(N, 3)`` float32, m/s.

        Args:
            frame: 0 … A.
            kind: ``instantaneous``, or ``mean`` over the frame that ends there, (x_k − x_{k−1})/Δt. The settled
                state has no frame before it and keeps its instantaneous velocity.
        """
        if kind == "instantaneous":
            return self.velocity[frame]
        before = self.position[frame - 1] if frame else self.previous_position
        if before is None:
            return self.velocity[frame]
        moved = self.position[frame].astype(np.float64) - before
        if self.scene.period:
            moved[:, 1] -= self.scene.period * np.round(moved[:, 1] / self.scene.period)
        return (moved / self.scene.frame_interval).astype(np.float32)

    def mirrored(self) -> Window:
        """The window reflected along the drum's axis, y → −y; spin, an axial vector, keeps its y component."""
        polar = np.array([1.0, -1.0, 1.0], np.float32)
        return replace(
            self,
            position=self.position * polar,
            velocity=self.velocity * polar,
            angular_velocity=self.angular_velocity * -polar,
            previous_position=None if self.previous_position is None else self.previous_position * polar,
        )


class Windows:
    """The training side of a data set: it holds its own cases and knows of no others.

    Args:
        cases: the training cases, held in memory.
        seed: of the draws.
        startup_fraction: share of windows that start in the start-up of a case.
        startup_fall_times: its length, √(d/g).
        startup_seconds: its length, s; None: by the fall times.
        mixture: of cases of several scenes; None: every case is as likely.

    Raises:
        ConfigError: an impossible seed, share or span.
        DatasetError: no cases, cases of different particle numbers or frame intervals, a frame that is not finite.
    """

    def __init__(
        self, cases: Sequence[Case], seed: int = 0, startup_fraction: float = 0.0,
        startup_fall_times: float = 14.0, startup_seconds: float | None = None, mixture: Mixture | None = None,
    ) -> None:  # fmt: skip
        if not cases:
            raise DatasetError("there is no case to train on; give dataset.training_speeds_rpm")
        checked_value(int, SEED, seed, "seed")
        checked(TrainerConfig, "startup_fraction", startup_fraction)
        checked(TrainerConfig, "startup_fall_times", startup_fall_times)
        checked(TrainerConfig, "startup_seconds", startup_seconds)
        intervals = {case.scene.frame_interval for case in cases}
        if len(intervals) > 1:
            raise DatasetError(f"cases have frame intervals of {sorted(intervals)} s; train on one interval")
        for case, name in itertools.product(cases, ("position", "velocity", "angular_velocity")):
            # A solver may leave what is no number, whose seal is whole all the same.
            broken = np.flatnonzero(~np.isfinite(getattr(case.trajectory, name)).all(axis=(1, 2)))
            if len(broken):
                raise DatasetError(
                    f"{case.path} has a {name} that is not finite in {len(broken)} of its frames, first in frame "
                    f"{broken[0]}; no training can use it: delete it and run the same command again, or leave it out"
                )
        self.cases, self.seed, self.mixture = list(cases), seed, mixture
        self.startup_fraction, self._startup = startup_fraction, (startup_fall_times, startup_seconds)
        self._overlap = [_mean_overlap(case) for case in cases]

    def draw(self, number: int, frames_ahead: int, progress: float = 0.0) -> Window:
        """Window ``number`` of an endless, seeded sequence; a pure function of the seed and the arguments.

        Args:
            number: 0, 1, 2, …; a resumed run goes on with the next number.
            frames_ahead: A.
            progress: share of the training's budget that is spent, which a mixture goes by.

        Raises:
            DatasetError: no case has A + 1 frames.
        """
        checked_value(int, SEED, number, "number")
        checked(RolloutConfig, "frames", frames_ahead)
        rng = np.random.default_rng((self.seed, number))
        mixed = self.mixture
        index = int(rng.integers(len(self.cases))) if mixed is None else mixed.draw(rng, progress)
        case = self.cases[index]
        starts = case.trajectory.frame_count - frames_ahead
        if starts < 1:
            raise DatasetError(
                f"rollout.frames={frames_ahead} is more than {case.path.name} has "
                f"({case.trajectory.frame_count - 1} ahead of its first); choose fewer frames or a later scene.end_time"
            )
        if rng.random() < self.startup_fraction:
            fall_times, seconds = self._startup
            seconds = fall_times * case.scene.fall_time if seconds is None else seconds
            starts = min(starts, max(1, round(seconds / case.scene.frame_interval)))
        return self.window(index, int(rng.integers(starts)), frames_ahead)

    def window(self, case: int, start: int, frames_ahead: int) -> Window:
        """The window of a case that starts at a frame.

        Raises:
            DatasetError: no such case, or not so many frames from the start on.
        """
        if not (0 <= case < len(self.cases) and 0 <= start < self.cases[case].trajectory.frame_count - frames_ahead):
            raise DatasetError(f"case {case} has no window of {frames_ahead} frames ahead of frame {start}")
        scene, motion, span = (
            self.cases[case].scene,
            self.cases[case].trajectory,
            slice(start, start + frames_ahead + 1),
        )
        ahead = motion.position[span], motion.velocity[span], motion.angular_velocity[span]
        previous = motion.position[start - 1] if start else None
        return Window(scene, case, start, float(motion.time[start]), *ahead, previous, self._overlap[case][span])

    @property
    def digest(self) -> str:
        """Digest of the training cases."""
        return dataset_digest(self.cases)

    @property
    def data_seconds(self) -> float:
        """What the DEM took for the training cases, where known, s."""
        return float(np.nansum([case.attributes["wall_seconds"] for case in self.cases]))


def dataset_digest(cases: Iterable[Case | Path | str]) -> str:
    """16 hex digits over the digests of cases, whatever their order."""
    digests = sorted(c.digest if isinstance(c, Case) else read_attributes(c)["digest"] for c in cases)
    return hashlib.sha256("\n".join(digests).encode()).hexdigest()[:16]


def _mean_overlap(case: Case) -> FloatArray:
    """Mean overlap of a contact, pairs and walls, ``(F,)`` m, from the engine's float64 figures; 0 without contacts."""
    figures = case.trajectory.diagnostics
    total, count = np.zeros((2, case.trajectory.frame_count))
    for contacts, mean in (("contact_count", "overlap_mean"), ("wall_contact_count", "wall_overlap_mean")):
        # No contact has no mean overlap, which an engine may store as NaN.
        total += np.where(figures[contacts] > 0, figures[contacts] * figures[mean], 0.0)
        count += figures[contacts]
    return total / np.maximum(count, 1)
