"""From a config to a scene: the containers that a config can name, and what goes into them."""

import math
from dataclasses import dataclass

from gran_bench.config import BoxConfig, ContainerConfig, FillingConfig, HopperConfig, SceneConfig
from gran_bench.config.registry import WALLS
from gran_bench.scene.errors import SceneError
from gran_bench.scene.filling import Filling, Room, Sizes
from gran_bench.scene.material import Material, PairCoefficients
from gran_bench.scene.motion import Rotation
from gran_bench.scene.scene import Scene
from gran_bench.scene.walls import Cone, Cylinder, Disc, Outlet, Plane, Wall, box

# Of ρ g d/E: a single sphere's own weight presses it into the floor by a tenth of its diameter or more.
CRUSHED = 0.1
UP, ALONG = (0.0, 0.0, 1.0), (0.0, 1.0, 0.0)


@dataclass(frozen=True)
class Container:
    """What a container gives a scene: its walls, and where in them the spheres start."""

    walls: tuple[Wall, ...] = ()  # and room, outlet, drum_radius, length, periodic_axis: as in `Scene`
    room: Room | None = None
    outlet: Outlet | None = None
    drum_radius: float | None = None
    length: float | None = None
    periodic_axis: bool = False


def build_scene(config: SceneConfig) -> Scene:
    """The scene that a config describes.

    Raises:
        SceneError: a value that no scene can have; the message names key, value and remedy.
    """
    kind = config.container.kind
    container = WALLS[kind](config.container, config)
    if not isinstance(container, Container) or WALLS[kind].drum != (container.drum_radius is not None):
        raise SceneError(
            f"scene.container.kind={kind}: its function gives no Container with "
            f"{'a' if WALLS[kind].drum else 'no'} drum_radius; let it, or change register_wall(..., drum=...)"
        )
    material = Material.from_config(config.material)
    second = config.second_material
    mixed = PairCoefficients(0, 1, config.mixed.restitution, config.mixed.friction, config.mixed.rolling_friction)
    scene = Scene(
        name=config.name,
        filling=build_filling(config.filling),
        material=material,
        wall_material=Material.from_config(config.wall_material or config.material),
        more_materials=() if second is None else (Material.from_config(second),),
        pair_coefficients=() if second is None else (mixed,),
        gravity=tuple(float(g) for g in config.gravity),
        rotation=Rotation(tuple(config.rotation.times), tuple(config.rotation.speeds_rpm)),
        start_time=config.start_time,
        end_time=config.end_time,
        frame_interval=config.frame_interval,
        **vars(container),
    )
    check_stiffness(scene)
    if config.coarse_graining == 1.0:
        return scene
    return scene.coarse_grained(config.coarse_graining, config.coarse_friction, config.coarse_rolling_friction)


def check_stiffness(scene: Scene) -> None:
    """Refuses particles that their own weight crushes, ρ g d/E > 0.1: as a rule E was not given in Pa.

    Raises:
        SceneError: names the material's modulus.
    """
    weight = scene.gravity_strength * 2.0 * scene.filling.largest_radius
    for place, material in zip(("material", "second_material"), scene.materials, strict=False):
        given = f"scene.{place}.youngs_modulus={material.youngs_modulus:g} Pa"
        if (share := material.density * weight / material.youngs_modulus) > CRUSHED:
            raise SceneError(
                f"{given} lets spheres be crushed by their own weight (ρ g d/E = {share:.2g}); it is in Pa: choose at "
                f"least {material.density * weight / CRUSHED:.2g}, such as 1e7, or 6.3e10 for 63 GPa"
            )


def build_filling(config: FillingConfig) -> Filling:
    """The filling that a config describes."""
    given, share = {name: getattr(config, name) for name in FillingConfig.__dataclass_fields__}, config.second_fraction
    del given["second_fraction"]
    given["sizes"] = Sizes(**{name: getattr(config.sizes, name) for name in Sizes.__dataclass_fields__})
    return Filling(**given, fractions=(1.0 - share, share) if share else ())


def open_space(config: ContainerConfig, scene: SceneConfig) -> Container:
    """No walls."""
    return Container()


def drum(config: ContainerConfig, scene: SceneConfig) -> Container:
    """A horizontal drum about the y axis, with caps that turn with it unless y wraps around."""
    radius, half = 0.5 * config.diameter, 0.5 * config.length
    walls: tuple[Wall, ...] = (Cylinder((0.0, 0.0, 0.0), ALONG, radius),)
    if not config.periodic_axis:
        walls += (Plane((0.0, -half, 0.0), ALONG), Plane((0.0, half, 0.0), (0.0, -1.0, 0.0)))
    return Container(walls, drum_radius=radius, length=config.length, periodic_axis=config.periodic_axis)


def closed_box(config: BoxConfig, scene: SceneConfig) -> Container:
    """A closed box that stands on z = 0, its middle above the origin."""
    x, y = 0.5 * config.width, 0.5 * config.length
    lower, upper = (-x, -y, 0.0), (x, y, config.height)
    return Container(box(lower, upper, turns=False), Room(lower, upper))


def hopper(config: HopperConfig, scene: SceneConfig) -> Container:
    """A tube above a cone that ends in an orifice at z = 0, a lid on it until the start, and an outlet below."""
    wide, narrow = 0.5 * config.diameter, 0.5 * config.orifice
    if not narrow < wide:
        raise SceneError(
            f"scene.container.orifice={config.orifice:g} is not narrower than scene.container.diameter="
            f"{config.diameter:g}; choose less"
        )
    cone = (wide - narrow) / math.tan(math.radians(config.half_angle_deg))
    walls = (
        Cylinder((0.0, 0.0, cone + 0.5 * config.height), UP, wide, length=config.height, turns=False),
        Cone((0.0, 0.0, 0.0), UP, narrow, wide, cone, turns=False),
        Disc((0.0, 0.0, 0.0), UP, narrow, turns=False, opens=scene.start_time),
    )
    room = Room((-wide, -wide, cone), (wide, wide, cone + config.height), radius=wide)
    return Container(walls, room, Outlet((0.0, 0.0, -config.outlet_depth), UP, radius=config.orifice))
