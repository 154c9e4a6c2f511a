"""Finished runs, read from their folders."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gran_bench.run.finding import CONFIG, SUMMARY
from gran_bench.tracking import TrackingError, shown_name
from gran_bench.tracking.search import stored_runs

_PARTS = {"judged", "judged_rpm", "model", "training", "rollouts", "nearest_case", "position_error"}  # of a summary


class CompareError(ValueError):
    """Runs that cannot be compared; the message names the run and the remedy."""


@dataclass(frozen=True)
class ComparedRun:
    """A finished run.

    Attributes:
        folder: of its files.
        summary: as in ``summary.json``.
        keys: of its config, dotted; where a run is kept is not among them.
        whole: sections of the config that the folder records in full.
    """

    folder: Path
    summary: dict[str, Any]
    keys: dict[str, Any]
    whole: frozenset[str]

    @property
    def name(self) -> str:
        """As the UI shows it."""
        return shown_name(self.folder.resolve().name)

    def scene_at(self, rpm: float) -> str:
        """For people: ``drum, 3000 spheres, 30 rpm``, with the name of the scene where it is recorded."""
        failures = self.summary["judged"]["shared"]["failures"]
        count = f"{failures['spheres']} spheres" if failures else None
        return ", ".join(filter(None, (self.keys.get("scene.name", "unnamed scene"), count, f"{rpm:g} rpm")))


def read_run(folder: Path, root: Path) -> ComparedRun:
    """A finished run, from its folder.

    Args:
        folder: with ``summary.json``; ``config.json`` or ``model.pt`` add what the summary does not say.
        root: of the results; the store there knows the command of a run that is not finished.

    Raises:
        CompareError: the run is not finished (with the command that goes on with it), or a file cannot be read.
    """
    config = _read(folder / CONFIG) if (folder / CONFIG).exists() else {}
    if not (folder / SUMMARY).exists():
        state = "trained, but not judged" if (folder / "training.json").exists() else "not trained to the end"
        commands = []
        with suppress(TrackingError):
            name = shown_name(folder.resolve().name)
            commands = [run.command for run in stored_runs(root) if run.name == name and run.command]
        remedy = commands[0] if commands else "repeat the command that began it, which goes on from there"
        raise CompareError(f"{folder}: this run is not finished ({state}); to go on with it: {remedy}")
    summary = _read(folder / SUMMARY)
    if _PARTS - summary.keys():
        raise CompareError(f"{folder / SUMMARY} is no summary of a judged run; give the folder of one")
    training, model = summary["training"], Path(config.get("checkpoint") or folder / "model.pt")
    whole = {"model": summary["model"]} | {name: value for name, value in config.items() if name != "tracking"}
    if "scene" not in config and model.is_file():  # a record that ships, or an evaluation
        from gran_bench.surrogate import checkpoint  # with PyTorch, which others need not wait for

        try:
            card, _ = checkpoint.load_card(model)
        except checkpoint.CheckpointError as error:
            raise CompareError(str(error)) from error
        whole |= {"scene": card.scene, "boundary": card.boundary}
    keys = {"seed": training.get("seed"), "dataset.training_speeds_rpm": training.get("training_speeds_rpm")}
    keys = {name: value for name, value in keys.items() if value is not None}
    return ComparedRun(folder, summary, keys | dict(_dotted(whole)), frozenset(whole))


def _read(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise CompareError(f"{path} cannot be read ({error}); get it again, or leave the run out") from error
    return content if isinstance(content, dict) else {}


def _dotted(values: Mapping[str, Any], path: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in values.items():
        if isinstance(value, Mapping):
            yield from _dotted(value, f"{path}{name}.")
        else:
            yield path + name, value
