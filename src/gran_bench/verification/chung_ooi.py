"""The eight benchmark tests of Chung & Ooi (2011), Granular Matter 13, 643–656, with their materials, sizes and speeds.

Parameters are YADE's for tests 1–4 and PySPH's for 5, 7 and 8; test 6 has the metals of 7 on a plane. What is expected
comes from closed forms, and between those from the equations that the solver claims to solve. A rigid plane is a wall
10⁶ times as stiff as the sphere; in test 8 the larger sphere is 1000 times as dense as the smaller one.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from gran_bench.scene import Material
from gran_bench.verification import laboratory as lab
from gran_bench.verification.case import Case, Check, Curves
from gran_bench.verification.impacts import at_angles, curves, expected_rebounds, rebound_checks
from gran_bench.verification.theory import HERTZ, RESTITUTION, SLIDING, Contact, sliding_rebound

FINE = 1000  # steps per contact where peaks are read off the frames
SPINS = np.array([0.175, 0.3, 0.5, 0.9, 1.3, 2.0, 3.0, 4.0, 5.0, 7.0, 9.0, 12.0, 21.0])  # rad/s
ALUMINA = (3.8e11, 0.23, 4000.0)  # E, ν, ρ
# Of tests 6–8, with e = 0.5 and μ = 0.4.
ALUMINIUM = Material(7.0e10, 0.33, 2700.0, 0.5, 0.4)
COPPER = Material(1.2e11, 0.35, 8900.0, 0.5, 0.4)
NYLON = Material(2.5e9, 0.40, 1000.0, 0.5, 0.4)


def _elastic(contacts: dict[str, Contact], approach: float) -> Iterator[Check]:
    """Largest overlap, largest force and duration of elastic head-on impacts."""
    for name, contact in contacts.items():
        rebounds = lab.collide(lab.Impacts(contact, approach), steps_per_contact=FINE, stride=1)
        trajectory, step = rebounds.result.trajectory, rebounds.result.time_step
        kind = "wall_" if contact.second.is_wall else ""
        deepest = trajectory.diagnostics[f"{kind}overlap_max"].max()
        force = contact.first.mass * np.abs(np.diff(trajectory.velocity[:, 0, 2])).max() / step
        touching = np.count_nonzero(trajectory.diagnostics[f"{kind}contact_count"]) * step
        yield Check(f"largest overlap, m, {name}", contact.largest_overlap(approach), deepest, 1e-3, HERTZ)
        yield Check(f"largest force, N, {name}", contact.largest_force(approach), force, 1e-3, HERTZ)
        yield Check(f"duration, s, {name}", contact.duration(approach), touching, 2.0 / FINE, HERTZ)
        yield Check(f"speed after over before, {name}", 1.0, rebounds.normal / approach, 1e-3, RESTITUTION)


def impact_3() -> Iterator[Check]:
    """Normal contact with different coefficients of restitution (2.5 mm radius, 3.9 m/s, rigid plane)."""
    steps = np.array([0.2, 0.4, 0.6, 0.8, 1.0])
    for name, elastic in (("aluminium oxide", ALUMINA), ("cast iron", (1.0e11, 0.25, 7000.0))):
        contacts = [lab.on_rigid_wall(Material(*elastic, float(e), 0.0), 0.0025) for e in steps]
        found = [lab.collide(lab.Impacts(contact, 3.9)).normal[0] / 3.9 for contact in contacts]
        at = [f"e {e:g}" for e in steps]
        yield Check(f"restitution, {name}", steps, found, 1e-3, RESTITUTION, 1.0, "of approach speed", at)


def _rebounds(impacts: lab.Impacts, name: str, at: list[str], rigid: bool = False) -> Iterator[Check]:
    """Against the equations; where the body is rigid and slides throughout, against its closed form too."""
    rebounds, expected = lab.collide(impacts), expected_rebounds(impacts)
    yield from rebound_checks(impacts, rebounds, expected, name, at)
    rows = np.flatnonzero(expected["slid"])
    if rigid and len(rows):
        radius, where = impacts.contact.first.radius, [at[k] for k in rows]
        speed, spin = sliding_rebound(impacts.contact, impacts.normal[rows], impacts.tangential[rows], radius)
        found = rebounds.tangential[rows], rebounds.first_spin[rows]
        yield Check(f"tangential speed after sliding, m/s, {name}", speed, found[0], 0.01, SLIDING, at=where)
        yield Check(f"spin after sliding, rad/s, {name}", spin, found[1], 0.01, SLIDING, at=where)


def impact_4() -> Iterator[Check | Curves]:
    """Oblique impact with a rigid plane at a constant resultant speed (2.5 mm radius, 3.9 m/s, 5–85°)."""
    angles = np.arange(5.0, 90.0, 5.0)
    for name, elastic in (("aluminium oxide", ALUMINA), ("aluminium alloy", (7.0e10, 0.33, 2700.0))):
        contact = lab.on_rigid_wall(Material(*elastic, 0.98, 0.092), 0.0025)
        impacts = at_angles(contact, angles, 3.9)
        yield from _rebounds(impacts, name, [f"{angle:g}°" for angle in angles], rigid=True)
        yield curves(name, impacts, at_angles(contact, np.linspace(0.5, 88.0, 60), 3.9), lab.collide(impacts))


def impact_5() -> Iterator[Check]:
    """Oblique impact with a rigid plane at a constant normal speed (10 µm radius, 5 m/s, 0.1–70 m/s along it)."""
    speeds = np.array([0.1, 0.3, 0.5, 1.0, 2.0, 3.0, 5.0, 7.0, 10.0, 15.0, 20.0, 30.0, 40.0, 50.0, 70.0])
    at = [f"v_t {speed:g} m/s" for speed in speeds]
    # Polyethylene yields by 3 % of its radius, which a rigid body does not.
    for name, elastic in (("steel", (2.08e11, 0.30, 7850.0)), ("polyethylene", (1.0e9, 0.40, 1400.0))):
        impacts = lab.Impacts(lab.on_rigid_wall(Material(*elastic, 1.0, 0.3), 1e-5), 5.0, speeds)
        yield from _rebounds(impacts, name, at, rigid=name == "steel")


def _spinning(contacts: dict[str, Contact], approach: float, both: bool = False) -> Iterator[Check]:
    """Head-on impacts of a sphere that spins, or of two that spin alike."""
    for name, contact in contacts.items():
        impacts = lab.Impacts(contact, approach, 0.0, SPINS, SPINS if both else 0.0)
        yield from _rebounds(impacts, name, [f"ω {spin:g} rad/s" for spin in SPINS])


def impact_7() -> Iterator[Check]:
    """Impact of two identical spheres that spin alike, or oppositely like two gears (0.1 m radius, 0.2 m/s each)."""
    contacts = {"aluminium alloy": lab.on_sphere(ALUMINIUM, 0.1), "copper": lab.on_sphere(COPPER, 0.1)}
    yield from _spinning(contacts, 0.4, both=True)
    at, source = [f"ω ±{spin:g} rad/s" for spin in SPINS], "no slip, so that nothing changes them"
    for name, contact in contacts.items():
        found = lab.collide(lab.Impacts(contact, 0.4, 0.0, SPINS, -SPINS)).first_spin
        yield Check(f"spin after, like gears, rad/s, {name}", SPINS, found, 1e-12, source, at=at)


ALUMINIUM_ALLOY, MAGNESIUM = Material(7.0e10, 0.30, 2699.0, 1.0, 0.0), Material(4.0e10, 0.35, 1800.0, 1.0, 0.0)
GLASS, LIMESTONE = Material(4.8e10, 0.20, 2800.0, 1.0, 0.35), Material(2.0e10, 0.25, 2500.0, 1.0, 0.35)
# What hits what, with radii in m; the speeds of 1, 2, 6, 7 and 8 are the approach, 10 or 0.2 m/s of each body.
PAIRS = {
    1: {"glass": lab.on_sphere(GLASS, 0.01), "limestone": lab.on_sphere(LIMESTONE, 0.01)},
    2: {
        "aluminium alloy": lab.on_rigid_wall(ALUMINIUM_ALLOY, 0.1),
        "magnesium alloy": lab.on_rigid_wall(MAGNESIUM, 0.1),
    },
    6: {"aluminium alloy": lab.on_rigid_wall(ALUMINIUM, 0.1), "copper": lab.on_rigid_wall(COPPER, 0.1)},
    8: {
        "aluminium alloy": lab.on_sphere(ALUMINIUM, 0.1, 0.5, replace(ALUMINIUM, density=1000.0 * ALUMINIUM.density)),
        "nylon": lab.on_sphere(NYLON, 0.1, 0.5, replace(NYLON, density=1000.0 * NYLON.density)),
    },
}
CASES = tuple(
    Case(f"chung-ooi-{number}", f"Chung & Ooi (2011), test {number}: {title}", run)
    for number, title, run in (
        (1, "elastic normal impact of two spheres", lambda: _elastic(PAIRS[1], 20.0)),
        (2, "elastic normal impact on a rigid plane", lambda: _elastic(PAIRS[2], 0.2)),
        (3, "restitution on a rigid plane", impact_3),
        (4, "oblique impact on a rigid plane, one speed", impact_4),
        (5, "oblique impact on a rigid plane, one normal speed", impact_5),
        (6, "spinning sphere on a rigid plane", lambda: _spinning(PAIRS[6], 0.2)),
        (7, "two spinning spheres", impact_7),
        (8, "a spinning sphere on a larger one", lambda: _spinning(PAIRS[8], 0.2)),
    )
)
