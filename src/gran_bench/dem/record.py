"""What a run leaves behind: frames, their energies and overlaps, and the error that carries them."""

from __future__ import annotations

import numpy as np

from gran_bench.dem.contact import sphere_mass
from gran_bench.dem.initial_checks import LARGEST_INITIAL_OVERLAP
from gran_bench.dem.outlet import taking_part
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


class FrameRecord:
    """Frames and diagnostics as they come."""

    def __init__(self, scene: Scene, radius: FloatArray) -> None:
        self.scene, self.radius = scene, radius
        self.time: list[float] = []
        self.frames: list[tuple[FloatArray, FloatArray, FloatArray]] = []
        self.figures: list[dict[str, float]] = []

    def add(self, state: ParticleState, time: float) -> None:
        self.time.append(time)
        self.frames.append((state.position, state.velocity, state.angular_velocity))
        self.figures.append(contact_diagnostics(self.scene, state))

    def warnings(self) -> tuple[str, ...]:
        """What a reader of the frames must know: that no run could start from one of them."""
        if not len(self.radius):
            return ()
        deepest = [max(figures["overlap_max"], figures["wall_overlap_max"]) for figures in self.figures]
        worst, smallest = int(np.argmax(deepest)), 2.0 * float(self.radius.min())
        if deepest[worst] < LARGEST_INITIAL_OVERLAP * smallest:
            return ()
        return (
            f"an overlap of {deepest[worst]:.3g} m at t = {self.time[worst]:.6g} s is {deepest[worst] / smallest:.0%} "
            f"of the smallest diameter, and Hertz's law is for less than {LARGEST_INITIAL_OVERLAP:.0%}: choose a "
            "stiffer material",
        )

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
