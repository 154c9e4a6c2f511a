"""The page of drum_flow.py: tables of what each code's packings give, and what their scatter says."""

from __future__ import annotations

import numpy as np

from gran_bench.front_page.accuracy import OURS, compared_flows
from gran_bench.metrics.summary import STEADY_FROM
from gran_bench.state import FloatArray
from gran_bench.verification.agreement import (
    difference_of,
    mean_of,
    paired_difference_of,
    share_within,
    share_within_of,
)

THEIRS, SAME_LAW, FULL_RADIUS = "LAMMPS", "LAMMPS, gran-bench's law", f"{OURS}, LAMMPS' slip"
SETTINGS = {
    THEIRS: "LAMMPS `granular` on one rank: hertz/material, coeff_restitution, tangential mindlin/force.",
    SAME_LAW: "With *gran-bench's law* it runs mindlin_rescale/force and limit_damping, and is given the number for e "
    "that makes it 0.5 then.",
    FULL_RADIUS: "With *LAMMPS' slip* gran-bench runs with `dem.slip=full_radius`: one point of its law is LAMMPS'.",
}
QUANTITIES = (("angle", "centre-of-mass angle", "°", 2), ("speed", "mean speed", "m/s", 4))
# What a mean over three packings is held against, in degrees and m/s: an independent code's, found before this one.
BOUNDS = {30.0: ((34.9, 0.5), (0.612, 0.015)), 20.0: ((32.0, 0.6), (0.447, 0.015))}
# LAMMPS 22 Jul 2025, GRANULAR/granular_model.cpp: slip with radi and radj; torques with radi − δ/2, at walls with radi.
WHY = (
    "One point of the law differs whatever the setting. LAMMPS measures the slip of a contact with the spheres' full "
    "radii, gran-bench where the contact is, R − δ/2 from the centres of a pair and R − δ from that at a wall. With "
    "full radii a bed that turns as one body slips at each contact by ω δ, although nothing moves against anything; "
    "the contacts are loaded up to the Coulomb limit by it, and the bed is a little weaker. At the contact point it "
    "does not slip (`tests/physics/test_friction.py`). Two things show whether anything else differs: gran-bench with "
    "this one point as LAMMPS has it, *LAMMPS' slip* in the tables; and stiffer spheres, because with δ the "
    "difference vanishes: [1e7 Pa](drum_flow.md), [1e8 Pa](drum_flow_1e8.md)."
)
FEW = 3  # packings in such a mean
NAME = "drum_flow"

Bounds = dict[float, tuple[tuple[float, float], ...]]  # by speed: (middle, half width) of each quantity
Flow = dict[int, tuple[float, float]]  # by packing: steady angle in degrees, steady speed in m/s


def columns(flow: Flow) -> tuple[FloatArray, FloatArray]:
    """Angles and speeds of a flow's packings, in their order."""
    angle, speed = np.array([flow[packing] for packing in flow]).T
    return angle, speed


def code_rows(samples: dict[tuple[str, float], Flow], bounds: Bounds) -> list[str]:
    """A row a code, speed and quantity: mean with its 95 % interval, scatter, and what three packings would say."""
    lines = [
        "| speed | quantity | code | packings | mean, 95 % interval | standard deviation of a packing | bound "
        "| means of three inside |",
        "|---:|---|---|---:|---:|---:|---:|---:|",
    ]
    for (code, rpm), flow in samples.items():
        for row, (_, name, unit, digits) in enumerate(QUANTITIES):
            values, mean = columns(flow)[row], mean_of(columns(flow)[row])
            bound = inside = "–"
            if rpm in bounds and len(values) >= FEW:
                middle, half = bounds[rpm][row]
                bound, inside = f"{middle:g} ± {half:g}", f"{share_within_of(values, middle, half, FEW):.0%}"
            lines.append(
                f"| {rpm:g} rpm | {name}, {unit} | {code} | {len(values)} | {mean.middle:.{digits}f} "
                f"± {mean.half_width:.{digits}f} | {values.std(ddof=1):.{digits}f} | {bound} | {inside} |"
            )
    return lines


