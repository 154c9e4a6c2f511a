"""All scenes of the benchmark together: who is on their frontiers, where the surrogate stands, and one picture."""

import re
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from gran_bench.benchmark import results as claims
from gran_bench.benchmark.results import entries, read_all
from gran_bench.plots.overview import SAMPLES, STATISTICS, Panel, Point, overview
from gran_bench.plots.time_error import frontier

WORDS = {"dem": "the DEM at one of its steps", "float32": "the DEM in float32", "softened": "a softened DEM"}
WORDS |= {"coarse": "a coarse-grained DEM", "surrogate": "a surrogate"}  # for families of samples, in a sentence
FIGURE = "overview.png"
LEAST_SCENES = 2  # that a picture of all is of
Found = dict[str, Any]  # as in ``benchmark.json``


def family_of(row: Mapping[str, Any]) -> str:
    """Which family of `plots.overview` a method is of; ``baseline`` for what the picture leaves to each scene's own."""
    name, kind = row["name"], row["kind"]
    if kind != "dem":
        return "interpolation" if name.startswith("interpolation") else kind
    words = {"coarse-grained": "coarse", "float32": "float32", "E =": "softened"}
    return next((family for word, family in words.items() if word in name), "dem")


def draw_overview(root: Path) -> Path | None:
    """The picture of all results below a folder; None where they are of fewer than two scenes."""
    every = [*read_all(root).values()]
    if len(every) < LEAST_SCENES:
        return None
    titles = [f"{found['scene']}, {found['spheres']} spheres" for found in every]
    panels = [
        Panel(title, [*_points(found)], found["reference"]["accepted"])
        for title, found in zip(titles, every, strict=True)
    ]
    return overview(panels, root / FIGURE)


def _points(found: Found) -> Iterator[Point]:
    for row in found["methods"]:
        family, seconds = family_of(row), (row["wall"] or {}).get("median")
        if seconds is None or row["failed"]:
            continue
        if family in SAMPLES and row["floors"] is not None:
            factor = re.search(r"coarse-grained ([\d.]+)", row["name"])
            yield Point(family, seconds, row["floors"], float(factor[1]) if factor else None)
        elif family in STATISTICS and row.get("statistics"):
            scores = [one["multiple"] for one in row["statistics"].values()]
            if scores and None not in scores:
                yield Point(family, seconds, max(scores))


def overview_text(root: Path, every: Mapping[str, Found]) -> str:
    """What all scenes say together: the frontier by family, the surrogate beside the DEM, and the picture."""
    count, ahead = len(every), Counter()
    for found in every.values():
        ranked = [entry for entry in entries(found) if entry.kind in ("dem", "surrogate")]
        kinds = {row["name"]: family_of(row) for row in found["methods"]}
        ahead.update({kinds[entry.name] for entry in frontier(ranked)})
    there = {family_of(row) for found in every.values() for row in found["methods"]}
    seen = [f"{words} in {ahead[family] or 'none'}" for family, words in WORDS.items() if family in there]
    scenes = f"{count} scenes" if count > 1 else "one scene"
    seen[0] = f"{seen[0]} of {scenes}"
    lines = [f"**On the frontier, where nothing is both faster and as exact, stands {', '.join(seen)}.**"]
    lines += _surrogates(every)
    if (root / FIGURE).exists():
        lines += ["", f"![Run time against error in every scene.]({FIGURE})"]
    return "\n".join(lines)


def _surrogates(every: Mapping[str, Found]) -> Iterator[str]:
    """Where each surrogate stands beside the fastest DEM that is as exact."""
    judged: dict[str, list[claims.EqualAccuracy]] = {}
    for found in every.values():
        ranked, accepted = entries(found), found["reference"]["accepted"]
        for entry in (one for one in ranked if one.kind == "surrogate" and one.floors is not None):
            judged.setdefault(entry.name, []).append(claims.equal_accuracy(entry, ranked, accepted))
    for name, beside in judged.items():
        answers = Counter(one.faster for one in beside)
        slower = [one for one in beside if one.faster == "rival"]
        ratios = sorted(1.0 / claims.speed_up(one.entry, one.rival or one.lenient).middle for one in slower)
        said = f"The surrogate {name} fits {len(beside)} of the scenes"
        words = {"rival": "a DEM that is as exact is faster in", "entry": "it is faster than every DEM as exact in"}
        words |= {"alone": "no DEM is as exact in", "neither": "neither is faster in", "undecided": "undecided in"}
        parts = [f"{text} {answers[key]}" for key, text in words.items() if answers[key]]
        if ratios:
            times = f"{ratios[0]:.2g} to {ratios[-1]:.2g}" if len(ratios) > 1 else f"{ratios[0]:.2g}"
            parts[0] += f" ({times} times)"
        yield f"{said}: {', '.join(parts)}."
