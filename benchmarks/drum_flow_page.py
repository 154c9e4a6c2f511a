"""What drum_flow.py says on its page: a table of the steady flows by code, and one of how far the codes are apart."""

from __future__ import annotations

import io
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy import stats

from gran_bench.compose import compose
from gran_bench.provenance import read_table, stamp
from gran_bench.state import FloatArray

OURS = "gran-bench"
THEIRS, SAME_LAW, FULL_RADIUS = "LAMMPS", "LAMMPS, gran-bench's law", f"{OURS}, LAMMPS' slip"
QUANTITIES = (("angle", "centre-of-mass angle", "°", 2), ("speed", "mean speed", "m/s", 4))
# What a mean over three packings is held against, in degrees and m/s: an independent code's, found before this one.
BOUNDS = {30.0: ((34.9, 0.5), (0.612, 0.015)), 20.0: ((32.0, 0.6), (0.447, 0.015))}
NAME = "drum_flow"
STEADY_FROM: float = compose("train", ["judge=drum"]).judge.requirements.steady_from  # s

Bounds = dict[float, tuple[tuple[float, float], ...]]  # by speed: (middle, half width) of each quantity
Flow = dict[int, tuple[float, float]]  # by packing: steady angle in degrees, steady speed in m/s
Samples = dict[tuple[str, float], Flow]  # by code and speed


def interval(test: Any) -> tuple[float, float]:
    """Middle and half width of the 95 % interval of a mean, or of a difference of two, by Student or Welch."""
    low, high = test.confidence_interval(0.95)
    return 0.5 * (low + high), 0.5 * (high - low)


def columns(flow: Flow) -> tuple[FloatArray, FloatArray]:
    """Angles and speeds of a flow's packings, in their order."""
    angle, speed = np.array([flow[packing] for packing in flow]).T
    return angle, speed


def compared_flows(samples: Iterable[tuple[str, float]]) -> Iterator[tuple[str, str, float]]:
    """Which of these are held against each other: gran-bench, as it is or with a law changed; another code; rpm."""
    found = list(samples)
    for ours, speed in found:
        if ours.startswith(OURS):
            yield from ((ours, code, speed) for code, other in found if other == speed and not code.startswith(OURS))


def csv(samples: Samples) -> str:
    """Every packing's figures."""
    lines = ["code,speed_rpm,packing,com_angle_deg,mean_speed_m_per_s"]
    for (code, rpm), flow in samples.items():
        lines += [f'"{code}",{rpm:g},{packing},{angle:.4f},{speed:.6f}' for packing, (angle, speed) in flow.items()]
    return "\n".join(lines) + "\n"


def read_samples(table: str) -> Samples:
    """The samples of a CSV."""
    return {
        (code, float(rpm)): {row.packing: (row.com_angle_deg, row.mean_speed_m_per_s) for row in rows.itertuples()}
        for (code, rpm), rows in pd.read_csv(io.StringIO(table)).groupby(["code", "speed_rpm"], sort=False)
    }


def part(path: Path) -> str:
    """What the page says of a CSV: the two tables, the figure beside it, and where it comes from."""
    made, table = read_table(path)
    samples, bounds = read_samples(table), BOUNDS if path.stem == NAME else {}
    heads = " | ".join(f"{name}, {unit}" for _, name, unit, _ in QUANTITIES)
    lines = [f"| rpm | code | packings | {heads} |", "|---:|---|---:|---:|---:|"]
    for (code, rpm), flow in samples.items():
        means = zip(QUANTITIES, (interval(stats.ttest_1samp(values, 0.0)) for values in columns(flow)), strict=True)
        cells = [f"{middle:.{digits}f} ± {half:.{digits}f}" for (*_, digits), (middle, half) in means]
        lines.append(f"| {rpm:g} | {code} | {len(flow)} | {' | '.join(cells)} |")
    for rpm, bound in bounds.items():
        cells = " | ".join(f"{middle:g} ± {half:g}" for middle, half in bound)
        lines.append(f"| {rpm:g} | *an independent code, known before* | | {cells} |")
    lines += ["", f"| rpm | of | minus | {heads} | more than chance |", "|---:|---|---|---:|---:|---|"]
    for one, code, rpm in compared_flows(samples):
        pairs = zip(columns(samples[one, rpm]), columns(samples[code, rpm]), strict=True)
        apart = [interval(stats.ttest_ind(ours, theirs, equal_var=False)) for ours, theirs in pairs]
        cells = [f"{d:+.{q[3]}f} ± {half:.{q[3]}f}" for q, (d, half) in zip(QUANTITIES, apart, strict=True)]
        sure = [q[0] for q, (d, half) in zip(QUANTITIES, apart, strict=True) if abs(d) > half]
        lines.append(f"| {rpm:g} | {one} | {code} | {' | '.join(cells)} | {' and '.join(sure) or 'no'} |")
    lines += [
        "",
        f"Each figure is a mean over packings of the mean from {STEADY_FROM:g} s to 5.5 s, with its 95 % interval "
        "(Student; Welch for differences).",
        "",
        f"![A dot a packing, the mean with its 95 % interval.]({path.stem}.png)",
        "",
        f"Every packing: [`{path.name}`]({path.name}). {stamp(made)}",
    ]
    return "\n".join(lines)
