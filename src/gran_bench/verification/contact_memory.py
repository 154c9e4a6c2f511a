"""What a contact remembers: shear–load cycles create no energy, the force turns with the contact, arms end at it.

A sphere so heavy that the contact hardly changes its velocity leads it; that change tells what the contact took.
"""

import math
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise

import numpy as np

from gran_bench.scene import Material
from gran_bench.state import ContactHistory, FloatArray
from gran_bench.verification import laboratory as lab
from gran_bench.verification.case import Case, Check

MINDLIN = "k_t = 8 G* √(R* δ), force scaled by √(δ/δ_before) on unloading, closed form"
LEG_STEPS = 400
HEAVY = 1e12  # kg/m³
ENGINES = ("numba", "numpy")
# Corners of (share of the largest overlap, share of the largest shear).
CYCLES = {
    "shear at high load, back at low load": ((0.25, 0), (1, 0), (1, 1), (0.25, 1), (0.25, 0)),
    "shear at low load, back at high load": ((0.25, 0), (0.25, 1), (1, 1), (1, 0), (0.25, 0)),
    "shear and back at one load": ((1, 0), (1, 0), (1, 1), (1, 0), (1, 0)),
}


def _work_of_cycles(material: Material, overlap: float, shear: float, engine: str) -> FloatArray:
    """Work that each cycle takes from a sphere on a wall, J; negative would be energy from nowhere."""
    cycles = np.array(list(CYCLES.values()), float) * (overlap, shear)  # (cycle, corner, overlap and shear)
    line, mass = 1.0 * np.arange(len(cycles)), lab.mass_of(lab.RADIUS, HEAVY)
    scene, work, history = lab.laboratory(material, (lab.FLOOR,)), np.zeros(len(cycles)), ContactHistory.empty()
    # Slow enough to see the contact's pull on a velocity, fast enough not to be led astray by it.
    duration = 1e-3 * shear * math.sqrt(mass / (material.youngs_modulus * lab.RADIUS * overlap**2))
    for (depth, slid), (deeper, further) in pairwise(cycles.transpose(1, 2, 0)):
        velocity = np.stack((further - slid, np.zeros(len(line)), depth - deeper), axis=1) / duration
        state = lab.spheres(np.stack((slid, line, lab.RADIUS - depth), axis=1), velocity)
        final = lab.run(scene, replace(state, history=history), duration / LEG_STEPS, LEG_STEPS, engine=engine).final
        change = final.velocity - velocity
        work -= mass * ((velocity + 0.5 * change) * change).sum(axis=1)
        history = final.history
    return work


def cycles() -> Iterator[Check]:
    """Work of closed cycles of shear and load against the closed form ½ (k_deep − k_shallow) s²."""
    for modulus, overlap in ((lab.SOFT, 2e-3), (lab.STIFF, 2e-5)):
        material, shear = Material(modulus, 0.3, HEAVY, 1.0, 1e6), 0.05 * overlap
        deep, shallow = lab.on_wall(material).shear_stiffness * np.sqrt([overlap, 0.25 * overlap])
        expected = 0.5 * (deep - shallow) * shear**2 * np.array([1.0, 1.0, 0.0])
        scale = (0.5 * deep * shear**2, "of the shear energy", tuple(CYCLES))
        for engine in ENGINES:
            found, label = _work_of_cycles(material, overlap, shear, engine), f"E {modulus:g} Pa, {engine}"
            yield Check(f"energy that a cycle takes, J, {label}", expected, found, 1e-3, MINDLIN, *scale)
            # The closed path of elastic loads comes back to zero to the rounding of velocities.
            created, name = np.maximum(0.0, -found), f"energy that a cycle creates, J, {label}"
            yield Check(name, np.zeros(3), created, 1e-4, "no source of energy", *scale)


