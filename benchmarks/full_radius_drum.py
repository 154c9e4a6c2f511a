"""A turning drum run by gran-bench's readable engine with one point of its law changed: slip as LAMMPS measures it.

    python benchmarks/full_radius_drum.py BED.npz OUT.json [--rpm 20] [--step 2e-4] [--youngs-modulus 1e7]

gran-bench takes slip at the contact point. LAMMPS `granular` takes it with the spheres' full radii, and at a wall gives
the torque the full radius as well. Here the numpy engine does so too: what then differs from LAMMPS is not the law. Run
by drum_flow.py from the same files as lammps_drum.py, to the same series; a packing takes some minutes.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path

import numpy as np

from gran_bench.config import DemConfig
from gran_bench.dem import engine_numpy
from gran_bench.dem.contact import ContactForce, contact_force
from gran_bench.dem.simulate import simulate
from gran_bench.metrics.angle_of_repose import center_of_mass_angles
from gran_bench.shipped import shipped_scene
from gran_bench.state import ParticleState


def with_full_radii(radius: float):
    """The contact law for spheres of one radius, m, that takes full radii where contact_force is given lever arms."""

    def force(law, *, effective_radius, overlap, surface_spin, **given) -> ContactForce:
        wall = effective_radius > 0.75 * radius  # a wall's R* is r, a pair's is r/2
        longer = radius / (radius - np.where(wall, overlap, 0.5 * overlap))[:, None]
        contact = contact_force(
            law, effective_radius=effective_radius, overlap=overlap, surface_spin=longer * surface_spin, **given
        )
        return replace(contact, twist=np.where(wall[:, None], longer, 1.0) * contact.twist)

    return force


def main(bed: Path, output: Path, rpm: float, step: float, youngs_modulus: float) -> None:
    """Runs the rotation and writes both series."""
    scene = shipped_scene("drum", {"material.youngs_modulus": youngs_modulus}).at_speed(rpm)
    radius = 0.5 * scene.filling.diameter
    start = np.load(bed)
    arrays = (start[name] for name in ("position", "velocity", "angular_velocity"))
    state = ParticleState(*arrays, np.full(len(start["position"]), radius), time=scene.start_time)
    engine_numpy.contact_force = with_full_radii(radius)
    result = simulate(scene, state, scene.end_time, dem=DemConfig(engine="numpy", time_step=step))
    trajectory = result.trajectory
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
