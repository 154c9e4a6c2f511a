"""What a finished run says: ``summary.json`` for machines, a table for people, headline figures for both."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gran_bench.config.registry import METRICS
from gran_bench.files import write_text
from gran_bench.metrics.judgement import shown_multiple
from gran_bench.metrics.outside import FailureCount, counted
from gran_bench.tracking.names import HEADLINE

SUMMARY = "summary.json"


def write_summary(folder: Path, summary: dict[str, Any]) -> Path:
    """Write ``summary.json``, whole or not at all; its presence says that the run is finished."""
    path = folder / SUMMARY
    write_text(path, json.dumps(summary, indent=1, ensure_ascii=False, allow_nan=False) + "\n")
    return path


def read_summary(folder: Path) -> dict[str, Any] | None:
    """The summary of a finished run, or None."""
    path = folder / SUMMARY
    return json.loads(path.read_text("utf-8")) if path.exists() else None


def headline(summary: dict[str, Any]) -> dict[str, float]:
    """The figures that a person looks at first, by the names that they have in MLflow.

    A figure that is undefined is absent here; why, says the summary. A requirement fails for each row of the table
    that says so: the judged ones, a speed that is not told apart, a rollout that broke down.
    """
    shared = summary["judged"]["shared"]
    rollout = summary["rollouts"][f"{summary['judged_rpm']:g}rpm"]
    found = {
        "angle error deg": shared["errors"]["surface_angle"]["value"],
        "angle error floors": shared["errors"]["surface_angle"]["multiple_of_floor"],
        "com angle error deg": shared["errors"]["com_angle"]["value"],
        "com angle error floors": shared["errors"]["com_angle"]["multiple_of_floor"],
        "speed W1 m per s": shared["errors"]["speed_w1"]["value"],
        "speed W1 floors": shared["errors"]["speed_w1"]["multiple_of_floor"],
        "position error 10 frames mm": _scaled(summary["position_error"]["10_frames"]["m"], 1e3),
        "rollout ms per frame": rollout["ms_per_frame_median"],
        "training minutes": summary["training"]["seconds"] / 60.0,
        "requirements failed": float(len(missed_requirements(summary))),
        "rollouts failed": float(len(broken_rollouts(summary))),
    }
    for name in registered_metrics(shared):
        found[name], row = shared["figures"][name]["value"], shared["errors"][name]
        found |= {f"{name} error": row["value"], f"{name} floors": row["multiple_of_floor"]}
    return {name: float(value) for name, value in found.items() if value is not None}


def registered_metrics(judged: Mapping[str, Any]) -> list[str]:
    """The metrics of plugins that a judgement has."""
    return [name for name in METRICS.added() if name in judged["errors"]]


def missed_requirements(summary: dict[str, Any]) -> list[str]:
    """A line for each requirement that is not met: judged ones, speeds not told apart, rollouts that broke down."""
    missed = [
        f"{row['label']}: {_figure(row['value'], row['unit'])} ({packing} packing)"
        for packing, judged in summary["judged"].items()
        for row in judged["requirements"].values()
        if row["verdict"] == "fail"
    ]
    for name, row in summary["nearest_case"].items():
        if not row["is_own"]:
            nearest = "nothing" if row["nearest_rpm"] is None else f"{row['nearest_rpm']:g} rpm"
            missed.append(f"rolled out at {name}, nearest to {nearest}")
    return missed + [f"rollout {name} broke down at frame {k}" for name, k in broken_rollouts(summary).items()]


def broken_rollouts(summary: dict[str, Any]) -> dict[str, int]:
    """The frame at which each rollout that broke down did so, by the rollout's name."""
    frames = {name: row["failed_frame"] for name, row in summary["rollouts"].items()}
    return {name: frame for name, frame in frames.items() if frame is not None}


