"""What a run leaves behind: frames, their energies and overlaps, and the error that carries them."""

from collections.abc import Sequence

import numpy as np

from gran_bench.dem.contact import sphere_mass
from gran_bench.dem.initial_checks import LARGEST_INITIAL_OVERLAP
from gran_bench.dem.integrate import Peaks
from gran_bench.dem.outlet import taking_part
from gran_bench.dem.time_step import unresolved
from gran_bench.scene import Scene
from gran_bench.state import FloatArray, Moving, ParticleState, Trajectory


class SimulationError(RuntimeError):
    """A run that cannot go on, with the frames up to the failure; the failed one comes last and may not be finite."""

    def __init__(self, message: str, trajectory: Trajectory) -> None:
        super().__init__(message)
        self.trajectory = trajectory


def inertias(scene: Scene, state: ParticleState) -> tuple[FloatArray, FloatArray]:
    """Mass, kg, and moment of inertia, kg m², of each sphere of a scene, ``(N, 3)``, for each axis the same."""
    density = np.array([material.density for material in scene.materials])[state.material]
    mass = sphere_mass(density, state.radius)
    return tuple(np.repeat(of[:, None], 3, axis=1) for of in (mass, 0.4 * mass * state.radius**2))


def contact_diagnostics(
    scene: Scene, inertias: tuple[FloatArray, FloatArray], moving: Moving, overlaps: tuple[FloatArray, FloatArray]
) -> dict[str, float]:  # fmt: skip
    """Energies and overlaps of an instant: of :func:`inertias`, position, velocity and spin, and what touches, m.

    ½ Σ m v² and ½ Σ I ω² in J; mean and largest overlap of touching pairs and walls in m, 0 where none touch. In a
    scene with an outlet, the number of spheres that have left, which count in no other figure.
    """
    position, velocity, spin = moving
    mass, inertia = inertias
    if scene.outlet is not None:
        inside = taking_part(scene, position)
        mass, inertia = mass * inside[:, None], inertia * inside[:, None]
    figures = {
        "kinetic_energy_translational": 0.5 * float(np.vdot(mass * velocity, velocity)),
        "kinetic_energy_rotational": 0.5 * float(np.vdot(inertia * spin, spin)),
    }
    for prefix, overlap in zip(("", "wall_"), overlaps, strict=True):
        figures[f"{prefix}overlap_mean"] = float(overlap.sum()) / max(1, len(overlap))
        figures[f"{prefix}overlap_max"] = float(overlap.max(initial=0.0))
        figures[f"{prefix}contact_count"] = float(len(overlap))
    if scene.outlet is not None:
        figures["discharged"] = float(np.count_nonzero(~inside))
    return figures


def impact_warnings(
    scene: Scene, radius: float, time_step: float, judged: float, times: Sequence[float], peaks: list[Peaks]
) -> tuple[str, ...]:
    """What a reader must know of the impacts: too deep for Hertz's law, or too short for the step.

    ``judged`` is the speed that the step has been held against, m/s; each span ends at one of ``times``, s.
    """
    warnings = []
    worst, fastest = (int(np.argmax([getattr(p, name) for p in peaks])) for name in ("share", "approach"))
    if (share := peaks[worst].share) >= LARGEST_INITIAL_OVERLAP:
        deepest = max(peaks[worst].overlap, peaks[worst].wall_overlap)
        warnings.append(
            f"an overlap that reached {share:.0%} of the mean diameter (the deepest {deepest:.3g} m) by "
            f"t = {times[worst]:.6g} s: Hertz's law is for less than {LARGEST_INITIAL_OVERLAP:.0%}, and deeper spheres "
            "pass through each other or through walls; choose a stiffer material or lower speeds"
        )
    if (speed := peaks[fastest].approach) > judged:
        given = f"an impact at {speed:.3g} m/s by t = {times[fastest]:.6g} s: dem.time_step={time_step:g} s"
        warnings += unresolved(scene, time_step, given, True, radius, speed)
    return tuple(warnings)


class FrameRecord:
    """Frames, diagnostics and counted energies as they come, with room for so many and a failed one."""

    def __init__(self, scene: Scene, state: ParticleState, frames: int = 0) -> None:
        self._scene, self._radius, self._inertias = scene, state.radius, inertias(scene, state)
        self._moving = np.empty((3, frames + 1, state.count, 3))
        self._figures: list[dict[str, float]] = []
        self._energy: list[dict[str, FloatArray]] = []
        self.time: list[float] = []
        self.peaks: list[Peaks] = []

    def room(self) -> Moving:
        """Arrays for the next frame."""
        return tuple(self._moving[:, len(self.time)])

    def add(
        self, time: float, overlaps: tuple[FloatArray, FloatArray], peaks: Peaks, energy: dict[str, FloatArray]
    ) -> None:
        """Takes what the room now holds as a frame, s, with the overlaps of its contacts, m, and `energy_figures`.

        Peaks are the most of any contact in any step since the last frame (of the first, in itself alone).
        """
        figures = contact_diagnostics(self._scene, self._inertias, self.room(), overlaps)
        self.time.append(time)
        self.peaks.append(peaks)
        self._energy.append(energy)
        names = ("overlap_peak", "wall_overlap_peak", "overlap_share_peak", "approach_peak")
        self._figures.append(figures | dict(zip(names, peaks, strict=True)))

    def trajectory(self, *failed: tuple[float, FloatArray, FloatArray, FloatArray]) -> Trajectory:
        """All frames, and a failed one that has no diagnostics."""
        time = self.time.copy()
        for when, *moving in failed:
            self._moving[:, len(time)] = moving
            time.append(when)
        diagnostics = {
            name: np.array([of[name] for of in self._figures] + [np.nan for _ in failed])
            for name in (self._figures or [{}])[0]
        }
        energy = {
            name: np.stack([of[name] for of in self._energy] + [np.full_like(first, np.nan) for _ in failed])
            for name, first in (self._energy or [{}])[0].items()
        }
        moving = self._moving[:, : len(time)]
        return Trajectory(np.array(time), *moving, self._radius, diagnostics=diagnostics, energy=energy)
