"""The benchmark, stage by stage: data → turns → judgement → studies → results, figures, page."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from gran_bench.benchmark import results as kept
from gran_bench.benchmark.contest import Contest, Method
from gran_bench.benchmark.errors import Reference, Scored, errors_file, judged_rounds, score_run
from gran_bench.benchmark.page import TABLE, busy_sentences, softened, verdicts, winner, write_page, write_table
from gran_bench.benchmark.turns import PREPARED_AT_A_TIME, Record, round_file, take_turns
from gran_bench.config import BenchmarkConfig, DemConfig
from gran_bench.config.reading import validate
from gran_bench.config.rules import ConfigError
from gran_bench.dataset import ensure_cases, from_document, read_case, rotation_label
from gran_bench.dem.simulate import choose_time_step
from gran_bench.files import locked
from gran_bench.plots.time_error import CostLine, cost_against, time_against_error
from gran_bench.processes import stop_on_signals
from gran_bench.provenance import hardware, library_versions, provenance
from gran_bench.provenance.source_digest import comparing_code
from gran_bench.run.cost import PROCESS_BYTES, Cost, data_cost, flow_cost
from gran_bench.run.pace import dem_pace, rollout_pace, summary_pace
from gran_bench.shipped import DEFAULT_MODEL, SHIPPED, shipped_model
from gran_bench.surrogate.checkpoint import load_model

MEASUREMENTS = "measurements"  # folder of the finished runs
PREPARING = 5.0  # s that a method takes before its first run: libraries, kernels, two frames


def run_benchmark(config: BenchmarkConfig) -> dict[str, Any]:
    """Compare every method on the scene of a config, or do what is left of it.

    With ``measure=false`` nothing is measured: kept results are told anew, with the DEM's own accuracy by today's rule.

    Returns:
        The results, as in ``benchmark.json``.

    Raises:
        KeyboardInterrupt: SIGTERM or Ctrl-C; what was measured stays.
        ConfigError, CheckpointError, DatasetError: a value that cannot be, a model file that is none, or runs of the
            DEM that failed.
        ResultsError: nothing measured yet, or with other replicas, and ``measure=false``.
    """
    validate(config)
    contest, data = Contest(config, model_files(config.models)), config.dataset
    scene, folder = contest.scene, Path(config.root) / config.profile.name / contest.scene.name
    if (config.measure or config.dry_run) and benchmark_cost(contest, folder / MEASUREMENTS).tell(config.dry_run):
        return {}
    with stop_on_signals(), locked(folder / ".lock", lambda: _tell(f"another process works on {folder}; waiting")):
        _tell("DEM runs that the methods start from and are held against")
        ensure_cases(contest.cases if config.measure else contest.replicas, data.root, data.workers)
        _tell("summarising the replicas")
        reference = Reference(scene, [read_case(spec.path(data.root)) for spec in contest.replicas])
        if config.measure:
            found = _compare(contest, folder, reference)
        else:
            found = kept.judged_anew(kept.read_results(folder / kept.RESULTS), reference, data.replicas)
        kept.write_results(folder, found)
        draw(found, folder)
        write_table(folder / TABLE, found)
        page = write_page(Path(config.root))
    print(summary(found))
    _tell(f"table and figures in {folder}; the page is {page}")
    return found


def model_files(models: list[str]) -> dict[str, Path]:
    """Model files by the name that they are shown under: of their folder, which is the run's.

    Raises:
        ConfigError: two of one name.
    """
    found: dict[str, Path] = {}
    for word in models:
        path = shipped_model() if word == SHIPPED else Path(word)
        name = f"{DEFAULT_MODEL} (shipped)" if word == SHIPPED else path.resolve().parent.name
        if name in found:
            raise ConfigError(f"models={models} names two files of the folder {name}; give one, or copy the other")
        found[name] = path
    return found


def summary(found: dict[str, Any]) -> str:
    """The end of the terminal output: a line for each method, and who wins."""
    lines = [f"{'':<42}{'time, s':>9} {'min … max':>17} {'floors':>7}"]
    for row in sorted(found["methods"], key=lambda row: row["wall"]["median"] if row["wall"] else 1e9):
        if row["wall"] is None:
            lines.append(f"{row['name']:<42}{row['unfit_because'] or row['failure']}")
            continue
        wall = row["wall"]
        span = f"{wall['low']:.3g} … {wall['high']:.3g}"
        error = "failed" if row["failed"] else "-" if row["floors"] is None else f"{row['floors']:.2f}"
        lines.append(f"{row['name']:<42}{wall['median']:>9.3g} {span:>17} {error:>7}")
    said = [line.replace("**", "") for line in (winner(found), *verdicts(found), *busy_sentences(found))]
    return "\n".join([*lines, "", *said])


def draw(found: dict[str, Any], folder: Path) -> None:
    """The figures of one benchmark, from its results."""
    # The colour of a mark says already that it is a DEM.
    contenders = [replace(entry, name=entry.name.removeprefix("DEM ")) for entry in kept.entries(found)]
    lost = [name.removeprefix("DEM ") for name in kept.untimed(found)]
    labels = " and ".join(row["label"] for row in found["reference"]["ranked"])
    time_against_error(contenders, labels, folder / "time_error.png", found["reference"]["accepted"], lost)
    level, soft = softened(found), None
    if level is not None:
        soft = (f"as exact at {found['modulus']:.0e} Pa: {level.name}".replace("e+0", "e"), level.seconds)
    names = {"automatic": "DEM, automatic step", "largest": "DEM, largest allowed step", "DEM": "DEM, automatic step"}
    for study, quantity, same in (("stiffness", "Young's modulus, Pa", soft), ("counts", "spheres", None)):
        if found[study]:
            cost_against([*_cost_lines(found[study], names)], quantity, folder / f"{study}.png", same)


def _cost_lines(study: dict[str, list[dict[str, Any]]], names: dict[str, str]) -> Iterator[CostLine]:
    for label, points in study.items():
        kind, done = "dem" if label in names else "surrogate", [point for point in points if kept.succeeded(point)]
        places, costs = [point["at"] for point in done], [point["wall"]["median"] for point in done]
        failed = [point["at"] for point in points if not kept.succeeded(point)]
        yield CostLine(names.get(label, label), kind, places, costs, failed)


def benchmark_cost(contest: Contest, folder: Path) -> Cost:
    """What is left to measure in a folder, and what it will take."""
    config, scene, data = contest.config, contest.scene, contest.config.dataset
    cost = flow_cost(scene, config.dem) + data_cost(scene, config.dem, contest.cases, data.root, data.workers)
    conditions, profile, paces = measured_under(config.seed), config.profile, {}
    studies = [
        m for found in (contest.stiffness_methods, contest.count_methods) for line in found.values() for _, m in line
    ]
    turns = [(m, profile.rounds) for m in contest.methods] + [(m, profile.study_rounds) for m in studies]
    turns = [
        (m, sum(not round_file(folder / m.key(*conditions), k).exists() for k in range(n))) for m, n in turns if m.job
    ]
    for method, _ in turns:
        job, kind = method.job, pace_kind(method)
        if kind not in paces:
            paces[kind] = 0.0
            if method.kind == "dem":
                paces[kind] = dem_pace(scene, DemConfig(**job["dem"] | {"time_step": None}))
            elif method.kind == "surrogate":
                paces[kind] = rollout_pace(load_model(job["model"])[0], scene) / scene.filling.count
    seconds = sum(n * paces[pace_kind(m)] * _work(m) for m, n in turns)
    judged = sum(min(n, judged_rounds(m, profile.judged_rounds)) for m, n in turns if m.judged)
    summing = summary_pace(scene) * scene.frame_count * (judged + data.replicas)
    preparing = PREPARING * sum(n > 0 for _, n in turns) / PREPARED_AT_A_TIME
    runs = sum(n for _, n in turns)
    line = f"benchmark: {len(turns)} methods and points of studies, {runs} timed runs to make, one after the other"
    return cost + Cost(
        [line], {"preparing": preparing, "timed runs": seconds, "judging": summing}, PROCESS_BYTES["torch"]
    )


def pace_kind(method: Method) -> tuple[str, ...]:
    """Methods of one kind take as long for a sphere and a step, or a frame of a model."""
    if method.kind == "dem":
        return method.kind, method.job["dem"]["engine"], method.job["dem"]["precision"]
    return method.kind, method.job.get("model", "")


def _work(method: Method) -> float:
    """Steps of all spheres in a run, or frames of all spheres."""
    if method.kind == "baseline":
        return 0.0
    scene = from_document(method.job["scene"])
    step = scene.frame_interval if method.kind == "surrogate" else method.job["dem"]["time_step"]
    return method.seconds / (step or choose_time_step(scene)[0]) * scene.filling.count


def measured_under(seed: int) -> list[str]:
    """Whatever else than its job decides what is measured of a method: a change of any measures anew."""
    return [comparing_code(), library_versions(), hardware(), f"format {kept.FORMAT}", f"seed {seed}"]


def _compare(contest: Contest, folder: Path, reference: Reference) -> dict[str, Any]:
    config, scene, methods = contest.config, contest.scene, contest.methods
    profile, conditions = config.profile, measured_under(config.seed)
    runs: dict[str, list[Scored]] = {}

    def turns(what: list[Method], rounds: int, label: str, **judging: Any) -> dict[str, Record]:
        _tell(f"{label}: {len([m for m in what if not m.unfit_because])} methods in {rounds} rounds")
        place = folder / MEASUREMENTS
        return take_turns(what, rounds, config.seed, place, conditions, scene.frame_interval, label=label, **judging)

    def wants_frames(method: Method, place: Path, index: int) -> bool:
        known = errors_file(place, reference.digest, index).exists()
        return index < judged_rounds(method, profile.judged_rounds) and not known

    def judge_round(index: int, folders: dict[str, Path]) -> None:
        for method in methods:
            if method.name in folders and index < judged_rounds(method, profile.judged_rounds):
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


def _tell(line: str) -> None:
    """One line of progress, on stderr, so that stdout holds the table alone."""
    print(line, file=sys.stderr, flush=True)
