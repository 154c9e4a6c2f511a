"""Windows seen from another side: everything turned at random, walls, their motion and gravity included.

A network that sees no gravity has nothing that tells one direction of space from another, but its weights: a window
that is turned as a whole is one more window of the same physics. The loss is taken after the prediction is turned
back, so that a term may know which way is up.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any

import numpy as np
from torch import Tensor

from gran_bench.scene import Scene
from gran_bench.state import FloatArray
from gran_bench.surrogate.step import FrameState

VECTORS = ("point", "normal", "axis", "direction", "center", "gravity")  # of a scene and of its parts
PARTS = ("walls", "motion", "rotation", "outlet")


@dataclass(frozen=True)
class Turn:
    """A rotation about the origin, x → Q x."""

    matrix: FloatArray  # Q, (3, 3), orthogonal, det Q = 1

    @classmethod
    def drawn(cls, rng: np.random.Generator, period: float) -> Turn:
        """Any rotation as likely as any other; where y is periodic, any about y."""
        if period > 0.0:
            angle = rng.uniform(0.0, 2.0 * math.pi)
            w, x, y, z = math.cos(0.5 * angle), 0.0, math.sin(0.5 * angle), 0.0
        else:  # a unit quaternion of even density
            quaternion = rng.standard_normal(4)
            w, x, y, z = quaternion / np.linalg.norm(quaternion)
        cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        return cls(np.eye(3) + 2.0 * w * cross + 2.0 * cross @ cross)

    def scene(self, scene: Scene) -> Scene:
        """The scene with its walls, their motion and gravity turned; a filling stays where it is."""
        return self._turned(scene)

    def state(self, state: FrameState) -> FrameState:
        """The state turned."""
        return state.of_each(lambda vectors: vectors @ self._like(vectors).T)

    def back(self, state: FrameState) -> FrameState:
        """A turned state as it was."""
        return state.of_each(lambda vectors: vectors @ self._like(vectors))

    def _like(self, vectors: Tensor) -> Tensor:
        return vectors.new_tensor(self.matrix)

    def _turned(self, part: Any) -> Any:
        """A part of a scene with each of its vectors turned."""
        changes: dict[str, Any] = {}
        for name in {entry.name for entry in fields(part)}.intersection((*VECTORS, *PARTS, "velocities")):
            value = getattr(part, name)
            if name in VECTORS:
                changes[name] = self._vector(value)
            elif name == "velocities":
                changes[name] = tuple(map(self._vector, value))
            elif isinstance(value, tuple):
                changes[name] = tuple(map(self._turned, value))
            elif is_dataclass(value):
                changes[name] = self._turned(value)
        return replace(part, **changes)

    def _vector(self, vector: tuple[float, ...]) -> tuple[float, ...]:
        return tuple((self.matrix @ vector).tolist())
