"""Models compared at equal training time: one table and one picture, made from the rows of a sweep over models."""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path

import pandas as pd

from gran_bench.files import markdown, write_part
from gran_bench.plots.time_error import Contender, time_against_error
from gran_bench.sweep.runs import FINISHED, SweepRun
from gran_bench.sweep.side_by_side import SideBySide, read_side_by_side
from gran_bench.sweep.table import NOT_CHOSEN, TIME, Standing, axes_of, judged_at, made_by, shown

SWEEP = "models"  # recipe whose sweeps have this page
PAGE, PICTURE = "README.md", "time_error.png"
NEAR = {"1_frames": "1 frame ahead", "10_frames": "10 frames ahead"}
OUTSIDE, LOST = "shared/failures/outside_spheres", "shared/failures/non_finite_states"
RANKED = ("surface_angle", "com_angle", "speed_w1")  # where nothing was measured side by side
WORDS = {"surface_angle": "angle of repose", "com_angle": "centre-of-mass angle", "speed_w1": "speeds"}


def compares_models(folder: Path) -> bool:
    """Whether the sweep of a folder is of the recipe ``models``, whatever was changed in it."""
    return folder.name.partition("+")[0] == SWEEP


def write_models(folder: Path, stands: Standing) -> list[Path]:
    """Renew ``README.md`` and ``time_error.png`` in the results' folder of a sweep's name; what people wrote stays."""
    target, beside = folder.parent.parent / folder.name, read_side_by_side(folder)
    text = "\n".join(_lines(stands, beside, f"../{folder.parent.name}/{folder.name}/runs.csv"))
    write_part(target / PAGE, SWEEP, text, "Models compared at equal training time")
    contenders = [_contender(*one, beside) for one in by_model(stands.counted).items()]
    if beside is not None:
        contenders.append(Contender("DEM", "dem", beside.dem_ms / 1e3, 1.0))
    time_against_error(
        [one for one in contenders if one.seconds > 0], "the worst error of a whole run", target / PICTURE,
        untimed=[one.name for one in contenders if not one.seconds > 0], clock="wall time of a frame, s",
    )  # fmt: skip
    return [target / PAGE, target / PICTURE]


def by_model(runs: Sequence[SweepRun]) -> dict[str, list[SweepRun]]:
    """The runs of each model, its seeds, by what the command line calls it."""
    axes, found = axes_of(runs), defaultdict(list)
    for run in runs:
        found[", ".join(run.choices.get(axis, NOT_CHOSEN) for axis in axes) or run.facts.get("model", "")].append(run)
    return dict(found)


def worst_floors(run: SweepRun, ranked: Sequence[str]) -> float | None:
    """The largest of the ranked errors of a run over all frames, in noise floors; None where one is undefined."""
    floors = [run.figures.get(f"shared/floors/{name}") for name in ranked]
    return None if not floors or None in floors else max(floors)


def worst_words(runs: Sequence[SweepRun], ranked: Sequence[str]) -> str:
    """Mean and spread of `worst_floors`; where it is undefined, in how many runs and what the worst is at least."""
    words = shown(pd.Series([worst_floors(run, ranked) for run in runs], dtype=float), 2)
    known = [[found for name in ranked if (found := run.figures.get(f"shared/floors/{name}"))] for run in runs]
    least = pd.Series([max(floors) for floors in known if floors], dtype=float)
    return f"{words}, at least {shown(least, 2)}" if words.startswith("undefined") and len(least) else words


def near_floors(run: SweepRun, horizon: str, beside: SideBySide | None) -> float | None:
    """The position error of a run some frames ahead, in errors of the DEM from the same states; None if undefined."""
    error, dem = run.figures.get(f"position_error/{horizon}"), beside and beside.dem_error.get(horizon)
    return None if error is None or not dem else error / dem


def frame_ms(runs: Sequence[SweepRun], beside: SideBySide | None) -> float | None:
    """The time of a frame of a model, ms: measured side by side, else the median of its runs' own; None of neither."""
    timed = [beside.ms[run.key] for run in runs if beside is not None and run.key in beside.ms]
    timed = timed or [run.figures[TIME] for run in runs if TIME in run.figures]
    return float(pd.Series(timed).median()) if timed else None


