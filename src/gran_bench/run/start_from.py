"""Weights of an earlier training that another starts from: where they are, whether they fit, what they have seen."""

from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from torch import Tensor

from gran_bench.config import EvaluateConfig, TrainConfig
from gran_bench.config.reading import read_config
from gran_bench.config.registry import MODELS
from gran_bench.config.rules import ConfigError
from gran_bench.shipped import SHIPPED, shipped_model
from gran_bench.surrogate.checkpoint import MODEL, CheckpointError, ModelCard, load_card, weights_digest
from gran_bench.surrogate.step import Surrogate
from gran_bench.tracking.opening import dotted
from gran_bench.tracking.search import find_run


@dataclass(frozen=True)
class Start:
    """The weights that ``trainer.start_from`` names."""

    given: str  # the key as it was typed
    name: str  # of the run that trained them; of the file where it is in no run's folder
    card: ModelCard
    weights: dict[str, Tensor]

    @property
    def digest(self) -> str:
        """Of the weights alone: the same training done again elsewhere has the same."""
        return weights_digest(self.weights)

    def put_into(self, model: Surrogate, config: TrainConfig) -> list[str]:
        """Give the weights to a fresh model; a line for each thing that was otherwise when they were trained.

        Raises:
            ConfigError: a model of another architecture, or weights that have seen what this run will be judged on.
        """
        own, theirs = config.model.name, self.card.model.get("name")
        if theirs != own:
            remedy = f"choose model={theirs}, or train from the start"
            raise ConfigError(f"{self.given}: its weights are of model={theirs}, and this training of {own}; {remedy}")
        sections = ("model",) if MODELS[own].own_walls else ("model", "boundary")
        differs = [line for name in sections for line in self._differences(name, config)]
        try:
            model.load_state_dict(self.weights)
        except RuntimeError as error:
            found = f"{self.given}: its weights are of another architecture ({'; '.join(differs) or 'other shapes'})"
            raise ConfigError(f"{found}; choose as there, or train from the start") from error
        if self._same_scene(config):
            refuse_unfair(config, self.card.origin, f"{self.given}: this model")
        lines = [*differs, *self._differences("scene", config)]
        return [line for line in lines if not line.startswith(("scene.name=", "model.backend="))]

    def record(self, config: TrainConfig) -> dict[str, Any]:
        """What a training says of its start: whose weights, and the speeds (rpm) that they have seen in its scene."""
        earlier = seen_speeds(self.card.origin) if self._same_scene(config) else []
        trained = trained_on(config)["training_speeds_rpm"]
        seen = sorted({*earlier, *trained, *config.trainer.mixture.speeds_rpm})
        packings = seen_packings(self.card.origin) if self._same_scene(config) else []
        packings = sorted({*packings, *config.dataset.training_packings})
        names = {"parent_run": self.name, "parent_weights": self.digest}
        return names | {"seen_speeds_rpm": seen, "seen_packings": packings}

    def _same_scene(self, config: TrainConfig) -> bool:
        if config.scene.name in self.card.origin.get("further_scenes", ()):
            return True
        return all(line.startswith("scene.name=") for line in self._differences("scene", config))

    def _differences(self, section: str, config: TrainConfig) -> Iterator[str]:
        """A line for each key of a section that differs from the one of the weights."""
        old, new, own = getattr(self.card, section), getattr(config, section), type(getattr(config, section))
        with suppress(ConfigError):  # of a plugin that is not here, say
            old = asdict(read_config(own, old))  # with every key of today's schema
        old, new = dotted(old), dotted(new)
        for key in sorted(old.keys() | new.keys()):
            if old.get(key) != new.get(key):
                yield f"{section}.{key}={new.get(key, 'absent')}, trained with {old.get(key, 'none')}"


def start_of(config: TrainConfig) -> Start | None:
    """The weights that a training starts from; None where it starts from random ones.

    Raises:
        ConfigError: no such run or file, or one that is no model.
        TrackingError: the word may be a run's id, and the store does not answer.
    """
    if (word := config.trainer.start_from) is None:
        return None
    given, root = f"trainer.start_from={word}", Path(config.tracking.root)
    try:
        # Never by the beginning of a name: this run's own may begin with it.
        folder = None if word == SHIPPED or Path(word).exists() else find_run(word, root, beginnings=False)
    except ConfigError as error:
        raise ConfigError(f"trainer.start_from={error}") from error
    path = shipped_model() if word == SHIPPED else folder or Path(word)
    path = path / MODEL if path.is_dir() else path
    if path.name == MODEL and path.parent.is_dir() and not path.exists():
        raise ConfigError(f"{given}: {path.parent} has no {MODEL} (yet); finish its training, or name another run")
    try:
        card, weights = load_card(path)
    except CheckpointError as error:
        raise ConfigError(f"{given}: {error}") from error
    return Start(given, path.resolve().parent.name if path.name == MODEL else str(path), card, weights)


def seen_speeds(origin: Mapping[str, Any]) -> list[float]:
    """Speeds (rpm) that a model was trained on in its scene, those of the model that it started from included."""
    return origin.get("seen_speeds_rpm") or origin.get("training_speeds_rpm", [])


def seen_packings(origin: Mapping[str, Any]) -> list[int]:
    """Packings that a model was trained on in a scene that keeps its own motion, in the same way."""
    return origin.get("seen_packings") or origin.get("training_packings", [])


def trained_on(config: TrainConfig) -> dict[str, Any]:
    """What a training says of its cases: speeds (rpm) of a drum, or packings of a scene that keeps its own motion."""
    data, packings = config.dataset, config.dataset.training_packings
    return {
        "training_speeds_rpm": [] if packings else list(data.training_speeds_rpm),
        "validation_speeds_rpm": [] if packings else list(data.validation_speeds_rpm),
        "training_packings": list(packings),
        "packing_seed": None if packings else data.packing_seed,
    }


def seen_elsewhere(config: TrainConfig) -> dict[str, Any]:
    """What a training says of further scenes: their names, and every speed (rpm) that it saw anywhere."""
    mixture, speeds = config.trainer.mixture, config.dataset.training_speeds_rpm
    if not mixture.scenes:
        return {}
    return {"further_scenes": mixture.scenes, "seen_speeds_rpm": sorted({*speeds, *mixture.speeds_rpm})}


def refuse_unfair(config: TrainConfig | EvaluateConfig, origin: Mapping[str, Any], model: str) -> None:
    """Refuse, as a `ConfigError`, to judge a model on a speed or a packing that it was trained on."""
    dataset = config.dataset
    speeds = dataset.validation_speeds_rpm or dataset.holdout_speeds_rpm
    # The other sense of rotation is the mirror image.
    seen = [rpm for rpm in seen_speeds(origin) if abs(rpm) in map(abs, speeds)]
    if seen:
        raise ConfigError(
            f"dataset.holdout_speeds_rpm={speeds}: {model} was trained on {seen[0]:g} rpm; judge another speed, "
            "or choose the dataset= and judge= that it was trained with (dataset=small judge=quick for drum_small)"
        )
    packings = {"packing_seed": seen_packings(origin)}
    if config.judge.unseen_packing:
        packings["unseen_packing_seed"] = [*seen_packings(origin), origin.get("packing_seed")]
    for name, trained in packings.items():
        if (seed := getattr(dataset, name)) in trained:
            raise ConfigError(f"dataset.{name}={seed}: {model} was trained on that packing; choose another seed")
