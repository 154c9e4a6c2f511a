"""A training that goes on from a finished one of a smaller budget, whose state it would have gone through itself."""

import json
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from gran_bench.config import TrainConfig
from gran_bench.files import write_atomically, write_text
from gran_bench.processes import tell
from gran_bench.run.identity import RunIdentity, key_of
from gran_bench.run.record import LOSSES, TRAINING
from gran_bench.surrogate.checkpoint import CHECKPOINT, read_tensors
from gran_bench.tracking.search import CONFIG
from gran_bench.trainer import frames_ahead, learning_rate

PARENT = "parent.json"  # in the folder of a run that went on from another


class Parent(NamedTuple):
    """A finished training that differs in its budget alone."""

    steps: int  # updates done
    planned: int  # updates of its budget
    folder: Path


def go_on(config: TrainConfig, identity: RunIdentity) -> None:
    """Give the folder of a run that has not begun the state of the longest training that it would have gone through.

    A run that begins anew beside such a training, whose schedule was another from the first updates on, says so.
    """
    folder = identity.folder
    if any((folder / name).exists() for name in (CHECKPOINT, TRAINING)):
        return
    (folder / PARENT).unlink(missing_ok=True)  # of a start that was killed
    for parent in sorted(_shorter(config, identity), reverse=True):
        name, bent = parent.folder.name, _bent_by(config, parent)
        if bent:
            tell(
                f"{name}, the same training of {parent.steps} updates, is finished; this one starts from the beginning "
                f"nevertheless: {' and '.join(bent)} run through the whole budget, so its first updates are others. "
                f"To train those weights further, on a new schedule: trainer.start_from={name}"
            )
            return
        try:
            read_tensors(parent.folder / CHECKPOINT)
        except Exception as error:  # of any kind, where a byte of the file is not as it was written
            tell(f"{parent.folder / CHECKPOINT} is damaged, so nothing goes on from there: {error}")
            continue
        write_text(folder / PARENT, json.dumps({"parent_run": name, "parent_steps": parent.steps}) + "\n")
        for file in (LOSSES, CHECKPOINT):  # whose presence, the last, says that the others are whole
            with open(parent.folder / file, "rb") as source:
                write_atomically(folder / file, lambda target, source=source: shutil.copyfileobj(source, target))
        tell(f"goes on from {name}, a finished training of {parent.steps} updates")
        return


def updates_ahead(config: TrainConfig, identity: RunIdentity) -> int:
    """How many updates a run that has not begun has from the training that it will go on from."""
    longest = max(_shorter(config, identity), default=None)
    return 0 if longest is None or _bent_by(config, longest) else longest.steps


def parent_of(folder: Path) -> dict[str, Any]:
    """What a run that went on from another records of it: ``parent_run`` and ``parent_steps``; else nothing."""
    return json.loads((folder / PARENT).read_text("utf-8")) if (folder / PARENT).exists() else {}


def _shorter(config: TrainConfig, identity: RunIdentity) -> Iterator[Parent]:
    """Finished trainings whose key is that of the config with a smaller budget: the same data and code."""
    own = config.trainer
    for path in identity.folder.parent.glob(f"*/{TRAINING}"):
        folder = path.parent
        if not all((folder / name).exists() for name in (CONFIG, LOSSES, CHECKPOINT)):
            continue
        try:
            done = json.loads(path.read_text("utf-8"))["steps"]
            budget = json.loads((folder / CONFIG).read_text("utf-8"))["trainer"]
            shorter = replace(own, steps=budget["steps"], minutes=budget["minutes"])
            key = key_of(replace(config, trainer=shorter), identity.data_digest)
        except (KeyError, TypeError, ValueError):  # of another version of this package
            continue
        smaller = shorter.steps < own.steps if own.budget == "steps" else shorter.minutes < own.minutes
        if folder.name.endswith(f"-{key[:8]}") and smaller and 0 < done <= own.steps:
            yield Parent(done, shorter.steps, folder)


def _bent_by(config: TrainConfig, parent: Parent) -> list[str]:
    """The keys that made an update of the parent another one than this run's; none where each was the same."""
    optim, rollout, budgets = config.optim, config.rollout, (parent.planned, config.trainer.steps)
    if config.trainer.budget == "time":  # whose end in updates nobody knows before
        budgets = parent.steps, 2 * parent.steps
    stages = [[end * budget for end in config.trainer.mixture.until] for budget in budgets]
    staged = ["trainer.mixture.until"] if any(parent.steps > min(ends) for ends in stages if ends) else []
    bent = {
        f"optim.schedule={optim.schedule}": (learning_rate, optim),
        f"rollout.final_frames={rollout.final_frames}": (frames_ahead, rollout),
    }
    return staged + [
        key
        for key, (what, section) in bent.items()
        if any(what(section, step, budgets[0]) != what(section, step, budgets[1]) for step in range(parent.steps))
    ]
