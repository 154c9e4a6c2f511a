"""The fast engine against the readable one: forces of one step, and a hundred steps."""

from __future__ import annotations

import numpy as np

from gran_bench.verification.case import Case, Check, Findings
from gran_bench.verification.cluster import cluster, drum_bed, rough_material
from gran_bench.verification.laboratory import SOFT, STIFF, laboratory, run

SOURCE = "engine numpy, the readable reference"
STEP = {SOFT: 1e-4, STIFF: 4e-6}  # s


def _scenes(modulus: float):
    """(name, scene, state in the middle of many contacts)."""
    step = STEP[modulus]
    yield "bed in a turning drum", *drum_bed(modulus, step, 0.4)
    scene = laboratory(rough_material(modulus))
    gap, smallest = (1e-4, 0.9) if modulus == SOFT else (1e-6, 0.9999)
    state = cluster(200, 3, gap, 1.0, 20.0, smallest)
    yield "free cluster", scene, run(scene, state, step, 60 if modulus == SOFT else 25).final


def forces() -> Findings:
    """Forces and torques of one step, seen in what they do to velocities and spins."""
    checks = []
    for modulus in (SOFT, STIFF):
        for name, scene, state in _scenes(modulus):
            fast, plain = (run(scene, state, STEP[modulus], 1, engine=engine).final for engine in ("numba", "numpy"))
            for quantity, field in (("force", "velocity"), ("torque", "angular_velocity")):
                given = getattr(plain, field) - getattr(state, field)
                off = np.abs(getattr(fast, field) - getattr(plain, field)).max()
                checks.append(
                    Check(
                        f"{quantity} of one step, {name}, E {modulus:g} Pa, {len(plain.history)} contacts",
                        [0.0], [off], 1e-12, SOURCE, np.abs(given).max(), "of the largest",
                    )
                )  # fmt: skip
    return Findings(tuple(checks))


def hundred_steps() -> Findings:
    """Positions after a hundred steps from one state."""
    checks = []
    for modulus in (SOFT, STIFF):
        for name, scene, state in _scenes(modulus):
            fast, plain = (run(scene, state, STEP[modulus], 100, engine=engine).final for engine in ("numba", "numpy"))
            off = np.abs(fast.position - plain.position).max()
            moved = np.abs(plain.position - state.position).max()
            checks.append(
                Check(
                    f"positions after 100 steps, m, {name}, E {modulus:g} Pa, moved by up to {1e3 * moved:.2g} mm",
                    [0.0], [off], 1e-10, SOURCE, 1.0, "m",
                )
            )  # fmt: skip
    return Findings(tuple(checks))


CASES = (
    Case("engine-forces", "numba gives the forces of numpy to 1e-12", forces),
    Case("engine-steps", "numba stays with numpy for 100 steps to 1e-10 m", hundred_steps),
)
