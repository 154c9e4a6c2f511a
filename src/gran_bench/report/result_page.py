"""A finished run as a committed page: ``python -m gran_bench.report.result_page results/runs/NAME results/NAME``."""

import argparse
import json
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from gran_bench.evaluation.plan import motion_words, packing_words
from gran_bench.files import markdown, whole_file, write_part
from gran_bench.metrics.judgement import shown_multiple
from gran_bench.provenance import stamp
from gran_bench.run.summary import SUMMARY, compared_errors, missed_requirements, ranked_errors, read_summary
from gran_bench.surrogate.checkpoint import file_digest

MODEL, PAGE = "model.pt", "README.md"
LARGEST_MODEL = 1_000_000  # bytes; a larger one is not kept with the page
ERRORS = {
    **{"surface_angle": "angle of repose", "com_angle": "centre-of-mass angle", "speed_w1": "speeds"},
    **{"center_height": "height", "discharge_rate": "discharge rate", "packing_fraction": "packing fraction"},
}
FIGURES = {
    "flow_pattern.png": "Flow pattern at 2.5 s, DEM beside surrogate, coloured by speed (the article's figure 2).",
    "angle_of_repose.png": "Angle of repose against time over the band of the DEM's replicas (figure 3a).",
    "purpose.png": "What the scene is for, against time over the band of the DEM's replicas.",
    "speed_distribution.png": "Distribution of speeds at 2.5 s (figure 3b).",
    "flow.gif": "Both flows, moving.",
}


class ResultPageError(ValueError):
    """A folder that is not a finished run."""


def write_page(run: Path, target: Path, title: str) -> Path:
    """Copy a finished run's summary, figures and small model to a folder, and renew the table of its README.

    What people wrote there stays; a new page has ``title``, or the experiment's name. `ResultPageError` of no such run.
    """
    if read_summary(run) is None:
        raise ResultPageError(f"{run} has no {SUMMARY}: the run is not finished; run its command again")
    small = [run / MODEL] if (run / MODEL).exists() and (run / MODEL).stat().st_size <= LARGEST_MODEL else []
    for source in [run / SUMMARY, *small, *sorted((run / "figures").glob("*.[pg][ni][gf]"))]:
        with whole_file(target / source.relative_to(run)) as temporary:
            shutil.copyfile(source, temporary)
    return renew_page(target, title)


def renew_page(folder: Path, title: str = "") -> Path:
    """Renew the table of a folder's README from its ``summary.json``; a new page has ``title`` or the experiment's."""
    summary = read_summary(folder)
    text = "\n".join(_lines(summary, folder))
    write_part(folder / PAGE, "judgement", text, title or summary["experiment"])
    return folder / PAGE


def _lines(summary: dict[str, Any], folder: Path) -> Iterator[str]:
    training, packings, rpm = summary["training"], summary["judged"], summary["judged_rpm"]
    ranked, shared = ranked_errors(packings["shared"]), compared_errors(summary)
    yield (
        f"`{summary['model']['name']}`, {training['parameters']:,} parameters, {training['steps']} updates in "
        f"{training['seconds'] / 60:.0f} min; judged at {motion_words(rpm)}, {summary['judged_as']}."
    )
    yield ""
    rows = [["", *(packing_words(name, rpm) for name in packings)]]
    for kind, shown, what in (
        ("requirements", lambda row: f"{_value(row)}, {row['verdict']}", ""),
        ("errors", _error, " (noise floors)"),
    ):
        for key in next(iter(packings.values()))[kind]:
            if kind == "requirements" or key in ranked:
                labels = dict.fromkeys(one[kind][key]["label"] for one in packings.values())  # a bound has its packing
                rows.append([f"{'; '.join(labels)}{what}", *(shown(one[kind][key]) for one in packings.values())])
    counts = [judged["failures"] for judged in packings.values()]
    failures = (
        "" if count is None else f"{count['non_finite_states']}; {count['outside_spheres']}" for count in counts
    )
    yield from markdown([*rows, ["states not finite; spheres outside by more than r", *failures]])
    yield ""
    baselines = ([name, *(_error(errors[key]) for key in shared)] for name, errors in summary["baselines"].items())
    heads = [ERRORS[key] for key in shared]
    yield from markdown([[f"baseline, {packing_words('shared', rpm)}", *heads], *baselines])
    yield ""
    if missed := missed_requirements(summary):
        further = [line for line in missed if not line.endswith("packing)")]  # the others are in the table
        yield f"**{len(missed)} requirements are not met**{': ' * bool(further)}{'; '.join(further)}."
        yield ""
    # Time and numbers of figures are of the article's drum.
    foreign = r" at 2\.5 s| \(.*?\)" if rpm is None else "$^"
    for name, caption in ((name, re.sub(foreign, "", words)) for name, words in FIGURES.items()):
        if (folder / "figures" / name).exists():
            yield f"![{caption}](figures/{name})"
            yield ""
    kept = (folder / MODEL).exists()
    model = f" Model: [`{MODEL}`]({MODEL}), SHA-256 `{file_digest(folder / MODEL)}`." if kept else ""
    yield f"All figures: [`{SUMMARY}`]({SUMMARY}), [`figures/`](figures).{model}"
    yield ""
    yield f"- Training: {stamp(training)}, data `{training['data_digest']}`"
    yield f"- Judgement: {stamp(summary['provenance'])}, data `{summary['data_digest']}`"


def _error(row: dict[str, Any]) -> str:
    multiple = row["multiple_of_floor"]
    return _value(row) if multiple is None else f"{_value(row)} ({shown_multiple(multiple)})"


def _value(row: dict[str, Any]) -> str:
    return "undefined" if row["value"] is None else f"{row['value']:.3g} {row['unit']}".replace(" deg", "°")


def main() -> None:
    """Read the command line and write the page."""
    parser = argparse.ArgumentParser(prog="python -m gran_bench.report.result_page", description=write_page.__doc__)
    parser.add_argument("run", type=Path, help="folder of a finished run")
    parser.add_argument("target", type=Path, help="folder of the page")
    parser.add_argument("--title", default="", help="of the page; the experiment's name where it is not given")
    arguments = parser.parse_args()
    try:
        print(write_page(arguments.run, arguments.target, arguments.title))
    except (ResultPageError, OSError, json.JSONDecodeError) as error:
        parser.exit(2, f"error: {error}\n")


if __name__ == "__main__":
    main()
