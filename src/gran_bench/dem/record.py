"""What a run leaves behind: frames, their energies and overlaps, and the error that carries them."""

from __future__ import annotations

import numpy as np

from gran_bench.dem.contact import sphere_mass
from gran_bench.dem.initial_checks import LARGEST_INITIAL_OVERLAP
from gran_bench.dem.integrate import Peaks
from gran_bench.dem.outlet import taking_part
from gran_bench.dem.time_step import unresolved
from gran_bench.scene import Scene
from gran_bench.state import FloatArray, ParticleState, Trajectory


class SimulationError(RuntimeError):
    """A run that cannot go on; the message names particle and time.

    Attributes:
        trajectory: the frames up to the failure, the failed one last. Its values may not be finite.
    """

    def __init__(self, message: str, trajectory: Trajectory) -> None:
        super().__init__(message)
        self.trajectory = trajectory


def contact_diagnostics(scene: Scene, state: ParticleState) -> dict[str, float]:
    """Energies and overlaps of a state whose history lists its touching contacts.

    ½ Σ m v² and ½ Σ I ω² in J; mean and largest overlap of touching pairs and walls in m, 0 where none touch. In a
    scene with an outlet, the number of spheres that have left, which count in no other figure.

    Args:
        scene: materials and outlet.
        state: as an engine leaves it.
    """
    mass = sphere_mass(np.array([material.density for material in scene.materials])[state.material], state.radius)
    inside = taking_part(scene, state.position)
    if inside is not None:
        mass = np.where(inside, mass, 0.0)
    inertia = 0.4 * mass * state.radius**2
    touching_wall = state.history.second < 0
    figures = {
        "kinetic_energy_translational": 0.5 * float(mass @ np.square(state.velocity).sum(axis=1)),
        "kinetic_energy_rotational": 0.5 * float(inertia @ np.square(state.angular_velocity).sum(axis=1)),
    }
    for prefix, overlap in (
        ("", state.history.overlap[~touching_wall]),
        ("wall_", state.history.overlap[touching_wall]),
    ):
        figures[f"{prefix}overlap_mean"] = float(overlap.mean()) if len(overlap) else 0.0
        figures[f"{prefix}overlap_max"] = float(overlap.max()) if len(overlap) else 0.0
        figures[f"{prefix}contact_count"] = float(len(overlap))
    if scene.outlet is not None:
        figures["discharged"] = 0.0 if inside is None else float(np.count_nonzero(~inside))
    return figures


def peak_diagnostics(peaks: Peaks) -> dict[str, float]:
    """The most of any contact in any step since the last frame (of the first frame, in its state alone).

    Largest overlap of a pair and with a wall in m, largest overlap as a share of the pair's mean diameter (of the
    diameter at a wall), fastest approach of touching surfaces in m/s; 0 where nothing touched.
    """
    return {
        "overlap_peak": peaks.overlap,
        "wall_overlap_peak": peaks.wall_overlap,
        "overlap_share_peak": peaks.share,
        "approach_peak": peaks.approach,
    }


def impact_warnings(
    scene: Scene, radius: float, time_step: float, judged: float, times: FloatArray, peaks: list[Peaks]
) -> tuple[str, ...]:
    """What a reader must know of the impacts: too deep for Hertz's law, or too short for the step.

    Args:
        scene: materials and walls.
        radius: of the smallest sphere, m.
        time_step: s.
        judged: speed that the step has been held against, m/s.
        times: s, at which the spans end that the peaks are of.
        peaks: of each span.
    """
    warnings = []
    if peaks and max(p.share for p in peaks) >= LARGEST_INITIAL_OVERLAP:
        worst = int(np.argmax([p.share for p in peaks]))
        deepest = max(peaks[worst].overlap, peaks[worst].wall_overlap)
        warnings.append(
            f"an overlap that reached {peaks[worst].share:.0%} of the mean diameter (the deepest {deepest:.3g} m) by "
            f"t = {times[worst]:.6g} s: Hertz's law is for less than {LARGEST_INITIAL_OVERLAP:.0%}, and deeper spheres "
            "pass through each other or through walls; choose a stiffer material or lower speeds"
        )
    if peaks and (fastest := max(p.approach for p in peaks)) > judged:
        when = times[int(np.argmax([p.approach for p in peaks]))]
        if said := unresolved(scene, radius, time_step, fastest):
            warnings.append(f"an impact at {fastest:.3g} m/s by t = {when:.6g} s: {said}")
    return tuple(warnings)


class FrameRecord:
    """Frames and diagnostics as they come."""

    def __init__(self, scene: Scene, radius: FloatArray) -> None:
        self.scene, self.radius = scene, radius
        self.time: list[float] = []
        self.frames: list[tuple[FloatArray, FloatArray, FloatArray]] = []
        self.figures: list[dict[str, float]] = []
        self.peaks: list[Peaks] = []

    def add(self, state: ParticleState, time: float, peaks: Peaks) -> None:
        self.time.append(time)
        self.frames.append((state.position, state.velocity, state.angular_velocity))
        self.figures.append(contact_diagnostics(self.scene, state) | peak_diagnostics(peaks))
        self.peaks.append(peaks)

    def trajectory(self, *failed: tuple[float, FloatArray, FloatArray, FloatArray]) -> Trajectory:
        """All frames, and a failed one that has no diagnostics."""
        frames = self.frames + [frame[1:] for frame in failed]
        nothing = dict.fromkeys(self.figures[0], np.nan) if self.figures else {}
        figures = self.figures + [nothing for _ in failed]
        position, velocity, spin = (np.stack([frame[k] for frame in frames]) for k in range(3))
        return Trajectory(
            time=np.array(self.time + [frame[0] for frame in failed]),
            position=position,
            velocity=velocity,
            angular_velocity=spin,
            radius=self.radius,
            diagnostics={name: np.array([f[name] for f in figures]) for name in figures[0]},
        )
