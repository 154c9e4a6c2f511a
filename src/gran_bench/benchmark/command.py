"""The benchmark, stage by stage: data → turns → judgement → studies → results, figures, page."""

import json
import os
from dataclasses import replace
from pathlib import Path
from textwrap import shorten
from typing import Any

from gran_bench.benchmark import page
from gran_bench.benchmark import results as kept
from gran_bench.benchmark.contest import Contest, Method
from gran_bench.benchmark.errors import Reference, Scored, errors_file, judged_rounds, score_run
from gran_bench.benchmark.judges import JUDGED_AT_A_TIME, judges
from gran_bench.benchmark.overview import draw_overview
from gran_bench.benchmark.turns import PREPARED_AT_A_TIME, Record, round_file, take_turns
from gran_bench.config import BenchmarkConfig, DemConfig
from gran_bench.config.reading import validate
from gran_bench.config.rules import ConfigError
from gran_bench.dataset import Case, ensure_beds, ensure_cases, from_document, read_case, rotation_label
from gran_bench.dem.time_step import choose_time_step
from gran_bench.files import locked, markdown, write_text
from gran_bench.plots.style import titled
from gran_bench.plots.time_error import CostLine, cost_against, time_against_error
from gran_bench.processes import stop_on_signals, tell
from gran_bench.provenance import hardware, library_versions, provenance
from gran_bench.provenance.source_digest import comparing_code
from gran_bench.run.cost import PROCESS_BYTES, Cost, data_cost, flow_cost
from gran_bench.run.pace import dem_pace, rollout_pace, summary_pace
from gran_bench.scene import Scene
from gran_bench.shipped import DEFAULT_MODEL, SHIPPED, shipped_model
from gran_bench.surrogate.checkpoint import load_model

MEASUREMENTS = "measurements"  # folder of the finished runs
PREPARING = 5.0  # s that a method takes before its first run: libraries, kernels, two frames


def run_benchmark(config: BenchmarkConfig) -> dict[str, Any]:
    """Compare every method on the scene of a config, or do what is left of it; the results, as in ``benchmark.json``.

    With ``measure=false`` nothing is measured: kept results are told anew, with the DEM's own accuracy by today's rule.

    Raises:
        ConfigError, CheckpointError, DatasetError: an impossible value, no model file, or runs of the DEM that failed.
        ResultsError: nothing measured yet, or with other replicas, and ``measure=false``.
        KeyboardInterrupt: SIGTERM or Ctrl-C; what was measured stays.
    """
    validate(config)
    contest, data = Contest(config, model_files(config.models)), config.dataset
    scene, folder = contest.scene, Path(config.root) / config.profile.name / contest.scene.name
    if (config.measure or config.dry_run) and benchmark_cost(contest, folder / MEASUREMENTS).tell(config.dry_run):
        return {}
    with stop_on_signals(), locked(folder / ".lock", lambda: tell(f"another process works on {folder}; waiting")):
        tell("DEM runs that the methods start from and are held against")
        ensure_cases(contest.cases if config.measure else contest.replicas, data.root, data.workers)
        ensure_beds(contest.beds if config.measure else [], data.root, data.workers)
        tell("summarising the replicas")

        def packings() -> list[Case]:
            tell("nudges hardly grow in this scene: runs of the DEM from other packings, which give the noise floor")
            ensure_cases(contest.packings, data.root, data.workers)
            return [read_case(spec.path(data.root)) for spec in contest.packings]

        reference = Reference(scene, [read_case(spec.path(data.root)) for spec in contest.replicas], packings)
        if config.measure:
            found = _compare(contest, folder, reference)
        else:
            found = kept.judged_anew(kept.read_results(folder / kept.RESULTS), reference, data.replicas)
        write_text(folder / kept.RESULTS, json.dumps(found, indent=1, allow_nan=False) + "\n")
        draw(found, folder)
        write_text(folder / page.TABLE, page.table_of(found).to_csv(index=False))
        draw_overview(Path(config.root))
        written = page.write_page(Path(config.root))
    print(summary(found))
    tell(f"table and figures in {folder}; the page is {written}")
    return found


