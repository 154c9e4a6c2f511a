"""gran-bench: which method gives the granular-flow answer you can trust in the least time?

>>> from gran_bench import settle, shipped_scene, simulate
>>> scene = shipped_scene("free_flight")
>>> simulate(scene, settle(scene, seed=0), scene.end_time).trajectory.frame_count == scene.frame_count
True
"""

import importlib as _importlib

from gran_bench import cache_folders as cache_folders

__version__ = "0.1.0"

# Where each public name is. A module is imported when a name of it is first asked for: PyTorch not for the DEM.
_HOMES = {
    **dict.fromkeys(("register_loss", "register_metric", "register_model", "register_wall"), "config.registry"),
    **dict.fromkeys(("ConfigError", "Section", "at_least", "between", "key", "one_of", "positive"), "config.rules"),
    **dict.fromkeys(("Cone", "Container", "Cylinder", "Disc", "Outlet", "Plane", "Room", "Scene"), "scene"),
    "surface_of_revolution": "scene",
    **dict.fromkeys(("settle", "simulate"), "dem.simulate"),
    **dict.fromkeys(("shipped_model", "shipped_scene"), "shipped"),
    **dict.fromkeys(("FrameState", "NewtonSurrogate", "Surrogate"), "surrogate.step"),
    **dict.fromkeys(("Measured", "Series"), "metrics.measured"),
    **{"DemConfig": "config", "Trajectory": "state", "FrameAhead": "losses", "judge": "metrics.judge"},
    **{"import_arrays": "import_case", "load_model": "surrogate.checkpoint", "rollout": "surrogate.rollout"},
    "load_emulator": "emulator.network",
}
__all__ = sorted(_HOMES)


def __getattr__(name):
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = found = getattr(_importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
    return found


def __dir__():
    return sorted({*globals(), *__all__})
