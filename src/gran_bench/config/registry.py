"""Which models, terms of the loss, metrics and containers there are: the house's and those of plugins, in one way.

A plugin is a package of the entry-point group ``gran_bench.plugins`` that registers something when it is imported.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, is_dataclass
from importlib.metadata import entry_points
from pkgutil import resolve_name
from typing import Any, Generic, TypeVar

from gran_bench.config.rules import ConfigError, Section, add_key, at_least, key, one_of, stand_at

GROUP = "gran_bench.plugins"
HOUSE = "gran_bench"

Entry = TypeVar("Entry")
Config = TypeVar("Config", bound=type[Section])
Function = TypeVar("Function", bound=Callable[..., Any])

_state: dict[str, Any] = {"loaded": False, "weights": None}


def load_plugins() -> None:
    """Import every plugin that is installed, once a process; a `ConfigError` where one cannot be imported."""
    if _state["loaded"]:
        return
    _state["loaded"] = True  # first of all: a plugin that is being imported may read a registry
    for point in sorted(entry_points(group=GROUP)):
        try:
            point.load()
        except Exception as error:
            _state["loaded"] = False
            plugin = f"{point.name}{f' of the package {point.dist.name}' if point.dist else ''} ({point.value})"
            why = f"{type(error).__name__}: {' '.join(str(error).split())}"
            raise ConfigError(f"the plugin {plugin} cannot be loaded: {why}; mend it or uninstall it") from error


class Registry(Mapping[str, Entry], Generic[Entry]):
    """What has been registered, by name; reading it loads the plugins."""

    def __init__(self, what: str, place: str = "", chooser: str = "") -> None:
        self.what = what  # one entry, for messages
        self.place = place  # of the section of a config that an entry describes
        self.chooser = chooser  # the section's key that chooses the entry
        self._entries: dict[str, Entry] = {}
        self._owners: dict[str, str] = {}

    def add(self, name: str, entry: Entry, module: str) -> None:
        """Register an entry of a module. The package that owns a name may register it again, as when it is reloaded."""
        owner = module.partition(".")[0]
        if not name.isidentifier():
            raise ConfigError(f"{self.what} {name!r}: choose a name of letters, digits and _, no digit first")
        if self._owners.get(name, owner) != owner:
            has = f"{self._owners[name]} has one of that name"
            raise ConfigError(f"{self.what} {name}, registered by {owner}: {has}; choose another")
        self._entries[name], self._owners[name] = entry, owner

    def section(self, config: Config, names: tuple[str, ...], entry: Entry) -> Config:
        """Register an entry under some names with the dataclass of its keys, which gets the key that chooses it."""
        if not (is_dataclass(config) and issubclass(config, Section)):
            given = f"{config.__name__}, registered as {' and '.join(names)}, is no dataclass of gran_bench.Section"
            raise ConfigError(f"{given}; write @dataclass below the decorator and derive it from Section")
        stand_at(config, self.place)
        if self.chooser not in config.__dataclass_fields__:
            add_key(config, self.chooser, "str", key(names[0], one_of(*names)))
        for name in names:
            self.add(name, entry, config.__module__)
        return config

    def owner(self, name: str) -> str:
        load_plugins()
        return self._owners[name]

    def added(self) -> list[str]:
        """The names that packages beside the house registered."""
        load_plugins()
        return [name for name, owner in self._owners.items() if owner != HOUSE]

    def plugins(self) -> list[str]:
        """The packages beside the house that registered something."""
        load_plugins()
        return sorted({*self._owners.values()} - {HOUSE})

    def __getitem__(self, name: str) -> Entry:
        load_plugins()
        return self._entries[name]

    def __iter__(self) -> Iterator[str]:
        load_plugins()
        return iter(dict(self._entries))

    def __len__(self) -> int:
        return len(list(iter(self)))


@dataclass(frozen=True)
class Builder:
    """A section of the config, and the function that makes something of it, perhaps as ``package.module:name``."""

    config: type[Section]
    build: Callable[..., Any] | str

    def __call__(self, *arguments: Any) -> Any:
        return (resolve_name(self.build) if isinstance(self.build, str) else self.build)(*arguments)


@dataclass(frozen=True)
class Model(Builder):
    """A model that training can name."""

    own_walls: bool = True  # sees walls in a way of its own, so that `boundary` decides nothing
    spin: bool = False  # predicts spin
    conserves_momentum: bool = False  # its pairs do, exactly
    particles: bool = True  # steps particles; else it gives statistics alone
    gravity_outside: bool = False  # its network sees no gravity, so that turned windows are windows like any other
    code: tuple[str, ...] = ()  # rooms of the house that its weights pass through; a plugin's are all of its package


@dataclass(frozen=True)
class Wall(Builder):
    """A container that a scene can name."""

    drum: bool = False  # turns about y at the speeds of a data set, so that a model can be trained in it


@dataclass(frozen=True)
class Metric:
    """A figure of a trajectory: its words, its unit, and the function that measures it (see `register_metric`)."""

    label: str
    unit: str
    measure: Callable[..., Any]


MODELS: Registry[Model] = Registry("model", "model", "name")
WALLS: Registry[Wall] = Registry("container", "scene.container", "kind")
LOSS_TERMS: Registry[Callable[..., Any]] = Registry("term of the loss")
METRICS: Registry[Metric] = Registry("metric")
# Keys of `loss` that plugins have added.
ADDED_TERMS: set[str] = set()


def register_model(
    *names: str,
    build: Callable[..., Any] | str,
    own_walls: bool = True,
    spin: bool = False,
    conserves_momentum: bool = False,
    particles: bool = True,
    gravity_outside: bool = False,
    code: tuple[str, ...] = (),
) -> Callable[[Config], Config]:
    """Let ``model.name`` be one of ``names``; decorates the dataclass of the model's keys.

    Args:
        build: the `Surrogate`'s class, or ``package.module:Class``. It is called with the config and the scene; where
            the walls are not its own, with the config, the ``boundary`` and the scene.
        own_walls, spin, conserves_momentum, particles, gravity_outside, code: as in `Model`.

    Raises:
        ConfigError: no dataclass of `Section`, or a name that another package has.
    """
    model = {"own_walls": own_walls, "spin": spin, "conserves_momentum": conserves_momentum, "particles": particles}
    model |= {"gravity_outside": gravity_outside}
    return lambda config: MODELS.section(config, names, Model(config, build, **model, code=code))


def register_wall(*names: str, build: Callable[..., Any] | str, drum: bool = False) -> Callable[[Config], Config]:
    """Let ``scene.container.kind`` be one of ``names``; decorates the dataclass of the container's keys.

    Args:
        build: a function, or ``package.module:function``, of the container's config and the scene's; gives a
            `Container`.
        drum: as in `Wall`.

    Raises:
        ConfigError: as for `register_model`.
    """
    return lambda config: WALLS.section(config, names, Wall(config, build, drum))


def holds_weights(section: Config) -> Config:
    """Mark the section of a config whose keys are the weights of the loss's terms."""
    _state["weights"] = section
    return section


