"""What the step does: time runs backwards, errors fall with its square, and an elastic gas keeps its energy."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from scipy.integrate import solve_ivp
from scipy.spatial import cKDTree

from gran_bench.scene import Plane, Scene
from gran_bench.state import ContactHistory, FloatArray, ParticleState, Trajectory
from gran_bench.verification import laboratory as lab
from gran_bench.verification.case import Case, Check, Curves
from gran_bench.verification.theory import impact

HALVINGS = 2.0 ** np.arange(6)
# Verlet errs in the energy of one elastic impact by 0.15 (Δt/t_c)² rms over the phases of the step, and on average by
# nothing. The 3·10⁴ impacts of 27 spheres in 100 s each hold a 27th of the energy or so, and their errors add up like a
# random walk, to (Δt/t_c)². The bound is three times that.
DRIFT_BOUND = 3.0  # (Δt/t_c)², of the energy
GAS_SPEED, GAS_WIDTH, GAS_SIDE = 0.5, 0.25, 3  # m/s, m, spheres along an edge
LONG = 100.0  # s
PHASES = (0.1, 0.3, 0.5, 0.7, 0.9)  # of a step, when an impact begins


def gas(seed: int, modulus: float) -> tuple[Scene, ParticleState]:
    """27 elastic smooth spheres (E in Pa; velocities of a seed) in a box of such walls, without gravity."""
    walls = tuple(
        Plane(tuple(sign * 0.5 * GAS_WIDTH * axis), tuple(-sign * axis), turns=False)
        for axis in np.eye(3)
        for sign in (-1.0, 1.0)
    )
    line = (np.arange(GAS_SIDE) - 0.5 * (GAS_SIDE - 1)) * GAS_WIDTH / GAS_SIDE
    grid = np.stack(np.meshgrid(line, line, line, indexing="ij"), axis=-1).reshape(-1, 3)
    velocity = np.random.default_rng(seed).normal(0.0, GAS_SPEED, grid.shape)
    return lab.laboratory(lab.sphere_material(modulus), walls), lab.spheres(grid, velocity)


def quick_impact(modulus: float) -> float:
    """Contact time of the fastest impact that the gas makes likely: two spheres, each at three times the mean, s."""
    return lab.on_sphere(lab.sphere_material(modulus)).duration(6.0 * GAS_SPEED)


def elastic_energy(scene: Scene, trajectory: Trajectory) -> FloatArray:
    """Kinetic energy and ⅖ K δ^{5/2} of every contact, of elastic equal spheres in a box, ``(F,)`` J."""
    pair, wall = lab.on_sphere(scene.material), lab.on_wall(scene.material)
    energy = 0.5 * (lab.mass_of(trajectory.radius)[:, None] * trajectory.velocity**2).sum(axis=(1, 2))
    for frame, position in enumerate(trajectory.position):
        pairs = cKDTree(position).query_pairs(2.0 * lab.RADIUS, output_type="ndarray")
        overlap = 2.0 * lab.RADIUS - np.linalg.norm(position[pairs[:, 0]] - position[pairs[:, 1]], axis=1)
        energy[frame] += 0.4 * pair.stiffness * (overlap**2.5).sum()
        for plane in scene.walls:
            depth = lab.RADIUS - (position - np.array(plane.point)) @ np.array(plane.normal)
            energy[frame] += 0.4 * wall.stiffness * (np.maximum(depth, 0.0) ** 2.5).sum()
    return energy


def reversal() -> Iterator[Check]:
    """Elastic smooth spheres run for a time, turn round, and come back to where they started."""
    for modulus, step in ((lab.SOFT, 1e-4), (lab.STIFF, 2e-6)):
        scene, state = gas(1, modulus)
        steps = round(0.3 / step)
        there = lab.run(scene, state, step, steps, steps // 100)
        seen = there.trajectory.diagnostics
        back = replace(there.final, velocity=-there.final.velocity, time=0.0, history=ContactHistory.empty())
        final = lab.run(scene, back, step, steps).final
        touched = np.count_nonzero(seen["contact_count"] + seen["wall_contact_count"])
        label, source = f"E {modulus:g} Pa, {touched} of 101 frames in touch", "Verlet is reversible"
        off, wrong = np.abs(final.position - state.position).max(), np.abs(final.velocity + state.velocity).max()
        went = np.abs(there.final.position - state.position).max()
        yield Check(f"way back missed, m, of {went:.2g} m, {label}", 0.0, off, 1e-9, source, 1.0, "m")
        yield Check(f"velocity missed, m/s, {label}", 0.0, wrong, 1e-9, source, 1.0, "m/s")


def _order(steps: FloatArray, error: FloatArray) -> float:
    """Slope of log error over log step by least squares."""
    return float(np.polyfit(np.log(steps), np.log(error), 1)[0])


def order() -> Iterator[Check | Curves]:
    """Error against the step, each time from a start at touch, and its order."""
    for modulus in (lab.SOFT, lab.STIFF):
        contact, speed = lab.on_sphere(lab.sphere_material(modulus)), 1.0
        duration, deepest = contact.duration(speed), contact.largest_overlap(speed)
        exact = solve_ivp(
            lambda _, y, c=contact: (y[1], -c.stiffness * max(y[0], 0.0) ** 1.5 / c.effective_mass),
            (0.0, 0.8 * duration), (0.0, speed), "DOP853", rtol=1e-12, atol=1e-15 * deepest,
        ).y[:, -1]  # fmt: skip
        errors = []
        for count in (20 * HALVINGS).astype(int).tolist():
            state = lab.spheres([[0, 0, 0], [2 * lab.RADIUS, 0, 0]], [[0.5 * speed, 0, 0], [-0.5 * speed, 0, 0]])
            final = lab.run(lab.laboratory(contact.first.material), state, 0.8 * duration / count, count).final
            closing = final.velocity[0, 0] - final.velocity[1, 0]
            overlap = 2 * lab.RADIUS - (final.position[1, 0] - final.position[0, 0])
            errors.append(max(abs(closing - exact[1]) / speed, abs(overlap - exact[0]) / deepest))
        name, fraction = f"elastic contact, E {modulus:g} Pa", 0.8 / (20 * HALVINGS)
        yield {f"{name}|step": fraction, f"{name}|error": np.array(errors)}
        yield Check(
            f"order of the error in an {name}", 2.0, _order(fraction, np.array(errors)), 0.1,
            "velocity Verlet is of second order (Swope et al. 1982)", 1.0, "order",
        )  # fmt: skip
    for e in (1.0, 0.5):
        contact, angle = lab.on_wall(lab.sphere_material(lab.SOFT, e, 0.5)), np.radians(20.0)
        impacts = lab.Impacts(contact, np.cos(angle), np.sin(angle))
        spin = impact(contact, np.array([np.sin(angle), -np.cos(angle)])).spin[0]
        # The mean over phases, because where a step falls on the first touch scatters the error.
        found = np.array([
            [lab.collide(impacts, steps_per_contact=25 * k, phase=phase).first_spin[0] for phase in PHASES]
            for k in HALVINGS
        ])  # fmt: skip
        errors, fraction = np.abs(found / spin - 1.0).mean(axis=1), 1.0 / (25 * HALVINGS)
        yield {f"spin, sticking impact, e {e:g}|step": fraction, f"spin, sticking impact, e {e:g}|error": errors}
        lowest = _order(fraction, errors)
        yield Check(
            f"order of the spin's error is at least 1, sticking impact, e {e:g}", 0.0, max(0.0, 1.0 - lowest), 0.1,
            f"stick and slip change between steps (found {lowest:.2f})", 1.0, "order",
        )  # fmt: skip


def drift() -> Iterator[Check | Curves]:
    """Energy of an elastic gas over 100 s, at t_c/50 and t_c/100, and of a stiff one over as many steps."""
    for modulus, per_contact in ((lab.SOFT, 50), (lab.SOFT, 100), (lab.STIFF, 50)):
        scene, state = gas(0, modulus)
        impacts, name = lab.Impacts(lab.on_sphere(scene.material), np.ones(200)), f"E {modulus:g} Pa, t_c/{per_contact}"
        one = lab.collide(impacts, steps_per_contact=per_contact, phase=np.arange(200) / 200.0).normal ** 2 - 1.0
        yield Check(
            f"energy error of an impact, mean over 200 phases, {name}", 0.0, one.mean(), 0.01 / per_contact**2,
            "no bias, rms 0.15 (Δt/t_c)²", 1.0, "of the energy",
        )  # fmt: skip
        step = quick_impact(modulus) / per_contact
        time = LONG if modulus == lab.SOFT else LONG * step / (quick_impact(lab.SOFT) / 50)
        stride = round(time / step / 1000)
        trajectory = lab.run(scene, state, step, 1000 * stride, stride).trajectory
        energy = elastic_energy(scene, trajectory)
        change = energy / energy[0] - 1.0
        yield {f"{name}|time": trajectory.time, f"{name}|change": change}
        label = f"E {modulus:g} Pa, {trajectory.time[-1]:.3g} s, {1000 * stride:,} steps of t_c/{per_contact}"
        yield Check(
            f"largest change of energy, {label}", 0.0, np.abs(change).max(), DRIFT_BOUND / per_contact**2,
            "bound 3 (Δt/t_c)², a random walk of impact errors", 1.0, "of the energy",
        )  # fmt: skip


CASES = (
    Case("time-reversal", "an elastic smooth gas runs backwards to its start (e = 1, μ = 0)", reversal),
    Case("order", "the error falls with the square of the step", order),
    Case("energy-drift", "an elastic gas keeps its energy for 100 s", drift, quick=False),
)
