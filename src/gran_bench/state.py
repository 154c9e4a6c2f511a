"""The vocabulary of the house: what a set of particles and its motion are, with shapes and units.

Everything is SI. Arrays of one instant are ``(N, 3)``; a trajectory is ``(F, N, 3)``.
Angular velocity is in rad/s and in the lab frame, like position and velocity.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gran_bench.config.rules import ConfigError, checked_value

FloatArray = NDArray[np.floating]

Moving = tuple[FloatArray, FloatArray, FloatArray]  # (N, 3) position, m, velocity, m/s, and spin, rad/s

VELOCITY_KINDS = ("instantaneous", "mean")


class StateError(ValueError):
    """A particle state that cannot be simulated; the message names the particles and the remedy."""


@dataclass(frozen=True)
class ContactHistory:
    """The elastic tangential force that each touching contact remembers.

    Raises:
        StateError: a shape that does not fit, or what is no array of numbers.
    """

    first: NDArray[np.int64]  # (M,) index of the particle that the force acts on
    second: NDArray[np.int64]  # (M,) index of the other particle, or -1 - w for wall w of the scene
    force: FloatArray  # (M, 3) N, elastic tangential force on first
    overlap: FloatArray  # (M,) m, when the force was stored
    rolling_moment: FloatArray | None = None  # (M, 3) N m, elastic, on first; zeros without a rolling model
    ledger: FloatArray | None = None  # (M, 3) J, what each has lost so far (dem/energy.py); (M, 0) where nobody asks

    def __post_init__(self) -> None:
        _keep(self, "first", _indices("history.first", self.first, np.int64))
        count = len(self.first)
        _keep(self, "second", _indices("history.second", self.second, np.int64, (count,)))
        if self.rolling_moment is None:
            _keep(self, "rolling_moment", np.zeros((count, 3)))
        if self.ledger is None:
            _keep(self, "ledger", np.zeros((count, 0)))
        for name, shape in (
            ("force", (count, 3)), ("overlap", (count,)), ("rolling_moment", (count, 3)),
            ("ledger", (count, 3 if np.shape(self.ledger)[-1:] == (3,) else 0)),
        ):  # fmt: skip
            _keep(self, name, _numbers(f"history.{name}", getattr(self, name), shape))

    @classmethod
    def empty(cls) -> ContactHistory:
        """No contact remembers anything."""
        return cls(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros(0))

    def __len__(self) -> int:
        return len(self.first)


class Held(NamedTuple):
    """What an engine needs beside a state to go on from it as if it had not stopped."""

    position: FloatArray  # (N, 3) m, not brought into the period
    force: FloatArray  # (N, 3) N, of the last evaluation
    torque: FloatArray  # (N, 3) N m
    order: np.ndarray  # (n,) int64, those that take part, in the order in which their forces are summed


@dataclass(frozen=True)
class Continuation:
    """What a run keeps beside its last state, so that a further run goes on bit for bit."""

    key: str  # of the state, the physics, the walls and the time step that it holds for; others do not look at it
    start: float  # s, where the run's clock begins
    steps: int  # since then
    held: Held  # of the engine


@dataclass(frozen=True)
class ParticleState:
    """N spheres at one instant. Lists will do for arrays.

    Raises:
        StateError: what is no array of numbers, a shape that does not fit, a value that is not finite, a radius that
            is not positive, or a material that is no index.
    """

    position: FloatArray  # (N, 3) m, of the centres
    velocity: FloatArray  # (N, 3) m/s
    angular_velocity: FloatArray  # (N, 3) rad/s
    radius: FloatArray  # (N,) m
    time: float = 0.0  # s, in the scene's clock
    history: ContactHistory = field(default_factory=ContactHistory.empty)  # empty for a fresh filling
    material: NDArray[np.uint8] | None = None  # (N,) index into the scene's materials; zeros unless given
    continuation: Continuation | None = None  # of the run that ended here, if one did

    def __post_init__(self) -> None:
        position = _numbers("position", self.position)
        count = position.shape[0] if position.ndim else 0
        for name in _BY_SPHERE:
            array = _numbers(name, getattr(self, name), (count, 3))
            if not np.isfinite(array).all():
                bad = np.flatnonzero(~np.isfinite(array).all(axis=1))
                raise StateError(
                    f"{name} is not finite for {name_some(bad)}; "
                    "repair the values or remove the particles before the run"
                )
            _keep(self, name, array)
        _keep(self, "radius", _radii("radius", self.radius, count))
        material = np.zeros(count, np.uint8) if self.material is None else self.material
        _keep(self, "material", _indices("material", material, np.uint8, (count,)))
        try:
            _keep(self, "time", checked_value(float, None, self.time, "time"))
            checked_value(ContactHistory, None, self.history, "history")
        except ConfigError as error:
            raise StateError(str(error)) from None

    @property
    def count(self) -> int:
        """Number of particles N."""
        return len(self.position)


@dataclass(frozen=True)
class Trajectory:
    """F frames of N spheres, as a solver or a surrogate made them; nothing clipped, dropped or projected.

    Lists will do for arrays. Positions, velocities and spins may hold what is not finite: it is counted as a failure.

    Raises:
        StateError: what is no array of numbers, a shape that does not fit, times that do not increase, a radius that
            is not positive, or an unknown kind of velocity.
    """

    time: FloatArray  # (F,) s
    position: FloatArray  # (F, N, 3) m
    velocity: FloatArray  # (F, N, 3) m/s
    angular_velocity: FloatArray | None  # (F, N, 3) rad/s, or None for a model that has no spin
    radius: FloatArray  # (N,) m
    diagnostics: dict[str, FloatArray] = field(default_factory=dict)  # overlaps and energies by name, (F,), in SI
    energy: dict[str, FloatArray] = field(default_factory=dict)  # of dem.power, (F, …), in SI; empty where nobody asks
    velocity_kind: str = "instantaneous"  # or mean, over the frame that ends at time

    def __post_init__(self) -> None:
        position = _numbers("trajectory position", self.position)
        if position.ndim != 3:
            raise StateError(f"trajectory position has shape {position.shape}; expected (F, N, 3)")
        frames, count = position.shape[:2]
        for name in _BY_SPHERE[: 2 if self.angular_velocity is None else 3]:
            _keep(self, name, _numbers(f"trajectory {name}", getattr(self, name), (frames, count, 3)))
        _keep(self, "time", _numbers("trajectory time", self.time, (frames,)))
        if not (np.isfinite(self.time).all() and (np.diff(self.time) > 0).all()):
            raise StateError("trajectory time is not finite or does not increase; give the time of each frame, s")
        _keep(self, "radius", _radii("trajectory radius", self.radius, count))
        for name, values in self.diagnostics.items():
            _numbers(f"trajectory {name}", values, (frames,))
        for name, values in self.energy.items():
            _numbers(f"trajectory {name}", values, (frames, *np.shape(values)[1:]))
        if self.velocity_kind not in VELOCITY_KINDS:
            raise StateError(f"velocity_kind={self.velocity_kind!r}; choose {' or '.join(VELOCITY_KINDS)}")

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


_BY_SPHERE = ("position", "velocity", "angular_velocity")


def _keep(owner: object, name: str, value: Any) -> None:
    object.__setattr__(owner, name, value)  # of a frozen dataclass


def _array(value: Any) -> NDArray:
    try:
        return np.asarray(value)
    except (TypeError, ValueError, RuntimeError):  # rows of different lengths; a tensor that follows gradients
        return np.asarray(None)


def _numbers(name: str, value: Any, shape: tuple[int, ...] | None = None) -> FloatArray:
    """``value`` as an array of floating-point numbers, of a shape; one that is such an array stays itself."""
    array = _array(value)
    if array.dtype.kind not in "iuf":
        raise StateError(f"{name} is no array of numbers; give one of equally long rows")
    return _of_shape(name, array if array.dtype.kind == "f" else array.astype(np.float64), shape)


def _indices(
    name: str, value: Any, dtype: type[np.integer], shape: tuple[int, ...] | None = None
) -> NDArray[np.integer]:
    """``value`` as an array of whole numbers that ``dtype`` holds, of a shape."""
    found, legal = _array(value), np.iinfo(dtype)
    if found.size and (found.dtype.kind not in "iu" or found.min() < legal.min or found.max() > legal.max):
        raise StateError(f"{name} of {found.dtype} is no array of indices; give whole numbers up to {legal.max}")
    return _of_shape(name, found.astype(dtype, copy=False), shape)


def _of_shape(name: str, array: NDArray, shape: tuple[int, ...] | None) -> NDArray:
    if shape is not None and array.shape != shape:
        raise StateError(f"{name} has shape {array.shape}; expected {shape}")
    return array


def _radii(name: str, value: Any, count: int) -> FloatArray:
    radius = _numbers(name, value, (count,))
    bad = np.flatnonzero(~(np.isfinite(radius) & (radius > 0)))
    if len(bad):
        raise StateError(f"{name} must be positive and finite; {name_some(bad, 'is', 'are')} not")
    return radius


def name_some(indices: NDArray[np.integer], one: str = "", several: str = "", most: int = 5) -> str:
    """``particle 1`` or ``particles 1, 2 and 3 more``, with what is said of ``one`` or of ``several`` behind it."""
    shown = ", ".join(str(int(i)) for i in indices[:most])
    rest = f" and {len(indices) - most} more" if len(indices) > most else ""
    words = ("particle", shown, one) if len(indices) == 1 else ("particles", shown + rest, several)
    return " ".join(filter(None, words))
