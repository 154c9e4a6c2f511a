"""The data card's figures and tables: what each case is, and how far apart equally right answers are."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Normalize

from gran_bench.config import GenerateConfig
from gran_bench.dataset import CaseSpec, ensure_cases, half_step, read_case, replicas, rotation_label, split_cases
from gran_bench.metrics.angle_of_repose import com_angle, surface_angle
from gran_bench.metrics.comparisons import COMPARISONS, FIGURES, Comparison
from gran_bench.metrics.measured import Measured, frame_at, mean_of, noise_floor, score
from gran_bench.metrics.phases import PATTERN_AT, find_phases
from gran_bench.metrics.summary import TrajectorySummary, summarise
from gran_bench.plots.flow import default_title, draw_pattern, fastest, finish_patterns, pattern_view
from gran_bench.plots.style import BASELINE, DEM, QUIET, SURROGATE, drawing, say
from gran_bench.progress import Progress
from gran_bench.scene import Scene, build_scene
from gran_bench.state import FloatArray, Trajectory

CASE_COLUMNS = (
    *("surface_angle_steady", "surface_angle_peak", "com_angle_steady", "com_angle_peak"),
    *("mean_speed_steady", "overlap_max", "wall_overlap_max"),
)
FLOOR_ROWS = (
    *("surface_angle", "surface_angle_steady", "surface_angle_peak", "com_angle"),
    *("speed_w1", "speed_w1_pattern", "speed_w1_steady"),
)
SHARES = ((5, 95, "#dbe7f1", "5–95 %"), (25, 75, "#a9c8e0", "25–75 %"))  # of the spheres, per cent
SHOWN_AS = {"m": ("mm", 1e3), "deg": ("°", 1.0)}  # unit of a figure: for people, times


def draw_missing_cards(paths: Sequence[Path], progress: bool = True) -> list[Path]:
    """Draw each case that has no figure yet, to ``figures/`` beside its file; the figure of each.

    A case never changes under its name, so neither does its figure.
    """
    figures = [path.parent / "figures" / f"{path.stem}.png" for path in paths]
    missing = [(path, figure) for path, figure in zip(paths, figures, strict=True) if not figure.exists()]
    for path, figure in Progress(missing, desc="figures", unit="figure", show=progress and bool(missing), leave=False):
        case = read_case(path)
        packing = case.attributes.get("packing_seed")
        words = default_title(case.scene) + ("" if packing is None else f", packing {packing}")
        case_card(case.trajectory, case.scene, figure, words)
    return figures


def print_data_card(config: GenerateConfig) -> None:
    """Make whatever the card needs and print its two tables in Markdown: the cases, and the noise floor."""
    root, workers = config.dataset.root, config.dataset.workers
    split = split_cases(build_scene(config.scene), config.dem, config.dataset)
    judged = split.holdout[0] if split.holdout else split.training[0]
    nudged = replicas(judged, max(config.dataset.replicas, 2))
    halved = half_step(judged)
    packings = [replace(judged, packing_seed=config.dataset.unseen_packing_seed + k) for k in range(2)]
    ensure_cases([*split.all, *nudged, halved, *packings], root, workers)

    def summary_of(spec: CaseSpec) -> TrajectorySummary:
        case = read_case(spec.path(root))
        return summarise(case.trajectory, case.scene)

    cases = {rotation_label(spec.scene): summary_of(spec) for spec in split.all}
    print("\n".join(_case_table(cases)), end="\n\n")
    runs = [summary_of(spec) for spec in (*nudged, halved, *packings)]
    phases = find_phases([run.series for run in runs[: len(nudged)]], judged.scene)
    *truth, fine, one, other = (replace(run, phases=phases) for run in runs)
    print("\n".join(_floor_table(truth, fine, [one, other])))


def _case_table(cases: dict[str, TrajectorySummary]) -> Iterator[str]:
    """A case a row."""
    figures = [figure for key in CASE_COLUMNS for figure in FIGURES if figure.key == key]
    yield _row("case", *map(_label, figures))
    yield _row(*["---"] * (1 + len(figures)))
    for label, summary in cases.items():
        yield _row(label, *(_shown(figure.figure(summary)) for figure in figures))


def _floor_table(
    truth: Sequence[TrajectorySummary], fine: TrajectorySummary, others: Sequence[TrajectorySummary]
) -> Iterator[str]:
    """Distances between replicas, and mean distances to them of half the time step and of other packings."""
    yield _row("", "between replicas", "half the time step", "other packings")
    yield _row(*["---"] * 4)
    for row in (row for key in FLOOR_ROWS for row in COMPARISONS if row.key == key):
        halved, *away = (score(row.distance, run, truth, row.unit) for run in (fine, *others))
        cells = (noise_floor(row.distance, truth, row.unit), halved, mean_of(away, row.unit))
        yield _row(_label(row), *map(_shown, cells))


def _row(*cells: str) -> str:
    return f"| {' | '.join(cells)} |"


def _label(row: Comparison) -> str:
    return f"{row.label}, {SHOWN_AS.get(row.unit, (row.unit, 1.0))[0]}"


def _shown(figure: Measured) -> str:
    return f"{figure.value * SHOWN_AS.get(figure.unit, ('', 1.0))[1]:.3g}" if figure.defined else "undefined"


def case_card(trajectory: Trajectory, scene: Scene, path: Path | str, title: str = "") -> Path:
    """Draw a case of the DEM: three flow patterns of one scale above, speeds and a drum's angle against time below."""
    speed = np.linalg.norm(trajectory.velocity, axis=2)
    norm, instants = Normalize(0.0, fastest([speed])), _instants(scene)
    frames = [frame_at(trajectory.time, time) for time in instants]
    view = pattern_view(trajectory.position[[frame for frame in frames if frame is not None]], scene)
    with drawing(path, 10.0, 7.0) as figure:
        upper, lower = figure.subfigures(2, 1, height_ratios=(1.25, 1.0))
        figure.suptitle(title or default_title(scene))
        panels = upper.subplots(1, len(instants), sharey=True, squeeze=False)[0]
        for axes, time, frame in zip(panels, instants, frames, strict=True):
            axes.set_title(f"{time:g} s")
            if frame is None:
                say(axes, f"no state at {time:g} s")
                continue
            draw_pattern(axes, trajectory.position[frame], speed[frame], trajectory.radius, scene, norm, view)
        finish_patterns(upper, panels, norm, "speed, m/s", shrink=0.8)
        *left, right = lower.subplots(1, 1 if scene.drum_radius is None else 2, squeeze=False)[0]
        for axes in left:
            _draw_angles(axes, trajectory, scene)
        _draw_speeds(right, trajectory.time, speed)
    return Path(path)


