"""The benchmark, stage by stage: data → turns → judgement → studies → results, figures, page."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from gran_bench.benchmark.contest import Contest
from gran_bench.benchmark.errors import Reference, Scored, errors_file, judged_rounds, score_run
from gran_bench.benchmark.method import Method
from gran_bench.benchmark.page import TABLE, write_page, write_table
from gran_bench.benchmark.results import (
    FORMAT,
    RESULTS,
    entries,
    judged_anew,
    method_row,
    read_results,
    reference_facts,
    share_waited,
    study_rows,
    succeeded,
    untimed,
    write_results,
)
from gran_bench.benchmark.sentences import busy_sentences, softened, verdicts, winner
from gran_bench.benchmark.turns import Record, take_turns
from gran_bench.config import BenchmarkConfig
from gran_bench.config.reading import validate
from gran_bench.config.rules import ConfigError
from gran_bench.dataset import ensure_cases, read_case, rotation_label
from gran_bench.files import locked
from gran_bench.plots.time_error import Contender, CostLine, cost_against, time_against_error
from gran_bench.processes import stop_on_signals
from gran_bench.provenance import hardware, library_versions, provenance
from gran_bench.provenance.source_digest import comparing_code
from gran_bench.shipped import DEFAULT_MODEL, SHIPPED, shipped_model


def run_benchmark(config: BenchmarkConfig) -> dict[str, Any]:
    """Compare every method on the scene of a config, or do what is left of it.

    With ``measure=false`` nothing is measured: kept results are told anew, with the DEM's own accuracy by today's rule.

    Args:
        config: checked.

    Returns:
        The results, as in ``benchmark.json``.

    Raises:
        KeyboardInterrupt: SIGTERM or Ctrl-C; what was measured stays.
        ConfigError, CheckpointError, DatasetError: a value that cannot be, a model file that is none, or runs of the
            DEM that failed.
        ResultsError: nothing measured yet, or with other replicas, and ``measure=false``.
    """
    validate(config)
    contest = Contest(config, model_files(config.models))
    scene, profile = contest.scene, config.profile
    folder = Path(config.root) / profile.name / scene.name
    with stop_on_signals(), locked(folder / ".lock", lambda: _tell(f"another process works on {folder}; waiting")):
        _tell(f"scene {scene.name}: {scene.filling.count} spheres; {scene.needs}")
        _tell("DEM runs that the methods start from and are held against")
        ensure_cases(contest.cases if config.measure else contest.replicas, config.dataset.root, config.dataset.workers)
        reference = _reference(contest)
        found = _compare(contest, folder, reference) if config.measure else _kept(contest, folder, reference)
        write_results(folder, found)
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
    lines += ["", winner(found).replace("**", ""), *(line.replace("**", "") for line in verdicts(found))]
    return "\n".join([*lines, *busy_sentences(found)])


def draw(found: dict[str, Any], folder: Path) -> None:
    """The figures of one benchmark, from its results."""
    rows = {row["name"]: row for row in found["methods"]}
    contenders = [
        Contender(
            short_name(entry.name),
            entry.kind,
            entry.seconds,
            entry.floors,
            *((rows[entry.name]["floors_low"], rows[entry.name]["floors_high"]) if entry.floors is not None else ()),
            fast=entry.low,
            slow=entry.high,
        )
        for entry in entries(found)
    ]
    labels = " and ".join(row["label"] for row in found["reference"]["ranked"])
    lost = [short_name(name) for name in untimed(found)]
    time_against_error(contenders, labels, folder / "time_error.png", found["reference"]["accepted"], lost)
    level = softened(found)
    if found["stiffness"]:
        names = {"automatic": "DEM, automatic step", "largest": "DEM, largest allowed step"}
        lines = _cost_lines(found["stiffness"], names)
        soft = None
        if level is not None:
            soft = (f"as exact at {found['modulus']:.0e} Pa: {level.name}".replace("e+0", "e"), level.seconds)
        cost_against(lines, "Young's modulus, Pa", folder / "stiffness.png", soft)
    if found["counts"]:
        lines = _cost_lines(found["counts"], {"DEM": "DEM, automatic step"})
        cost_against(lines, "spheres", folder / "counts.png")


def short_name(name: str) -> str:
    """A method's name beside its mark in a figure, whose colour says already that it is a DEM."""
    return name.removeprefix("DEM ")


