"""The mass flow of a conical hopper against Beverloo's law: four orifices, some two minutes of one core.

    python benchmarks/hopper_discharge.py [--output results/verification] [--seed 0]

With --output a page and a figure of the name hopper_discharge are written there.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

from gran_bench.atomic import write_text
from gran_bench.plots import draw_discharge
from gran_bench.provenance import commit, hardware
from gran_bench.verification.hopper_discharge import HopperDischarge, discharge

NAME = "hopper_discharge"
EXPECTED, TOLERANCE = 2.5, 0.15  # of the exponent


def table(result: HopperDischarge) -> list[str]:
    """A row an orifice, as Markdown."""
    lines = ["| D/d | D − k d, m | W, kg/s | two standard errors, kg/s |", "|---:|---:|---:|---:|"]
    rows = zip(result.orifice / result.diameter, result.opening, result.flow, result.flow_error, strict=True)
    return lines + [f"| {d:.1f} | {opening:.4f} | {flow:.3f} | {2 * error:.3f} |" for d, opening, flow, error in rows]


def page(result: HopperDischarge, seconds: float) -> str:
    """What came out, and whether Beverloo's law holds."""
    met = "met" if abs(result.exponent - EXPECTED) <= TOLERANCE else "FAILED"
    lines = [
        "# Discharge of a conical hopper",
        "",
        "Beverloo's law: W = C ρ_b √g (D − k d)^{5/2}, with ρ_b the bulk density, D the diameter of the orifice and d "
        f"that of the spheres; k = {result.rim:g} is set (Nedderman 1992, §10.2), C and the exponent come out.",
        "",
        f"**Exponent {result.exponent:.3f} ± {result.exponent_error:.3f}** (standard error); expected {EXPECTED:g} ± "
        f"{TOLERANCE:g}: {met}. C = {result.factor:.3f} with the exponent 5/2, bulk density of the settled bed "
        f"{result.bulk_density:.0f} kg/m³.",
        "",
        *table(result),
        "",
        f"![The flows against D − k d, both axes logarithmic.]({NAME}.png)",
        "",
        "*The flows against D − k d, both axes logarithmic; bars are two standard errors.*",
        "",
        f"Made by `{' '.join(['python', f'benchmarks/{Path(sys.argv[0]).name}', *sys.argv[1:]])}` at {commit()} on "
        f"{hardware()}; {seconds:.0f} s of processor time.",
    ]
    return "\n".join(lines) + "\n"


def main(output: Path | None, seed: int) -> None:
    """Discharges the hoppers, prints the page and writes it."""
    started = time.process_time()
    result = discharge(seed=seed)
    text = page(result, time.process_time() - started)
    print(text)
    if output is not None:
        draw_discharge(output / f"{NAME}.png", result)
        write_text(output / f"{NAME}.md", text)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, help="folder of the page and the figure")
    parser.add_argument("--seed", type=int, default=0, help="of the fillings")
    given = parser.parse_args()
    main(given.output, given.seed)
