"""What a command line describes: the config of its one job, or of every job of its sweep, checked."""

import hashlib
import re
from collections import defaultdict
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import hydra
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import ConfigCompositionException
from omegaconf import DictConfig, OmegaConf

from gran_bench.config import GenerateConfig, TrainConfig
from gran_bench.config.identity import UNDECIDING
from gran_bench.config.reading import read_config
from gran_bench.config.registry import HOUSE, WALLS
from gran_bench.config.rules import LONGEST_NAME, ConfigError
from gran_bench.scene import build_scene

CONFIG_MODULE = "gran_bench.conf"
VERSION_BASE = "1.3"

# Two commands that differ in these alone train the same weights, so they share a folder.
UNNAMED = UNDECIDING | {"hydra"}

Config = TypeVar("Config")


@dataclass(frozen=True)
class Source:
    """Where configs come from."""

    config_name: str  # of the primary config in `conf/`
    config_dir: str | None = None  # a folder that is searched before the package's (--config-dir)
    config_path: str | None = None  # a folder that is searched instead of the package's (--config-path)

    @property
    def flags(self) -> list[str]:
        folders = {"--config-dir": self.config_dir, "--config-path": self.config_path}
        return [f"{flag}={folder}" for flag, folder in folders.items() if folder is not None]

    @contextmanager
    def opened(self) -> Iterator[None]:
        """Hydra, ready to compose from here and to say which choices there are.

        Raises:
            ConfigError: a folder that is not there.
        """
        if self.config_dir is not None and not Path(self.config_dir).is_dir():
            raise ConfigError(f"--config-dir={self.config_dir}: no such folder; name the one that has your configs")
        # A command that Hydra runs may compose another config, such as a shipped scene.
        outer = GlobalHydra.instance().hydra
        GlobalHydra.instance().clear()
        if self.config_path is not None and "://" not in self.config_path:
            start = hydra.initialize_config_dir(str(Path(self.config_path).resolve()), version_base=VERSION_BASE)
        else:
            start = hydra.initialize_config_module(CONFIG_MODULE, version_base=VERSION_BASE)
        try:
            with start:
                yield
        finally:
            GlobalHydra.instance().hydra = outer

    def composed(self, overrides: Sequence[str], hydra_too: bool = False) -> DictConfig:
        search = [f"hydra.searchpath=[file://{Path(self.config_dir).resolve()}]"] if self.config_dir else []
        try:
            return hydra.compose(self.config_name, [*overrides, *search], return_hydra_config=hydra_too)
        except ConfigCompositionException as error:
            # What the other overrides choose says which keys there are in the place of an unknown one.
            unknown = re.search(r"Could not override '([^']+)'", str(error))
            others = [line for line in overrides if not unknown or not line.startswith(f"{unknown[1]}=")]
            if len(others) < len(overrides):
                error.without = self.composed(others)
            raise


def compose(
    config_name: str, overrides: Sequence[str], config_dir: str | None = None, config_path: str | None = None
) -> DictConfig:
    """What Hydra composes for one job, without starting it; arguments as of `Source`, and overrides without sweeps."""
    source = Source(config_name, config_dir, config_path)
    with source.opened():
        return source.composed(overrides)


@dataclass(frozen=True)
class Described:
    """The jobs that a command line describes."""

    jobs: list[tuple[list[str], DictConfig]] = field(default_factory=list)  # overrides and config, in Hydra's order
    complete: bool = True  # false where a sweeper draws values as it goes: then one job stands for what is fixed
    launcher: DictConfig | None = None  # chosen for a multirun


