"""Which scenes a trained model can answer for, and which it may: none that it was trained on."""

from __future__ import annotations

from gran_bench.config import SceneConfig
from gran_bench.config.reading import read_config
from gran_bench.scene import Scene, build_scene
from gran_bench.surrogate.checkpoint import ModelCard


def why_unfit(card: ModelCard, scene: Scene, packing_seed: int) -> str:
    """Why a trained model cannot answer for a scene, or may not; empty where it can.

    Args:
        card: of the model.
        scene: with its motion.
        packing_seed: of the bed that it would start from.
    """
    home = build_scene(read_config(SceneConfig, card.scene))
    known = {
        "spheres of one size": not scene.needs.polydispersity,
        "one material": len(scene.materials) == 1,
    }
    for what, holds in known.items():
        if not holds:
            return f"it knows {what} alone"
    same = {
        "diameter": (2.0 * scene.filling.largest_radius, 2.0 * home.filling.largest_radius),
        "frame interval": (scene.frame_interval, home.frame_interval),
        "gravity": (scene.gravity, home.gravity),
        "material": (scene.material, home.material),
        "wall material": (scene.wall_material, home.wall_material),
    }
    for what, (here, there) in same.items():
        if here != there:
            return f"it was trained with another {what}"
    # The other sense of rotation is the mirror image.
    speeds = set(map(abs, scene.rotation.speeds_rpm))
    if scene.takes_speeds and speeds & set(map(abs, card.origin.get("training_speeds_rpm", ()))):
        return f"it was trained at {max(speeds):g} rpm"
    if scene.takes_speeds and card.origin.get("packing_seed") == packing_seed:
        return f"it was trained on packing {packing_seed}"
    return ""
