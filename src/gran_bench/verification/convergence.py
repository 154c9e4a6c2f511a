"""What the step does: time runs backwards, errors fall with its square, and an elastic gas keeps its energy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.integrate import solve_ivp
from scipy.spatial import cKDTree

from gran_bench.scene import Scene
from gran_bench.state import ContactHistory, FloatArray, Trajectory
from gran_bench.verification.case import Case, Check, Findings
from gran_bench.verification.cluster import gas, mass_of
from gran_bench.verification.impact_theory import impact
from gran_bench.verification.laboratory import (
    RADIUS,
    SOFT,
    STIFF,
    Impacts,
    collide,
    laboratory,
    on_sphere,
    on_wall,
    run,
    sphere_material,
    spheres,
)

HALVINGS = 2.0 ** np.arange(6)
# Verlet errs in the energy of one elastic impact by 0.15 (Δt/t_c)² rms over the phases of the step, and on average by
# nothing. The 3·10⁴ impacts of 27 spheres in 100 s each hold a 27th of the energy or so, and their errors add up like a
# random walk, to (Δt/t_c)². The bound is three times that.
DRIFT_BOUND = 3.0  # (Δt/t_c)², of the energy
GAS_SPEED, GAS_WIDTH, GAS_SIDE = 0.5, 0.25, 3  # m/s, m, spheres along an edge
LONG = 100.0  # s


def reversal() -> Findings:
    """Elastic smooth spheres run for a time, turn round, and come back to where they started."""
    checks = []
    for modulus, step in ((SOFT, 1e-4), (STIFF, 2e-6)):
        scene, state = gas(GAS_SIDE, 1, GAS_SPEED, GAS_WIDTH, modulus)
        steps = round(0.3 / step)
        there = run(scene, state, step, steps, steps // 100)
        impacts = there.trajectory.diagnostics
        back = replace(there.final, velocity=-there.final.velocity, time=0.0, history=ContactHistory.empty())
        final = run(scene, back, step, steps).final
        touched = np.count_nonzero(impacts["contact_count"] + impacts["wall_contact_count"])
        label = f"E {modulus:g} Pa, {touched} of 101 frames in touch"
        off = np.abs(final.position - state.position).max()
        wrong = np.abs(final.velocity + state.velocity).max()
        went = np.abs(there.final.position - state.position).max()
        checks += [
            Check(
                f"way back missed, m, of {went:.2g} m, {label}", [0.0], [off], 1e-9, "Verlet is reversible", 1.0, "m"
            ),
            Check(
                f"velocity missed, m/s, {label}", [0.0], [wrong], 1e-9, "Verlet is reversible", 1.0, "m/s"
            ),
        ]  # fmt: skip
    return Findings(tuple(checks))


def _order(steps: FloatArray, error: FloatArray) -> float:
    """Slope of log error over log step by least squares."""
    return float(np.polyfit(np.log(steps), np.log(error), 1)[0])


def order() -> Findings:
    """Error against the step, each time from a start at touch, and its order."""
    checks, drawn = [], {}
    for modulus in (SOFT, STIFF):
        contact, speed = on_sphere(sphere_material(modulus)), 1.0
        duration = contact.duration(speed)
        exact = solve_ivp(
            lambda _, y, c=contact: (y[1], -c.stiffness * max(y[0], 0.0) ** 1.5 / c.effective_mass),
            (0.0, 0.8 * duration), (0.0, speed), "DOP853",
            rtol=1e-12, atol=1e-15 * contact.largest_overlap(speed),
        ).y[:, -1]  # fmt: skip
        errors = []
        for halving in HALVINGS:
            count = int(20 * halving)
            state = spheres([[0, 0, 0], [2 * RADIUS, 0, 0]], [[0.5 * speed, 0, 0], [-0.5 * speed, 0, 0]])
            final = run(laboratory(contact.first.material), state, 0.8 * duration / count, count).final
            closing = final.velocity[0, 0] - final.velocity[1, 0]
            overlap = 2 * RADIUS - (final.position[1, 0] - final.position[0, 0])
            errors.append(
                max(abs(closing - exact[1]) / speed, abs(overlap - exact[0]) / contact.largest_overlap(speed))
            )
        fraction = 0.8 / (20 * HALVINGS)
        drawn[f"elastic contact, E {modulus:g} Pa|step"] = fraction
        drawn[f"elastic contact, E {modulus:g} Pa|error"] = np.array(errors)
        checks.append(
            Check(
                f"order of the error in an elastic contact, E {modulus:g} Pa", 2.0, _order(fraction, np.array(errors)),
                0.1, "velocity Verlet is of second order (Swope et al. 1982)", 1.0, "order",
            )
        )  # fmt: skip
    for name, e in (("sticking impact, e 1", 1.0), ("sticking impact, e 0.5", 0.5)):
        contact, angle = on_wall(sphere_material(SOFT, e, 0.5)), np.radians(20.0)
        impacts = Impacts.of(contact, np.cos(angle), np.sin(angle))
        spin = impact(contact, np.array([np.sin(angle), -np.cos(angle)])).spin[0]
        errors = []
        for halving in HALVINGS:
            # The mean over phases, because where a step falls on the first touch scatters the error.
            found = [
                collide(impacts, steps_per_contact=25 * halving, phase=phase).first_spin[0]
                for phase in (0.1, 0.3, 0.5, 0.7, 0.9)
            ]
            errors.append(np.abs(np.array(found) / spin - 1.0).mean())
        fraction = 1.0 / (25 * HALVINGS)
        drawn[f"spin, {name}|step"], drawn[f"spin, {name}|error"] = fraction, np.array(errors)
        lowest = _order(fraction, np.array(errors))
        checks.append(
            Check(
                f"order of the spin's error is at least 1, {name}", 0.0, max(0.0, 1.0 - lowest), 0.1,
                f"stick and slip change between steps (found {lowest:.2f})", 1.0, "order",
            )
        )  # fmt: skip
    return Findings(tuple(checks), drawn)


def elastic_energy(scene: Scene, trajectory: Trajectory) -> FloatArray:
    """Kinetic energy and ⅖ K δ^{5/2} of every contact, of elastic equal spheres in a box, ``(F,)`` J."""
    pair, wall = on_sphere(scene.material), on_wall(scene.material)
    energy = 0.5 * (mass_of(trajectory.radius)[:, None] * trajectory.velocity**2).sum(axis=(1, 2))
    for frame, position in enumerate(trajectory.position):
        pairs = cKDTree(position).query_pairs(2.0 * RADIUS, output_type="ndarray")
        overlap = 2.0 * RADIUS - np.linalg.norm(position[pairs[:, 0]] - position[pairs[:, 1]], axis=1)
        energy[frame] += 0.4 * pair.stiffness * (overlap**2.5).sum()
        for plane in scene.walls:
            depth = RADIUS - (position - np.array(plane.point)) @ np.array(plane.normal)
            energy[frame] += 0.4 * wall.stiffness * (np.maximum(depth, 0.0) ** 2.5).sum()
    return energy


def drift() -> Findings:
    """Energy of an elastic gas over 100 s, at t_c/50 and t_c/100, and of a stiff one over as many steps."""
    checks, drawn = [], {}
    for modulus, per_contact in ((SOFT, 50), (SOFT, 100), (STIFF, 50)):
        scene, state = gas(GAS_SIDE, 0, GAS_SPEED, GAS_WIDTH, modulus)
        contact = on_sphere(scene.material)
        phases = np.arange(200) / 200.0
        one = collide(Impacts.of(contact, np.ones(200)), steps_per_contact=per_contact, phase=phases).normal ** 2 - 1.0
        checks.append(
            Check(
                f"energy error of an impact, mean over 200 phases, E {modulus:g} Pa, t_c/{per_contact}",
                0.0, one.mean(), 0.01 / per_contact**2, "no bias, rms 0.15 (Δt/t_c)²", 1.0, "of the energy",
            )
        )  # fmt: skip
        # The fastest impact that the energy of the gas makes likely: two spheres, each at three times the mean.
        quick = contact.duration(6.0 * GAS_SPEED)
        step = quick / per_contact
        soft_step = on_sphere(sphere_material(SOFT)).duration(6.0 * GAS_SPEED) / 50
        time = LONG if modulus == SOFT else LONG * step / soft_step
        stride = round(time / step / 1000)
        trajectory = run(scene, state, step, 1000 * stride, stride).trajectory
        energy = elastic_energy(scene, trajectory)
        change = energy / energy[0] - 1.0
        label = f"E {modulus:g} Pa, {trajectory.time[-1]:.3g} s, {1000 * stride:,} steps of t_c/{per_contact}"
        drawn[f"E {modulus:g} Pa, t_c/{per_contact}|time"] = trajectory.time
        drawn[f"E {modulus:g} Pa, t_c/{per_contact}|change"] = change
        checks.append(
            Check(
                f"largest change of energy, {label}", [0.0], [np.abs(change).max()],
                DRIFT_BOUND / per_contact**2, "bound 3 (Δt/t_c)², a random walk of impact errors", 1.0, "of the energy",
            )
        )  # fmt: skip
    return Findings(tuple(checks), drawn)


CASES = (
    Case("time-reversal", "an elastic smooth gas runs backwards to its start (e = 1, μ = 0)", reversal),
    Case("order", "the error falls with the square of the step", order),
    Case("energy-drift", "an elastic gas keeps its energy for 100 s", drift, quick=False),
)
