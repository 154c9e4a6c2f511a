"""The mass flow of a conical hopper against Beverloo's law: four orifices, some two minutes of one core.

    python benchmarks/hopper_discharge.py [--output results/verification] [--seed 0]

With --output the part hopper_discharge of the page there is renewed, and a figure written beside it.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from dem_page import PAGE, made_by_this

from gran_bench.files import write_part
from gran_bench.plots.verification import draw_discharge
from gran_bench.provenance import stamp
from gran_bench.verification.hopper_discharge import HopperDischarge, discharge

NAME = "hopper_discharge"
EXPECTED, TOLERANCE = 2.5, 0.15  # of the exponent


def table(result: HopperDischarge) -> list[str]:
    """A row an orifice, as Markdown."""
    lines = ["| D/d | D − k d, m | W, kg/s | two standard errors, kg/s |", "|---:|---:|---:|---:|"]
    rows = zip(result.orifice / result.diameter, result.opening, result.flow, result.flow_error, strict=True)
    return lines + [f"| {d:.1f} | {opening:.4f} | {flow:.3f} | {2 * error:.3f} |" for d, opening, flow, error in rows]


def part(result: HopperDischarge) -> str:
    """What came out, and whether Beverloo's law holds."""
    met = "met" if abs(result.exponent - EXPECTED) <= TOLERANCE else "FAILED"
    lines = [
        f"**Exponent {result.exponent:.3f} ± {result.exponent_error:.3f}** (standard error); expected {EXPECTED:g} ± "
        f"{TOLERANCE:g}: {met}. C = {result.factor:.3f} with the exponent 5/2 and k = {result.rim:g}, bulk density of "
        f"the settled bed {result.bulk_density:.0f} kg/m³.",
        "",
        *table(result),
        "",
        f"![The flows against D − k d, both axes logarithmic; bars are two standard errors.]({NAME}.png)",
        "",
        stamp(made_by_this()),
    ]
    return "\n".join(lines)


def main(output: Path | None, seed: int) -> None:
    """Discharges the hoppers, prints what came out and writes it into the page of a folder."""
    result = discharge(seed=seed)
    text = part(result)
    print(text)
    if output is not None:
        draw_discharge(output / f"{NAME}.png", result)
        write_part(output / PAGE, NAME, text, heading="Discharge of a conical hopper")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, help="folder whose page gets the table; figure beside it")
    parser.add_argument("--seed", type=int, default=0, help="of the fillings")
    given = parser.parse_args()
    main(given.output, given.seed)