def _instants(scene: Scene) -> list[float]:
    """Of the drum: a state of the first avalanche, that of the article's figure, and the last."""
    span = scene.end_time - scene.start_time
    steps = [round(share * span / scene.frame_interval) for share in (1 / 12, PATTERN_AT, 1.0)]
    return [scene.start_time + step * scene.frame_interval for step in steps]


def _draw_angles(axes: Axes, trajectory: Trajectory, scene: Scene) -> None:
    axes.set(title="Angle of repose", xlabel="time, s", ylabel="angle, °")
    axes.set_xlim(trajectory.time[0], trajectory.time[-1])
    for measure, label, colour in ((surface_angle, "surface", SURROGATE), (com_angle, "centre of mass", BASELINE)):
        series = measure(trajectory, scene)
        if series.undefined_because:
            say(axes, f"undefined:\n{series.undefined_because}")
            return
        axes.plot(series.time, np.where(series.valid, series.value, np.nan), color=colour, label=label)
    axes.legend(loc="upper right")


def _draw_speeds(axes: Axes, time: FloatArray, speed: FloatArray) -> None:
    axes.set_title("Speeds of the spheres")
    if not speed.shape[1]:
        say(axes, "no spheres")
        return
    finite = np.where(np.isfinite(speed).all(axis=1)[:, None], speed, np.nan)
    for low, high, colour, label in SHARES:
        band = np.percentile(finite, (low, high), axis=1)
        axes.fill_between(time, *band, color=colour, linewidth=0, label=f"{label} of the spheres")
    axes.plot(time, np.median(finite, axis=1), color=BASELINE, label="median")
    axes.plot(time, finite.mean(axis=1), color=DEM, linewidth=1.1, linestyle=(0, (5, 2)), label="mean")
    axes.set(xlabel="time, s", ylabel="speed, m/s", xlim=(time[0], time[-1]))
    axes.set_ylim(bottom=0.0)
    axes.tick_params(color=QUIET)
    axes.legend(loc="upper right", ncols=2)
