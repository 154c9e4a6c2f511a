"""The data card's figures and tables: what each case is, and how far apart equally right answers are."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from tqdm import tqdm

from gran_bench.config import GenerateConfig
from gran_bench.dataset import CaseSpec, ensure_cases, half_step, read_case, replicas, rotation_label, split_cases
from gran_bench.metrics.comparisons import COMPARISONS, FIGURES
from gran_bench.metrics.measured import Measured, mean_of
from gran_bench.metrics.noise_floor import noise_floor, score
from gran_bench.metrics.summary import TrajectorySummary, summarise
from gran_bench.plots.case_card import case_card
from gran_bench.scene import build_scene

CASE_COLUMNS = (
    *("surface_angle_steady", "surface_angle_peak", "com_angle_steady", "com_angle_peak"),
    *("mean_speed_steady", "overlap_max", "wall_overlap_max"),
)
FLOOR_ROWS = (
    *("surface_angle", "surface_angle_steady", "surface_angle_peak", "com_angle"),
    *("speed_w1", "speed_w1_pattern", "speed_w1_steady"),
)
SHOWN_AS = {"m": ("mm", 1e3), "deg": ("°", 1.0)}  # unit of a figure: for people, times


def draw_missing_cards(paths: Sequence[Path], progress: bool = True) -> list[Path]:
    """Draw each case that has no figure yet, to ``figures/`` beside its file; the figure of each.

    A case never changes under its name, so neither does its figure.

    Raises:
        DatasetError: a file is missing or damaged.
    """
    figures = [path.parent / "figures" / f"{path.stem}.png" for path in paths]
    missing = [(path, figure) for path, figure in zip(paths, figures, strict=True) if not figure.exists()]
    for path, figure in tqdm(missing, desc="figures", disable=None if progress and missing else True, leave=False):
        case = read_case(path)
        case_card(case.trajectory, case.scene, figure)
    return figures


def print_data_card(config: GenerateConfig) -> None:
    """Make whatever the card needs and print its two tables in Markdown: the cases, and the noise floor.

    Raises:
        DatasetError: a case cannot be made, or a file is damaged.
    """
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
    truth, others = [summary_of(spec) for spec in nudged], [summary_of(spec) for spec in packings]
    print("\n".join(_floor_table(truth, summary_of(halved), others)))


def _case_table(cases: dict[str, TrajectorySummary]) -> Iterator[str]:
    """A case a row."""
    figures = [figure for key in CASE_COLUMNS for figure in FIGURES if figure.key == key]
    yield _row("case", *(f"{figure.label}, {_unit(figure.unit)}" for figure in figures))
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
        yield _row(f"{row.label}, {_unit(row.unit)}", *map(_shown, cells))


def _row(*cells: str) -> str:
    return f"| {' | '.join(cells)} |"


def _unit(unit: str) -> str:
    return SHOWN_AS.get(unit, (unit, 1.0))[0]


def _shown(figure: Measured) -> str:
    if figure.value is None:
        return "undefined"
    return f"{figure.value * SHOWN_AS.get(figure.unit, ('', 1.0))[1]:.3g}"
