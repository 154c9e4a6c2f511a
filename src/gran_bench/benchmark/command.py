"""The benchmark: data, methods in turns (shuffled anew, on an idle machine), judgement, studies, results, page."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from textwrap import shorten
from typing import Any

import numpy as np
from tqdm import tqdm

from gran_bench.benchmark import page
from gran_bench.benchmark import results as kept
from gran_bench.benchmark.contest import Contest, Method
from gran_bench.benchmark.errors import Reference, Scored, errors_file, judged_rounds, score_run, trajectory_file
from gran_bench.config import BenchmarkConfig
from gran_bench.config.reading import validate
from gran_bench.config.rules import ConfigError
from gran_bench.dataset import ensure_cases, read_case, rotation_label
from gran_bench.files import locked, markdown, write_text
from gran_bench.plots.time_error import CostLine, cost_against, time_against_error
from gran_bench.processes import stop_on_signals, tell
from gran_bench.provenance import hardware, library_versions, provenance
from gran_bench.provenance.source_digest import comparing_code
from gran_bench.shipped import DEFAULT_MODEL, SHIPPED, shipped_model
from gran_bench.workers import Worker, crew

PREPARED_AT_A_TIME = 2
PATIENCE = 3600.0  # s that a method may prepare itself, or take for one run: the slowest take minutes
FAILURE = "failure.json"
FIRST_NUDGE = 1001  # seed of the nudge of the first round of seed 0; the replicas have the lower ones
ROUNDS_OF_A_SEED = 1000


def nudge_seed(seed: int, index: int) -> int:
    """Seed of the nudge that a round of a benchmark starts from: no two rounds of two benchmarks have the same."""
    return FIRST_NUDGE + ROUNDS_OF_A_SEED * seed + index


def take_turns(
    methods: Sequence[Method], rounds: int, seed: int, folder: Path, conditions: Sequence[str], frame_interval: float,
    wants_frames: Callable[[Method, Path, int], bool] = lambda method, folder, index: False,
    after_round: Callable[[int, dict[str, Path]], None] = lambda index, folders: None,
    label: str = "timing",
) -> dict[str, kept.Record]:  # fmt: skip
    """Run every method that fits the scene once a round, and keep what was measured; records by the method's name.

    Args:
        seed: of the order in each round, and of the nudges that the rounds start from.
        folder: of all measurements; ``conditions`` are what else decides one (`Method.key`).
        frame_interval: s.
        wants_frames: whether the frames of a method's round, in its folder, are still to be judged.
        after_round: called with the round and the folders of all methods, to judge what was kept.
    """
    fit = [method for method in methods if not method.unfit_because]
    folders = {method.name: folder / method.key(*conditions) for method in fit}

    def keeps(method: Method, index: int) -> bool:
        place = folders[method.name]
        return wants_frames(method, place, index) and not trajectory_file(place, index).exists()

    def wants(method: Method, index: int) -> bool:
        place = folders[method.name]
        return not (place / FAILURE).exists() and (keeps(method, index) or not _path(place, index).exists())

    for failed in (place / FAILURE for place in folders.values()):
        # A run that diverged will diverge again; a process that died (of a lack of memory, say) gets another chance.
        if failed.exists() and json.loads(failed.read_text("utf-8"))["died"]:
            failed.unlink()
    orders = [np.random.default_rng([seed, index]).permutation(len(fit)) for index in range(rounds)]
    missing = [(fit[k], index) for index, order in enumerate(orders) for k in order if wants(fit[k], index)]
    workers = {method.name: Worker("gran_bench.benchmark.jobs") for method, _ in missing}
    bar = tqdm(total=len(missing), desc=label, unit="run", disable=None, leave=False)
    with bar, crew(list(workers.values()), PREPARED_AT_A_TIME) as threads:

        def prepare(method: Method) -> None:
            bar.set_postfix_str(f"preparing {method.name}", refresh=True)
            frames = round(method.seconds / frame_interval)
            request = {"job": method.job, "frames": frames, "nudge_seed": nudge_seed(seed, 0)}
            answer = workers[method.name].ask(request, PATIENCE)
            if "died" in answer:
                _note(method, answer, folders[method.name], 0, frame_interval)

        # All are compiled and warm before the first is timed; the first compiles what the others then load.
        needed = list({method.name: method for method, _ in missing}.values())
        for some in (needed[:1], needed[1:]):
            list(threads.map(prepare, some))
        for index in range(rounds):
            for method in [method for method, when in missing if when == index]:
                bar.set_postfix_str(method.name, refresh=True)
                bar.update()
                if wants(method, index):
                    place = folders[method.name]
                    keep = str(trajectory_file(place, index).resolve()) if keeps(method, index) else None
                    request = {"nudge_seed": nudge_seed(seed, index), "keep": keep}
                    _note(method, workers[method.name].ask(request, PATIENCE), place, index, frame_interval)
            after_round(index, folders)
    return {method.name: _read(folders[method.name], rounds) for method in fit}


def _note(method: Method, answer: dict[str, Any], folder: Path, index: int, frame_interval: float) -> None:
    """Write down what came of a run."""
    if "died" in answer or "failure" in answer:
        reached = answer.get("reached", 0) * frame_interval
        found = {"failure": answer.get("died") or answer["failure"], "died": "died" in answer}
        found["seconds"] = answer["wall_seconds"] / reached if reached else None
        write_text(folder / FAILURE, json.dumps(found) + "\n")
    else:
        turn = {"round": index, **answer, "method": method.name}
        write_text(_path(folder, index), json.dumps(turn, indent=1) + "\n")


def _path(folder: Path, index: int) -> Path:
    return folder / f"round{index}.json"


def _read(folder: Path, rounds: int) -> kept.Record:
    turns = [json.loads(_path(folder, k).read_text("utf-8")) for k in range(rounds) if _path(folder, k).exists()]
    failed = json.loads((folder / FAILURE).read_text("utf-8")) if (folder / FAILURE).exists() else {}
    return kept.Record(turns, failed.get("failure", ""), failed.get("seconds"))


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
    with stop_on_signals(), locked(folder / ".lock", lambda: tell(f"another process works on {folder}; waiting")):
        tell(f"scene {scene.name}: {scene.filling.count} spheres; {scene.needs}")
        tell("DEM runs that the methods start from and are held against")
        ensure_cases(contest.cases if config.measure else contest.replicas, data.root, data.workers)
        tell("summarising the replicas")
        reference = Reference(scene, [read_case(spec.path(data.root)) for spec in contest.replicas])
        if config.measure:
            found = _compare(contest, folder, reference)
        else:
            found = kept.judged_anew(kept.read_results(folder / kept.RESULTS), reference, data.replicas)
        write_text(folder / kept.RESULTS, json.dumps(found, indent=1, allow_nan=False) + "\n")
        draw(found, folder)
        write_text(folder / page.TABLE, page.table_of(found).to_csv(index=False))
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
        wall, error = row["wall"], "-" if row["floors"] is None else f"{row['floors']:.2f}"
        times = (f"{wall['median']:.3g}", f"{wall['low']:.3g} … {wall['high']:.3g}") if wall else ("", "")
        rows.append((row["name"], *times, row["unfit_because"] or shorten(row["failure"], 60) or error))
    said = [page.winner(found), *(f"{name}: {words}" for name, words, *_ in page.surrogate_rows(found))]
    return "\n".join([*markdown(rows, aligned=True), "", *said, *page.busy_sentences(found)])


def draw(found: dict[str, Any], folder: Path) -> None:
    """The figures of one benchmark, from its results."""
    # The colour of a mark says already that it is a DEM.
    contenders = [replace(entry, name=entry.name.removeprefix("DEM ")) for entry in kept.entries(found)]
    lost = [name.removeprefix("DEM ") for name in kept.untimed(found)]
    labels = " and ".join(row["label"] for row in found["reference"]["ranked"])
    time_against_error(contenders, labels, folder / "time_error.png", found["reference"]["accepted"], lost)
    level, soft = page.softened(found), None
    if level is not None:
        soft = (f"as exact at {found['modulus']:.0e} Pa: {level.name}".replace("e+0", "e"), level.seconds)
    for study, quantity, same in (("stiffness", "Young's modulus, Pa", soft), ("counts", "spheres", None)):
        if found[study]:
            cost_against([*_cost_lines(found[study])], quantity, folder / f"{study}.png", same)


def _cost_lines(study: dict[str, list[dict[str, Any]]]) -> Iterator[CostLine]:
    for label, points in study.items():
        kind, done = "dem" if label in page.DEMS else "surrogate", [point for point in points if kept.succeeded(point)]
        places, costs = [point["at"] for point in done], [point["wall"]["median"] for point in done]
        failed = [point["at"] for point in points if not kept.succeeded(point)]
        yield CostLine(page.DEMS.get(label, label), kind, places, costs, failed)


def measured_under(seed: int) -> list[str]:
    """Whatever else than its job decides what is measured of a method: a change of any measures anew."""
    return [comparing_code(), library_versions(), hardware(), f"format {kept.FORMAT}", f"seed {seed}"]


def _compare(contest: Contest, folder: Path, reference: Reference) -> dict[str, Any]:
    config, scene, methods = contest.config, contest.scene, contest.methods
    profile, conditions = config.profile, measured_under(config.seed)
    runs: dict[str, list[Scored]] = {}

    def turns(what: list[Method], rounds: int, label: str, **judging: Any) -> dict[str, kept.Record]:
        tell(f"{label}: {len([m for m in what if not m.unfit_because])} methods in {rounds} rounds")
        place = folder / "measurements"
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
