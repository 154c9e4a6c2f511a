"""The records that ship with a clone, in the store of the UI: so that a newcomer's first run has company."""

import json
from collections import defaultdict
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pandas as pd
from hydra.core.global_hydra import GlobalHydra

import gran_bench
from gran_bench.benchmark.page import TABLE
from gran_bench.benchmark.results import RESULTS
from gran_bench.compose import compose
from gran_bench.processes import tell
from gran_bench.run.summary import FIGURES, SUMMARY, judged_tags, record_judgement
from gran_bench.shipped import shipped_scene
from gran_bench.surrogate.checkpoint import MODEL
from gran_bench.sweep.runs import FINISHED, read_runs, read_sweep, sweep_folders
from gran_bench.tracking import HEADLINE, SHIPPED_TAG, SWEEP_TAG, VERDICT, Run, Store, shown_name, three_figures
from gran_bench.tracking.abandoned import ENDED_TAG
from gran_bench.tracking.names import FAILED
from gran_bench.tracking.store import PARENT_TAG, SWEEP_SEPARATOR

CLONE = Path(gran_bench.__file__).parents[2]  # an installed package has no records
DONE_TAG = "gran_bench.shipped"  # of the experiment: a record that a user deletes there does not come back
# A method's headline figure by its column in a benchmark's table, and the factor between them.
COLUMNS = {
    **{"angle error deg": ("surface_angle_deg", 1.0), "angle error floors": ("surface_angle_floors", 1.0)},
    **{"com angle error deg": ("com_angle_deg", 1.0), "com angle error floors": ("com_angle_floors", 1.0)},
    **{"speed W1 m per s": ("speed_w1_m_per_s", 1.0), "speed W1 floors": ("speed_w1_floors", 1.0)},
    "position error 10 frames mm": ("position_10_m", 1e3),
}


def record_shipped(store: Store) -> None:
    """Put models, sweeps and benchmarks of the clone into a store's experiment, unless it has had them before."""
    results = CLONE / "results"
    if DONE_TAG in store.client.get_experiment(store.experiment_id).tags or not (CLONE / "conf").is_dir():
        return
    tell("the records that ship with gran-bench come into the store, this once (shipped=false does without)")
    GlobalHydra.instance().clear()  # the command's own, which has done its work and bears no other beside it
    records = _Records(store)
    for summary in sorted(results.glob(f"*/{SUMMARY}")):
        _record_model(records, summary.parent)
    # Others are sweeps of the user's own.
    folders = [one for one in sweep_folders(results) if (CLONE / "conf" / "experiment" / f"{one.name}.yaml").exists()]
    names = defaultdict(list)  # of the sweeps that have a run, by its key
    for folder in folders:
        for row in read_runs(folder):
            names[row.key].append(folder.name)
    for folder in folders:
        _record_sweep(records, folder, names)
    for table in sorted(results.glob(f"benchmark/*/*/{RESULTS}")):
        _record_benchmark(records, table)
    store.client.set_experiment_tag(store.experiment_id, DONE_TAG, "true")


class _Records:
    """Adds each record once, by its key: what an interrupted start has left half made, it makes anew."""

    def __init__(self, store: Store) -> None:
        self.store, self.known = store, {}
        for key, run in store.runs_by_key().items():
            if SHIPPED_TAG in run.data.tags and run.info.status == "RUNNING":
                store.client.delete_run(run.info.run_id)
            else:
                self.known[key] = run.info.run_id

    def add(self, name: str, key: str, *what: Any, **more: Any) -> str:
        if key not in self.known:
            self.known[key] = self.store.add_ended_run(name, key, *what, **more)
        return self.known[key]


