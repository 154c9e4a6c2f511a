"""Spheres that leave: who takes part in a stretch, and how those who don't keep their last state."""

from dataclasses import replace

import numpy as np

from gran_bench.scene import Scene
from gran_bench.state import ContactHistory, FloatArray, ParticleState

_BY_PARTICLE = ("position", "velocity", "angular_velocity", "radius", "material")


def taking_part(scene: Scene, position: FloatArray) -> np.ndarray:
    """Whether each centre is on the near side of the outlet, ``(N,)`` bool."""
    if scene.outlet is None:
        return np.ones(len(position), bool)
    return (position - np.asarray(scene.outlet.point)) @ np.asarray(scene.outlet.normal) >= 0.0


def leaked(scene: Scene, position: FloatArray) -> np.ndarray:
    """Indices of centres beyond the outlet that did not come through it, because they lie too far from its middle."""
    if scene.outlet is None or scene.outlet.radius is None:
        return np.zeros(0, np.int64)
    normal, offset = np.asarray(scene.outlet.normal), position - np.asarray(scene.outlet.point)
    along = offset @ normal
    aside = np.linalg.norm(offset - np.outer(along, normal), axis=1)
    return np.flatnonzero((along < 0.0) & (aside > scene.outlet.radius))


def part_of(state: ParticleState, inside: np.ndarray) -> ParticleState:
    """The particles where ``inside`` is true, with what their contacts among themselves and with walls remember."""
    if inside.all():
        return state
    history, walls, name = state.history, state.history.second < 0, np.cumsum(inside) - 1
    other = np.where(walls, 0, history.second)
    kept = inside[history.first] & (walls | inside[other])
    renamed = replace(history, first=name[history.first], second=np.where(walls, history.second, name[other]))
    memory = ContactHistory(*(array[kept] for array in vars(renamed).values()))
    return replace(state, history=memory, **{field: getattr(state, field)[inside] for field in _BY_PARTICLE})


def rejoined(state: ParticleState, inside: np.ndarray, part: ParticleState) -> ParticleState:
    """The whole state after its part was moved on; the others are as they were, and touch nothing."""
    if inside.all():
        return part
    number, history = np.flatnonzero(inside), part.history
    arrays = {field: np.array(getattr(state, field)) for field in _BY_PARTICLE[:3]}
    for field, values in arrays.items():
        values[inside] = getattr(part, field)
    second = np.array(history.second)
    second[second >= 0] = number[second[second >= 0]]
    memory = replace(history, first=number[history.first], second=second)
    return replace(state, time=part.time, history=memory, **arrays)
