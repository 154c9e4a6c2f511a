"""A closed system keeps its momentum and its angular momentum, whatever its contacts do."""

from __future__ import annotations

import numpy as np

from gran_bench.state import Trajectory
from gran_bench.verification.case import Case, Check, Findings
from gran_bench.verification.cluster import cluster, mass_of, rough_material
from gran_bench.verification.laboratory import SOFT, STIFF, laboratory, run
from gran_bench.verification.theory import Body, Contact

TOLERANCE = 1e-12
STEPS = 10_000
INWARD = 1.0  # m/s, of the rim of the cluster


def momenta() -> Findings:
    """Momentum and angular momentum over 10⁴ steps of a rough, inelastic cluster that falls in on itself."""
    checks = []
    # A stiff cluster starts almost in touch: its steps are a hundred times shorter.
    for modulus, gap, per_contact in ((SOFT, 1e-4, 40), (STIFF, 1e-6, 20)):
        state = cluster(200, 5, gap, INWARD, 20.0, smallest=0.9 if modulus == SOFT else 0.999)
        material = rough_material(modulus)
        contact = Contact(Body(material, float(state.radius.min())), Body(material, float(state.radius.min())))
        step = contact.duration(3.0 * INWARD) / per_contact
        trajectory = run(laboratory(material), state, step, STEPS, 100).trajectory
        mass = mass_of(trajectory.radius)[:, None]
        linear = (mass * trajectory.velocity).sum(axis=1)
        own = 0.4 * mass * trajectory.radius[:, None] ** 2 * trajectory.angular_velocity
        orbital = mass * np.cross(trajectory.position, trajectory.velocity)
        angular = (own + orbital).sum(axis=1)
        speeds, reaches = (np.linalg.norm(a[0], axis=1) for a in (trajectory.velocity, trajectory.position))
        linear_scale = float((mass[:, 0] * speeds).sum())
        angular_scale = float((mass[:, 0] * reaches * speeds).sum() + np.linalg.norm(own[0], axis=1).sum())
        touching = trajectory.diagnostics["contact_count"].mean()
        label = f"E {modulus:g} Pa, {touching:.1f} contacts at a time"
        for name, values, scale, unit in (
            ("momentum", linear, linear_scale, "of Σ m|v|"),
            ("angular momentum", angular, angular_scale, "of Σ m|x||v| + Σ I|ω|"),
        ):
            change = np.abs(values - values[0]).max()
            checks.append(
                Check(f"change of {name} over 10⁴ steps, {label}", [0.0], [change], TOLERANCE, "conserved", scale, unit)
            )
        # Without contacts nothing would be shown.
        if _energy(trajectory, -1) > 0.7 * _energy(trajectory, 0):
            raise RuntimeError("the cluster hardly touched, so that its momenta say nothing")
    return Findings(tuple(checks))


def _energy(trajectory: Trajectory, frame: int) -> float:
    figures = trajectory.diagnostics
    return float(figures["kinetic_energy_translational"][frame] + figures["kinetic_energy_rotational"][frame])


CASES = (Case("momentum", "a closed system keeps momentum and angular momentum over 10⁴ steps", momenta),)
