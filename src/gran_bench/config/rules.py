"""What a config key may hold, and sections that hold every value against its key.

The same table serves the command line, a config that is made in Python, and the parts of a scene.
"""

from __future__ import annotations

import functools
import math
import os
import re
import sys
import types
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any, Union, get_args, get_origin, get_type_hints

TYPE_WORDS = {float: "a number", int: "a whole number", bool: "true or false", str: "a word"}
MISSING = "???"  # Hydra's mark of a value that the user must choose
LONGEST_SHOWN = 80  # characters of a refused value
LONGEST_NAME = 150  # bytes; file systems end at 255, and a key and an extension follow

hints_of = functools.cache(get_type_hints)
# Registered sections by the place where they stand.
_standing: dict[str, list[type[Section]]] = defaultdict(list)


class ConfigError(ValueError):
    """A config that no run can have; the message names the key, the value and the remedy in one line."""


@dataclass(frozen=True)
class Range:
    """An interval of numbers; ``open_low`` and ``open_high`` exclude the ends. Never holds nan or an infinity."""

    low: float = -math.inf
    high: float = math.inf
    open_low: bool = False
    open_high: bool = False
    unit: str = ""

    def holds(self, value: float) -> bool:
        above = value > self.low if self.open_low else value >= self.low
        below = value < self.high if self.open_high else value <= self.high
        return abs(value) < math.inf and above and below

    def __str__(self) -> str:
        unit = f" {self.unit}" if self.unit else ""
        if math.isinf(self.low):
            return f"a finite value{unit and ' in' + unit}"
        if math.isinf(self.high):
            return f"a value {'>' if self.open_low else '≥'} {self.low:g}{unit}"
        left, right = "(" if self.open_low else "[", ")" if self.open_high else "]"
        return f"a value in {left}{self.low:g}, {self.high:g}{right}{unit}"


@dataclass(frozen=True)
class OneOf:
    """An enumeration of words."""

    words: tuple[str, ...]

    def holds(self, value: str) -> bool:
        return value in self.words

    def __str__(self) -> str:
        return " or ".join(self.words)


@dataclass(frozen=True)
class Name:
    """A word that a file or a folder is called by on any file system; never a path, and never a pattern to a shell."""

    def holds(self, value: str) -> bool:
        return re.fullmatch(r"\w[\w.+-]*", value) is not None and len(value.encode()) <= LONGEST_NAME

    def __str__(self) -> str:
        letters = "letters, digits, _ . + and -, a letter or digit first"
        return f"a name, which is never a path: {letters}, of at most {LONGEST_NAME} bytes"


Rule = Range | OneOf | Name


def positive(unit: str = "") -> Range:
    """> 0, in ``unit``."""
    return Range(0.0, open_low=True, unit=unit)


def at_least(low: float, unit: str = "") -> Range:
    """≥ ``low``, in ``unit``."""
    return Range(low, unit=unit)


def between(low: float, high: float, unit: str = "") -> Range:
    """From ``low`` to ``high`` without the ends, in ``unit``."""
    return Range(low, high, open_low=True, open_high=True, unit=unit)


def one_of(*words: str) -> OneOf:
    """One of the words."""
    return OneOf(words)


def key(default: Any, rule: Rule) -> Any:
    """A key of a section: its default and its rule. The rule of a list holds for each of its elements."""
    if isinstance(default, list):
        return field(default_factory=default.copy, metadata={"rule": rule})
    return field(default=default, metadata={"rule": rule})


class Section:
    """A section of a config: what is put into a key is held against the key's type and rule at once (`ConfigError`).

    A word without a rule may be any but the empty one. Tuples, arrays and NumPy's numbers become lists and plain
    numbers, so that a config made in Python is the one that a command line would have made.
    """

    place = ""  # where the section stands in a whole config, dotted, with a dot at its end

    def __init_subclass__(cls, place: str = "") -> None:
        super().__init_subclass__()
        cls.place = place and f"{place}."

    def __setattr__(self, name: str, value: Any) -> None:
        object.__setattr__(self, name, checked(type(self), name, value))


def stand_at(section: type[Section], place: str) -> None:
    """Let a section's class be one of those that stand at a place of a whole config, such as ``model``."""
    section.place = f"{place}."
    _standing[section.place] = list(dict.fromkeys([*_standing[section.place], section]))


def add_key(section: type[Section], name: str, hint: str, entry: Any) -> None:
    """Give a section's dataclass one more key, the last: its type as an annotation has it, and what `key` gives."""
    for known in fields(section):  # dataclass() reads its fields from the class again
        again = field(default=known.default, default_factory=known.default_factory, metadata=known.metadata)
        setattr(section, known.name, again)
    section.__annotations__[name] = hint
    setattr(section, name, entry)
    for made in ("__init__", "__repr__", "__eq__"):
        delattr(section, made)
    dataclass(section)
    hints_of.cache_clear()


