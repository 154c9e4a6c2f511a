"""A scene as plain numbers and text, for YAML files and for hashes, and back."""

from __future__ import annotations

from dataclasses import asdict, fields
from typing import Any

from gran_bench.scene import Cylinder, Filling, Material, Plane, Rotation, Scene, SceneError

_WALLS = {"plane": Plane, "cylinder": Cylinder}
_WHOLE_NUMBERS = {"count"}


def to_document(scene: Scene) -> dict[str, Any]:
    """Every field of a scene as nested dicts, lists, floats and text; equal scenes give equal documents."""
    document = _plain(asdict(scene))
    for entry, wall in zip(document["walls"], scene.walls, strict=True):
        entry["kind"] = next(kind for kind, cls in _WALLS.items() if type(wall) is cls)
    return document


def from_document(document: dict[str, Any]) -> Scene:
    """The scene that a document describes.

    Raises:
        SceneError: a key is missing or unknown, or a value is impossible.
    """
    try:
        values = {name: _hashable(value) for name, value in document.items()}
        values["walls"] = tuple(_wall(dict(entry)) for entry in document["walls"])
        for name, cls in (("filling", Filling), ("material", Material), ("wall_material", Material)):
            values[name] = cls(**document[name])
        values["rotation"] = Rotation(**{name: _hashable(value) for name, value in document["rotation"].items()})
        missing = {f.name for f in fields(Scene)} - set(values)
        if missing:
            raise SceneError(f"the scene's document lacks {', '.join(sorted(missing))}")
        return Scene(**values)
    except (AttributeError, KeyError, TypeError) as error:
        raise SceneError(f"not the document of a scene: {error}") from error


def _wall(entry: dict[str, Any]) -> Plane | Cylinder:
    cls = _WALLS[entry.pop("kind")]
    return cls(**{name: _hashable(value) for name, value in entry.items()})


def _hashable(value: Any) -> Any:
    return tuple(_hashable(v) for v in value) if isinstance(value, list | tuple) else value


def _plain(value: Any, name: str = "") -> Any:
    """Floats throughout, so that 30 and 30.0 are one speed; −0 is 0."""
    if isinstance(value, dict):
        return {key: _plain(entry, key) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    if value is None or isinstance(value, bool | str):
        return value
    return int(value) if name in _WHOLE_NUMBERS else float(value) + 0.0
