"""The figures of a data set's cases, kept beside the files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from tqdm import tqdm

from gran_bench.dataset import read_case
from gran_bench.plots.case_card import case_card


def draw_missing_cards(paths: Sequence[Path], progress: bool = True) -> list[Path]:
    """Draw each case that has no figure yet, to ``figures/`` beside its file.

    A case never changes under its name, so neither does its figure.

    Args:
        paths: files of cases.
        progress: show a bar; silent without a terminal.

    Returns:
        The figure of each case.

    Raises:
        DatasetError: a file is missing or damaged.
    """
    figures = [path.parent / "figures" / f"{path.stem}.png" for path in paths]
    missing = [(path, figure) for path, figure in zip(paths, figures, strict=True) if not figure.exists()]
    for path, figure in tqdm(missing, desc="figures", disable=None if progress and missing else True, leave=False):
        case = read_case(path)
        case_card(case.trajectory, case.scene, figure)
    return figures