def _record_model(records: _Records, folder: Path) -> None:
    summary = json.loads((folder / SUMMARY).read_text("utf-8"))
    made, training = summary["provenance"], summary["training"]
    tags = _tags(folder, {"scene": _scene_of(summary["experiment"]), **made})
    params = {f"model.{name}": str(value) for name, value in summary["model"].items()}
    params |= {"seed": str(training["seed"])}
    run_id = records.add(folder.name, f"shipped/{folder.name}", params, {}, tags, _milliseconds(made["day"]))
    run = Run(records.store, run_id, resumed=True)
    if (folder / MODEL).exists():
        run.log_artifact(folder / MODEL, "model")
    record_judgement(run, summary, folder, sorted((folder / FIGURES).glob("*")))
    run.send()


def _record_sweep(records: _Records, folder: Path, names: Mapping[str, Sequence[str]]) -> None:
    sweep, scene, runs = read_sweep(folder), _scene_of(folder.name), read_runs(folder)
    ended = {run.key: _milliseconds(run.ended_at) for run in runs}
    tags = _tags(folder, {SWEEP_TAG: folder.name, "scene": scene, "command": sweep.command})
    parent = records.add(folder.name, sweep.key, {}, {}, tags, max(ended.values()))
    for row in runs:
        missed = row.figures.get(f"{HEADLINE}requirements failed")
        tags = {name: row.facts[name] for name in ("model", "command", "commit", "hardware") if name in row.facts}
        tags |= {"scene": scene, SWEEP_TAG: SWEEP_SEPARATOR.join(names[row.key]), PARENT_TAG: parent}
        tags |= {VERDICT: FAILED} if missed is None else judged_tags(row.facts["judged"], missed)
        tags |= {ENDED_TAG: row.reason} if row.reason else {}
        params = row.choices | {"model.name": row.facts["model"], "seed": str(row.seed)}
        figures = {name: three_figures(v) if name.startswith(HEADLINE) else v for name, v in row.figures.items()}
        status = "FINISHED" if row.status == FINISHED else "FAILED"
        name = shown_name(f"{row.run}-{row.key[:8]}")
        records.add(name, row.key, params, figures, _tags(folder, tags), ended[row.key], status)


def _record_benchmark(records: _Records, table: Path) -> None:
    found, folder = json.loads(table.read_text("utf-8")), table.parent
    made, scene, profile = found["provenance"], found["scene"], found["profile"]
    frame_ms, ended = 1e3 * shipped_scene(scene).frame_interval, _milliseconds(made["day"])
    tags = _tags(folder, {"scene": scene, "speed": found["motion"].replace("rpm", " rpm"), **made})
    key = f"shipped/benchmark/{profile}/{scene}"
    tags[PARENT_TAG] = records.add(f"benchmark {scene} {profile}", key, {}, {}, tags, ended)
    for row in pd.read_csv(folder / TABLE, dtype=str, keep_default_na=False).to_dict("records"):
        figures = {name: factor * float(row[at]) for name, (at, factor) in COLUMNS.items() if row.get(at)}
        if row["seconds_median"]:
            figures["rollout ms per frame"] = frame_ms * float(row["seconds_median"])
        figures = {HEADLINE + name: three_figures(value) for name, value in figures.items()}
        failed = {VERDICT: FAILED, ENDED_TAG: row["reason"]} if row["failed"] == "True" else {}
        name, more = f"{row['method']}, {scene} {profile}", {"model": row["method"], **failed}
        records.add(name, f"{key}/{row['method']}", {"kind": row["kind"]}, figures, tags | more, ended)


def _tags(folder: Path, tags: Mapping[str, Any]) -> dict[str, str]:
    place = folder.relative_to(CLONE).as_posix()
    return {SHIPPED_TAG: place, "folder": str(folder), **{name: str(value) for name, value in tags.items()}}


def _scene_of(recipe: str) -> str:
    return compose("train", [f"+experiment={recipe}"]).scene.name


def _milliseconds(day_or_time: str) -> int:
    """Of UTC, since 1970."""
    return int(1e3 * datetime.fromisoformat(day_or_time).replace(tzinfo=UTC).timestamp())
