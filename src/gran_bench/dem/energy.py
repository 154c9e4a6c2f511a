"""Where the energy goes: work of the walls, losses of the contacts, and spectra of impacts, in joules.

Velocity Verlet obeys, without any error, with K' = K − Δt²/8 Σ F²/m, which follows K and never drifts from it,

    K'_k − K'_{k−1} = ½ (F_{k−1} + F_k) · v_{k−½} Δt

So an elastic force works with the half-step velocity against the mean of its values before and after the step. A
damping force d_k, summed by parts, works with the velocity of the whole step: d_k · v_k Δt, where v_k is the prediction
v_{k−½} + ½ a_{k−1} Δt. With w the approach and s the slip of a contact, a step loses

    damping             (F_n − K δ^{3/2}) w_k Δt: also what a parting contact still holds where attraction is cut off
    tangential damping  −d_t · s_k Δt, where the contact sticks
    sliding             −½ (h_{k−1} + h_k) · s Δt − d_t · s_k Δt − ΔU_t − release, where it is at the Coulomb limit
    release             what the tangential spring gives up as the contact's radius changes, and when the contact ends
    rolling             −½ (M_{k−1} + M_k) · ω_r Δt − d_r · ω_{r,k} Δt − ΔU_r

with the elastic force h turned into the present plane, and the energy of the springs

    U = 2/5 K δ^{5/2} + h² / (16 G* √(R* δ)) + M² / (2 k_r)

The law "rescale/force" makes h fall with the contact's radius and keeps h where the radius grows; both lose part of
U_t, which is `release`. What the terms leave open is `unaccounted`: the error of the step, and with
``dem.slip=full_radius`` the work of a slip that is not the one of the contact point.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gran_bench.dem.contact import ContactForce, ContactLaw, Contacts, sphere_mass
from gran_bench.dem.outlet import taking_part
from gran_bench.dem.rolling import rolling_stiffness
from gran_bench.dem.vectors import cross, dot
from gran_bench.dem.walls import SPIN, surface_velocity
from gran_bench.scene import Scene
from gran_bench.state import ContactHistory, FloatArray, ParticleState

LOSSES = ("damping", "sliding", "tangential_damping", "release", "rolling")
SPECTRA = ("impact", "normal", "shear")  # ½ m* v_n² at first touch; lost by a contact along and across its normal
KINDS = ("", "wall_")  # prefix of what concerns pairs, and of what concerns walls
# Bins of the spectra, five a decade; the first also has all below and what is 0, the last all above.
LOWEST_DECADE, DECADES, BINS_A_DECADE = -15, 20, 5
BINS = DECADES * BINS_A_DECADE
# A contact that sticks is at most so near its limit: what is at the limit was cut to it, and rounded.
AT_LIMIT = 1.0 - 1e-5
# Of a contact's row: lost along and across the normal, J; in its springs of tangent and rolling, J. In the fast engine
# a fourth place has its first body.
LOST_NORMAL, LOST_SHEAR, SPRINGS, OWNER = range(4)
# Of a wall's row: force on the spheres, N, moment about the origin, N m, each times Δt, and work on the spheres, J.
IMPULSE, TWIST, WORK = slice(0, 3), slice(3, 6), 6


def spectrum_edges() -> FloatArray:
    """Edges of the bins of a spectrum, ``(BINS + 1,)`` J."""
    return 10.0 ** (LOWEST_DECADE + np.arange(BINS + 1) / BINS_A_DECADE)


def bins_of(energy: FloatArray) -> np.ndarray:
    """Bin of each energy in J, by its logarithm."""
    with np.errstate(divide="ignore", invalid="ignore"):
        place = np.floor(BINS_A_DECADE * (np.log10(energy) - LOWEST_DECADE))
    return np.clip(np.where(energy > 0.0, place, 0.0), 0, BINS - 1).astype(np.int64)


@dataclass
class Work:
    """What the steps since the last look did."""

    steps: int
    lost: FloatArray  # ``(2, 5)`` J, of pairs and walls by `LOSSES`
    walls: FloatArray  # ``(W, 7)`` see above
    spectra: np.ndarray  # ``(2, 3, BINS)`` int64, number of first touches and of ended contacts

    @classmethod
    def none(cls, walls: int) -> Work:
        """No step yet."""
        return cls(0, np.zeros((2, len(LOSSES))), np.zeros((walls, 7)), np.zeros((2, len(SPECTRA), BINS), np.int64))

    def add(self, other: Work) -> None:
        """Counts in further steps."""
        self.steps += other.steps
        for name in ("lost", "walls", "spectra"):
            getattr(self, name)[...] += getattr(other, name)

    def count(self, kind: int, spectrum: str, energy: FloatArray) -> None:
        """Counts pairs or walls, by the number of their kind, in a spectrum."""
        self.spectra[kind, SPECTRA.index(spectrum)] += np.bincount(bins_of(energy), minlength=BINS)


def followed(history: ContactHistory, power: bool) -> ContactHistory:
    """The history with what its contacts have lost, from now on where it has none; without it where nobody asks."""
    columns = 3 if power else 0
    if history.ledger.shape[1] == columns:
        return history
    return replace(history, ledger=np.zeros((len(history), columns)))


def count_contacts(
    work: Work, contacts: Contacts, force: ContactForce, rolled: tuple[FloatArray, FloatArray] | None,
    before: ContactHistory, spin_gain: FloatArray, radius: FloatArray | None, time_step: float,
) -> FloatArray:  # fmt: skip
    """Counts what touching contacts lose in a step; returns their rows of the ledger, ``(M, 3)`` J.

    Args:
        work, contacts: what is added to; what touches.
        force, rolled: what `contact_force` gave; what `rolling_moment` gave, None where nothing rolls.
        before: what these contacts, row by row, remember of the last step.
        spin_gain: ``(N, 3)`` what spins still gain until the end of the step, rad/s.
        radius: ``(N,)`` m, where slip is measured with full radii; else None.
        time_step: s; 0 counts the springs alone.
    """
    law, wall = ContactLaw.from_constants(contacts.law), contacts.second < 0
    first, second = contacts.first, np.where(wall, 0, contacts.second)
    gain, other_gain = spin_gain[first], np.where(wall[:, None], 0.0, spin_gain[second])
    arm, other_arm = contacts.arm, contacts.other_arm
    if radius is not None:
        arm, other_arm = radius[first], radius[second]
    losses, ledger = np.zeros((len(wall), len(LOSSES))), before.ledger.copy()
    losses[:, :4], ledger[:, SPRINGS] = contact_losses(
        law, force,
        normal=contacts.normal,
        overlap=contacts.overlap,
        effective_radius=contacts.effective_radius,
        velocity=contacts.velocity,
        velocity_gain=contacts.gain,
        surface_spin=contacts.surface_spin,
        surface_spin_gain=arm[:, None] * gain + other_arm[:, None] * other_gain,
        history=before.force,
        overlap_before=before.overlap,
        time_step=time_step,
    )  # fmt: skip
    if rolled is not None:
        moment, kept = rolled
        losses[:, 4], holds = rolling_losses(
            law,
            normal=contacts.normal,
            overlap=contacts.overlap,
            overlap_before=before.overlap,
            effective_radius=contacts.effective_radius,
            spin=contacts.spin,
            spin_gain=gain - other_gain,
            history=before.rolling_moment,
            moment=moment,
            kept=kept,
            time_step=time_step,
        )
        ledger[:, SPRINGS] += holds
    if time_step:
        ledger[:, LOST_NORMAL] += losses[:, 0]
        ledger[:, LOST_SHEAR] += losses[:, 1:4].sum(axis=1)
        approach = np.maximum(0.0, dot(contacts.velocity, contacts.normal))
        impact = 0.5 * contacts.effective_mass * approach**2
        for kind, those in enumerate((~wall, wall)):
            work.lost[kind] += losses[those].sum(axis=0)
            work.count(kind, "impact", impact[those & (before.overlap == 0.0)])
        work.steps += 1
    return ledger


def count_walls(
    work: Work, contacts: Contacts, force: FloatArray, moment: FloatArray | None, point: FloatArray, poses: FloatArray,
    time_step: float,
) -> None:  # fmt: skip
    """Counts what walls do to the spheres that touch them, with force, N, and moment, N m, at points, ``(M, 3)`` m."""
    wall = -1 - contacts.second
    pose, done = poses[wall], np.zeros((len(wall), work.walls.shape[1]))
    done[:, IMPULSE], done[:, TWIST] = force, cross(point, force)
    done[:, WORK] = dot(force, surface_velocity(pose, point))
    if moment is not None:
        done[:, TWIST] += moment
        done[:, WORK] += dot(moment, pose[:, SPIN])
    np.add.at(work.walls, wall, time_step * done)


def count_ended(work: Work, history: ContactHistory, ended: np.ndarray) -> None:
    """Counts the contacts of a history that have ended, by what they have lost."""
    for kind, those in enumerate((history.second >= 0, history.second < 0)):
        rows = history.ledger[ended & those]
        work.lost[kind, LOSSES.index("release")] += rows[:, SPRINGS].sum()
        work.count(kind, "normal", rows[:, LOST_NORMAL])
        work.count(kind, "shear", rows[:, LOST_SHEAR] + rows[:, SPRINGS])


def contact_losses(
    law: ContactLaw, contact: ContactForce, *, normal: FloatArray, overlap: FloatArray, effective_radius: FloatArray,
    velocity: FloatArray, velocity_gain: FloatArray, surface_spin: FloatArray, surface_spin_gain: FloatArray,
    history: FloatArray, overlap_before: FloatArray, time_step: float,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """What M contacts lose in a step, ``(M, 4)`` J by `LOSSES` without rolling, and their U_t after it, ``(M,)`` J.

    Arguments are those of :func:`contact.contact_force`, the ``contact`` that it gave, and ``surface_spin_gain``,
    ``(M, 3)`` m/s, by which Σ lever arm × ω still grows until the end of the step.
    """
    radius = np.sqrt(effective_radius * overlap)
    approach, gain = dot(velocity, normal), dot(velocity_gain, normal)
    load = -dot(contact.force, normal)
    elastic = 4.0 / 3.0 * law.effective_modulus * radius * overlap
    tangential = contact.force + load[:, None] * normal
    slip = velocity - approach[:, None] * normal + cross(surface_spin, normal)
    gained = velocity_gain - gain[:, None] * normal + cross(surface_spin_gain, normal)
    # The old spring, turned into the plane at its own length.
    length = np.linalg.norm(history, axis=1)
    flat = history - dot(history, normal)[:, None] * normal
    inside = np.linalg.norm(flat, axis=1)
    turned = np.divide(length, inside, out=np.zeros_like(length), where=inside > 0)[:, None] * flat

    compliance = 0.5 / (8.0 * law.effective_shear_modulus)  # U = compliance h² / a
    before = np.sqrt(effective_radius * overlap_before)
    stored = np.divide(compliance * length**2, before, out=np.zeros_like(length), where=before > 0)
    kept = compliance * dot(contact.history, contact.history) / radius
    spring = -0.5 * dot(turned + contact.history, slip) * time_step - (kept - stored)
    damped = -dot(tangential - contact.history, slip + gained) * time_step
    ratio = np.divide(overlap, overlap_before, out=np.zeros_like(overlap), where=overlap_before > 0)
    released = stored - compliance * length**2 * np.minimum(1.0, ratio) / radius
    slides = np.linalg.norm(tangential, axis=1) >= AT_LIMIT * law.friction * load
    losses = np.stack(
        (
            (load - elastic) * (approach + gain) * time_step,
            np.where(slides, spring + damped - released, 0.0),
            np.where(slides, 0.0, damped),
            np.where(slides, released, spring),
        ),
        axis=1,
    )
    return losses, kept


def rolling_losses(
    law: ContactLaw, *, normal: FloatArray, overlap: FloatArray, overlap_before: FloatArray,
    effective_radius: FloatArray, spin: FloatArray, spin_gain: FloatArray, history: FloatArray, moment: FloatArray,
    kept: FloatArray, time_step: float,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """What the rolling springs of M contacts lose in a step, and hold after it, ``(M,)`` J each.

    Args:
        spin, spin_gain: ``(M, 3)`` of the first relative to the second, rad/s, and what it gains until the step's end.
        history, moment, kept: ``(M, 3)`` N m: spring before the step, moment on the first, spring after the step.
    """
    old, new = (rolling_stiffness(law.effective_modulus, law.rolling_friction, effective_radius, size)
                for size in (overlap_before, overlap))  # fmt: skip
    rolling = spin - dot(spin, normal)[:, None] * normal
    gained = spin_gain - dot(spin_gain, normal)[:, None] * normal
    stored, holds = (_ratio(0.5 * dot(m, m), k) for m, k in ((history, old), (kept, new)))
    work = -0.5 * dot(history + kept, rolling) - dot(moment - kept, rolling + gained)
    return work * time_step - (holds - stored), holds


def elastic_energy(scene: Scene, state: ParticleState, pair_laws: FloatArray, wall_laws: FloatArray) -> FloatArray:
    """U of all touching contacts of a state along the normal, tangential and of rolling, ``(3,)`` J."""
    history, wall, radius = state.history, state.history.second < 0, state.radius
    first, other = history.first, np.where(wall, 0, history.second)
    law = np.empty((len(first), 5))
    law[~wall] = pair_laws[state.material[first], state.material[other]][~wall]
    if wall.any():
        law[wall] = wall_laws[state.material[first[wall]], -1 - history.second[wall]]
    modulus, shear, _, _, rolling = law.T
    size = np.where(wall, radius[first], radius[first] * radius[other] / (radius[first] + radius[other]))
    contact_radius = np.sqrt(size * history.overlap)
    stiffness = rolling_stiffness(0.75 * modulus, rolling, size, history.overlap)
    parts = (
        0.4 * modulus * contact_radius * history.overlap**2,
        _ratio(dot(history.force, history.force), 2.0 * shear * contact_radius),
        _ratio(dot(history.rolling_moment, history.rolling_moment), 2.0 * stiffness),
    )
    # Pairs and walls apart, as threads would interleave them in orders of their own.
    return np.array([part[~wall].sum() + part[wall].sum() for part in parts])


def energy_figures(
    scene: Scene, state: ParticleState, work: Work, time_step: float, laws: tuple[FloatArray, FloatArray]
) -> dict[str, FloatArray]:
    """What a frame says of energy, by name; powers are means over the steps since the frame before, NaN for the first.

    ====================================  ===================================================================
    potential_energy                      −Σ m g · x of the spheres that take part, J
    discharged_energy                     kinetic and potential, of those that left, J; with an outlet alone
    elastic_normal, _tangential, _rolling  energy of the springs, J
    wall_power, wall_torque               ``(W,)`` W that each wall gives the spheres; N m about the drum's axis,
                                          of the wall on the spheres: P = ω T
    loss_damping … loss_rolling           W, of pairs by `LOSSES`; wall_loss_… of walls
    spectrum_impact …                     ``(BINS,)`` 1/s, of pairs by `SPECTRA`; wall_spectrum_… of walls
    ====================================  ===================================================================
    """
    mass = sphere_mass(np.array([material.density for material in scene.materials])[state.material], state.radius)
    inside = taking_part(scene, state.position)
    weight = mass[:, None] * np.asarray(scene.gravity)
    duration = work.steps * time_step
    rate = 1.0 / duration if duration else np.nan
    height = -np.einsum("nk,nk->n", weight, state.position)  # in J
    found = {"potential_energy": height[inside].sum()}
    if scene.outlet is not None:
        rim = 0.4 * state.radius**2 * dot(state.angular_velocity, state.angular_velocity)
        moving = 0.5 * mass * (dot(state.velocity, state.velocity) + rim)
        found["discharged_energy"] = (moving + height)[~inside].sum()
    found |= zip(("elastic_normal", "elastic_tangential", "elastic_rolling"), elastic_energy(scene, state, *laws),
                 strict=True)  # fmt: skip
    found["wall_power"] = rate * work.walls[:, WORK]
    if scene.drum_radius is not None:
        point = np.asarray(scene.rotation.point)
        about = work.walls[:, TWIST] - np.cross(point, work.walls[:, IMPULSE])
        found["wall_torque"] = rate * about @ np.asarray(scene.rotation.axis)
    for kind, lost, spectra in zip(KINDS, work.lost, work.spectra, strict=True):
        found |= {f"{kind}loss_{name}": rate * value for name, value in zip(LOSSES, lost, strict=True)}
        found |= {f"{kind}spectrum_{name}": rate * counts for name, counts in zip(SPECTRA, spectra, strict=True)}
    return {name: np.asarray(value, np.float64) for name, value in found.items()}


def _ratio(above: FloatArray, below: FloatArray) -> FloatArray:
    return np.divide(above, below, out=np.zeros_like(above), where=below > 0)
