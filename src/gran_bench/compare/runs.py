"""Finished runs, read from their folders: what differs between them, and every headline figure with its floor."""

import json
import re
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from gran_bench.evaluation.plan import motion_words, rollout_name
from gran_bench.metrics.judgement import shown_multiple
from gran_bench.metrics.outside import counted
from gran_bench.run.summary import broken_rollouts, ranked_errors, registered_metrics, requirements_met
from gran_bench.tracking import TrackingError, shown_name
from gran_bench.tracking.search import CONFIG, SUMMARY, RunError, stored_runs

_PARTS = {"judged", "judged_rpm", "model", "training", "rollouts", "nearest_case", "position_error"}  # of a summary
FROM_START = ("position_10", "position_30")
UNSEEN = ", unseen packing"
ABSENT, UNKNOWN = "–", "?"
_UNITS = {"m": "mm", "-": ""}  # as shown


@dataclass(frozen=True)
class ComparedRun:
    """A finished run."""

    folder: Path
    name: str  # as the UI shows it
    summary: dict[str, Any]
    keys: dict[str, Any]  # of its config, dotted; where a run is kept is not among them
    whole: frozenset[str]  # sections of the config that the folder records in full

    def scene_at(self, rpm: float | None) -> str:
        """For people: ``drum, 3000 spheres, 30 rpm``, with the name of the scene where it is recorded."""
        failures = self.summary["judged"]["shared"]["failures"]
        count = f"{failures['spheres']} spheres, " if failures else ""
        return f"{self.keys.get('scene.name', 'unnamed scene')}, {count}{motion_words(rpm)}"


def read_run(folder: Path, root: Path) -> ComparedRun:
    """A finished run, from its folder; ``config.json`` or ``model.pt`` add what the summary does not say.

    Raises:
        RunError: the run is not finished (with the command that goes on with it, as the store of the results in
            ``root`` knows it), or a file cannot be read.
    """
    config, name = _read(folder / CONFIG) if (folder / CONFIG).exists() else {}, shown_name(folder.resolve().name)
    if not (folder / SUMMARY).exists():
        commands = []
        with suppress(TrackingError):
            commands = [run.data.tags.get("command") for run in stored_runs(root) if run.info.run_name == name]
        remedy = next(filter(None, commands), "repeat the command that began it, which goes on from there")
        raise RunError(f"{folder}: this run is not finished; to go on with it: {remedy}")
    summary = _read(folder / SUMMARY)
    if _PARTS - summary.keys():
        raise RunError(f"{folder / SUMMARY} is no summary of a judged run; give the folder of one")
    training, model = summary["training"], Path(config.get("checkpoint") or folder / "model.pt")
    whole = {"model": summary["model"]} | {key: value for key, value in config.items() if key != "tracking"}
    if "scene" not in config and model.is_file():  # a record that ships, or an evaluation
        from gran_bench.surrogate import checkpoint  # with PyTorch, which others need not wait for

        card, _ = checkpoint.load_card(model)
        whole |= {"scene": card.scene, "boundary": card.boundary}
    keys = {"seed": training.get("seed"), "dataset.training_speeds_rpm": training.get("training_speeds_rpm")}
    keys = {key: value for key, value in keys.items() if value is not None}
    return ComparedRun(folder, name, summary, keys | pd.json_normalize(whole).to_dict("records")[0], frozenset(whole))


def _read(path: Path) -> dict[str, Any]:
    try:
        return dict(json.loads(path.read_text("utf-8")))
    except (OSError, TypeError, ValueError) as error:
        raise RunError(f"{path} cannot be read ({error}); get it again, or leave the run out") from error


class Figure(NamedTuple):
    """One figure of one run as it is shown; a distance from the DEM has a floor, and its multiple of the floor."""

    shown: str
    unit: str = ""
    floor: str = ABSENT
    multiple: float | None = None
    note: str = ""


def differences(runs: Mapping[str, ComparedRun]) -> pd.DataFrame:
    """The config keys whose values differ, then the digests of data and code that do; a column for each label of a run.

    A key that a run does not have is ``–``, one that its folder does not record is ``?``.
    """
    every = sorted({key for run in runs.values() for key in run.keys}, key=lambda key: ("." in key, key))
    digests = all("code_digest" in run.summary["training"] for run in runs.values())
    code, code_key = ("code digest", "code_digest") if digests else ("commit", "commit")
    columns = {}
    for label, run in runs.items():
        absent = {key: ABSENT if key.partition(".")[0] in run.whole else UNKNOWN for key in every}
        columns[label] = absent | {key: _plain(value) for key, value in run.keys.items()} | {
            "training data": run.summary["training"].get("data_digest", UNKNOWN),
            f"{code} of the training": run.summary["training"].get(code_key, UNKNOWN),
            "judging data": run.summary.get("data_digest", UNKNOWN),
        }  # fmt: skip
    table = pd.DataFrame(columns)
    return table[table.where(table != UNKNOWN).nunique(axis=1) > 1]