def _turned(force: FloatArray, turns: float, steps: int, engine: str) -> tuple[FloatArray, FloatArray]:
    """Forces ``(M, 3)`` that M contacts, at first with normals along x, keep while pairs turn about y; the normal."""
    count, scene = len(force), lab.laboratory(Material(lab.SOFT, 0.3, 1e18, 1.0, 1e6))
    distance, first = 2.0 * lab.RADIUS - 1e-3, np.arange(count)
    history = ContactHistory(first, first + count, force, np.full(count, 1e-3))
    middle = first[:, None] * np.array([0.0, 1.0, 0.0])
    for step in range(1, steps + 1):
        angle = 2.0 * math.pi * turns * step / steps
        normal = np.array([math.cos(angle), 0.0, math.sin(angle)])
        position = np.concatenate((middle - 0.5 * distance * normal, middle + 0.5 * distance * normal))
        history = lab.run(scene, replace(lab.spheres(position), history=history), 1e-9, 1, engine=engine).final.history
    return history.force, normal


def turning() -> Iterator[Check]:
    """The remembered force of a pair that turns by 7/8 of a circle: its length, and its place in the contact plane."""
    force, turns = np.array([[0.0, 0.0, 2.0], [0.0, 3.0, 0.0], [0.0, 1.0, 1.0]]), 0.875
    at, source = ("in the plane of turning", "along the axis", "between them"), "turns with the contact"
    angle, length = 2.0 * math.pi * turns, np.linalg.norm(force, axis=1)
    tangent = np.array([-math.sin(angle), 0.0, math.cos(angle)])
    for engine in ENGINES:
        found, normal = _turned(force, turns, 140, engine)
        lengths, out, along = np.linalg.norm(found, axis=1), np.abs((found * normal).sum(axis=1)), (found @ tangent)[:2]
        yield Check(f"length of the remembered force, N, {engine}", length, lengths, 1e-12, source, at=at)
        name = f"part out of the contact plane, N, {engine}"
        yield Check(name, np.zeros(3), out, 1e-12, source, length, "of its length", at)
        name = f"part along the turned tangent, N, {engine}"
        yield Check(name, force[:2, 2], along, 1e-12, source, length[:2], "of its length", at[:2])


def lever_arm() -> Iterator[Check]:
    """Angular momentum about the common centre through impacts so soft that a sphere yields by a tenth of its size."""
    angles, material = np.radians(np.arange(10.0, 90.0, 10.0)), lab.sphere_material(1e5, 0.8, 0.5)
    for name, contact in (("equal", lab.on_sphere(material)), ("unequal", lab.on_sphere(material, 0.02, 0.03))):
        impacts = lab.Impacts(contact, 0.8 * np.cos(angles), 0.8 * np.sin(angles), 5.0, -3.0)
        rebounds = lab.collide(impacts, stride=50)
        trajectory, count = rebounds.result.trajectory, len(angles)
        mass = lab.mass_of(trajectory.radius)
        own = (0.4 * mass * trajectory.radius**2)[:, None] * trajectory.angular_velocity
        orbital = mass[:, None] * np.cross(trajectory.position, trajectory.velocity)
        momentum = (own + orbital).reshape(len(own), 2, count, 3).sum(axis=1)
        scale = (np.abs(own) + np.linalg.norm(orbital, axis=-1, keepdims=True)).reshape(len(own), 2, count, 3)
        leak = np.abs(momentum - momentum[0]).max(axis=(0, 2)) / scale[0].sum(axis=0).max(axis=1)
        at, deepest = [f"{angle:g}°" for angle in np.degrees(angles)], rebounds.overlap / contact.first.radius
        quantity = f"angular momentum lost, {name} spheres, overlap up to {deepest:.2f} R"
        yield Check(quantity, np.zeros(count), leak, 1e-12, "conserved", 1.0, "of Σ m|x×v| + I|ω|", at)


CASES = (
    Case("shear-load-cycle", "a cycle of shear and load creates no energy, in either order", cycles),
    Case("turning-contact", "the remembered force turns with the contact and keeps its length", turning),
    Case("lever-arm", "a soft contact leaks no angular momentum", lever_arm),
)
