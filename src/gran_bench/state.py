"""The vocabulary of the house: what a set of particles and its motion are, with shapes and units.

Everything is SI. Arrays of one instant are ``(N, 3)``; a trajectory is ``(F, N, 3)``.
Angular velocity is in rad/s and in the lab frame, like position and velocity.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.floating]


class StateError(ValueError):
    """A particle state that cannot be simulated; the message names the particles and the remedy."""


@dataclass(frozen=True)
class ContactHistory:
    """The elastic tangential force that each touching contact remembers.

    Attributes:
        first: ``(M,)`` int64, index of the particle that the force acts on.
        second: ``(M,)`` int64, index of the other particle, or ``-1 - w`` for wall ``w`` of the scene.
        force: ``(M, 3)`` float64, elastic tangential force on ``first``, N.
        overlap: ``(M,)`` float64, overlap when the force was stored, m.
        rolling_moment: ``(M, 3)`` float64, elastic rolling moment on ``first``, N m; zeros without a rolling model.
    """

    first: NDArray[np.int64]
    second: NDArray[np.int64]
    force: FloatArray
    overlap: FloatArray
    rolling_moment: FloatArray | None = None

    def __post_init__(self) -> None:
        if self.rolling_moment is None:
            object.__setattr__(self, "rolling_moment", np.zeros((len(self.first), 3)))

    @classmethod
    def empty(cls) -> ContactHistory:
        """No contact remembers anything."""
        return cls(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros(0))

    def __len__(self) -> int:
        return len(self.first)


@dataclass(frozen=True)
class ParticleState:
    """N spheres at one instant.

    Attributes:
        position: ``(N, 3)`` centres, m.
        velocity: ``(N, 3)`` m/s.
        angular_velocity: ``(N, 3)`` rad/s.
        radius: ``(N,)`` m.
        time: s, in the scene's clock.
        history: what the contacts remember; empty for a fresh filling.
        material: ``(N,)`` uint8, index into the scene's ``materials``; zeros unless given.

    Raises:
        StateError: a shape that does not fit, a value that is not finite, or a radius that is not positive.
    """

    position: FloatArray
    velocity: FloatArray
    angular_velocity: FloatArray
    radius: FloatArray
    time: float = 0.0
    history: ContactHistory = field(default_factory=ContactHistory.empty)
    material: NDArray[np.uint8] | None = None

    def __post_init__(self) -> None:
        count = len(self.position)
        if self.material is None:
            object.__setattr__(self, "material", np.zeros(count, np.uint8))
        for name in ("position", "velocity", "angular_velocity"):
            array = getattr(self, name)
            if array.shape != (count, 3):
                raise StateError(f"{name} has shape {array.shape}; expected ({count}, 3)")
            if not np.isfinite(array).all():
                bad = np.flatnonzero(~np.isfinite(array).all(axis=1))
                raise StateError(
                    f"{name} is not finite for {name_some(bad)}; "
                    "repair the values or remove the particles before the run"
                )
        if self.radius.shape != (count,):
            raise StateError(f"radius has shape {self.radius.shape}; expected ({count},)")
        bad = np.flatnonzero(~(np.isfinite(self.radius) & (self.radius > 0)))
        if len(bad):
            raise StateError(f"radius must be positive and finite; {name_some(bad, 'is', 'are')} not")
        if self.material.shape != (count,) or self.material.dtype != np.uint8:
            raise StateError(
                f"material has shape {self.material.shape} of {self.material.dtype}; expected ({count},) of uint8"
            )

    @property
    def count(self) -> int:
        """Number of particles N."""
        return len(self.position)


@dataclass(frozen=True)
class Trajectory:
    """F frames of N spheres, as a solver or a surrogate made them; nothing clipped, dropped or projected.

    Attributes:
        time: ``(F,)`` s.
        position: ``(F, N, 3)`` m.
        velocity: ``(F, N, 3)`` m/s, instantaneous unless ``velocity_kind`` says ``mean``.
        angular_velocity: ``(F, N, 3)`` rad/s, or None for a model that has no spin.
        radius: ``(N,)`` m.
        diagnostics: per-frame scalars ``(F,)`` by name (overlap and energy figures), in SI.
        velocity_kind: ``instantaneous``, or ``mean`` over the frame that ends at ``time``.
    """

    time: FloatArray
    position: FloatArray
    velocity: FloatArray
    angular_velocity: FloatArray | None
    radius: FloatArray
    diagnostics: dict[str, FloatArray] = field(default_factory=dict)
    velocity_kind: str = "instantaneous"

    def __post_init__(self) -> None:
        frames, count = self.position.shape[:2]
        expected = {
            "time": (frames,),
            "position": (frames, count, 3),
            "velocity": (frames, count, 3),
            "radius": (count,),
        }
        if self.angular_velocity is not None:
            expected["angular_velocity"] = (frames, count, 3)
        for name, shape in expected.items():
            found = getattr(self, name).shape
            if found != shape:
                raise StateError(f"trajectory {name} has shape {found}; expected {shape}")
        if self.velocity_kind not in ("instantaneous", "mean"):
            raise StateError(f"velocity_kind={self.velocity_kind!r}; expected 'instantaneous' or 'mean'")

    @property
    def frame_count(self) -> int:
        """Number of frames F."""
        return len(self.time)

    def mean_velocity(self, period: float = 0.0) -> FloatArray:
        """Velocity over the frame that ends at each state, (x_k − x_{k−1})/Δt, ``(F, N, 3)`` m/s.

        The first frame has no predecessor and keeps its stored velocity.

        Args:
            period: length of a periodic y axis, m; a step across its seam is taken to the nearest image.
        """
        # In double precision: a step of single-precision positions over Δt may exceed what single precision holds.
        velocity = self.velocity.astype(np.float64)
        interval = np.diff(self.time)[:, None, None]
        step = np.diff(self.position.astype(np.float64), axis=0)
        if period > 0:
            step[..., 1] -= period * np.round(step[..., 1] / period)
        velocity[1:] = step / interval
        return velocity


def name_some(indices: NDArray[np.integer], one: str = "", several: str = "", most: int = 5) -> str:
    """``particle 1`` or ``particles 1, 2 and 3 more``, with what is said of ``one`` or of ``several`` behind it."""
    shown = ", ".join(str(int(i)) for i in indices[:most])
    rest = f" and {len(indices) - most} more" if len(indices) > most else ""
    words = ("particle", shown, one) if len(indices) == 1 else ("particles", shown + rest, several)
    return " ".join(filter(None, words))