def described_jobs(source: Source, overrides: Sequence[str], multirun: bool) -> Described:
    """Compose every job of a command line: the one, or the product of all swept values.

    A recipe holds its axes in ``hydra.sweeper.params``; the same key on the command line takes their place.

    Raises:
        ConfigError: a recipe that is a sweep, without ``-m`` or among others; a sweep without a job.
        HydraException: what Hydra cannot compose.
    """
    with source.opened():
        # As Hydra does: what is swept on the command line is no part of the config that chooses the sweeper.
        parser = OverridesParser.create(config_loader=GlobalHydra.instance().config_loader())
        typed = zip(overrides, parser.parse_overrides(list(overrides)), strict=True)
        fixed = [line for line, override in typed if not (multirun and override.is_sweep_override())]
        chosen = source.composed(fixed, hydra_too=True).hydra
        axes = _axes(chosen.sweeper)
        if not multirun:
            if axes:
                raise ConfigError(f"this recipe is a sweep over {', '.join(axes)}; add -m (--multirun) to run its jobs")
            return Described([(list(overrides), source.composed(overrides))])
        if not chosen.sweeper._target_.endswith(f".{BasicSweeper.__name__}"):
            return Described([(fixed, source.composed(fixed))], complete=False, launcher=chosen.launcher)
        lines = [*(f"{key}={values}" for key, values in axes.items()), *overrides]
        parsed = parser.parse_overrides(lines)
        (jobs,) = BasicSweeper.split_arguments(parsed, None)
        for line, override in zip(lines, parsed, strict=True):
            if override.is_sweep_override() and not any(True for _ in override.sweep_string_iterator()):
                raise ConfigError(f"{line} has no value, so there is no job to run; give at least one")
        # Hydra would run a recipe that is a sweep once, and forget its axes.
        for job in jobs if "experiment" in swept_keys(jobs) else ():
            if lost := sorted({*_axes(source.composed(job, hydra_too=True).hydra.sweeper)} - {*axes}):
                recipe = next(line.partition("=")[2] for line in job if line.lstrip("+").startswith("experiment="))
                raise ConfigError(
                    f"experiment={recipe} is itself a sweep over {', '.join(lost)}, which one among several recipes "
                    f"would lose; give each a command of its own: -m +experiment={recipe}"
                )
        return Described([(job, source.composed(job)) for job in jobs], launcher=chosen.launcher)


def _axes(sweeper: DictConfig) -> dict[str, str]:
    return OmegaConf.to_container(sweeper.params, resolve=True) if sweeper.get("params") else {}


def checked_config(composed: DictConfig, schema: type[Config]) -> Config:
    """The config that Hydra composed, read into ``schema``; its scene can be built, filled and resolved in time.

    Raises:
        ConfigError, SceneError, StateError, TimeStepError: what cannot be, in one line.
    """
    config = read_config(schema, OmegaConf.to_container(composed, resolve=True))
    if isinstance(config, TrainConfig | GenerateConfig):
        # Imported here, so that a typo need not wait for SciPy.
        from gran_bench.dem.initial_checks import check_initial_state
        from gran_bench.dem.time_step import choose_time_step

        scene, data = build_scene(config.scene), config.dataset
        filled = scene.fresh_filling(seed=0)
        kind = config.scene.container.kind
        if scene.filling.positions:  # sites of a lattice are apart, and inside a container of the house
            check_initial_state(scene, filled)
        elif WALLS.owner(kind) != HOUSE:
            check_initial_state(
                scene,
                filled,
                f"let the Container of scene.container.kind={kind} have a room, or a drum_radius and a length, that "
                "lies within its walls",
            )
        if scene.takes_speeds:
            speeds = data.training_speeds_rpm + data.validation_speeds_rpm + data.holdout_speeds_rpm
            scene = scene.at_speed(max(speeds, key=abs, default=0.0))
        choose_time_step(scene, config.dem.time_step, config.dem.allow_unsafe_step)
    return config


def swept_keys(jobs: Sequence[Sequence[str]]) -> frozenset[str]:
    """The keys that the jobs of a sweep, given by their overrides, have more than one value of."""
    values = defaultdict(set)
    for key, _, value in (line.lstrip("+~").partition("=") for overrides in jobs for line in overrides):
        values[key].add(value)
    return frozenset(key for key, found in values.items() if len(found) > 1)


def changed_in(overrides: Sequence[str], swept: Collection[str] = ()) -> list[str]:
    """The overrides of a job, sorted and without ``+``, that change what is trained, and all of swept keys."""
    unnamed = re.compile(rf"({'|'.join(map(re.escape, UNNAMED))})(?=[=./@]|$)")
    lines = sorted(line.lstrip("+~") for line in overrides)
    return [line for line in lines if line.partition("=")[0] in swept or not unnamed.match(line)]


def run_folder(experiment: str, overrides: Sequence[str], swept: Collection[str] = ()) -> str:
    """The folder of a run: the recipe's name, then what was changed in it, so that no two different runs share one."""
    changed = changed_in(overrides, set(swept) - {"experiment"})
    # Only letters that a path in a Hydra override may have without quotes.
    name = re.sub(r"[^\w.+-]", "_", "+".join([experiment, *changed]).replace("=", "-"))
    letters = name.encode()
    if len(letters) > LONGEST_NAME:
        name = f"{letters[: LONGEST_NAME - 9].decode(errors='ignore')}-{hashlib.sha256(letters).hexdigest()[:8]}"
    return name
