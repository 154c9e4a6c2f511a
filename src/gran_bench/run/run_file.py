"""The small file that a job of a sweep leaves when it ends: who it was, what came out, or why nothing did.

Files lie in ``<root>/sweeps/<sweep>/runs/<run>-<key>.json``. They are enough to make the sweep's table and figures
anew and to know that a run need not be done again, on a machine that has nothing else of it.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from gran_bench.config.registry import METRICS
from gran_bench.files import write_text

SWEEPS = "sweeps"  # folder below the results
RUNS = "runs"  # folder below a sweep's
FINISHED, FAILED = "finished", "failed"
MADE = "made_with"  # among a run's facts: model, hashes of code, budget
TRAINING = ("steps", "planned_steps", "seconds", "stopped_by", "loss", "parameters")  # what is kept of a training
ERRORS = ("surface_angle", "com_angle", "speed_w1")  # the distances from the DEM that are kept, by packing


class SweepFileError(RuntimeError):
    """A file of a sweep that cannot be read; the message names it and the remedy."""


@dataclass(frozen=True)
class RunFile:
    """One run of a sweep.

    Attributes:
        run: name, as of its folder and its MLflow run, without the key.
        key: hash of what determines its training.
        judged_by: hash of what determines its judgement.
        status: ``finished`` or ``failed``.
        choices: what the command line changed, by key (``model.radius``: ``0.08``), the seed included.
        seed: of weights and windows.
        reason: why it failed; None where it did not.
        judged: speed in rpm, and whether it was a validation speed or the held-out one.
        figures: headline figures by name; an undefined one is None.
        packings: errors in their unit and in noise floors, and failures, by packing.
        training: updates done and planned, seconds, what stopped it, last loss, parameters.
        facts: whatever else: wall seconds by stage, data digest, provenance, …
        ended_at: ISO 8601, UTC.
    """

    run: str
    key: str
    judged_by: str
    status: str
    choices: dict[str, str]
    seed: int
    reason: str | None = None
    judged: dict[str, Any] = field(default_factory=dict)
    figures: dict[str, float | None] = field(default_factory=dict)
    packings: dict[str, Any] = field(default_factory=dict)
    training: dict[str, Any] = field(default_factory=dict)
    facts: dict[str, Any] = field(default_factory=dict)
    ended_at: str = ""

    @property
    def file_name(self) -> str:
        """Of its file: the run's name and the first digits of its key."""
        return f"{self.run}-{self.key[:8]}.json"

    def write(self, sweep_folder: Path) -> Path:
        """Write the file into a sweep's folder, whole or not at all; an older one of the same run is replaced."""
        path = sweep_folder / RUNS / self.file_name
        write_text(path, json.dumps(asdict(self), indent=1, ensure_ascii=False, allow_nan=False) + "\n")
        return path


def finished_run(
    run: str, key: str, choices: Mapping[str, str], seed: int, summary: Mapping[str, Any], requirements_failed: float
) -> RunFile:
    """What a finished run leaves.

    Args:
        run: its name.
        key: of its training.
        choices: what the command line changed.
        seed: of the run.
        summary: as in ``summary.json``.
        requirements_failed: how many, as its table counts them.
    """
    shared, training = summary["judged"]["shared"], summary["training"]
    rollout = summary["rollouts"][f"{summary['judged_rpm']:g}rpm"]
    ten_frames = summary["position_error"]["10_frames"]["m"]
    angle, speed = shared["errors"]["surface_angle"], shared["errors"]["speed_w1"]
    return RunFile(
        run,
        key,
        summary["judged_by"],
        FINISHED,
        dict(choices),
        seed,
        judged={"rpm": summary["judged_rpm"], "as": summary["judged_as"]},
        figures={
            "angle_error_deg": angle["value"],
            "angle_error_floors": angle["multiple_of_floor"],
            "speed_w1_m_s": speed["value"],
            "speed_w1_floors": speed["multiple_of_floor"],
            "position_error_10_frames_mm": None if ten_frames is None else 1e3 * ten_frames,
            "ms_per_frame": rollout["ms_per_frame_median"],
            "training_minutes": training["seconds"] / 60.0,
            "requirements_failed": requirements_failed,
            **{
                f"{name}_floors": shared["errors"][name]["multiple_of_floor"]
                for name in METRICS
                if name in shared["errors"]
            },
        },
        packings={name: _packing(judged) for name, judged in summary["judged"].items()},
        training={name: training[name] for name in TRAINING if name in training},
        facts={
            "wall_seconds": summary["wall_seconds"],
            "dem_ms_per_frame": rollout["dem_ms_per_frame"],
            "position_error_mm": {
                name: None if row["m"] is None else 1e3 * row["m"] for name, row in summary["position_error"].items()
            },
            "broken_rollouts": {
                name: row["failed_frame"]
                for name, row in summary["rollouts"].items()
                if row["failed_frame"] is not None
            },
            "data_digest": training["data_digest"],
            "model_sha256": training["model_sha256"],
            "provenance": summary["provenance"],
        },
        ended_at=now(),
    )