def model_files(models: list[str]) -> dict[str, Path]:
    """Model files by the name of their folder, the run's; a `ConfigError` where two have one name."""
    found: dict[str, Path] = {}
    for word in models:
        path = shipped_model() if word == SHIPPED else Path(word)
        name = f"{DEFAULT_MODEL} (shipped)" if word == SHIPPED else path.resolve().parent.name
        if name in found:
            raise ConfigError(f"models={models} names two files of the folder {name}; give one, or copy the other")
        found[name] = path
    return found


def summary(found: dict[str, Any]) -> str:
    """The end of the terminal output: a row for each method, who wins, and who is faster at equal accuracy."""
    rows = [("method", "time, s", "min … max", "floors")]
    for row in sorted(found["methods"], key=lambda row: row["wall"]["median"] if row["wall"] else 1e9):
        wall, error = row["wall"], "statistics" if row.get("statistics") else "-"
        error = error if row["floors"] is None else f"{row['floors']:.2f}"
        times = (f"{wall['median']:.3g}", f"{wall['low']:.3g} … {wall['high']:.3g}") if wall else ("", "")
        rows.append((row["name"], *times, row["unfit_because"] or shorten(row["failure"], 60) or error))
    said = [page.winner(found), *(f"{name}: {words}" for name, words, *_ in page.surrogate_rows(found))]
    return "\n".join(
        [*markdown(rows, aligned=True), "", *page.statistics_table(found), *said, *page.busy_sentences(found)]
    )


def draw(found: dict[str, Any], folder: Path) -> None:
    """The figures of one benchmark, from its results."""
    # The colour of a mark says already that it is a DEM.
    contenders = [replace(entry, name=entry.name.removeprefix("DEM ")) for entry in kept.entries(found)]
    lost = [name.removeprefix("DEM ") for name in kept.untimed(found)]
    labels = page.listed([row["label"] for row in found["reference"]["ranked"]])
    scene, packing = f"{found['scene']}, {found['motion'].replace('rpm', ' rpm')}", "a packing that no training saw"
    with titled(f"{scene}, {found['spheres']} spheres, {packing}"):
        time_against_error(contenders, labels, folder / "time_error.png", found["reference"]["accepted"], lost)
    level, soft = page.softened(found), None
    if level is not None:
        soft = (f"as exact at {found['modulus']:.0e} Pa: {level.name}".replace("e+0", "e"), level.seconds)
    for study, quantity, same in (("stiffness", "Young's modulus, Pa", soft), ("counts", "spheres", None)):
        if found[study]:
            lines = [_cost_line(label, points) for label, points in found[study].items()]
            with titled(f"{scene}, {packing}"):
                cost_against(lines, quantity, folder / f"{study}.png", same)


def _cost_line(label: str, points: list[dict[str, Any]]) -> CostLine:
    kind, done = "dem" if label in page.DEMS else "surrogate", [point for point in points if kept.succeeded(point)]
    costs, failed = [point["wall"]["median"] for point in done], [p["at"] for p in points if not kept.succeeded(p)]
    return CostLine(page.DEMS.get(label, label), kind, [point["at"] for point in done], costs, failed)


def benchmark_cost(contest: Contest, folder: Path) -> Cost:
    """What is left to measure in a folder, and what it will take."""
    config, scene, data = contest.config, contest.scene, contest.config.dataset
    cost = data_cost(scene, config.dem, contest.cases, data.root, data.workers, contest.beds)
    cost = flow_cost(scene, config.dem) + cost
    conditions, profile, paces = measured_under(config.seed), config.profile, {}
    studies = [*contest.stiffness_methods.values(), *contest.count_methods.values()]
    turns = [(method, profile.rounds) for method in contest.methods]
    turns += [(method, profile.study_rounds) for line in studies for _, method in line]
    runs = methods = judged = timed = 0
    for method, rounds in (turn for turn in turns if turn[0].job and not turn[0].unfit_because):
        place = folder / method.key(*conditions)
        if left := sum(not round_file(place, k).exists() for k in range(rounds)):
            runs, methods, timed = runs + left, methods + 1, timed + left * _run_seconds(method, scene, paces)
            spheres = from_document(method.job["scene"]).filling.count if "scene" in method.job else 0
            judged += min(left, judged_rounds(method, profile.judged_rounds)) * spheres / scene.filling.count
    stages = {"preparing": PREPARING * methods / PREPARED_AT_A_TIME, "timed runs": timed}
    lanes = min(JUDGED_AT_A_TIME, os.cpu_count() or 1)
    stages["judging"] = summary_pace(scene, overlaps=True) * scene.frame_count * (judged / lanes + data.replicas)
    line = f"benchmark: {methods} methods and points of studies, {runs} timed runs to make, one after the other"
    return cost + Cost([line], stages, PROCESS_BYTES["torch"])


