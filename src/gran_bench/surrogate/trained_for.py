"""What a model was trained for, held against what it is asked to roll out: refused where it cannot be right."""

from collections import Counter
from dataclasses import asdict, dataclass

import numpy as np

from gran_bench.scene import Scene
from gran_bench.state import ParticleState


class ModelMismatch(ValueError):
    """A scene or state that a model cannot be right for; the message names what differs and the remedy."""


@dataclass(frozen=True)
class TrainedFor:
    """What a model was made for; its file's card says it."""

    scene: Scene  # gives d, Δt, materials, gravity, walls and the number of spheres
    speeds_rpm: tuple[float, ...] = ()  # of the drum in the training cases; empty where that is not known

    def warnings(self, scene: Scene, state: ParticleState) -> tuple[str, ...]:
        """What is an extrapolation of a rollout from a state, a line each.

        Raises:
            ModelMismatch: another diameter, several, another frame interval, or walls for a model that saw none.
        """
        home = self.scene
        radii = np.unique((*state.radius, scene.filling.radius)) if state.count else np.array([scene.filling.radius])
        if not np.allclose(radii, home.filling.radius, rtol=1e-6, atol=0.0):
            found = f"{radii[0]:g} m" if len(radii) == 1 else f"{radii[0]:g} to {radii[-1]:g} m (state and scene)"
            raise ModelMismatch(
                f"spheres of radius {found}: this model knows spheres of radius {home.filling.radius:g} m alone; give "
                "it such a bed and scene.filling.diameter, or train a model on yours"
            )
        if not np.isclose(scene.frame_interval, home.frame_interval, rtol=1e-9, atol=0.0):
            raise ModelMismatch(
                f"scene.frame_interval={scene.frame_interval:g} s: this model steps {home.frame_interval:g} s "
                "and nothing else; choose that, or train a model on yours"
            )
        if scene.walls and not home.walls:
            raise ModelMismatch(
                f"the walls of scene {scene.name!r}: this model was trained without walls and cannot know them; "
                "train a model in a scene with walls"
            )
        lines = []
        for name in ("material", "wall_material") if scene.walls else ("material",):
            for entry, value in asdict(getattr(scene, name)).items():
                if value != (trained := getattr(getattr(home, name), entry)):
                    lines.append(f"scene.{name}.{entry}={value:g}, trained on {trained:g}")
        if (kinds := len(np.unique(state.material))) > 1:
            lines.append(f"spheres of {kinds} materials, which the model cannot tell apart")
        if scene.gravity != home.gravity:
            lines.append(f"scene.gravity={list(scene.gravity)}, trained on {list(home.gravity)}")
        if (scene.walls, scene.period) != (home.walls, home.period):
            lines.append(f"walls: {_container(scene)}; trained in {_container(home)}")
        turns = any(wall.turns and wall.motion is None for wall in scene.walls)
        speeds = sorted(scene.rotation.speeds_rpm) if turns else ()
        known = self.speeds_rpm if home.takes_speeds else home.rotation.speeds_rpm
        if known and speeds and (speeds[0] < min(known) or speeds[-1] > max(known)):
            here = " to ".join(f"{rpm:g}" for rpm in dict.fromkeys((speeds[0], speeds[-1])))
            lines.append(f"a drum at {here} rpm, trained at {min(known):g} to {max(known):g} rpm")
        if state.count != home.filling.count:
            lines.append(f"{state.count} spheres, trained on {home.filling.count}")
        return tuple(lines)


def _container(scene: Scene) -> str:
    """The walls of a scene in a few words."""
    if scene.drum_radius is not None and scene.length is not None:
        kind = "periodic drum" if scene.periodic_axis else "drum"
        return f"a {kind} of diameter {2.0 * scene.drum_radius:g} m and length {scene.length:g} m"
    counts = Counter(type(wall).__name__.lower() for wall in scene.walls)
    return f"{scene.name}, " + (", ".join(f"{number} × {kind}" for kind, number in counts.items()) or "no walls")
