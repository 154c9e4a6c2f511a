"""Which config keys decide the weights of a trained model: they give a run its key, and its folder a name."""

from dataclasses import asdict
from typing import Any

from gran_bench.config import TrainConfig
from gran_bench.config.registry import ADDED_TERMS, MODELS

# Sections and dotted keys that say where, when, how often or against what, and leave every bit of the weights as it is.
# ``device`` is not among them: a GPU adds in another order. Nor is ``threads``: with a budget of time they decide how
# far a training gets.
UNDECIDING = frozenset(
    {
        *("experiment", "judge", "tracking", "dry_run"),
        *("dataset.root", "dataset.files", "dataset.workers"),
        *("dataset.holdout_speeds_rpm", "dataset.unseen_packing_seed", "dataset.replicas"),
        *("trainer.minutes", "trainer.checkpoint_every", "trainer.checkpoint_steps", "trainer.log_every"),
    }
)


def deciding_keys(config: TrainConfig) -> dict[str, Any]:
    """The config as nested plain values, without what does not decide the trained weights.

    A plugin's term without weight is as if its package were not installed. A budget of minutes paces the schedule.
    """
    values = asdict(config)
    undeciding = UNDECIDING | ({"boundary"} if MODELS[config.model.name].own_walls else set())
    undeciding |= {f"loss.{term}" for term in ADDED_TERMS if values["loss"].get(term) == 0}
    undeciding |= {"dem.ranks"} if config.dem.engine != "lammps" else set()
    for key in undeciding - ({"trainer.minutes"} if config.trainer.budget == "time" else set()):
        section, _, name = key.rpartition(".")
        del (values[section] if section else values)[name]
    return values
