"""``python -m gran_bench.compare RUN RUN ...``: what differs, every headline figure with its floor, a picture."""

import argparse
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from gran_bench.compare.runs import UNKNOWN, ComparedRun, Figure, differences, figures_of, figures_table, read_run
from gran_bench.processes import run_command
from gran_bench.tracking.search import RunError, find_run

_SHORT = 24  # characters of a name that heads a column; with longer ones the columns are numbered


def compare_command(words: Sequence[str] | None = None) -> int:
    """Print what differs between the runs of a command line and what the judge found, and draw it; the exit code."""
    parser = argparse.ArgumentParser("python -m gran_bench.compare", description="Set finished runs side by side.")
    parser.add_argument("runs", nargs="*", metavar="RUN", help="name, id in MLflow, the beginning of one, or folder")
    parser.add_argument("--speed", type=float, metavar="RPM", help="at which to compare (default: the judged one)")
    parser.add_argument("--out", type=Path, metavar="FILE", help="picture (default: a PNG in comparisons/ of the root)")
    parser.add_argument("--root", type=Path, default=Path("results"), help="results folder (default: results)")
    return run_command(parser, _compare, words)


def _compare(chosen: argparse.Namespace) -> None:
    if chosen.out is not None and chosen.out.suffix.lower() != ".png":
        raise RunError(f"--out {chosen.out}: the picture is a PNG; give a name that ends with .png")
    runs = _named(chosen.runs, chosen.root)
    judged = {name: run.summary["judged_rpm"] for name, run in runs.items()}
    rolled = {row["own_rpm"] for run in runs.values() for row in run.summary["nearest_case"].values()}
    if chosen.speed not in (None, *rolled, *judged.values()):
        there = " or ".join(f"{rpm:g}" for rpm in sorted(rolled))
        raise RunError(f"--speed {chosen.speed:g}: none of these runs was rolled out at it; choose {there}")
    rpms = judged if chosen.speed is None else dict.fromkeys(runs, chosen.speed)
    figures = {name: dict(figures_of(run, rpms[name])) for name, run in runs.items()}
    scenes = {name: run.scene_at(rpms[name]) for name, run in runs.items()}
    places = dict.fromkeys(scenes.values())
    print("\n".join(_report(runs, len(places) > 1, figures)), flush=True)
    keys = "_".join(run.folder.resolve().name.rpartition("-")[2] for run in runs.values())
    path = chosen.out or chosen.root / "comparisons" / f"{keys[:200]}.png"
    legend = {name if len(places) == 1 else f"{name}: {scenes[name]}": rows for name, rows in figures.items()}
    from gran_bench.compare.figure import errors_in_floors  # matplotlib, which the table need not wait for

    drawn = errors_in_floors(legend, f"{' | '.join(places)}: distance from the DEM", path)
    print(f"picture: {path}" if drawn else "no picture: the judge has noise floors at the judged speed alone")


def _named(words: Sequence[str], root: Path) -> dict[str, ComparedRun]:
    """The finished runs that words name, by name, or by folder where another has that name."""
    if len(words) < 2:
        raise RunError(f"{len(words)} of at least two runs given; name a further one: compare RUN RUN ...")
    runs: dict[str, ComparedRun] = {}
    for word in words:
        run = read_run(find_run(word, root), root)
        if any(run.folder.samefile(other.folder) for other in runs.values()):
            raise RunError(f"{run.folder}: this run is named more than once; name each once")
        runs[str(run.folder) if run.name in runs else run.name] = run
    return runs


def _report(runs: Mapping[str, ComparedRun], apart: bool, figures: Mapping[str, Mapping[str, Figure]]) -> Iterator[str]:
    """Lines for the terminal: the runs, perhaps of scenes ``apart``, what differs, the figures, what is undefined."""
    short = max(map(len, runs)) <= _SHORT
    labels = {name: name if short else f"#{i}" for i, name in enumerate(runs, 1)}
    for name, run in runs.items():
        model, judged = run.summary["model"]["name"], run.scene_at(run.summary["judged_rpm"])
        number = "" if short else f"{labels[name]} "
        yield f"{number}{name}: {model}, judged on {judged}, {run.summary.get('judged_as', 'held out')}"
    if apart:
        yield "note: judged on different scenes or speeds, as far as recorded; each error has its own floor"
    elif len({run.summary.get("judged_by") for run in runs.values()}) > 1:
        yield "note: judged against other runs of the DEM, or by another judge; each error has its own floor"
    machines = {run.summary.get("provenance", {}).get("hardware", UNKNOWN) for run in runs.values()}
    if len(machines) > 1:
        yield f"note: times are of different machines: {' | '.join(sorted(machines))}"
    table = differences({labels[name]: run for name, run in runs.items()})
    yield f"\n{table.to_string()}" if len(table) else "\nno key of the config, no data and no code differ"
    if (table == UNKNOWN).to_numpy().any():
        yield f"({UNKNOWN}: the run's folder does not record it)"
    shown = {labels[name]: rows for name, rows in figures.items()}
    yield f"\n{figures_table(shown).to_string()}"
    for label, rows in shown.items():
        yield from (f"undefined: {name} of {label}: {one.note}" for name, one in rows.items() if one.note)