def _run_seconds(method: Method, scene: Scene, paces: dict[Any, float]) -> float:
    """Wall time of a run; methods of one kind take as long for a sphere and a step, or a frame of a model."""
    if method.kind in ("baseline", "emulator"):
        return 0.0
    job, own = method.job, from_document(method.job["scene"])
    if method.kind == "surrogate":
        kind, step = job["model"], own.frame_interval
        if kind not in paces:
            paces[kind] = rollout_pace(load_model(kind)[0], scene) / scene.filling.count
    else:
        kind = job["dem"]["engine"], job["dem"]["precision"]
        step = job["dem"]["time_step"] or choose_time_step(own)[0]
        if kind not in paces:
            paces[kind] = dem_pace(scene, DemConfig(**job["dem"] | {"time_step": None}))
    return method.seconds / step * own.filling.count * paces[kind]


def measured_under(seed: int) -> list[str]:
    """Whatever else than its job decides what is measured of a method: a change of any measures anew."""
    return [comparing_code(), library_versions(), hardware(), f"format {kept.FORMAT}", f"seed {seed}"]


def _compare(contest: Contest, folder: Path, reference: Reference) -> dict[str, Any]:
    config, scene, methods = contest.config, contest.scene, contest.methods
    profile, conditions = config.profile, measured_under(config.seed)
    runs: dict[str, list[Scored]] = {}

    def turns(what: list[Method], rounds: int, label: str, **judging: Any) -> dict[str, Record]:
        tell(f"{label}: {len([m for m in what if not m.unfit_because])} methods in {rounds} rounds")
        place = folder / MEASUREMENTS
        return take_turns(what, rounds, config.seed, place, conditions, scene.frame_interval, label=label, **judging)

    def wants_frames(method: Method, place: Path, index: int) -> bool:
        judged = errors_file(place, reference.digest, index).exists()
        return method.has_frames and index < judged_rounds(method, profile.judged_rounds) and not judged

    with judges(reference) as judge:

        def judge_round(index: int, folders: dict[str, Path]) -> None:
            some = [m for m in methods if m.name in folders and index < judged_rounds(m, profile.judged_rounds)]
            judge([(method, folders[method.name]) for method in some], index)
            for method in some:
                scored = score_run(method, folders[method.name], reference, index)
                runs.setdefault(method.name, []).extend([scored] if scored else [])

        judging = {"wants_frames": wants_frames, "after_round": judge_round}
        records = turns(methods, profile.rounds, "timing and judging", **judging)
    scores = {name: reference.pooled(found) for name, found in runs.items() if found and not records[name].failure}
    studies = {}
    for label, points in (("stiffness", contest.stiffness_methods), ("counts", contest.count_methods)):
        flat = [method for line in points.values() for _, method in line]
        studies[label] = kept.study_rows(points, turns(flat, profile.study_rounds, label)) if flat else {}
    automatic = next(method for method in methods if method.name == contest.automatic)
    own = scores[automatic.name].floors if automatic.name in scores else None
    beside = {one["round"]: one["wall_seconds"] / automatic.seconds for one in records[automatic.name].turns}
    rows = [kept.method_row(m, records.get(m.name), scores.get(m.name), beside) for m in methods]
    facts = {"format": kept.FORMAT, "scene": scene.name, "profile": profile.name, "spheres": scene.filling.count}
    facts |= {"simulated_seconds": scene.end_time - scene.start_time, "motion": rotation_label(scene)}
    facts |= {"modulus": scene.material.youngs_modulus, "rounds": profile.rounds, "automatic": contest.automatic}
    facts["reference"] = kept.reference_facts(reference, config.dataset.replicas, profile.judged_rounds, own)
    return facts | {"methods": rows, "waited": kept.share_waited(rows), **studies, "provenance": provenance()}