def rollout_warnings(summary: dict[str, Any]) -> list[str]:
    """A line for each difference between a rollout and the training of its model."""
    rollouts = summary["rollouts"].items()
    return [f"rollout {name} is an extrapolation: {line}" for name, row in rollouts for line in row.get("warnings", ())]


def _scaled(value: float | None, factor: float) -> float | None:
    return None if value is None else value * factor


def flat_metrics(summary: dict[str, Any]) -> dict[str, float]:
    """Every defined figure of a summary for the tracking store, as ``headline/name`` or ``packing/kind/name``.

    The UI draws a group for each first word, in the order of the alphabet: the headline figures come first.
    """
    metrics: dict[str, Any] = {HEADLINE + name: value for name, value in headline(summary).items()}
    for packing, judged in summary["judged"].items():
        for name, row in judged["errors"].items():
            metrics[f"{packing}/error/{name}"] = row["value"]
            metrics[f"{packing}/floors/{name}"] = row["multiple_of_floor"]
        for name, row in judged["figures"].items():
            metrics[f"{packing}/figure/{name}"] = row["value"]
        for name, count in (judged["failures"] or {}).items():
            metrics[f"{packing}/failures/{name}"] = count
    for name, row in summary["nearest_case"].items():
        metrics[f"nearest/{name}"] = row["nearest_rpm"]
    for name, row in summary["position_error"].items():
        metrics[f"position_error/{name}"] = row["m"]
    for name, row in summary["rollouts"].items():
        metrics[f"rollout/{name}/ms_per_frame"] = row["ms_per_frame_median"]
        metrics[f"rollout/{name}/dem_ms_per_frame"] = row["dem_ms_per_frame"]
    for name, seconds in summary["wall_seconds"].items():
        metrics[f"wall_seconds/{name}"] = seconds
    return {
        name: float(value)
        for name, value in metrics.items()
        if isinstance(value, int | float) and not isinstance(value, bool)
    }


def cut_short(training: Mapping[str, Any]) -> str | None:
    """A sentence that says that the clock has cut a budget of steps; None where it has not.

    Args:
        training: as in ``training.json``; one of before this was kept says nothing.
    """
    steps, planned = training["steps"], training.get("planned_steps")
    if planned is None or steps >= planned:
        return None
    return (
        f"the clock has cut the training: {steps} of {planned} updates in {training['seconds'] / 60.0:.1f} minutes, "
        f"the last at a learning rate of {training['learning_rate']:.2g}; with more trainer.minutes the same command "
        "goes on"
    )