def failures(runs: Sequence[SweepRun]) -> str:
    """What failed in the runs of a model: runs without a result, rollouts not finite, runs with spheres outside."""
    done = [run for run in runs if run.status == FINISHED]
    outside = [run.figures[OUTSIDE] for run in done if run.figures.get(OUTSIDE)]
    counts = {
        "without a result": len(runs) - len(done),
        "not finite": sum(bool(run.figures.get(LOST)) or "broken_rollouts" in run.facts for run in done),
        f"with up to {max(outside, default=0):g} spheres outside": len(outside),
    }
    return ", ".join(f"{count} {words}" for words, count in counts.items() if count) or "0"


def _contender(name: str, runs: Sequence[SweepRun], beside: SideBySide | None) -> Contender:
    found = [worst_floors(run, beside.ranked if beside else RANKED) for run in runs]
    floors = [one for one in found if one is not None]
    lost = f", {len(found) - len(floors)} of {len(found)} undefined" if 0 < len(floors) < len(found) else ""
    mean = sum(floors) / len(floors) if floors else None
    return Contender(name + lost, "surrogate", (frame_ms(runs, beside) or 0.0) / 1e3, mean, each=tuple(floors))


def _lines(stands: Standing, beside: SideBySide | None, record: str) -> Iterator[str]:
    runs, ranked = stands.counted, beside.ranked if beside else RANKED
    finished = [run for run in runs if run.status == FINISHED]
    budgets, scenes = ({run.facts[name] for run in runs if name in run.facts} for name in ("budget", "scene"))
    yield (
        f"{len(finished)} runs finished, {len(runs) - len(finished)} failed, {len(stands.waiting)} wait; each trained "
        f"{', '.join(sorted(budgets))} of processor time in {', '.join(sorted(scenes))}; {judged_at(runs)}."
    )
    heads = ["model", "parameters", "a frame, ms", *(f"{words}, floors" for words in NEAR.values())]
    whole = f"{beside.frames} frames" if beside else "all frames"
    rows = [[*heads, f"{whole}, floors", "updates", "seeds", "failures"]]
    if beside is not None:
        rows.append(["*DEM*", "", f"{beside.dem_ms:.2f}", "1", "1", "1", "", "", ""])
    groups = {name: [run for run in its if run.status == FINISHED] for name, its in by_model(runs).items()}

    def order(name: str) -> tuple[bool, float]:  # by the mean; an undefined error makes a model the last
        floors = [worst_floors(run, ranked) for run in groups[name]]
        return (True, 0.0) if None in floors or not floors else (False, sum(floors) / len(floors))

    for name in sorted(groups, key=order):
        done, its = groups[name], by_model(runs)[name]
        near = (pd.Series([near_floors(run, horizon, beside) for run in done], dtype=float) for horizon in NEAR)
        size = max((run.training.get("parameters", 0) for run in done), default=0)
        updates = pd.Series([run.training.get("steps") for run in done], dtype=float)
        ms = frame_ms(done, beside)
        rows.append([f"`{name}`", str(size), "-" if ms is None else f"{ms:.2f}", *(shown(one, 2) for one in near),
                     worst_words(done, ranked), shown(updates, 0), str(len(its)), failures(its)])  # fmt: skip
    yield from ("", *markdown(rows), "")
    if beside is not None:
        dem = (error and 1e3 * error for error in map(beside.dem_error.get, NEAR))
        yield (
            f"- *Ahead*: mean position error from {beside.starts} stored states. One floor is the error of the DEM "
            "itself that starts from the same states, without its contact springs: "
            f"{', '.join('undefined' if error is None else f'{error:.3g} mm' for error in dem)}."
        )
    yield (
        f"- *{whole.capitalize()}*: the largest error of {', '.join(WORDS.get(name, name) for name in ranked)} over "
        "the whole run. One floor is the distance of two runs of the DEM after a tiny nudge."
    )
    yield "- *A frame*: wall time on one thread" + (", all models and the DEM in turns." if beside else ".")
    yield from (f"- failed: `{run.run}`: {run.reason}" for run in runs if run.status != FINISHED)
    yield from ("", f"![{PICTURE.partition('.')[0]}]({PICTURE})", "", f"Record: [`runs.csv`]({record}).", "")
    yield made_by(stands)
