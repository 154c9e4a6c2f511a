"""``python -m gran_bench.compare RUN RUN ...``: what differs, every headline figure with its floor, a picture."""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from gran_bench.compare.runs import ComparedRun, CompareError, read_run
from gran_bench.compare.tables import UNKNOWN, Figure, differences, figures_of, figures_table
from gran_bench.config.rules import ConfigError
from gran_bench.run.finding import find_run
from gran_bench.tracking import TrackingError

_SHORT = 24  # characters of a name that heads a column; with longer ones the columns are numbered


def compare_command(arguments: Sequence[str] | None = None) -> int:
    """Print what differs between runs and what the judge found, and draw it.

    Args:
        arguments: of the command line.

    Returns:
        The exit code: 0; 1 where the picture cannot be written; 2 where the runs cannot be compared.
    """
    parser = argparse.ArgumentParser("python -m gran_bench.compare", description="Set finished runs side by side.")
    parser.add_argument("runs", nargs="*", metavar="RUN", help="name, id in MLflow, the beginning of one, or folder")
    parser.add_argument("--speed", type=float, metavar="RPM", help="at which to compare (default: the judged one)")
    parser.add_argument("--out", type=Path, metavar="FILE", help="picture (default: a PNG in comparisons/ of the root)")
    parser.add_argument("--root", type=Path, default=Path("results"), help="results folder (default: results)")
    chosen = parser.parse_args(arguments)
    try:
        if chosen.out is not None and chosen.out.suffix.lower() != ".png":
            raise CompareError(f"--out {chosen.out}: the picture is a PNG; give a name that ends with .png")
        runs = named_runs(chosen.runs, chosen.root)
        rpms = {name: run.summary["judged_rpm"] if chosen.speed is None else chosen.speed for name, run in runs.items()}
        rolled = [row["own_rpm"] for run in runs.values() for row in run.summary["nearest_case"].values()]
        if chosen.speed not in (None, *rolled, *(run.summary["judged_rpm"] for run in runs.values())):
            there = " or ".join(f"{rpm:g}" for rpm in sorted({*rolled}))
            raise CompareError(f"--speed {chosen.speed:g}: none of these runs was rolled out at it; choose {there}")
        figures = {name: figures_of(run, rpms[name]) for name, run in runs.items()}
    except (CompareError, ConfigError, TrackingError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print("\n".join(report(runs, rpms, figures)), flush=True)
    keys = "_".join(run.folder.resolve().name.rpartition("-")[2] for run in runs.values())
    path = chosen.out or chosen.root / "comparisons" / f"{keys[:200]}.png"
    scenes = {name: run.scene_at(rpms[name]) for name, run in runs.items()}
    places = dict.fromkeys(scenes.values())
    legend = {name if len(places) == 1 else f"{name}: {scenes[name]}": rows for name, rows in figures.items()}
    try:
        from gran_bench.compare.figure import errors_in_floors  # matplotlib, which the table need not wait for

        drawn = errors_in_floors(legend, f"{' | '.join(places)}: distance from the DEM", path)
    except OSError as error:
        print(f"error: {path} cannot be written ({error.strerror}); choose another --out", file=sys.stderr)
        return 1
    print(f"picture: {path}" if drawn else "no picture: the judge has noise floors at the judged speed alone")
    return 0


def named_runs(words: Sequence[str], root: Path) -> dict[str, ComparedRun]:
    """The finished runs that words name, by name, or by folder where two share a name.

    Raises:
        CompareError: fewer than two, one of them twice, or one that cannot be compared.
    """
    if len(words) < 2:
        raise CompareError(f"{len(words)} of at least two runs given; name a further one: compare RUN RUN ...")
    folders = [find_run(word, root) for word in words]
    folder, times = Counter(path.resolve() for path in folders).most_common(1)[0]
    if times > 1:
        raise CompareError(f"{folder}: this run is named {times} times; name each once")
    runs = [read_run(path, root) for path in folders]
    often = Counter(run.name for run in runs)
    return {run.name if often[run.name] == 1 else str(run.folder): run for run in runs}


def report(
    runs: Mapping[str, ComparedRun], rpms: Mapping[str, float], figures: Mapping[str, Mapping[str, Figure]]
) -> Iterator[str]:
    """The lines for the terminal: the runs, what differs, the figures, what is undefined and why."""
    short = max(map(len, runs)) <= _SHORT
    labels = {name: name if short else f"#{i}" for i, name in enumerate(runs, 1)}
    for name, run in runs.items():
        model, judged = run.summary["model"]["name"], run.scene_at(run.summary["judged_rpm"])
        number = "" if short else f"{labels[name]} "
        yield f"{number}{name}: {model}, judged on {judged}, {run.summary.get('judged_as', 'held out')}"
    if len({run.scene_at(rpms[name]) for name, run in runs.items()}) > 1:
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