def measured_under(seed: int) -> list[str]:
    """Whatever else than its job decides what is measured of a method: a change of any measures anew.

    Args:
        seed: of the nudges that rounds start from, and of their order.
    """
    return [comparing_code(), library_versions(), hardware(), f"format {FORMAT}", f"seed {seed}"]


def _compare(contest: Contest, folder: Path, reference: Reference) -> dict[str, Any]:
    config, scene, methods = contest.config, contest.scene, contest.methods
    profile, conditions = config.profile, measured_under(config.seed)

    def turns(what: list[Method], rounds: int, label: str, judged: bool) -> dict[str, Record]:
        _tell(f"{label}: {len([m for m in what if not m.unfit_because])} methods in {rounds} rounds")
        return take_turns(
            what,
            rounds,
            config.seed,
            folder / "measurements",
            conditions,
            scene.frame_interval,
            wants_frames if judged else lambda method, place, index: False,
            judge_round if judged else lambda index, folders: None,
            label=label,
        )

    def wants_frames(method: Method, place: Path, index: int) -> bool:
        kept = errors_file(place, reference.digest, index).exists()
        return index < judged_rounds(method, profile.judged_rounds) and not kept

    runs: dict[str, list[Scored]] = {}

    def judge_round(index: int, folders: dict[str, Path]) -> None:
        for method in methods:
            if method.name in folders and index < judged_rounds(method, profile.judged_rounds):
                scored = score_run(method, folders[method.name], reference, index)
                runs.setdefault(method.name, []).extend([scored] if scored else [])

    records = turns(methods, profile.rounds, "timing and judging", True)
    scores = {name: reference.pooled(found) for name, found in runs.items() if found and not records[name].failure}
    studies = {}
    for label, points in (("stiffness", contest.stiffness_methods), ("counts", contest.count_methods)):
        flat = [method for line in points.values() for _, method in line]
        studies[label] = study_rows(points, turns(flat, profile.study_rounds, label, False)) if flat else {}
    automatic = next(method for method in methods if method.name == contest.automatic)
    own = scores[automatic.name].floors if automatic.name in scores else None
    beside = {turn.round: turn.wall_seconds / automatic.seconds for turn in records[automatic.name].turns}
    rows = [method_row(m, records.get(m.name), scores.get(m.name), beside) for m in methods]
    return {
        "format": FORMAT,
        "scene": scene.name,
        "profile": profile.name,
        "spheres": scene.filling.count,
        "simulated_seconds": scene.end_time - scene.start_time,
        "motion": rotation_label(scene),
        "modulus": scene.material.youngs_modulus,
        "rounds": profile.rounds,
        "automatic": contest.automatic,
        "reference": reference_facts(reference, config.dataset.replicas, profile.judged_rounds, own),
        "methods": rows,
        "waited": share_waited(rows),
        **studies,
        "provenance": provenance(),
    }


def _kept(contest: Contest, folder: Path, reference: Reference) -> dict[str, Any]:
    config, kept = contest.config, read_results(folder / RESULTS)
    return judged_anew(kept, reference, config.dataset.replicas)


def _reference(contest: Contest) -> Reference:
    root = contest.config.dataset.root
    _tell("summarising the replicas")
    return Reference(contest.scene, [read_case(spec.path(root)) for spec in contest.replicas])


def _cost_lines(study: dict[str, list[dict[str, Any]]], names: dict[str, str]) -> list[CostLine]:
    lines = []
    for label, points in study.items():
        done = [point for point in points if succeeded(point)]
        lines.append(
            CostLine(
                names.get(label, label),
                "dem" if label in names else "surrogate",
                [point["at"] for point in done],
                [point["wall"]["median"] for point in done],
                [point["at"] for point in points if not succeeded(point)],
            )
        )
    return lines


def _tell(line: str) -> None:
    """One line of progress, on stderr, so that stdout holds the table alone."""
    print(line, file=sys.stderr, flush=True)
