"""Read a composed config into the schema: no unknown key, no wrong type, no missing value, nothing converted silently.

OmegaConf can merge a config into dataclasses too, but turns the text "3" into a number, cannot hold the union of
model schemas and does not know the nearest right key; so the reading is done here, where every refusal is one line.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import MISSING as NO_DEFAULT
from dataclasses import fields
from difflib import SequenceMatcher
from typing import Any, TypeVar

from gran_bench.config.consistency import check_consistency
from gran_bench.config.registry import ADDED_TERMS, MODELS, WALLS, Registry, load_plugins
from gran_bench.config.rules import ConfigError, checked, hints_of, is_optional, recheck, sections_of, shown
from gran_bench.config.schema import MISSING, SceneConfig

Config = TypeVar("Config")

# Sections whose class a key of theirs chooses: the registry, the key, what it is called, and the usual choice.
CHOSEN: dict[str, tuple[Registry, str, str, str | None]] = {
    "model.": (MODELS, "name", "model", None),
    "scene.container.": (WALLS, "kind", "container", "drum"),
}


def read_config(schema: type[Config], values: Mapping[str, Any]) -> Config:
    """The config that ``values`` describe, read strictly and held against every rule.

    Args:
        schema: a dataclass of ``gran_bench.config``.
        values: nested plain values, as ``OmegaConf.to_container(config, resolve=True)`` gives them.

    Raises:
        ConfigError: an unknown key (with the nearest right one), a wrong type, a missing or an illegal value.
    """
    load_plugins()
    config = _read_section(schema, values, schema.place, schema)
    validate(config)
    return config


def validate(config: Any) -> None:
    """Hold every value of a config against its rule, then the values against each other.

    Raises:
        ConfigError: names the dotted key, the value and what is legal.
    """
    recheck(config)
    check_consistency(config)


def dotted_keys(schema: type, path: str = "") -> Iterator[str]:
    """Every key of a schema in dotted form, sections included; a union gives the keys of all its members."""
    for name, hint in hints_of(schema).items():
        yield path + name
        seen: set[str] = set()
        for member in sections_of(hint):
            new = [key for key in dotted_keys(member, f"{path}{name}.") if key not in seen]
            seen.update(new)
            yield from new


def section_names(schema: type) -> list[str]:
    """The keys of a schema that are sections."""
    return [name for name, hint in hints_of(schema).items() if any(sections_of(hint))]


def nearest_key(key: str, keys: list[str]) -> str | None:
    """The dotted key that the writer of ``key`` most likely meant, or None where none is alike.

    A right name in a wrong place (``restitution``) counts as well as a slip of a letter in the right one.
    """
    parent, _, name = key.rpartition(".")

    def likeness(other: str) -> float:
        other_parent, _, other_name = other.rpartition(".")
        names = SequenceMatcher(None, name, other_name).ratio()
        parents = SequenceMatcher(None, parent, other_parent).ratio()
        return names + 0.2 * parents

    best = max(keys, key=likeness, default=None)
    return best if best is not None and likeness(best) >= 0.75 else None


def unknown_key(key: str, value: Any, schema: type, present: list[str] | None = None) -> ConfigError:
    """The error for a key that the schema, or the chosen model, does not have.

    Args:
        key: dotted.
        value: what it was given.
        schema: of the whole config.
        present: the keys that are legal in its place where that is known; None: all of the schema.
    """
    everywhere = list(dotted_keys(schema, schema.place))
    keys = everywhere if present is None else present
    given = key if isinstance(value, Mapping) else f"{key}={value}"  # a section, such as a whole scene, is too long
    place, _, name = key.rpartition(".")
    if f"{place}." in CHOSEN and key in everywhere:
        registry, chooser, what, _ = CHOSEN[f"{place}."]
        owners = " or ".join(owner for owner, its in registry.items() if name in hints_of(its.config))
        choice = place if place == what else f"{place}.{chooser}"
        if present is None:  # Hydra knows the chosen file alone, which may leave out a key of its own section
            return ConfigError(
                f"{given}: the file of the chosen {what} has no such key; it belongs to {choice}={owners}; if that is "
                f"the {what}, write +{given}"
            )
        return ConfigError(f"{given}: the chosen {what} has no such key; it belongs to {choice}={owners}")
    if place == "loss" and name in ADDED_TERMS:
        return ConfigError(f"{given}: a registered term is added to the chosen loss; write +{given}")
    if key in everywhere:
        return ConfigError(f"{given}: {key.rpartition('.')[0]} is null here; write +{given}")
    guess = nearest_key(key, keys) or nearest_key(key, everywhere)
    if guess is not None:
        return ConfigError(f"{given}: no such key; did you mean {guess}?")
    while place and not any(other.startswith(f"{place}.") for other in keys):
        place = place.rpartition(".")[0]
    below = f"{place}." if place else ""
    names = dict.fromkeys(other.removeprefix(below).partition(".")[0] for other in keys if other.startswith(below))
    what = f"the keys of {place}" if place else "the sections and keys"
    return ConfigError(f"{given}: no such key; {what} are {', '.join(names)}")


def _read_section(schema: type, values: Any, path: str, root: type) -> Any:
    if not isinstance(values, Mapping):
        names = ", ".join(hints_of(schema))
        raise ConfigError(f"{path[:-1] or 'the config'}={shown(values)} is no section; give it the keys {names}")
    if schema is SceneConfig:
        values = _with_whole_materials(values)
    hints = hints_of(schema)
    for name in values:
        if name not in hints:
            raise unknown_key(f"{path}{name}", values[name], root, [path + hint for hint in hints])
    given = {name: _read(schema, name, values[name], path, root) for name in values}
    for entry in fields(schema):
        has_default = entry.default is not NO_DEFAULT or entry.default_factory is not NO_DEFAULT
        if (entry.name not in given and not has_default) or given.get(entry.name, entry.default) == MISSING:
            raise ConfigError(f"{path}{entry.name} is missing; give it a value")
    return schema(**given)


def _with_whole_materials(scene: Mapping[str, Any]) -> Mapping[str, Any]:
    """A scene whose further materials take what they leave out from ``material``; a null wall takes everything."""
    material = scene.get("material")
    further = {name: scene.get(name) for name in ("wall_material", "second_material")}
    if not isinstance(material, Mapping):
        return scene
    return {**scene, **{name: {**material, **m} for name, m in further.items() if isinstance(m, Mapping)}}


def _read(schema: type, name: str, value: Any, path: str, root: type) -> Any:
    hint, key = hints_of(schema)[name], path + name
    sections = list(sections_of(hint))
    if not sections or (value is None and is_optional(hint)):
        return checked(schema, name, value, path)
    return _read_section(_section_of(sections, value, key), value, f"{key}.", root)


def _section_of(sections: list[type], value: Any, key: str) -> type:
    """The dataclass that ``value`` is of: the only one there is, or the one that its name or kind selects."""
    if len(sections) == 1:
        return sections[0]
    registry, chooser, what, default = CHOSEN[sections[0].place]
    name = value.get(chooser, default) if isinstance(value, Mapping) else value
    if name not in registry:
        guess = nearest_key(str(name), list(registry))
        meant = f"did you mean {guess}?" if guess else f"choose {' or '.join(registry)}"
        raise ConfigError(f"{key}.{chooser}={name}: no such {what}; {meant}")
    return registry[name].config
