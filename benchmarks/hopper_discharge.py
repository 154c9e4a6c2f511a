"""The mass flow of a conical hopper against Beverloo's law: four orifices, some two minutes of one core.

python benchmarks/hopper_discharge.py [--figure results/verification/hopper_discharge.png] [--seed 0]
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

from gran_bench.plots import draw_discharge
from gran_bench.verification.hopper_discharge import discharge


def main(figure: Path | None, seed: int) -> None:
    """Prints the table and draws the figure."""
    started = time.process_time()
    result = discharge(seed=seed)
    print("D/d    D − k d, m   W, kg/s    2 standard errors")
    rows = zip(result.orifice / result.diameter, result.opening, result.flow, result.flow_error, strict=True)
    for size, opening, flow, error in rows:
        print(f"{size:4.1f}   {opening:9.4f}   {flow:7.3f}    {2 * error:.3f}")
    print(f"k = {result.rim:g} (set), bulk density {result.bulk_density:.0f} kg/m³, C = {result.factor:.3f}")
    print(f"exponent {result.exponent:.3f} ± {result.exponent_error:.3f} (expected 2.5 ± 0.15)")
    print(f"{time.process_time() - started:.0f} s of processor time")
    if figure is not None:
        figure.parent.mkdir(parents=True, exist_ok=True)
        draw_discharge(figure, result)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--figure", type=Path)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    main(given.figure, given.seed)
