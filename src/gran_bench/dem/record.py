"""What a run leaves behind: frames, their energies and overlaps, and the error that carries them."""

from collections.abc import Sequence

import numpy as np

from gran_bench.dem.contact import sphere_mass
from gran_bench.dem.energy import Work, energy_figures
from gran_bench.dem.initial_checks import LARGEST_INITIAL_OVERLAP
from gran_bench.dem.integrate import Peaks, Physics
from gran_bench.dem.outlet import taking_part
from gran_bench.dem.time_step import unresolved
from gran_bench.scene import Scene
from gran_bench.state import FloatArray, ParticleState, Trajectory


class SimulationError(RuntimeError):
    """A run that cannot go on, with the frames up to the failure; the failed one comes last and may not be finite."""

    def __init__(self, message: str, trajectory: Trajectory) -> None:
        super().__init__(message)
        self.trajectory = trajectory


def contact_diagnostics(scene: Scene, state: ParticleState) -> dict[str, float]:
    """Energies and overlaps of a state whose history lists its touching contacts, as an engine leaves it.

    ½ Σ m v² and ½ Σ I ω² in J; mean and largest overlap of touching pairs and walls in m, 0 where none touch. In a
    scene with an outlet, the number of spheres that have left, which count in no other figure.
    """
    inside = taking_part(scene, state.position)
    mass = sphere_mass(np.array([material.density for material in scene.materials])[state.material], state.radius)
    mass = np.where(inside, mass, 0.0)
    inertia = 0.4 * mass * state.radius**2
    touching_wall = state.history.second < 0
    figures = {
        "kinetic_energy_translational": 0.5 * float(mass @ np.square(state.velocity).sum(axis=1)),
        "kinetic_energy_rotational": 0.5 * float(inertia @ np.square(state.angular_velocity).sum(axis=1)),
    }
    for prefix, touching in (("", ~touching_wall), ("wall_", touching_wall)):
        overlap = state.history.overlap[touching]
        figures[f"{prefix}overlap_mean"] = float(overlap.mean()) if len(overlap) else 0.0
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
    """Frames and diagnostics as they come; with the step, s, and the laws of what counts energy."""

    def __init__(
        self, scene: Scene, radius: FloatArray, time_step: float = 0.0, physics: Physics | None = None
    ) -> None:
        self._scene, self._radius, self._time_step, self._physics = scene, radius, time_step, physics
        self._energy: list[dict[str, FloatArray]] = []
        self._frames: list[tuple[float, FloatArray, FloatArray, FloatArray]] = []
        self._figures: list[dict[str, float]] = []
        self.time: list[float] = []
        self.peaks: list[Peaks] = []

    def add(self, state: ParticleState, peaks: Peaks, work: Work | None = None) -> None:
        """A state, the most of any contact in any step since the last frame (of the first, in its state alone), and
        what the steps since then did.
        """
        if work is not None:
            laws = self._physics.pair_laws, self._physics.wall_laws
            self._energy.append(energy_figures(self._scene, state, work, self._time_step, laws))
        self.time.append(state.time)
        self.peaks.append(peaks)
        self._frames.append((state.time, state.position, state.velocity, state.angular_velocity))
        names = ("overlap_peak", "wall_overlap_peak", "overlap_share_peak", "approach_peak")
        self._figures.append(contact_diagnostics(self._scene, state) | dict(zip(names, peaks, strict=True)))

    def trajectory(self, *failed: tuple[float, FloatArray, FloatArray, FloatArray]) -> Trajectory:
        """All frames, and a failed one that has no diagnostics."""
        time, position, velocity, spin = map(np.array, zip(*self._frames, *failed, strict=True))
        diagnostics = {
            name: np.array([of[name] for of in self._figures] + [np.nan for _ in failed])
            for name in (self._figures or [{}])[0]
        }
        energy = {
            name: np.stack([of[name] for of in self._energy] + [np.full_like(first, np.nan) for _ in failed])
            for name, first in (self._energy or [{}])[0].items()
        }
        return Trajectory(time, position, velocity, spin, self._radius, diagnostics=diagnostics, energy=energy)
