"""Space has no direction, particles no numbers, and uniform motion does not show."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation as Turn

from gran_bench.state import FloatArray, ParticleState
from gran_bench.verification.case import Case, Check, Findings
from gran_bench.verification.cluster import cluster, rough_material
from gran_bench.verification.laboratory import SOFT, STIFF, laboratory, run

TOLERANCE = 1e-10  # m, as for two engines
STEPS = 400


def _both(change, undo) -> Findings:
    """Runs a cluster as it is and changed, undoes the change, and compares positions, velocities and spins.

    Args:
        change: of the start state.
        undo: of the changed run's final state.
    """
    checks = []
    for modulus, gap, step, smallest in ((SOFT, 1e-4, 1e-4, 0.9), (STIFF, 1e-6, 2e-6, 0.9999)):
        scene, state = laboratory(rough_material(modulus)), cluster(60, 11, gap, 1.0, 20.0, smallest)
        # Frames at the same steps: an engine starts anew from each.
        plain = run(scene, state, step, STEPS, STEPS // 20)
        other = undo(run(scene, change(state), step, STEPS, STEPS // 20).final)
        touching = plain.trajectory.diagnostics["contact_count"].mean()
        if touching < 1.0:
            raise RuntimeError("the cluster hardly touched, so that it says nothing of contacts")
        label = f"E {modulus:g} Pa, {touching:.0f} contacts at a time"
        for name, field, scale, unit in (
            ("positions", "position", 1.0, "m"),
            ("velocities", "velocity", 1.0, "m/s"),
            ("spins", "angular_velocity", 100.0, "100 rad/s"),
        ):
            off = np.abs(getattr(other, field) - getattr(plain.final, field)).max()
            # A velocity is a position over a contact time: it may be off by that much more.
            tolerance = TOLERANCE if field == "position" else 1e3 * TOLERANCE
            checks.append(
                Check(
                    f"{name} after {STEPS} steps, {label}", [0.0], [off], tolerance, "symmetry of space and time",
                    scale, unit,
                )
            )  # fmt: skip
    return Findings(tuple(checks))


def _mapped(state: ParticleState, linear: FloatArray) -> ParticleState:
    """A state with its vectors turned; the history is not needed."""
    return replace(
        state,
        **{name: getattr(state, name) @ linear.T for name in ("position", "velocity", "angular_velocity")},
    )


def rotation() -> Findings:
    """A cluster turned by an odd angle."""
    turn = Turn.from_rotvec([0.4, -1.1, 0.7]).as_matrix()
    return _both(lambda s: _mapped(s, turn), lambda s: _mapped(s, turn.T))


def permutation() -> Findings:
    """A cluster with its spheres numbered otherwise."""
    order = np.random.default_rng(3).permutation(60)
    place = np.argsort(order)

    def reorder(state: ParticleState, rows: FloatArray) -> ParticleState:
        names = ("position", "velocity", "angular_velocity", "radius")
        return replace(state, **{name: getattr(state, name)[rows] for name in names})

    return _both(lambda s: reorder(s, order), lambda s: reorder(s, place))


def galilei() -> Findings:
    """A cluster that moves as a whole."""
    drift = np.array([0.7, -0.4, 0.3])
    return _both(
        lambda s: replace(s, velocity=s.velocity + drift),
        lambda s: replace(s, velocity=s.velocity - drift, position=s.position - drift * s.time),
    )


CASES = (
    Case("rotation", "turning everything turns the result", rotation),
    Case("permutation", "the numbering of the particles does not matter", permutation),
    Case("galilei", "a uniform motion of the whole does not matter", galilei),
)