def summary_table(summary: dict[str, Any]) -> str:
    """The end of the terminal output: requirements met and missed, headline figures, where things are."""
    lines = [f"{summary['experiment']}: {summary['model']['name']}, {summary['training']['parameters']} parameters"]
    lines.append(
        f"trained {summary['training']['steps']} updates in {summary['training']['seconds'] / 60:.1f} min "
        f"(stopped by {summary['training']['stopped_by']})"
    )
    if (cut := cut_short(summary["training"])) is not None:
        lines.append(cut)
    for packing, judged in summary["judged"].items():
        lines += ["", f"{summary['judged_rpm']:g} rpm, {summary['judged_as']}, {packing} packing"]
        lines.append(f"  {'':<56}{'found':>16}  verdict")
        for row in judged["requirements"].values():
            lines.append(f"  {row['label']:<56}{_figure(row['value'], row['unit']):>16}  {row['verdict']}{_note(row)}")
        lines.append(f"  {'distance from the DEM':<56}{'found':>16}  noise floor")
        for name in ("surface_angle", "com_angle", "speed_w1", *registered_metrics(judged)):
            row = judged["errors"][name]
            times = "" if row["multiple_of_floor"] is None else f" (× {shown_multiple(row['multiple_of_floor'])})"
            floor = _figure(row["floor"], row["unit"])
            lines.append(f"  {row['label']:<56}{_figure(row['value'], row['unit']):>16}  {floor}{times}{_note(row)}")
        if judged["failures"]:
            lines += [f"  {line}" for line in FailureCount(**judged["failures"]).lines(judged.get("dem_outside"))]
        lines += _unlike_the_dem(judged["figures"])
    lines += ["", f"baselines at {summary['judged_rpm']:g} rpm, shared packing"]
    lines.append(f"  {'':<56}{'angle':>16}{'speed W1':>14}{'a frame':>12}")
    for name, errors in summary["baselines"].items():
        angle, speed = (_figure(errors[key]["value"], errors[key]["unit"]) for key in ("surface_angle", "speed_w1"))
        time = _figure(errors["ms_per_frame"], "ms") if "ms_per_frame" in errors else "not timed"
        lines.append(f"  {name:<56}{angle:>16}{speed:>14}{time:>12}")
    lines += ["", "tells speeds apart (the one DEM run at each speed that is nearest, by speed W1)"]
    for name, row in summary["nearest_case"].items():
        nearest = "undefined" if row["nearest_rpm"] is None else f"{row['nearest_rpm']:g} rpm"
        alone = "  [the only speed, so there is none to be told from]" if len(summary["nearest_case"]) == 1 else ""
        lines.append(f"  {name:<56}{nearest:>16}  {'pass' if row['is_own'] else 'fail'}{alone}")
    for name, frame in broken_rollouts(summary).items():
        lines.append(f"  {'rollout ' + name:<56}{f'failed at frame {frame}':>16}  fail")
    lines += [f"  {line}" for line in rollout_warnings(summary)]
    errors = summary["position_error"].values()
    shown = ", ".join(_figure(row["m"], "m") for row in errors)
    horizons = ", ".join(name.split("_")[0] for name in summary["position_error"])
    lines += ["", f"position error after {horizons} frames: {shown}"]
    rollout = summary["rollouts"][f"{summary['judged_rpm']:g}rpm"]
    lines.append(
        f"time for a frame of {summary['frame_ms']:g} ms: surrogate {_figure(rollout['ms_per_frame_median'], 'ms')}, "
        f"this DEM {_figure(rollout['dem_ms_per_frame'], 'ms')} (one core; other work on the machine counts)"
    )
    spent = ", ".join(f"{name} {seconds:.0f} s" for name, seconds in summary["wall_seconds"].items())
    lines.append(f"wall time: {spent}")
    lines += ["", verdict(summary)]
    return "\n".join(lines)


def verdict(summary: dict[str, Any]) -> str:
    """Whether the requirements are met, and how many of the figures that none of them is about are unlike the DEM's."""
    missed, unlike = (
        len(missed_requirements(summary)),
        sum(
            row["inside_interval"] is False
            for judged in summary["judged"].values()
            for row in judged["figures"].values()
        ),
    )
    words = f"{counted(missed, 'requirement')} NOT met" if missed else "all requirements met"
    further = "lies" if unlike == 1 else "lie"
    return words + (f"; {counted(unlike, 'figure')} {further} outside the DEM's interval" if unlike else "")


def _unlike_the_dem(figures: dict[str, Any]) -> list[str]:
    """Rows of the figures that a further run of the DEM would not have (95 %); no requirement is about them."""
    unlike = [row for row in figures.values() if row["inside_interval"] is False]
    if not unlike:
        return []
    lines = [f"  {'outside the interval of the DEM (95 %), no requirement':<56}{'found':>16}  DEM"]
    for row in unlike:
        low, high = (_figure(end, row["unit"]) for end in row["dem_interval"])
        lines.append(f"  {row['label']:<56}{_figure(row['value'], row['unit']):>16}  {low} … {high}")
    return lines


def _figure(value: float | None, unit: str) -> str:
    if value is None:
        return "undefined"
    if unit == "m":
        value, unit = 1e3 * value, "mm"
    return f"{value:.3g} {unit}".rstrip()


def _note(row: dict[str, Any]) -> str:
    return f"  [{row['note']}]" if row.get("note") else ""