def checked(schema: type[Section], name: str, value: Any, place: str | None = None) -> Any:
    """``value`` as the key ``name`` of a section holds it, else a `ConfigError`; ``place`` ends with a dot."""
    dotted, hints = (schema.place if place is None else place) + name, hints_of(schema)
    if name not in hints:
        raise ConfigError(f"{dotted}={shown(value)}: no such key; the keys are {', '.join(hints)}")
    declared = schema.__dataclass_fields__[name]
    if isinstance(value, str) and value == MISSING == declared.default:
        return value
    return checked_value(hints[name], declared.metadata.get("rule"), value, dotted)


def checked_value(hint: Any, rule: Rule | None, value: Any, dotted: str) -> Any:
    """``value`` as a key of type ``hint`` holds it.

    Args:
        hint: bool, int, float, str, a list or a tuple of them, or classes; perhaps or None.
        rule: of a number or a word, or of each in a list; a number without a rule is finite.
        dotted: the key's name for the message.

    Raises:
        ConfigError: a wrong type or a value outside the rule.
    """
    if value is None and is_optional(hint):
        return None
    or_null = ", or null" if is_optional(hint) else ""
    kinds = tuple(dict.fromkeys([*(m for m in _members_of(hint) if m is not type(None)), *sections_of(hint)]))
    kind = kinds[0]
    if not _is_list(kind) and kind not in TYPE_WORDS:
        if not isinstance(value, kinds):
            wanted = " or ".join(each.__name__ for each in kinds)
            raise ConfigError(f"{dotted}={shown(value)} has the wrong type; give a {wanted}{or_null}")
        return value
    if hasattr(value, "tolist"):  # of NumPy or torch
        value = value.tolist()
    if _is_list(kind):
        return _checked_list(kind, rule, value, dotted)
    if kind is float and type(value) is int:
        value = float(value) if abs(value) <= sys.float_info.max else math.inf if value > 0 else -math.inf
    elif kind is str and isinstance(value, os.PathLike):
        value = os.fspath(value)
    # bool is an int to Python, but not to a person: only an exact type will do.
    if type(value) is not kind:
        raise ConfigError(f"{dotted}={shown(value)} has the wrong type; give {TYPE_WORDS[kind]}{or_null}")
    if rule is None and kind in (int, float):
        rule = Range()
    if not (rule.holds(value) if rule else kind is not str or value.strip()):
        raise ConfigError(f"{dotted}={shown(value)} is impossible; choose {rule or TYPE_WORDS[kind]}{or_null}")
    return value


def _is_list(hint: Any) -> bool:
    return get_origin(hint) in (list, tuple)


def _checked_list(kind: Any, rule: Rule | None, value: Any, dotted: str) -> Any:
    elements = get_args(kind)
    if not isinstance(value, list | tuple):
        raise ConfigError(f"{dotted}={shown(value)} is no list; write {dotted}=[{shown(value)}]")
    if _is_list(elements[0]) and not all(isinstance(row, list | tuple) or hasattr(row, "tolist") for row in value):
        raise ConfigError(f"{dotted}={shown(value)} is no list of vectors; write {dotted}=[[x, y, z]]")
    found = [checked_value(elements[0], rule, each, f"{dotted}[{i}]") for i, each in enumerate(value)]
    if get_origin(kind) is tuple and elements[-1] is not ... and len(found) != len(elements):
        raise ConfigError(f"{dotted}={shown(found)} is no vector; give three components")
    return get_origin(kind)(found)


def check_arguments(**arguments: tuple[Any, Any]) -> None:
    """Refuse, as a `ConfigError`, arguments of another type than a function takes: ``scene=(scene, Scene)``."""
    for name, (value, hint) in arguments.items():
        checked_value(hint, None, value, name)


def raising(complaints: Callable[..., Iterable[str]]) -> Callable[..., None]:
    """The check that raises, as a `ConfigError`, the first sentence that a function complains with."""

    @functools.wraps(complaints)
    def check(*arguments: Any) -> None:
        for complaint in complaints(*arguments):
            raise ConfigError(complaint)

    return check


def _members_of(hint: Any) -> tuple[Any, ...]:
    return get_args(hint) if get_origin(hint) in (Union, types.UnionType) else (hint,)


def is_optional(hint: Any) -> bool:
    """Whether null will do."""
    return type(None) in _members_of(hint)


def sections_of(hint: Any) -> Iterator[type[Section]]:
    """The sections that a key of this type may hold, registered ones included; none where it holds values."""
    members = [member for member in _members_of(hint) if is_dataclass(member)]
    registered = [one for member in members for one in _standing.get(getattr(member, "place", ""), ())]
    yield from dict.fromkeys([*members, *registered])


def shown(value: Any) -> str:
    """A value as a command line has it, in one line that is not too long."""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    if is_dataclass(value):
        return f"{type(value).__name__}(…)"
    text = " ".join(str(value).removesuffix(".0").split() if isinstance(value, float) else str(value).split())
    return text if len(text) <= LONGEST_SHOWN else f"{text[: LONGEST_SHOWN - 1]}…"
