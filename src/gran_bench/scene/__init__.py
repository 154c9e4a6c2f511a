"""A scene: walls and their motion, materials, gravity and filling, and what of the physics it needs."""

from gran_bench.scene.build import Container, build_scene
from gran_bench.scene.errors import SceneError
from gran_bench.scene.filling import Filling, Room, Sizes
from gran_bench.scene.material import Material, PairCoefficients
from gran_bench.scene.motion import RADIANS_PER_SECOND_PER_RPM, Motion, Rotation, Spin, Translation, Vibration
from gran_bench.scene.scene import FineSpheres, Needs, Scene
from gran_bench.scene.walls import Cone, Cylinder, Disc, Outlet, Plane, Wall, box, surface_of_revolution
