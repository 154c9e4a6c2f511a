"""Read a composed config into the schema: no unknown key, no wrong type, no missing value, nothing converted silently.

OmegaConf would turn the text "3" into a number, and cannot hold the union of model schemas.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import MISSING as NO_DEFAULT
from dataclasses import fields, is_dataclass
from difflib import SequenceMatcher
from typing import Any, TypeVar

from gran_bench.config.consistency import check_consistency
from gran_bench.config.registry import ADDED_TERMS, MODELS, WALLS, load_plugins
from gran_bench.config.rules import MISSING, ConfigError, Section, checked, hints_of, is_optional, sections_of, shown
from gran_bench.config.schema import SceneConfig

Config = TypeVar("Config")

# Registries of the sections whose class a key of theirs chooses, by the section's place.
CHOSEN = {registry.place: registry for registry in (MODELS, WALLS)}


def read_config(schema: type[Config], values: Mapping[str, Any]) -> Config:
    """The config that nested plain values describe, read strictly and held against every rule.

    Raises:
        ConfigError: an unknown key (with the nearest right one), a wrong type, a missing or an illegal value.
    """
    load_plugins()
    config = _read_section(schema, values, schema.place, schema)
    validate(config)
    return config


def validate(config: Any) -> None:
    """Hold every value of a config against its rule, then the values against each other (`ConfigError`)."""
    _recheck(config)
    check_consistency(config)


def _recheck(config: Section) -> None:
    for entry in fields(config):
        value = getattr(config, entry.name)
        setattr(config, entry.name, value)  # a list may have been changed in place
        if is_dataclass(value):
            _recheck(value)


def dotted_keys(schema: type, path: str = "") -> Iterator[str]:
    """Every key of a schema in dotted form, sections included; a union gives the keys of all its members."""
    for name, hint in hints_of(schema).items():
        yield path + name
        below = (key for member in sections_of(hint) for key in dotted_keys(member, f"{path}{name}."))
        yield from dict.fromkeys(below)


def section_names(schema: type) -> list[str]:
    """The keys of a schema that are sections."""
    return [name for name, hint in hints_of(schema).items() if any(sections_of(hint))]


def nearest_key(key: str, keys: list[str]) -> str | None:
    """The dotted key that the writer of ``key`` most likely meant, or None where none is alike.

    A right name in a wrong place (``restitution``) counts as well as a slip of a letter in the right one.
    """

    def likeness(other: str) -> float:
        places, names = zip(key.rpartition(".")[::2], other.rpartition(".")[::2], strict=True)
        return SequenceMatcher(None, *names).ratio() + 0.2 * SequenceMatcher(None, *places).ratio()

    best = max(keys, key=likeness, default=None)
    return best if best is not None and likeness(best) >= 0.75 else None


def unknown_key(key: str, value: Any, schema: type, present: list[str] | None = None) -> ConfigError:
    """The error for a dotted key that the schema of a whole config, or the chosen model, does not have.

    Args:
        present: the keys that are legal in its place where that is known; None: all of the schema.
    """
    everywhere = list(dotted_keys(schema, schema.place))
    keys = everywhere if present is None else present
    given = key if isinstance(value, Mapping) else f"{key}={value}"  # a section, such as a whole scene, is too long
    place, _, name = key.rpartition(".")
    if place in CHOSEN and key in everywhere:
        registry = CHOSEN[place]
        owners = " or ".join(owner for owner, its in registry.items() if name in hints_of(its.config))
        choice = place if place == registry.what else f"{place}.{registry.chooser}"
        if present is not None and key in present:  # Hydra has the keys of the chosen file alone
            return ConfigError(f"{given}: the file of the chosen {registry.what} leaves this key out; write +{given}")
        return ConfigError(f"{given}: the chosen {registry.what} has no such key; it belongs to {choice}={owners}")
    if place == "loss" and name in ADDED_TERMS:
        return ConfigError(f"{given}: a registered term is added to the chosen loss; write +{given}")
    if key in everywhere:
        return ConfigError(f"{given}: {place} is null here; write +{given}")
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
    hints = hints_of(schema)
    if not isinstance(values, Mapping):
        place = path[:-1] or "the config"
        raise ConfigError(f"{place}={shown(values)} is no section; give it the keys {', '.join(hints)}")
    if schema is SceneConfig and isinstance(material := values.get("material"), Mapping):
        # Further materials take what they leave out from the first; a null wall takes everything.
        further = {name: values.get(name) for name in ("wall_material", "second_material")}
        values = {**values, **{name: {**material, **m} for name, m in further.items() if isinstance(m, Mapping)}}
    given = {}
    for name, value in values.items():
        if name not in hints:
            raise unknown_key(f"{path}{name}", value, root, [path + hint for hint in hints])
        sections = list(sections_of(hints[name]))
        if not sections or (value is None and is_optional(hints[name])):
            given[name] = checked(schema, name, value, path)
        else:
            given[name] = _read_section(_section_of(sections, value, path + name), value, f"{path}{name}.", root)
    for entry in fields(schema):
        has_default = entry.default is not NO_DEFAULT or entry.default_factory is not NO_DEFAULT
        if (entry.name not in given and not has_default) or given.get(entry.name, entry.default) == MISSING:
            raise ConfigError(f"{path}{entry.name} is missing; give it a value")
    return schema(**given)


def _section_of(sections: list[type], value: Any, key: str) -> type:
    """The dataclass that ``value`` is of: the only one there is, or the one that its name or kind selects."""
    if len(sections) == 1:
        return sections[0]
    registry = CHOSEN[sections[0].place[:-1]]
    usual = getattr(sections[0], registry.chooser)
    name = value.get(registry.chooser, usual) if isinstance(value, Mapping) else value
    if name not in registry:
        guess = nearest_key(str(name), list(registry))
        meant = f"did you mean {guess}?" if guess else f"choose {' or '.join(registry)}"
        raise ConfigError(f"{key}.{registry.chooser}={name}: no such {registry.what}; {meant}")
    return registry[name].config
