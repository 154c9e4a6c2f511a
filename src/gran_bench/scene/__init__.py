"""A scene: walls and their motion, materials, gravity and filling, and what of the physics it needs."""

from gran_bench.scene.build import Container, build_scene
from gran_bench.scene.errors import SceneError
from gran_bench.scene.filling import Filling, Room
from gran_bench.scene.material import Material, PairCoefficients
from gran_bench.scene.motion import RADIANS_PER_SECOND_PER_RPM, Motion, Rotation, Spin, Translation, Vibration
from gran_bench.scene.scene import Needs, Scene
from gran_bench.scene.sizes import Sizes
from gran_bench.scene.walls import Cone, Cylinder, Disc, Outlet, Plane, Wall, box, surface_of_revolution

__all__ = [
    "RADIANS_PER_SECOND_PER_RPM", "Cone", "Container", "Cylinder", "Disc", "Filling", "Material", "Motion", "Needs",
    "Outlet", "PairCoefficients", "Plane", "Room", "Rotation", "Scene", "SceneError", "Sizes", "Spin", "Translation",
    "Vibration", "Wall", "box", "build_scene", "surface_of_revolution",
]  # fmt: skip
