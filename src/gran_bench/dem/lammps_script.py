"""What LAMMPS `granular` is told of a scene: law, walls, gravity, and what of a scene it has not.

The law is hertz, ``mindlin_rescale/force`` and ``coeff_restitution`` with ``limit_damping``. That is the law of
contact.py with ``dem.slip=full_radius``: the forces of a state agree to rounding. Three points remain that LAMMPS has
no setting for. Damping takes half-step velocities, which costs restitution a term of first order in the step. What a
sliding contact remembers is the limit less the damping, not a share of both. Between unequal spheres the arms of the
torque are R − δ/2; ours end on the plane in which the spheres intersect.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from gran_bench.dem.integrate import Physics, pair_law, wall_law
from gran_bench.dem.walls import CYLINDER, DIRECTION, KIND, POINT
from gran_bench.scene import Cylinder, Plane, Rotation, Scene, SceneError
from gran_bench.scene.walls import turns_into_itself
from gran_bench.state import FloatArray

OURS = "mindlin_rescale/force"


def given_restitution(damping: float) -> float:
    """The number that LAMMPS makes a damping α of, α = −√5 ln e/√(π² + ln² e); it is e where contacts may attract.

    Raises:
        SceneError: a damping of √5 or more, which no number gives.
    """
    share = damping / math.sqrt(5.0)
    if share >= 1.0:
        raise SceneError(
            f"scene.material.restitution needs a damping of {damping:.3g}, and LAMMPS has less than √5; "
            "choose a larger restitution, or dem.engine=numba"
        )
    return math.exp(-math.pi * share / math.sqrt(1.0 - share**2))


def contact_words(constants: Sequence[float], tangential: str = OURS, restitution: float | None = None) -> str:
    """A contact law (4/3 E*, 8 G*, α, μ, μ_r) as LAMMPS says it; with a restitution, contacts that part may attract."""
    normal, shear, damping, friction, _ = map(float, constants)
    number, cut = (given_restitution(damping), " limit_damping") if restitution is None else (restitution, "")
    return (
        f"hertz {normal!r} {number!r} tangential {tangential} {shear!r} 1.0 {friction!r} damping coeff_restitution{cut}"
    )


def opening(physics: Physics, lower: FloatArray, upper: FloatArray, processors: str = "* * *") -> list[str]:
    """Commands that precede the spheres, in a box around them that grows with them."""
    sides = [f"{low!r} {high!r}" for low, high in zip(map(float, lower), map(float, upper), strict=True)]
    return [
        "units si", "atom_style sphere", "atom_modify map array", "newton off", f"processors {processors}",
        f"boundary s {'p' if physics.period else 's'} s", f"region box block {' '.join(sides)}",
        f"create_box {len(physics.pair_laws)} box",
        "reset_timestep 1",  # at 0 no wall moves
    ]  # fmt: skip


def curvature(pose: FloatArray, radius: FloatArray | float) -> FloatArray | float:
    """LAMMPS' R* of spheres of a radius, m, in a wall over the radius: it counts the bend of a cylinder, we don't."""
    return 1.0 / (1.0 - radius / (2.0 * pose[7])) if pose[KIND] == CYLINDER else 1.0


def acting(
    physics: Physics, time_step: float, poses: FloatArray, turning: Mapping[int, Rotation], radius: float = 0.0,
    tangential: str = OURS, restitution: float | None = None,
) -> list[str]:  # fmt: skip
    """Commands that follow the spheres: contacts, gravity, walls at poses ``(W, 22)``, and who of them turns.

    Wall w turns by the variable ``angle<w>``, rad, which must be there. For spheres of this radius, m, its stiffness
    makes up for :func:`curvature`; 0 leaves LAMMPS' own.
    """
    kinds = range(len(physics.pair_laws))

    def words(law: FloatArray) -> str:
        return contact_words(law, tangential, restitution)

    commands = ["comm_modify vel yes", f"neighbor {physics.skin!r} bin", "neigh_modify delay 0 every 1 check yes"]
    commands += [f"timestep {time_step!r}", "thermo 1000000000", "thermo_style custom step", "pair_style granular"]
    commands += [f"pair_coeff {a + 1} {b + 1} {words(physics.pair_laws[a, b])}" for a in kinds for b in kinds if a <= b]
    commands += [f"group kind{kind} type {kind + 1}" for kind in kinds]
    if strength := float(np.linalg.norm(physics.gravity)):
        way = " ".join(repr(float(part)) for part in physics.gravity / strength)
        commands.append(f"fix gravity all gravity {strength!r} vector {way}")
    commands.append("fix move all nve/sphere")
    for w, pose in enumerate(poses):
        point, direction = (tuple(map(float, pose[part])) for part in (POINT, DIRECTION))
        shape = f"plane {_row(point)} {_row(direction)}"
        if pose[KIND] == CYLINDER:
            along = int(np.argmax(np.abs(direction)))
            middle = _row(p for k, p in enumerate(point) if k != along)
            shape = f"cylinder {'xyz'[along]} {middle} {float(pose[7])!r} INF INF"
        turn = turning.get(w)
        rotates = "" if turn is None else f" rotate v_angle{w} {_row(turn.point)} {_row(turn.axis)}"
        commands.append(f"region wall{w} {shape} side in{rotates}")
        for kind in kinds:
            law = np.array(physics.wall_laws[kind, w])
            law[:2] /= np.sqrt(curvature(pose, radius))
            commands.append(f"fix wall{w}_{kind} kind{kind} wall/gran/region granular {words(law)} region wall{w}")
    return commands


def check_scene(scene: Scene) -> None:
    """Refuses, by name, what LAMMPS has not.

    Raises:
        SceneError: names the wall or the key, and the remedy.
    """
    remedy = "choose dem.engine=numba"
    for index, wall in enumerate(scene.walls):
        motion, name = scene.motion_of(wall), f"wall {index} ({type(wall).__name__.lower()})"
        if not wall.contains or not isinstance(wall, Plane | Cylinder):
            raise SceneError(f"{name} is thin, with two sides, and LAMMPS has none that answers so; {remedy}")
        if isinstance(wall, Cylinder) and sorted(map(abs, wall.axis)) != [0.0, 0.0, 1.0]:
            raise SceneError(f"{name} has its axis along {wall.axis}, and LAMMPS has x, y and z alone; {remedy}")
        if wall.opens is not None:
            raise SceneError(f"{name} opens at {wall.opens:g} s, and a wall of LAMMPS stays; {remedy}")
        turns = isinstance(motion, Rotation) and turns_into_itself(wall, motion.axis, motion.point)
        if motion is not None and not turns:
            raise SceneError(f"{name} moves otherwise than by turning into itself, which is not handed on; {remedy}")
        if scene.surfaces[index]:
            raise SceneError(f"{name} is a piece of a surface, whose seam LAMMPS would answer twice; {remedy}")
    if scene.outlet is not None:
        raise SceneError(f"the scene {scene.name!r} has an outlet, and in LAMMPS nobody leaves; {remedy}")
    if scene.needs.rolling:
        raise SceneError(f"scene.material.rolling_friction > 0, and LAMMPS' law of rolling is another; {remedy}, or 0")
    kinds = range(len(scene.materials))
    laws = [pair_law(scene, a, b) for a in kinds for b in kinds] + [wall_law(scene, a) for a in kinds if scene.walls]
    for law in laws:
        given_restitution(law.damping)


def _row(numbers: Iterable[float]) -> str:
    return " ".join(repr(float(number)) for number in numbers)
