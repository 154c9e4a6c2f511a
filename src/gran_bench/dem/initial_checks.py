"""What must hold before the first step; each refusal names the particles and the remedy."""

from __future__ import annotations

import numpy as np

from gran_bench.dem.walls import largest_excess, wall_contact
from gran_bench.neighbors import nearest_image, tree_pairs
from gran_bench.scene import Scene
from gran_bench.state import ParticleState, StateError, name_some

# Of the smaller radius sum resp. the radius: far beyond what a DEM makes itself, and the stored energy would explode.
LARGEST_INITIAL_OVERLAP = 0.2


def check_initial_state(scene: Scene, state: ParticleState) -> None:
    """Refuses a state that cannot be simulated.

    Raises:
        StateError: duplicates, pairs or walls overlapping by 20 % of the mean diameter (of the diameter for a wall)
            or more, a centre outside the container, or a history that names particles or walls that do not exist.
    """
    if state.count == 0:
        return
    pairs = tree_pairs(state.position, 2.0 * float(state.radius.max()), scene.period)
    offset = nearest_image(state.position[pairs[:, 1]] - state.position[pairs[:, 0]], scene.period)
    distance = np.linalg.norm(offset, axis=1)
    same = pairs[distance == 0.0]
    if len(same):
        raise StateError(f"particles {_name_pairs(same)} have the same position; remove the duplicates before the run")
    reach = state.radius[pairs[:, 0]] + state.radius[pairs[:, 1]]
    squeezed = pairs[reach - distance >= LARGEST_INITIAL_OVERLAP * reach]
    if len(squeezed):
        raise StateError(
            f"particles {_name_pairs(squeezed)} overlap by {LARGEST_INITIAL_OVERLAP:.0%} of their mean diameter "
            "or more; move them apart before the run"
        )
    outside = np.flatnonzero(largest_excess(scene.walls, state.position) > 0)
    if len(outside):
        raise StateError(
            f"particles {name_some(outside)} have their centre outside the container; move them inside before the run"
        )
    for index, wall in enumerate(scene.walls):
        overlap = state.radius - wall_contact(wall, state.position)[0]
        squeezed = np.flatnonzero(overlap >= LARGEST_INITIAL_OVERLAP * 2.0 * state.radius)
        if len(squeezed):
            raise StateError(
                f"particles {name_some(squeezed)} overlap wall {index} by {LARGEST_INITIAL_OVERLAP:.0%} of their "
                "diameter or more; move them inside before the run"
            )
    history = state.history
    if len(history):
        known = (history.first >= 0) & (history.first < state.count)
        known &= (history.second < state.count) & (history.second >= -len(scene.walls))
        if not known.all():
            raise StateError(
                f"the contact history names {np.count_nonzero(~known)} contacts whose particles or walls this scene "
                "does not have; run the state in its own scene, or with ContactHistory.empty()"
            )


def _name_pairs(pairs: np.ndarray, most: int = 5) -> str:
    shown = ", ".join(f"{i} and {j}" for i, j in pairs[:most])
    return shown if len(pairs) <= most else f"{shown} and {len(pairs) - most} more pairs"
