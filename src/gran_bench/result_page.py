"""A finished run as a page that is committed: ``python -m gran_bench.result_page results/runs/NAME results/NAME``."""

from __future__ import annotations

import argparse
import json
import shutil
from pathlib import Path
from typing import Any

from gran_bench.atomic import whole_file, write_text
from gran_bench.run_summary import SUMMARY, read_summary, summary_table
from gran_bench.surrogate.checkpoint import file_digest

MODEL = "model.pt"
LARGEST_MODEL = 1_000_000  # bytes; a larger one is named by its hash and not kept with the page
CAPTIONS = {
    "flow_pattern": "Flow pattern at 2.5 s, DEM beside surrogate, spheres coloured by speed (the article's figure 2).",
    "angle_of_repose": "Angle of repose against time over the band of the DEM's replicas (figure 3a).",
    "speed_distribution": "Distribution of speeds at 2.5 s (figure 3b).",
    "position_error": "Position error against time; beyond the divergence horizon the DEM does not agree with itself.",
    "nearest_case": "Distance in speed (Wasserstein-1) of each rollout from each DEM case.",
    "loss": "Training loss.",
    "flow": "Both flows, moving.",
}


class ResultPageError(ValueError):
    """A folder that is not a finished run."""


def write_page(run: Path, target: Path, title: str, remark: str = "") -> Path:
    """Copy a finished run's summary, figures and small model to a folder, and describe them in its README.

    Args:
        run: folder of a finished run.
        target: folder of the page; files of the same names are replaced.
        title: of the page.
        remark: paragraphs of one's own, put before the table.

    Returns:
        The README.

    Raises:
        ResultPageError: the run is not finished.
    """
    summary = read_summary(run)
    if summary is None:
        raise ResultPageError(f"{run} has no {SUMMARY}: the run is not finished; run its command again")
    figures = sorted((run / "figures").glob("*.png")) + sorted((run / "figures").glob("*.gif"))
    for source in [run / SUMMARY, *figures]:
        _copy(source, target / source.relative_to(run))
    keeps_model = (run / MODEL).exists() and (run / MODEL).stat().st_size <= LARGEST_MODEL
    if keeps_model:
        _copy(run / MODEL, target / MODEL)
    text = "\n".join(_lines(summary, [figure.relative_to(run) for figure in figures], title, remark, keeps_model, run))
    write_text(target / "README.md", text + "\n")
    return target / "README.md"


def _lines(
    summary: dict[str, Any], figures: list[Path], title: str, remark: str, keeps_model: bool, run: Path
) -> list[str]:
    training, judged = summary["training"], summary["provenance"]
    lines = [f"# {title}", ""]
    if remark:
        lines += [remark.strip(), ""]
    lines += ["```", summary_table(summary), "```", ""]
    lines += [
        "| | training | judgement |",
        "|---|---|---|",
        *(
            f"| {name} | {_code(training.get(name))} | {_code(judged.get(name))} |"
            for name in ("command", "commit", "hardware", "versions")
        ),
        f"| data digest | `{training['data_digest']}` | `{summary['data_digest']}` |",
        "",
    ]
    if (run / MODEL).exists():
        where = f"[`{MODEL}`]({MODEL})" if keeps_model else "not kept here for its size"
        lines += [f"Model file: {where}, SHA-256 `{file_digest(run / MODEL)}`.", ""]
    lines += [f"Every figure of the table, and more, is in [`{SUMMARY}`]({SUMMARY}).", ""]
    for figure in sorted(figures, key=_place):
        lines += [f"![{_caption(figure)}]({figure.as_posix()})", "", f"*{_caption(figure)}*", ""]
    return lines


def _place(figure: Path) -> tuple[int, str]:
    names = list(CAPTIONS)
    stem = figure.stem.removesuffix("_unseen")
    return (names.index(stem) if stem in names else len(names), figure.stem)


def _caption(figure: Path) -> str:
    stem = figure.stem.removesuffix("_unseen")
    caption = CAPTIONS.get(stem, stem.replace("_", " ").capitalize() + ".")
    return f"{caption} From a packing that training never saw." if figure.stem.endswith("_unseen") else caption


def _code(value: object) -> str:
    return f"`{value}`" if value else ""


def _copy(source: Path, target: Path) -> None:
    with whole_file(target) as temporary:
        shutil.copyfile(source, temporary)


def main() -> None:
    """Read the command line and write the page."""
    parser = argparse.ArgumentParser(prog="python -m gran_bench.result_page", description=write_page.__doc__)
    parser.add_argument("run", type=Path, help="folder of a finished run")
    parser.add_argument("target", type=Path, help="folder of the page")
    parser.add_argument("--title", help="of the page; the experiment's name where it is not given")
    parser.add_argument("--remark", type=Path, help="a text file put before the table")
    arguments = parser.parse_args()
    try:
        summary = read_summary(arguments.run) or {}
        title = arguments.title or str(summary.get("experiment", ""))
        remark = arguments.remark.read_text("utf-8") if arguments.remark else ""
        print(write_page(arguments.run, arguments.target, title, remark))
    except (ResultPageError, OSError, json.JSONDecodeError) as error:
        parser.exit(2, f"error: {error}\n")


if __name__ == "__main__":
    main()
