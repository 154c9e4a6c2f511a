"""A drum of 100 000 spheres for half a second: `dem.engine=lammps` on two ranks beside `dem.engine=numba`.

    python benchmarks/scale_lammps.py [--count 100000] [--duration 0.5] [--ranks 2] [--output results/scale]

Needs the extra `lammps`. The drum is `drum` made longer, so that any number carries the same flow, and 30 rpm are on
from the start. The spheres fall and turn for a while by numba; then both engines go on from the same state, with the
same law (`dem.slip=full_radius`) and step, in turns of --turn frames, and each from its own last state. Costs are
medians of the time on the clock for a sphere and step; starts and restarts do not count, looks at frames do. What
follows for a million spheres on 64 ranks is a calculation from this cost, and is called one.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from dem_page import keep
from dem_scaling import turning_bed

from gran_bench.config import DemConfig
from gran_bench.dem.simulate import simulate
from gran_bench.metrics.angle_of_repose import center_of_mass_angles
from gran_bench.progress import Progress

STEP, FRAME = 1.0e-4, 0.01  # s
MANY, MANY_RANKS = 1_000_000, 64
LEAST_A_RANK = 5000  # spheres, below which the rims of a rank cost as much as its inside


def main(count: int, duration: float, ranks: int, threads: int, turn: int, output: Path | None) -> None:
    """Runs both engines in turns, and prints what a step costs."""
    scene, bed = turning_bed(count, "length")
    same = {"slip": "full_radius", "time_step": STEP}
    engines = {
        f"numba, {threads} thread{'s' * (threads > 1)}": DemConfig(threads=threads, **same),
        f"LAMMPS, {ranks} rank{'s' * (ranks > 1)}": DemConfig(engine="lammps", ranks=ranks, **same),
    }
    frames = round(duration / FRAME)
    states, costs, angles = dict.fromkeys(engines, bed), {name: [] for name in engines}, {}
    with Progress(total=frames * len(engines), desc="frames", leave=False) as bar:
        for first in range(0, frames, turn):
            end = bed.time + min(first + turn, frames) * FRAME
            for name, dem in engines.items():
                result = simulate(scene, states[name], end, dem=dem)
                states[name] = result.final
                costs[name].append(result.wall_seconds / (result.steps * count))
                bar.update(min(turn, frames - first))
    for name, state in states.items():
        found = center_of_mass_angles(state.position[None], state.radius, scene)
        angles[name] = float(np.degrees(found[0]))
    rows = rows_of(costs, count, angles)
    keep("lammps", text_of(rows, count, duration, ranks), output, rows)


def rows_of(costs: dict[str, list[float]], count: int, angles: dict[str, float]) -> list[dict[str, object]]:
    """A row an engine: cost of a sphere and step, ns, and where the bed has got to."""
    rows = []
    for name, each in costs.items():
        low, middle, high = (round(1e9 * float(np.quantile(each, q)), 1) for q in (0.0, 0.5, 1.0))
        rows.append({"engine": name, "spheres": count, "median_ns": middle, "lowest_ns": low, "highest_ns": high})
        rows[-1]["com_angle_deg"] = round(angles[name], 2)
    return rows


def text_of(rows: list[dict[str, object]], count: int, duration: float, ranks: int) -> str:
    """The table, and what would follow for a million spheres."""
    lines = [f"{'engine':22s} {'ns a sphere and step':>22s} {'(lowest–highest)':>20s} {'centre of mass, deg':>21s}"]
    for row in rows:
        spread = f"({row['lowest_ns']}–{row['highest_ns']})"
        lines.append(f"{row['engine']:22s} {row['median_ns']:22.1f} {spread:>20s} {row['com_angle_deg']:21.2f}")
    ours, theirs = (float(row["median_ns"]) for row in rows)
    second = MANY * theirs * 1e-9 * ranks / MANY_RANKS / STEP
    lines += [
        "",
        f"{count} spheres of 50 mm in a drum of 1 m at 30 rpm, {duration:g} s from one state, dt {STEP:g} s; "
        f"LAMMPS takes {theirs / ours:.2f} times the time of numba",
        f"calculated, not run: with {theirs * ranks:.0f} ns of a core for a sphere and step, {MANY} spheres on "
        f"{MANY_RANKS} ranks take {second / 60:.1f} minutes for a simulated second,",
        f"if {MANY // MANY_RANKS} spheres a rank still scale (they are above {LEAST_A_RANK}), and if memory is as fast "
        "for 64 cores as for these",
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=100_000)
    parser.add_argument("--duration", type=float, default=0.5, help="s")
    parser.add_argument("--ranks", type=int, default=2)
    parser.add_argument("--threads", type=int, default=2, help="of numba")
    parser.add_argument("--turn", type=int, default=10, help="frames that an engine goes on before the other does")
    parser.add_argument("--output", type=Path, help="folder whose page gets the table")
    given = parser.parse_args()
    main(given.count, given.duration, given.ranks, given.threads, given.turn, given.output)
