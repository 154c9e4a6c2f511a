"""A turning drum run by gran-bench's engines with one point of their law changed: slip as LAMMPS measures it.

    python benchmarks/full_radius_drum.py BED.npz OUT.json [--rpm 20] [--step 2e-4] [--youngs-modulus 1e7]

gran-bench takes slip at the contact point. LAMMPS `granular` takes it with the spheres' full radii, and at a wall gives
the torque the full radius as well. Here both engines do so too: what then differs from LAMMPS is not the law. The
readable engine says what is meant, the fast one runs the case, and over the first frames they have to agree. Run by
drum_flow.py from the same files as lammps_drum.py, to the same series. The changed engine is compiled anew each time,
half a minute; the case takes some ten seconds.
"""

from __future__ import annotations

import os
import tempfile

# Numba knows a compiled engine by its own files, which are the same here: it must neither find the one that others have
# compiled nor leave this one for them.
KERNELS = tempfile.TemporaryDirectory(prefix="kernels_")
os.environ["NUMBA_CACHE_DIR"] = KERNELS.name

# ruff: noqa: E402
import argparse
import json
from dataclasses import replace
from pathlib import Path

import numpy as np

from gran_bench.config import DemConfig
from gran_bench.dem import contact_blocks, engine_numpy, wall_contacts
from gran_bench.dem.contact import ContactForce, contact_force
from gran_bench.dem.contact_blocks import ARM_1, WX, WY, WZ
from gran_bench.dem.kernel import kernel
from gran_bench.dem.simulate import simulate
from gran_bench.metrics.angle_of_repose import center_of_mass_angles
from gran_bench.scene import Scene
from gran_bench.shipped import shipped_scene
from gran_bench.state import ParticleState

CHECKED = 2  # frames over which both engines run
ROUNDING = 1e-10  # m, that they may differ by then


def change_readable_engine(radius: float) -> None:
    """Full radii of spheres of one size, m, where contact_force is given lever arms."""

    def force(law, *, effective_radius, overlap, surface_spin, **given) -> ContactForce:
        wall = effective_radius > 0.75 * radius  # a wall's R* is r, a pair's is r/2
        longer = radius / (radius - np.where(wall, overlap, 0.5 * overlap))[:, None]
        contact = contact_force(
            law, effective_radius=effective_radius, overlap=overlap, surface_spin=longer * surface_spin, **given
        )
        return replace(contact, twist=np.where(wall[:, None], longer, 1.0) * contact.twist)

    engine_numpy.contact_force = force


def change_fast_engine(radius: float) -> None:
    """The same for the blocks of contacts, before anything is compiled."""

    @kernel
    def spins_of_pairs(buffer, size):
        for k in range(size):
            buffer[WX + k] *= radius
            buffer[WY + k] *= radius
            buffer[WZ + k] *= radius

    @kernel
    def spins_at_walls(buffer, size):
        for k in range(size):
            buffer[ARM_1 + k] = radius  # of the torque, too
            buffer[WX + k] *= radius
            buffer[WY + k] *= radius
            buffer[WZ + k] *= radius

    contact_blocks.surface_spins, wall_contacts.surface_spins = spins_of_pairs, spins_at_walls


def check(scene: Scene, state: ParticleState, step: float) -> None:
    """Ends the program where the two engines do not run the same law."""
    end = state.time + CHECKED * scene.frame_interval
    found = [
        simulate(scene, state, end, dem=DemConfig(engine=engine, time_step=step)).trajectory.position[-1]
        for engine in ("numpy", "numba")
    ]
    apart = float(np.abs(found[0] - found[1]).max())
    if apart > ROUNDING:
        raise SystemExit(f"the changed engines are {apart:.2g} m apart after {CHECKED} frames: they run two laws")


def main(bed: Path, output: Path, rpm: float, step: float, youngs_modulus: float) -> None:
    """Runs the rotation and writes both series."""
    scene = shipped_scene("drum", {"material.youngs_modulus": youngs_modulus}).at_speed(rpm)
    radius = 0.5 * scene.filling.diameter
    start = np.load(bed)
    arrays = (start[name] for name in ("position", "velocity", "angular_velocity"))
    state = ParticleState(*arrays, np.full(len(start["position"]), radius), time=scene.start_time)
    change_readable_engine(radius)
    change_fast_engine(radius)
    check(scene, state, step)
    trajectory = simulate(scene, state, scene.end_time, dem=DemConfig(engine="numba", time_step=step)).trajectory
    angle = np.degrees(center_of_mass_angles(trajectory.position, trajectory.radius, scene))
    speed = np.linalg.norm(trajectory.velocity, axis=2).mean(axis=1)
    draft = output.with_suffix(".tmp")
    draft.write_text(json.dumps({"com_angle": angle.tolist(), "mean_speed": speed.tolist()}))
    draft.rename(output)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bed", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("--rpm", type=float, default=20.0)
    parser.add_argument("--step", type=float, default=2.0e-4, help="s")
    parser.add_argument("--youngs-modulus", type=float, default=1.0e7, help="E, Pa")
    given = parser.parse_args()
    main(given.bed, given.output, given.rpm, given.step, given.youngs_modulus)