def failed_run(
    run: str, key: str, judged_by: str, choices: Mapping[str, str], seed: int, reason: str, facts: Mapping[str, Any]
) -> RunFile:
    """What a run leaves that failed: who it was, and why."""
    return RunFile(run, key, judged_by, FAILED, dict(choices), seed, reason=reason, facts=dict(facts), ended_at=now())


def copied_run(run: RunFile, name: str, choices: Mapping[str, str], source: Path) -> RunFile:
    """What a sweep keeps of a run that another one did.

    Args:
        run: as the other sweep kept it.
        name: of the run in this sweep.
        choices: of this sweep.
        source: the other sweep's file; logs are beside it.
    """
    facts = {key: value for key, value in run.facts.items() if key != "log"}
    return replace(
        run,
        run=name,
        choices=dict(choices),
        facts=facts | {"copied_from": f"{source.parent.parent.name}/{RUNS}/{source.name}"},
    )


def _packing(judged: Mapping[str, Any]) -> dict[str, Any]:
    names = ("value", "unit", "floor", "multiple_of_floor", "note")
    kept = (*ERRORS, *(name for name in METRICS if name in judged["errors"]))
    return {
        "errors": {row: {name: judged["errors"][row][name] for name in names} for row in kept},
        "requirements": {row["label"]: row["verdict"] for row in judged["requirements"].values()},
        "failures": judged["failures"],
    }


def read_runs(sweep_folder: Path) -> list[RunFile]:
    """The runs of a sweep that have ended, by name.

    Raises:
        SweepFileError: a file is no run of a sweep.
    """
    return [_read(path) for path in sorted((sweep_folder / RUNS).glob("*.json"))]


def recorded_runs(root: Path) -> tuple[dict[tuple[str, str], list[Path]], list[SweepFileError]]:
    """The files of each finished run below a results folder, in whatever sweep, by ``(key, judged_by)``.

    Returns:
        The files, and what could not be read: a damaged file of one sweep stops no other.
    """
    found: dict[tuple[str, str], list[Path]] = {}
    damaged = []
    for path in sorted((root / SWEEPS).glob(f"*/{RUNS}/*.json")):
        try:
            run = _read(path)
        except SweepFileError as error:
            damaged.append(error)
            continue
        if run.status == FINISHED:
            found.setdefault((run.key, run.judged_by), []).append(path)
    return found, damaged


def read_run(path: Path) -> RunFile:
    """One run's file.

    Raises:
        SweepFileError: it is no run of a sweep.
    """
    return _read(path)


def _read(path: Path) -> RunFile:
    try:
        return RunFile(**json.loads(path.read_text("utf-8")))
    except (ValueError, TypeError) as error:
        raise SweepFileError(f"{path} is no file of a sweep's run ({error}); delete it or restore it") from error


def now() -> str:
    """This moment, UTC, to the second."""
    return datetime.now(UTC).isoformat(timespec="seconds")
