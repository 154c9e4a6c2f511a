"""What must hold before the first step; each refusal names the particles and the remedy."""

from __future__ import annotations

import numpy as np

from gran_bench.dem.outlet import part_of, taking_part
from gran_bench.dem.walls import largest_excess, wall_contact, wall_poses
from gran_bench.neighbors import nearest_image, tree_pairs
from gran_bench.scene import Scene
from gran_bench.state import ParticleState, StateError, name_some

# Of the mean diameter of a pair, of the diameter at a wall: Hertz's law is for less, and the stored energy explodes.
LARGEST_INITIAL_OVERLAP = 0.2
STIFFEN = "its own weight crushes the bed: raise scene.material.youngs_modulus"


def check_initial_state(scene: Scene, state: ParticleState, remedy: str | None = None) -> None:
    """Refuses a state that cannot be simulated. Spheres that have left through an outlet are not looked at.

    The remedy against overlaps is to move the particles, where it is None.

    Raises:
        StateError: duplicates, pairs or walls overlapping by 20 % of the mean diameter (of the diameter for a wall)
            or more, a centre outside the container, a material or a contact that the scene does not have.
    """
    unknown = np.flatnonzero(state.material >= len(scene.materials))
    if len(unknown):
        raise StateError(
            f"{name_some(unknown, 'is', 'are')} of a material that the scene does not have (it has "
            f"{len(scene.materials)}); describe it or choose another material"
        )
    inside = taking_part(scene, state.position)
    number = np.arange(state.count) if inside is None else np.flatnonzero(inside)
    if len(number):
        here = state if inside is None else part_of(state, inside)
        _check_overlaps(scene, here, number, remedy or "move them apart before the run")
        _check_walls(scene, here, number, remedy or "move them inside before the run")
    history = state.history
    known = (history.first >= 0) & (history.first < state.count)
    known &= (history.second < state.count) & (history.second >= -len(scene.walls))
    if not known.all():
        raise StateError(
            f"the contact history names {np.count_nonzero(~known)} contacts whose particles or walls this scene "
            "does not have; run the state in its own scene, or with ContactHistory.empty()"
        )
    finite = np.isfinite(np.column_stack((history.force, history.overlap, history.rolling_moment))).all(axis=1)
    if not finite.all():
        raise StateError(
            f"the contact history is not finite for {np.count_nonzero(~finite)} contacts; repair it, or run the "
            "state with ContactHistory.empty()"
        )


def check_initial_speed(state: ParticleState, time_step: float) -> None:
    """Refuses particles that cross a quarter of the smallest radius in one step.

    Raises:
        StateError: names them, the fastest allowed speed and the largest step for what they do.
    """
    quarter, speed = 0.25 * float(state.radius.min(initial=np.inf)), np.linalg.norm(state.velocity, axis=1)
    wild = np.flatnonzero(~(speed * time_step <= quarter))
    if len(wild):
        raise StateError(
            f"{name_some(wild, 'crosses', 'cross')} more than a quarter of the smallest radius in one step of "
            f"{time_step:g} s (particle {wild[0]} at {speed[wild[0]]:.3g} m/s); start with less than "
            f"{quarter / time_step:.3g} m/s, or set dem.time_step to at most {quarter / speed.max():.3g} s"
        )


def closing_speed(state: ParticleState) -> float:
    """A bound of how fast two spheres can close in, or one on a wall at rest, m/s; exact for two, and for one."""
    if state.count == 0:
        return 0.0
    velocity = np.asarray(state.velocity, np.float64)
    apart = 2.0 * np.linalg.norm(velocity - velocity.mean(axis=0), axis=1).max()
    apart = min(apart, np.linalg.norm(np.ptp(velocity, axis=0)))
    return float(max(apart, np.linalg.norm(velocity, axis=1).max()))


def _check_overlaps(scene: Scene, state: ParticleState, number: np.ndarray, remedy: str) -> None:
    pairs = tree_pairs(state.position, 2.0 * float(state.radius.max()), scene.period)
    offset = nearest_image(state.position[pairs[:, 1]] - state.position[pairs[:, 0]], scene.period)
    distance = np.linalg.norm(offset, axis=1)
    same = number[pairs[distance == 0.0]]
    if len(same):
        raise StateError(f"particles {_name_pairs(same)} have the same position; remove the duplicates before the run")
    reach = state.radius[pairs[:, 0]] + state.radius[pairs[:, 1]]
    squeezed = number[pairs[reach - distance >= LARGEST_INITIAL_OVERLAP * reach]]
    if len(squeezed):
        raise StateError(
            f"particles {_name_pairs(squeezed)} overlap by {LARGEST_INITIAL_OVERLAP:.0%} of their mean diameter "
            f"or more; {remedy}"
        )


def _check_walls(scene: Scene, state: ParticleState, number: np.ndarray, remedy: str) -> None:
    poses = wall_poses(scene, state.time, 0.0, 0)[0]
    outside = number[largest_excess(scene, poses, state.position) > 0]
    if len(outside):
        raise StateError(f"{name_some(outside, 'has its centre', 'have their centre')} outside the container; {remedy}")
    for index, pose in enumerate(poses):
        overlap = state.radius - wall_contact(pose, state.position)[0]
        squeezed = number[overlap >= LARGEST_INITIAL_OVERLAP * 2.0 * state.radius]
        if len(squeezed):
            raise StateError(
                f"{name_some(squeezed, 'overlaps', 'overlap')} wall {index} by {LARGEST_INITIAL_OVERLAP:.0%} of the "
                f"diameter or more; {remedy}"
            )


def _name_pairs(pairs: np.ndarray, most: int = 5) -> str:
    shown = ", ".join(f"{i} and {j}" for i, j in pairs[:most])
    return shown if len(pairs) <= most else f"{shown} and {len(pairs) - most} more pairs"