def _plain(value: Any) -> str:
    """A value of a config as it is typed; 1 and 1.0 are one number."""
    text = json.dumps(value, ensure_ascii=False)
    return value if isinstance(value, str) else re.sub(r"\.0\b", "", text).replace('"', "")


def figures_of(run: ComparedRun, rpm: float | None) -> Iterator[tuple[str, Figure]]:
    """The headline figures of a run by name, at the judged speed or, without floors, at another one of its rollouts."""
    summary, training, judged = run.summary, run.summary["training"], run.summary["judged"]
    broken, at_rpm = broken_rollouts(summary), judged if rpm == summary["judged_rpm"] else {}
    after = {packing: "" if packing == "shared" else UNSEEN for packing in judged}
    for packing, found in at_rpm.items():
        for key in (*ranked_errors(found), *registered_metrics(found), *(FROM_START if packing == "shared" else ())):
            if row := found["errors"].get(key):
                floor, unit, times = _shown(row["floor"], row["unit"]), row["unit"], row["multiple_of_floor"]
                shown = _shown(row["value"], unit) + ("" if times is None else f" (× {shown_multiple(times)})")
                note = (row["note"] or row["floor_note"]) if times is None else ""
                yield row["label"] + after[packing], Figure(shown, _UNITS.get(unit, unit), floor, times, note)
    if at_rpm:
        for name, row in summary["position_error"].items():
            frames = counted(int(name.partition("_")[0]), "frame")
            yield f"position {frames} after a frame of the DEM", Figure(_shown(row["m"], "m"), "mm")
    elif nearest := summary["nearest_case"].get(rollout_name(rpm)):
        yield "speeds, W1 to the one DEM run", Figure(_shown(nearest["w1_m_s"].get(rollout_name(rpm))), "m/s")
        yield "speed of the nearest DEM run", Figure(_shown(nearest["nearest_rpm"]), "rpm")
    for packing, found in at_rpm.items():
        if counts := found["failures"]:
            lost = counts["non_finite_states"] + max(0, counts["expected_states"] - counts["states"])
            yield f"states not finite or missing{after[packing]}", Figure(f"{lost} of {counts['expected_states']}")
            yield f"sphere states outside by > r{after[packing]}", Figure(f"{counts['outside_radius']}")
    where = "".join(f"; {name} at frame {frame}" for name, frame in broken.items())
    yield "rollouts broken down", Figure(f"{len(broken)} of {len(summary['rollouts'])}{where}")
    if rollout := summary["rollouts"].get(rollout_name(rpm)):
        time, dem = (_shown(rollout[key]) for key in ("ms_per_frame_median", "dem_ms_per_frame"))
        yield "time of a frame (of the DEM)", Figure(f"{time} ({dem})", "ms")
    yield "training (updates)", Figure(f"{training['seconds'] / 60.0:.3g} ({training['steps']})", "min")
    parts = requirements_met(summary)
    met, asked = (sum(counts) for counts in zip(*parts.values(), strict=True))
    yield "requirements met", Figure(f"{met} of {asked}")
    for name, (met, asked) in parts.items():
        yield f"of these, {name}", Figure(f"{met} of {asked}")


def _shown(value: float | None, unit: str = "") -> str:
    """Three figures; lengths in mm."""
    return "undefined" if value is None else f"{(1e3 if unit == 'm' else 1.0) * value:.3g}"


def figures_table(found: Mapping[str, Mapping[str, Figure]]) -> pd.DataFrame:
    """A row a figure: its floor, of each run where they differ, then what each run (by its label) has."""
    rows = {}
    for name in dict.fromkeys(name for figures in sorted(found.values(), key=len, reverse=True) for name in figures):
        row = [figures.get(name, Figure(ABSENT)) for figures in found.values()]
        floors, unit = [one.floor for one in row], max(one.unit for one in row)
        floor = floors[0] if len({*floors}) == 1 else " | ".join(floors)
        rows[", ".join(filter(None, (name, unit)))] = [floor, *(one.shown for one in row)]
    return pd.DataFrame.from_dict(rows, orient="index", columns=["noise floor", *found])
