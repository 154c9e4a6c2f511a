"""Oblique impacts over 0–85°: what friction, stick and slip make of them, and that they never gain energy."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gran_bench.state import FloatArray
from gran_bench.verification import impact_theory
from gran_bench.verification.case import Case, Check, Findings
from gran_bench.verification.impact_theory import impact
from gran_bench.verification.laboratory import (
    SOFT,
    STIFF,
    Impacts,
    Rebounds,
    collide,
    on_sphere,
    on_wall,
    sphere_material,
)
from gran_bench.verification.theory import Contact, slides_throughout, sliding_rebound

TOLERANCE = 0.01  # at t_c/200
ANGLES = np.arange(0.0, 90.0, 5.0)  # °, between the path and the normal
SPEED = 2.0  # m/s


def expected_rebounds(impacts: Impacts) -> dict[str, FloatArray]:
    """Normal and tangential speed (along z and x) and both spins after each impact, by the equations."""
    found = [
        impact(impacts.contact, (t, -n), (first, second))
        for n, t, first, second in zip(
            impacts.normal, impacts.tangential, impacts.first_spin, impacts.second_spin, strict=True
        )
    ]
    return {
        "normal": np.array([r.velocity[1] for r in found]),
        "tangential": np.array([r.velocity[0] for r in found]),
        "first_spin": np.array([r.spin[0] for r in found]),
        "second_spin": np.array([r.spin[1] for r in found]),
        "slid": np.array([r.slid_throughout for r in found]),
    }


def rebound_checks(
    impacts: Impacts, rebounds: Rebounds, expected: dict[str, FloatArray], label: str, at: Sequence[str]
) -> list[Check]:
    """Normal speed, tangential speed and spins after each impact, each to 1 %; the spins of what the impact gave."""
    rows = [
        (f"normal speed after, m/s, {label}", "normal", rebounds.normal, impacts.normal, "of approach speed"),
        (f"tangential speed after, m/s, {label}", "tangential", rebounds.tangential, None, "of expected"),
    ]
    spins = [("spin", "first_spin")] + ([] if impacts.contact.second.is_wall else [("other's spin", "second_spin")])
    for name, key in spins:
        given = np.abs(expected[key] - getattr(impacts, key))
        rows.append((f"{name} after, rad/s, {label}", key, getattr(rebounds, key), given, "of expected change"))
    return [
        Check(quantity, expected[key], found, TOLERANCE, impact_theory.SOURCE, scale, unit, at)
        for quantity, key, found, scale, unit in rows
    ]


def at_angles(contact: Contact, angles: FloatArray, speed: float = SPEED) -> Impacts:
    """One impact at each angle, all at one resultant speed."""
    radians = np.radians(angles)
    return Impacts.of(contact, speed * np.cos(radians), speed * np.sin(radians))


def curves(impacts: Impacts, fine: Impacts, rebounds: Rebounds) -> dict[str, FloatArray]:
    """Tangential restitution, spin Rω/v and rebound angle of the contact point: found, and expected on a finer grid."""
    radius, line = impacts.contact.first.radius, expected_rebounds(fine)
    drawn = {}
    for name, given, normal, tangential, spin in (
        ("found", impacts, rebounds.normal, rebounds.tangential, rebounds.first_spin),
        ("expected", fine, line["normal"], line["tangential"], line["first_spin"]),
    ):
        with np.errstate(invalid="ignore"):
            drawn[f"{name}_angle_deg"] = np.degrees(np.arctan2(given.tangential, given.normal))
            drawn[f"{name}_tangential_restitution"] = tangential / given.tangential
        drawn[f"{name}_spin"] = radius * spin / np.hypot(given.normal, given.tangential)
        drawn[f"{name}_rebound_angle_deg"] = np.degrees(np.arctan2(tangential - _turned_by(impacts) * spin, normal))
    slides = slides_throughout(impacts.contact, fine.normal, fine.tangential)
    tangential, spin = sliding_rebound(impacts.contact, fine.normal, fine.tangential, radius)
    drawn["sliding_tangential_restitution"] = np.where(slides, tangential / fine.tangential, np.nan)
    drawn["sliding_spin"] = np.where(slides, radius * spin / np.hypot(fine.normal, fine.tangential), np.nan)
    return drawn


def _turned_by(impacts: Impacts) -> float:
    """Slip that a unit of the first one's spin takes away, m: R on a wall, 2R where an equal sphere spins alike."""
    return impacts.contact.first.radius * (1.0 if impacts.contact.second.is_wall else 2.0)


def all_angles() -> Findings:
    """Soft and stiff spheres on walls and on each other at 0–85°."""
    checks, drawn = [], {}
    at = [f"{angle:g}°" for angle in ANGLES]
    for modulus in (SOFT, STIFF):
        for e in (1.0, 0.5):
            material = sphere_material(modulus, e, friction=0.3)
            for name, contact in (("wall", on_wall(material)), ("sphere", on_sphere(material))):
                impacts = at_angles(contact, ANGLES)
                rebounds = collide(impacts)
                label = f"on a {name}, E {modulus:g} Pa, e {e:g}, μ 0.3"
                checks += rebound_checks(impacts, rebounds, expected_rebounds(impacts), label, at)
                if name == "wall" and (modulus, e) in ((SOFT, 0.5), (STIFF, 1.0)):
                    fine = at_angles(contact, np.linspace(0.5, 88.0, 60))
                    key = f"{name} E {modulus:g} e {e:g} mu 0.3"
                    drawn |= {f"{key}|{n}": v for n, v in curves(impacts, fine, rebounds).items()}
    return Findings(tuple(checks), drawn)


def never_gains() -> Findings:
    """Kinetic energy after over before of impacts at 1–89°, the grazing one at 76° with μ = 0.5 among them."""
    checks, angles = [], np.arange(1.0, 90.0)
    at = [f"{angle:g}°" for angle in angles]
    for modulus in (SOFT, STIFF):
        for e in (1.0, 0.5):
            material = sphere_material(modulus, e, friction=0.5)
            for name, contact in (("wall", on_wall(material)), ("sphere", on_sphere(material))):
                impacts = at_angles(contact, angles)
                gain = np.maximum(0.0, collide(impacts).energy - 1.0)
                label = f"energy gained, on a {name}, E {modulus:g} Pa, e {e:g}, μ 0.5"
                zero = np.zeros(len(gain))
                checks.append(Check(label, zero, gain, 1e-12, "no source of energy", 1.0, "of energy before", at))
    return Findings(tuple(checks))


CASES = (
    Case("oblique", "oblique impacts at 0–85° rebound as the equations say", all_angles),
    Case("grazing", "an oblique impact never gains energy (76°, μ = 0.5 among them)", never_gains),
)
