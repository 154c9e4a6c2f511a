"""Which models, terms of the loss, metrics and containers there are: the house's and those of plugins, in one way.

A plugin is a package that registers something when it is imported, and that says so in the entry-point group
``gran_bench.plugins``. Plugins are loaded once in each process, when a registry is first read.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, is_dataclass
from importlib.metadata import entry_points
from typing import Any, Generic, TypeVar

from gran_bench.config.rules import ConfigError, Section, add_key, at_least, key, one_of, stand_at

GROUP = "gran_bench.plugins"
HOUSE = "gran_bench"

Entry = TypeVar("Entry")
Config = TypeVar("Config", bound=type[Section])
Function = TypeVar("Function", bound=Callable[..., Any])

_state: dict[str, Any] = {"begun": False, "failure": None, "weights": None}


def load_plugins() -> None:
    """Import every plugin that is installed, once a process.

    Raises:
        ConfigError: a plugin cannot be imported; names it, its package and the remedy.
    """
    if _state["failure"] is not None:
        raise ConfigError(_state["failure"])
    if _state["begun"]:
        return
    _state["begun"] = True  # first of all: a plugin that is being imported may read a registry
    for point in sorted(entry_points(group=GROUP)):
        try:
            point.load()
        except Exception as error:
            package = f" of the package {point.dist.name}" if point.dist else ""
            _state["failure"] = (
                f"the plugin {point.name}{package} ({point.value}) cannot be loaded: {type(error).__name__}: "
                f"{' '.join(str(error).split())}; mend it or uninstall it"
            )
            raise ConfigError(_state["failure"]) from error


class Registry(Mapping[str, Entry], Generic[Entry]):
    """What has been registered, by name; reading it loads the plugins.

    Args:
        what: one entry, for messages.
    """

    def __init__(self, what: str) -> None:
        self.what = what
        self._entries: dict[str, Entry] = {}
        self._owners: dict[str, str] = {}

    def add(self, name: str, entry: Entry, owner: str) -> None:
        """Register an entry. The package that owns a name may register it again, as when its module is reloaded.

        Args:
            name: an identifier.
            entry: what the name stands for.
            owner: module that it is of.

        Raises:
            ConfigError: no identifier, or the name of another package.
        """
        owner = owner.partition(".")[0]
        if not name.isidentifier():
            raise ConfigError(f"{self.what} {name!r}: choose a name of letters, digits and _, no digit first")
        if self._owners.get(name, owner) != owner:
            raise ConfigError(
                f"{self.what} {name}, registered by {owner}: {self._owners[name]} has one of that name; choose another"
            )
        self._entries[name], self._owners[name] = entry, owner

    def owner(self, name: str) -> str:
        """The package that registered a name."""
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
        load_plugins()
        return len(self._entries)


@dataclass(frozen=True)
class Builder:
    """A section of the config, and the function that makes something of it.

    Attributes:
        config: the section's class.
        build: the function, or ``package.module:name``, which is imported when it is needed.
    """

    config: type[Section]
    build: Callable[..., Any] | str

    def __call__(self, *arguments: Any) -> Any:
        """What the function makes of its arguments."""
        function = self.build
        if isinstance(function, str):
            module, _, name = function.partition(":")
            function = getattr(importlib.import_module(module), name)
        return function(*arguments)


@dataclass(frozen=True)
class Model(Builder):
    """A model that training can name.

    Attributes:
        own_walls: whether it sees walls in a way of its own, so that ``boundary`` decides nothing.
        spin: whether it predicts spin.
        conserves_momentum: whether its pairs do, exactly.
        code: rooms of the house that its weights pass through; a plugin's are all of its package.
    """

    own_walls: bool = True
    spin: bool = False
    conserves_momentum: bool = False
    code: tuple[str, ...] = ()


@dataclass(frozen=True)
class Wall(Builder):
    """A container that a scene can name.

    Attributes:
        drum: whether it turns about y at the speeds of a data set, so that a model can be trained in it.
    """

    drum: bool = False


@dataclass(frozen=True)
class Metric:
    """A figure of a trajectory.

    Attributes:
        label: for people.
        unit: SI, or the exception that it names.
        measure: gets a trajectory and its scene; gives a number, a ``Measured`` or a ``Series``.
    """

    label: str
    unit: str
    measure: Callable[..., Any]


MODELS: Registry[Model] = Registry("model")
WALLS: Registry[Wall] = Registry("container")
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
    code: tuple[str, ...] = (),
) -> Callable[[Config], Config]:
    """Let ``model.name`` be one of ``names``; decorates the dataclass of the model's keys.

    Args:
        names: of the model.
        build: the `Surrogate`'s class, or ``package.module:Class``. It is called with the config and the scene; where
            the walls are not its own, with the config, the ``boundary`` and the scene.
        own_walls, spin, conserves_momentum, code: as in `Model`.

    Raises:
        ConfigError: no dataclass of `Section`, or a name that another package has.
    """

    def register(config: Config) -> Config:
        _stand(config, "model", "name", names)
        for name in names:
            MODELS.add(name, Model(config, build, own_walls, spin, conserves_momentum, code), config.__module__)
        return config

    return register


def register_wall(*names: str, build: Callable[..., Any] | str, drum: bool = False) -> Callable[[Config], Config]:
    """Let ``scene.container.kind`` be one of ``names``; decorates the dataclass of the container's keys.

    Args:
        names: of the container.
        build: a function, or ``package.module:function``, of the container's config and the scene's; gives a
            `Container`.
        drum: as in `Wall`.

    Raises:
        ConfigError: no dataclass of `Section`, or a name that another package has.
    """

    def register(config: Config) -> Config:
        _stand(config, "scene.container", "kind", names)
        for name in names:
            WALLS.add(name, Wall(config, build, drum), config.__module__)
        return config

    return register


def holds_weights(section: Config) -> Config:
    """Mark the section of a config whose keys are the weights of the loss's terms."""
    _state["weights"] = section
    return section


def register_loss(term: Function) -> Function:
    """Let ``loss`` have a key of the function's name: the weight of a term, 0 unless it is given.

    Args:
        term: gets a `FrameAhead`; gives a scalar tensor without unit, differentiable in the prediction.

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
    reason; or a `Series` with a value a state, whose mean is the figure and which is compared state by state.

    Args:
        label: for people.
        unit: SI; ``-`` for none.

    Raises:
        ConfigError: a name that another package has.
    """

    def register(measure: Function) -> Function:
        METRICS.add(measure.__name__, Metric(label, unit, measure), measure.__module__)
        return measure

    return register


def _stand(config: type, place: str, chooser: str, names: tuple[str, ...]) -> None:
    """Let a dataclass be a section at ``place``, with the key that chooses it."""
    if not (is_dataclass(config) and issubclass(config, Section)):
        raise ConfigError(
            f"{config.__name__}, registered as {' and '.join(names)}, is no dataclass of gran_bench.Section; write "
            "@dataclass below the decorator and derive it from Section"
        )
    stand_at(config, place)
    if chooser not in config.__dataclass_fields__:
        add_key(config, chooser, "str", key(names[0], one_of(*names)))
