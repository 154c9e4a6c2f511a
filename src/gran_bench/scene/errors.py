"""The one error of a scene, and how the parts of a scene are held against the table of the config keys."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from gran_bench.config.rules import ConfigError, Rule, Section, checked_value, hints_of


class SceneError(ValueError):
    """A scene that cannot exist; the message names the key, the value and the remedy."""


@contextmanager
def scene_errors() -> Iterator[None]:
    """What a config is refused for, refused with the same sentence as a scene."""
    try:
        yield
    except ConfigError as error:
        raise SceneError(str(error)) from None


def hold(part: Any, place: str, schema: type[Section] | None = None, unit: str = "", **rules: Rule | None) -> None:
    """Hold the fields of a part of a scene against their types and rules; arrays and lists become tuples.

    Args:
        part, place: a frozen dataclass, and where it stands in the names of its fields, with a dot at its end.
        schema: the config section that describes such a part; its keys have the rules of the fields of their names.
        unit: field that is a unit vector.
        rules: of fields that no config key describes, or whose rule is another. A number without a rule is finite.

    Raises:
        SceneError: names the field, the value and what is legal.
    """
    keys = {} if schema is None else schema.__dataclass_fields__
    with scene_errors():
        for name, hint in hints_of(type(part)).items():
            rule = rules.get(name, keys[name].metadata.get("rule") if name in keys else None)
            object.__setattr__(part, name, checked_value(hint, rule, getattr(part, name), place + name))
    length = math.hypot(*getattr(part, unit)) if unit else 1.0
    if not abs(length - 1.0) < 1e-9:
        raise SceneError(f"{place}{unit}={list(getattr(part, unit))} has length {length:g}; give a unit vector")
