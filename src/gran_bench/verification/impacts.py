"""Impacts head-on and at 0–89°: restitution, what friction, stick and slip make of them, and no energy gained."""

from collections.abc import Callable, Iterator, Sequence
from itertools import product

import numpy as np

from gran_bench.state import FloatArray
from gran_bench.verification import laboratory as lab
from gran_bench.verification.case import Case, Check, Curves
from gran_bench.verification.theory import EQUATIONS, RESTITUTION, Contact, impact, slides_throughout, sliding_rebound

SET = (0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 1.0)  # e
SPEEDS = (0.01, 1.0, 5.0)  # m/s
PHASES = np.array([0.0, 0.25, 0.5, 0.75, 0.99])  # of a step, between the last state apart and the first touch
ANGLES = np.arange(0.0, 90.0, 5.0)  # °, between the path and the normal
SPEED = 2.0  # m/s
BODIES: dict[str, Callable[..., Contact]] = {
    "two equal spheres": lab.on_sphere,
    "two unequal spheres (10 and 50 mm)": lambda material: lab.on_sphere(material, 0.01, 0.05),
    "sphere on a wall": lab.on_wall,
    "sphere on a rigid wall": lab.on_rigid_wall,
}


def restitution() -> Iterator[Check]:
    """Restitution of every pair of bodies over e, speed, stiffness and phase."""
    for name, bodies in BODIES.items():
        expected, found, at = [], [], []
        for modulus, e in product((lab.SOFT, lab.STIFF), SET):
            contact = bodies(lab.sphere_material(modulus, e))
            for speed in SPEEDS:
                rebounds = lab.collide(lab.Impacts(contact, np.full(len(PHASES), speed)), phase=PHASES)
                expected += [e] * len(PHASES)
                found += list(rebounds.normal / speed)
                at += [f"E {modulus:g} Pa, e {e:g}, {speed:g} m/s, phase {phase:g}" for phase in PHASES]
        yield Check(f"restitution, {name}", expected, found, 1e-3, RESTITUTION, 1.0, "of approach speed", at)


def at_angles(contact: Contact, angles_deg: FloatArray, speed: float = SPEED) -> lab.Impacts:
    """One impact at each angle from the normal, all at one resultant speed."""
    radians = np.radians(angles_deg)
    return lab.Impacts(contact, speed * np.cos(radians), speed * np.sin(radians))


def expected_rebounds(impacts: lab.Impacts) -> dict[str, FloatArray]:
    """Normal and tangential speed (along z and x) and both spins after each impact, by the equations."""
    rows = zip(impacts.normal, impacts.tangential, impacts.first_spin, impacts.second_spin, strict=True)
    found = [impact(impacts.contact, (t, -n), (first, second)) for n, t, first, second in rows]
    names = ("tangential", "normal", "first_spin", "second_spin", "slid")
    columns = zip(*((*r.velocity, *r.spin, r.slid_throughout) for r in found), strict=True)
    return {name: np.array(values) for name, values in zip(names, columns, strict=True)}


def rebound_checks(
    impacts: lab.Impacts, rebounds: lab.Rebounds, expected: dict[str, FloatArray], label: str, at: Sequence[str]
) -> Iterator[Check]:
    """Normal speed, tangential speed and spins after each impact, each to 1 %; the spins of what the impact gave."""
    rows = [("normal speed after, m/s", "normal", impacts.normal, "of approach speed")]
    rows += [("tangential speed after, m/s", "tangential", None, "of expected")]
    spins = {"first_spin": "spin"} | ({} if impacts.contact.second.is_wall else {"second_spin": "other's spin"})
    for key, name in spins.items():
        given = np.abs(expected[key] - getattr(impacts, key))
        rows.append((f"{name} after, rad/s", key, given, "of expected change"))
    for quantity, key, scale, unit in rows:
        found = getattr(rebounds, key)
        yield Check(f"{quantity}, {label}", expected[key], found, 0.01, EQUATIONS, scale, unit, at)


def curves(name: str, impacts: lab.Impacts, fine: lab.Impacts, rebounds: lab.Rebounds) -> Curves:
    """Tangential restitution, spin Rω/v and rebound angle of the contact point: found, and expected on a finer grid."""
    radius, line = impacts.contact.first.radius, expected_rebounds(fine)
    drawn = {}
    for kind, given, normal, tangential, spin in (
        ("found", impacts, rebounds.normal, rebounds.tangential, rebounds.first_spin),
        ("expected", fine, line["normal"], line["tangential"], line["first_spin"]),
    ):
        with np.errstate(invalid="ignore"):
            drawn[f"{kind}_angle_deg"] = np.degrees(np.arctan2(given.tangential, given.normal))
            drawn[f"{kind}_tangential_restitution"] = tangential / given.tangential
        drawn[f"{kind}_spin"] = radius * spin / np.hypot(given.normal, given.tangential)
        drawn[f"{kind}_rebound_angle_deg"] = np.degrees(np.arctan2(tangential - radius * spin, normal))
    slides = slides_throughout(impacts.contact, fine.normal, fine.tangential)
    tangential, spin = sliding_rebound(impacts.contact, fine.normal, fine.tangential, radius)
    drawn["sliding_tangential_restitution"] = np.where(slides, tangential / fine.tangential, np.nan)
    drawn["sliding_spin"] = np.where(slides, radius * spin / np.hypot(fine.normal, fine.tangential), np.nan)
    return {f"{name}|{key}": values for key, values in drawn.items()}


def _contacts(friction: float) -> Iterator[tuple[str, str, Contact]]:
    """Soft and stiff spheres, elastic and not, on walls and on each other: where, a label, the contact."""
    bodies = {"wall": lab.on_wall, "sphere": lab.on_sphere}
    for modulus, e, name in product((lab.SOFT, lab.STIFF), (1.0, 0.5), bodies):
        contact = bodies[name](lab.sphere_material(modulus, e, friction))
        words = f"on a {name}, E {modulus:g} Pa, e {e:g}, μ {friction:g}"
        yield f"{name} E {modulus:g} e {e:g} mu {friction:g}", words, contact


def all_angles() -> Iterator[Check | Curves]:
    """Soft and stiff spheres on walls and on each other at 0–85°."""
    for name, label, contact in _contacts(0.3):
        impacts = at_angles(contact, ANGLES)
        rebounds = lab.collide(impacts)
        yield from rebound_checks(impacts, rebounds, expected_rebounds(impacts), label, [f"{a:g}°" for a in ANGLES])
        if name in ("wall E 1e+07 e 0.5 mu 0.3", "wall E 7e+10 e 1 mu 0.3"):
            yield curves(name, impacts, at_angles(contact, np.linspace(0.5, 88.0, 60)), rebounds)


def never_gains() -> Iterator[Check]:
    """Kinetic energy after over before of impacts at 1–89°, the grazing one at 76° with μ = 0.5 among them."""
    angles = np.arange(1.0, 90.0)
    for _, label, contact in _contacts(0.5):
        gain = np.maximum(0.0, lab.collide(at_angles(contact, angles)).energy - 1.0)
        at, source = [f"{angle:g}°" for angle in angles], "no source of energy"
        yield Check(f"energy gained, {label}", np.zeros(89), gain, 1e-12, source, 1.0, "of energy before", at)


CASES = (
    Case("head-on", "the restitution of a head-on impact is the one that was set", restitution),
    Case("oblique", "oblique impacts at 0–85° rebound as the equations say", all_angles),
    Case("grazing", "an oblique impact never gains energy (76°, μ = 0.5 among them)", never_gains),
)
