"""Head-on impacts: the restitution that was set comes out, at any speed, stiffness, size and phase of the step."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gran_bench.verification.case import Case, Check, Findings
from gran_bench.verification.laboratory import (
    SOFT,
    STIFF,
    Impacts,
    collide,
    on_rigid_wall,
    on_sphere,
    on_wall,
    sphere_material,
)
from gran_bench.verification.theory import RESTITUTION, Contact

TOLERANCE = 1e-3  # of the approach speed, at t_c/200
SET = (0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 1.0)
SPEEDS = (0.01, 1.0, 5.0)  # m/s
PHASES = np.array([0.0, 0.25, 0.5, 0.75, 0.99])  # of a step, between the last state apart and the first touch

BODIES: dict[str, Callable[..., Contact]] = {
    "two equal spheres": on_sphere,
    "two unequal spheres (10 and 50 mm)": lambda material: on_sphere(material, 0.01, 0.05),
    "sphere on a wall": on_wall,
    "sphere on a rigid wall": on_rigid_wall,
}


def restitution() -> Findings:
    """Restitution of every pair of bodies over e, speed, stiffness and phase."""
    checks = []
    for name, bodies in BODIES.items():
        expected, found, at = [], [], []
        for modulus in (SOFT, STIFF):
            for e in SET:
                contact = bodies(sphere_material(modulus, e))
                for speed in SPEEDS:
                    rebounds = collide(Impacts.of(contact, np.full(len(PHASES), speed)), phase=PHASES)
                    expected += [e] * len(PHASES)
                    found += list(rebounds.normal / speed)
                    at += [f"E {modulus:g} Pa, e {e:g}, {speed:g} m/s, phase {phase:g}" for phase in PHASES]
        checks.append(
            Check(f"restitution, {name}", expected, found, TOLERANCE, RESTITUTION, 1.0, "of approach speed", at)
        )
    return Findings(tuple(checks))


CASES = (Case("head-on", "the restitution of a head-on impact is the one that was set", restitution),)
