"""How accurate: errors of each surrogate in their unit and in noise floors, beside baselines and the floor itself."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Any

import pandas as pd

from gran_bench.evaluation_plan import COARSER
from gran_bench.front_page.records import Records, judgement_of
from gran_bench.metrics.judgement import shown_multiple
from gran_bench.verification.agreement import difference_of

RANKED = (
    ("surface_angle", "angle of repose, °"),
    ("com_angle", "centre-of-mass angle, °"),
    ("speed_w1", "speeds, Wasserstein-1, m/s"),
)
OURS = "gran-bench"  # in the table of flows


def accuracy_section(records: Records, mark: Callable[[str], str]) -> Iterator[str]:
    """Lines of the section.

    Args:
        records: as read.
        mark: of a record's name: a sign where code that made it has changed since.
    """
    if not records.runs:
        yield "No run has been judged yet: `make train`, then `python -m gran_bench.result_page`."
        return
    first = next(iter(records.runs.values()))
    yield (
        f"`drum` at {first['judged_rpm']:g} rpm, a speed that is {first['judged_as']}: mean distance from the DEM over "
        "the series, and in brackets in noise floors: 1 is as good as the DEM against itself. *Unseen* is a packing "
        "that no training saw, *shared* one that it did, at other speeds."
    )
    yield ""
    yield f"| | packing | {' | '.join(words for _, words in RANKED)} | requirements missed |"
    yield "|---|---|" + "---:|" * (len(RANKED) + 1)
    for name, summary in records.runs.items():
        minutes, parameters = summary["training"]["seconds"] / 60, summary["training"]["parameters"]
        who = f"{run_words(name, summary)}, {parameters:,} parameters, {minutes:.0f} min of training"
        who += mark(judgement_of(name))
        for packing, judged in summary["judged"].items():
            verdicts = [row["verdict"] for row in judged["requirements"].values()]
            missed = f"{verdicts.count('fail')} of {len(verdicts)}"
            cells = [_error(judged["errors"].get(key)) for key, _ in RANKED]
            yield f"| {who} | {packing} | {' | '.join(cells)} | {missed} |"
            who = ""
    for packing, judged in first["judged"].items():
        floors = [_shown(judged["errors"][key]["floor"], judged["errors"][key]["unit"]) for key, _ in RANKED]
        who = "noise floor: the DEM against itself, nudged by 1e-9 m" if packing == "shared" else ""
        yield f"| {who} | {packing} | {' | '.join(floors)} | |"
    for name, errors in first["baselines"].items():
        cells = [_error(errors.get(key)) for key, _ in RANKED]
        yield f"| {baseline_words(name, errors)} | shared | {' | '.join(cells)} | |"
    yield ""
    yield from dem_sentences(records, mark)


def run_words(name: str, summary: dict[str, Any]) -> str:
    """A judged run's model, and its page."""
    return f"**`{summary['model']['name']}`** ([{name}]({name}/README.md))"


def baseline_words(name: str, errors: dict[str, Any]) -> str:
    """A baseline's name; of the DEM with larger steps also how much larger."""
    return f"{name} ({COARSER:g} × its own)" if "ms_per_frame" in errors else name


def dem_sentences(records: Records, mark: Callable[[str], str]) -> Iterator[str]:
    """What the DEM itself is held against: theory and experiments, and another code."""
    found = records.verification
    if found is None:
        yield "- The DEM against theory: not verified yet; `python -m data_gen.verify`."
    else:
        where = f"[theory and published experiments](verification/README.md){mark('verification')}"
        yield f"- The DEM against {where}: {found['verdict']}."
    for record, flow in records.flows.items():
        for line in flow_sentences(record, flow):
            yield f"- {line}{mark(record)}"


def flow_sentences(record: str, flow: pd.DataFrame) -> Iterator[str]:
    """For each speed and other code, how far the steady flows are apart, and whether chance gives as much."""
    modulus = record.partition("drum_flow_")[2]
    softness = f" with E {modulus} Pa" if modulus else ""
    samples = {found: rows for found, rows in flow.groupby(["code", "speed_rpm"], sort=False)}
    for one, code, speed in compared_flows(samples):
        ours, theirs = samples[one, speed], samples[code, speed]
        words = []
        for column, name, unit, digits in (
            ("com_angle_deg", "centre-of-mass angle", "°", 2),
            ("mean_speed_m_per_s", "mean speed", "m/s", 4),
        ):
            apart = difference_of(ours[column].to_numpy(), theirs[column].to_numpy())
            chance = "more than chance gives" if abs(apart.middle) > apart.half_width else "no more than chance gives"
            words.append(f"{name} {apart.middle:+.{digits}f} ± {apart.half_width:.{digits}f} {unit}, {chance}")
        yield (
            f"[Steady flow]({record}.md){softness} at {speed:g} rpm, {len(ours)} packings of {one} against "
            f"{len(theirs)} of {code}: {'; '.join(words)}."
        )


def compared_flows(samples: Iterable[tuple[str, float]]) -> Iterator[tuple[str, str, float]]:
    """Which of these are held against each other: gran-bench, as it is or with a law changed; another code; rpm."""
    found = list(samples)
    for ours, speed in found:
        if ours.startswith(OURS):
            yield from ((ours, code, speed) for code, other in found if other == speed and not code.startswith(OURS))


def _error(error: dict[str, Any] | None) -> str:
    if error is None or error["value"] is None:
        return "undefined"
    return f"{_shown(error['value'], error['unit'])} ({shown_multiple(error['multiple_of_floor'])})"


def _shown(value: float | None, unit: str) -> str:
    if value is None:
        return "undefined"
    return f"{value:.3f}" if unit == "m/s" else f"{value:.2f}"
