"""From a config to a scene: the containers that a config can name, and what goes into them."""

from __future__ import annotations

import math

from gran_bench.config import BoxConfig, ContainerConfig, FillingConfig, HopperConfig, SceneConfig
from gran_bench.scene.errors import SceneError
from gran_bench.scene.filling import Filling, Room
from gran_bench.scene.material import Material, PairCoefficients
from gran_bench.scene.motion import Rotation
from gran_bench.scene.scene import Scene
from gran_bench.scene.sizes import Sizes
from gran_bench.scene.walls import Cone, Cylinder, Disc, Outlet, Plane, Wall, box

UP, ALONG = (0.0, 0.0, 1.0), (0.0, 1.0, 0.0)


def build_scene(config: SceneConfig) -> Scene:
    """The scene that a config describes.

    Raises:
        SceneError: a value that no scene can have; the message names key, value and remedy.
    """
    material = Material.from_config(config.material)
    second = config.second_material
    mixed = PairCoefficients(0, 1, config.mixed.restitution, config.mixed.friction, config.mixed.rolling_friction)
    return Scene(
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
        **_container(config.container, config.start_time),
    )


def build_filling(config: FillingConfig) -> Filling:
    """The filling that a config describes."""
    share = config.second_fraction
    return Filling(
        count=config.count,
        diameter=config.diameter,
        lattice_spacing=config.lattice_spacing,
        jitter=config.jitter,
        settled_speed=config.settled_speed,
        longest_settling=config.longest_settling,
        settles=config.settles,
        sizes=Sizes(
            config.sizes.kind,
            tuple(config.sizes.factors),
            tuple(config.sizes.fractions),
            config.sizes.spread,
            tuple(config.sizes.edges),
            config.sizes.by,
        ),
        fractions=(1.0 - share, share) if share else (),
        positions=tuple(map(tuple, config.positions)),
        velocities=tuple(map(tuple, config.velocities)),
        spins=tuple(map(tuple, config.spins)),
        expansion=config.expansion,
        radii=tuple(config.radii),
    )


def _container(config: ContainerConfig | BoxConfig | HopperConfig, start_time: float) -> dict:
    """Walls, and where in them the spheres start, as fields of a scene."""
    if isinstance(config, BoxConfig):
        return _box(config)
    if isinstance(config, HopperConfig):
        return _hopper(config, start_time)
    return _drum(config) if config.kind == "drum" else {"walls": ()}


def _drum(drum: ContainerConfig) -> dict:
    """A horizontal drum about the y axis, with caps that turn with it unless y wraps around."""
    walls: list[Wall] = [Cylinder((0.0, 0.0, 0.0), ALONG, 0.5 * drum.diameter)]
    if not drum.periodic_axis:
        walls.append(Plane((0.0, -0.5 * drum.length, 0.0), ALONG))
        walls.append(Plane((0.0, 0.5 * drum.length, 0.0), (0.0, -1.0, 0.0)))
    return {
        "walls": tuple(walls),
        "drum_radius": 0.5 * drum.diameter,
        "length": drum.length,
        "periodic_axis": drum.periodic_axis,
    }


def _box(config: BoxConfig) -> dict:
    """A closed box that stands on z = 0, its middle above the origin."""
    x, y = 0.5 * config.width, 0.5 * config.length
    lower, upper = (-x, -y, 0.0), (x, y, config.height)
    return {"walls": box(lower, upper, turns=False), "room": Room(lower, upper)}


def _hopper(hopper: HopperConfig, start_time: float) -> dict:
    """A tube above a cone that ends in an orifice at z = 0, a lid on it until the start, and an outlet below."""
    wide, narrow = 0.5 * hopper.diameter, 0.5 * hopper.orifice
    if not narrow < wide:
        raise SceneError(
            f"scene.container.orifice={hopper.orifice:g} is not narrower than scene.container.diameter="
            f"{hopper.diameter:g}; choose less"
        )
    cone = (wide - narrow) / math.tan(math.radians(hopper.half_angle_deg))
    walls = (
        Cylinder((0.0, 0.0, cone + 0.5 * hopper.height), UP, wide, length=hopper.height, turns=False),
        Cone((0.0, 0.0, 0.0), UP, narrow, wide, cone, turns=False),
        Disc((0.0, 0.0, 0.0), UP, narrow, turns=False, opens=start_time),
    )
    room = Room((-wide, -wide, cone), (wide, wide, cone + hopper.height), radius=wide)
    outlet = Outlet((0.0, 0.0, -hopper.outlet_depth), UP, radius=hopper.orifice)
    return {"walls": walls, "room": room, "outlet": outlet}