def register_loss(term: Function) -> Function:
    """Let ``loss`` have a key of the function's name: the weight of a term, 0 unless it is given.

    The term gets a `FrameAhead`; it gives a scalar tensor without unit, differentiable in the prediction.

    Raises:
        ConfigError: a name that another package, or another key of ``loss``, has.
    """
    section, name = _state["weights"], term.__name__
    is_new = name not in section.__dataclass_fields__
    if not is_new and term.__module__.partition(".")[0] != HOUSE and name not in ADDED_TERMS:
        raise ConfigError(f"term of the loss {name}, of {term.__module__}: loss has a key of that name; choose another")
    LOSS_TERMS.add(name, term, term.__module__)
    if is_new:
        add_key(section, name, "float", key(0.0, at_least(0)))
        ADDED_TERMS.add(name)
    return term


def register_metric(label: str, unit: str) -> Callable[[Function], Function]:
    """Let every judgement have a figure of the function's name, beside the DEM's and its noise floor.

    The function gets a trajectory and its scene. It gives a number, or a `Measured`, which may be undefined with a
    reason; or a `Series` with a value a state, whose mean is the figure and which is compared state by state. The unit
    is SI; ``-`` for none.

    Raises:
        ConfigError: a name that another package has.
    """

    def register(measure: Function) -> Function:
        METRICS.add(measure.__name__, Metric(label, unit, measure), measure.__module__)
        return measure

    return register
