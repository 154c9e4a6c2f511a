"""A scene as plain numbers and text, for YAML files and for hashes, and back."""

import types
from dataclasses import fields, is_dataclass
from typing import Any, Union, get_args, get_origin, get_type_hints

from gran_bench.scene import Cone, Cylinder, Disc, Plane, Scene, SceneError, Spin, Translation, Vibration

# Where a field may hold one of several things, its document says which.
_KINDS = {cls.__name__.lower(): cls for cls in (Plane, Cylinder, Disc, Cone, Spin, Translation, Vibration)}
_NAMES = {cls: kind for kind, cls in _KINDS.items()}
_WHOLE_NUMBERS = {"count", "first", "second"}
_OPTIONAL = {"fine_spheres"}  # no part of a document where there are none, so that it keeps its hash


def to_document(scene: Scene) -> dict[str, Any]:
    """Every field of a scene as nested dicts, lists, floats and text; equal scenes give equal documents."""
    return _plain(scene)


def from_document(document: dict[str, Any]) -> Scene:
    """The scene that a document describes.

    Raises:
        SceneError: a key is missing or unknown, or a value is impossible.
    """
    try:
        missing = {f.name for f in fields(Scene)} - set(document) - _OPTIONAL
        if missing:
            raise SceneError(f"the scene's document lacks {', '.join(sorted(missing))}")
        return _read(Scene, document)
    except (AttributeError, KeyError, TypeError) as error:
        raise SceneError(f"not the document of a scene: {error}") from error


def _plain(value: Any, name: str = "") -> Any:
    """Floats throughout, so that 30 and 30.0 are one speed; −0 is 0."""
    if is_dataclass(value):
        found = {entry.name: getattr(value, entry.name) for entry in fields(value)}
        document = {
            name: _plain(entry, name) for name, entry in found.items() if name not in _OPTIONAL or entry is not None
        }
        return document | ({"kind": _NAMES[type(value)]} if type(value) in _NAMES else {})
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    if value is None or isinstance(value, bool | str):
        return value
    return int(value) if name in _WHOLE_NUMBERS else float(value) + 0.0


def _read(hint: Any, value: Any) -> Any:
    """A value of the type that the scene's classes declare, from its document."""
    if get_origin(hint) in (Union, types.UnionType):
        if value is None:
            return None
        choices = [member for member in get_args(hint) if member is not type(None)]
        if len(choices) == 1:
            return _read(choices[0], value)
        return _read(_KINDS[value["kind"]], value)
    if get_origin(hint) is tuple:
        return tuple(_read(get_args(hint)[0], entry) for entry in value)
    if not is_dataclass(hint):
        return value
    hints = get_type_hints(hint)
    given = {name: _read(hints[name], entry) for name, entry in value.items() if name != "kind" or "kind" in hints}
    return hint(**given)