def difference_rows(samples: dict[tuple[str, float], Flow], bounds: Bounds) -> list[str]:
    """A row a speed, quantity and two ways to run the case: gran-bench minus LAMMPS, unpaired and by packing."""
    lines = [
        "| speed | quantity | of | minus | difference, 95 % interval | standard errors | by packing, 95 % interval "
        "| correlation | means of three of each agree |",
        "|---:|---|---|---|---:|---:|---:|---:|---:|",
    ]
    for one, code, rpm in compared_flows(samples):
        ours, theirs = samples[one, rpm], samples[code, rpm]
        shared = [packing for packing in theirs if packing in ours]
        both = columns({p: ours[p] for p in shared}), columns({p: theirs[p] for p in shared})
        for row, (_, name, unit, digits) in enumerate(QUANTITIES):
            free = difference_of(columns(ours)[row], columns(theirs)[row])
            paired = paired_difference_of(both[0][row], both[1][row])
            half = bounds[rpm][row][1] if rpm in bounds else None
            agree = "–"
            if half is not None and min(len(ours), len(theirs)) >= FEW:
                agree = f"{share_within(columns(ours)[row], columns(theirs)[row], half, FEW):.0%} (± {half:g})"
            unpaired, by_packing = (f"{d.middle:+.{digits}f} ± {d.half_width:.{digits}f}" for d in (free, paired))
            together = np.corrcoef(both[0][row], both[1][row])[0, 1]
            lines.append(
                f"| {rpm:g} rpm | {name}, {unit} | {one} | {code} | {unpaired} | {free.standard_errors_from_zero:.1f} "
                f"| {by_packing} | {together:+.2f} | {agree} |"
            )
    return lines


def csv(samples: dict[tuple[str, float], Flow]) -> str:
    """Every packing's figures."""
    lines = ["code,speed_rpm,packing,com_angle_deg,mean_speed_m_per_s"]
    for (code, rpm), flow in samples.items():
        lines += [f'"{code}",{rpm:g},{packing},{angle:.4f},{speed:.6f}' for packing, (angle, speed) in flow.items()]
    return "\n".join(lines) + "\n"


def conclusions(samples: dict[tuple[str, float], Flow]) -> list[str]:
    """For each speed and two ways to run the case, whether they differ by more than chance gives."""
    lines = []
    for one, code, rpm in compared_flows(samples):
        ours, theirs = samples[one, rpm], samples[code, rpm]
        found = []
        for row, (_, name, unit, digits) in enumerate(QUANTITIES):
            free = difference_of(columns(ours)[row], columns(theirs)[row])
            verdict = "no more than chance gives"
            if abs(free.middle) > free.half_width:
                verdict = f"more than chance gives, {free.standard_errors_from_zero:.1f} standard errors"
            found.append(f"the {name} by {free.middle:+.{digits}f} ± {free.half_width:.{digits}f} {unit}, {verdict}")
        lines.append(f"- {rpm:g} rpm, {one} against {code}: {'; '.join(found)}.")
    return lines


def page(samples: dict[tuple[str, float], Flow], made: str, setting: str, name: str, bounds: Bounds) -> str:
    """The page called ``name``, with the figure and the packings' figures beside it."""
    caption = f"A dot a packing, the mean with its 95 % interval{', the bound as a band' if bounds else ''}."
    compared = any(code != OURS for code, _ in samples)
    lines = [
        "# Steady flow in the drum, packing by packing",
        "",
        f"`drum`: 3000 spheres of 50 mm. A figure of a packing is a mean over the frames from {STEADY_FROM:g} s on, "
        "two seconds after the drum began to turn, until 5.5 s: of the centre-of-mass angle, and of the mean of all "
        f"spheres' instantaneous speeds. {setting}",
        "",
        *([*conclusions(samples), "", WHY, ""] if compared else []),
        *code_rows(samples, bounds),
        "",
    ]
    if bounds:
        lines += [
            f"*Bound*: the figures of an independent code that a mean over {FEW} packings is held against. *Means of "
            f"three inside*: of all choices of {FEW} of these packings, how many pass.",
            "",
        ]
    if compared:
        lines += [
            *difference_rows(samples, bounds),
            "",
            "The first interval is Welch's, unpaired: all packings of each code. *By packing*: the packings that both "
            f"ran, one minus the other. *Means of three of each agree*: of all choices of {FEW} packings of each code, "
            "how many have means that differ by at most the bound's half width.",
            "",
        ]
    lines += [
        f"![{caption}]({name}.png)",
        "",
        f"*{caption} All figures: [`{name}.csv`]({name}.csv).*",
        "",
        made,
    ]
    return "\n".join(lines) + "\n"
