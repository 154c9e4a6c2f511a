"""Finished runs, read from their folders."""

from __future__ import annotations

import json
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from gran_bench.tracking import TrackingError, shown_name
from gran_bench.tracking.search import CONFIG, SUMMARY, RunError, stored_runs

_PARTS = {"judged", "judged_rpm", "model", "training", "rollouts", "nearest_case", "position_error"}  # of a summary


@dataclass(frozen=True)
class ComparedRun:
    """A finished run."""

    folder: Path
    summary: dict[str, Any]
    keys: dict[str, Any]  # of its config, dotted; where a run is kept is not among them
    whole: frozenset[str]  # sections of the config that the folder records in full

    @property
    def name(self) -> str:
        """As the UI shows it."""
        return shown_name(self.folder.resolve().name)

    def scene_at(self, rpm: float) -> str:
        """For people: ``drum, 3000 spheres, 30 rpm``, with the name of the scene where it is recorded."""
        failures = self.summary["judged"]["shared"]["failures"]
        count = f"{failures['spheres']} spheres, " if failures else ""
        return f"{self.keys.get('scene.name', 'unnamed scene')}, {count}{rpm:g} rpm"


def read_run(folder: Path, root: Path) -> ComparedRun:
    """A finished run, from its folder; ``config.json`` or ``model.pt`` add what the summary does not say.

    Raises:
        RunError: the run is not finished (with the command that goes on with it, as the store of the results in
            ``root`` knows it), or a file cannot be read.
    """
    config = _read(folder / CONFIG) if (folder / CONFIG).exists() else {}
    if not (folder / SUMMARY).exists():
        state = "trained, but not judged" if (folder / "training.json").exists() else "not trained to the end"
        name, commands = shown_name(folder.resolve().name), []
        with suppress(TrackingError):
            commands = [run.data.tags.get("command") for run in stored_runs(root) if run.info.run_name == name]
        remedy = next(filter(None, commands), "repeat the command that began it, which goes on from there")
        raise RunError(f"{folder}: this run is not finished ({state}); to go on with it: {remedy}")
    summary = _read(folder / SUMMARY)
    if _PARTS - summary.keys():
        raise RunError(f"{folder / SUMMARY} is no summary of a judged run; give the folder of one")
    training, model = summary["training"], Path(config.get("checkpoint") or folder / "model.pt")
    whole = {"model": summary["model"]} | {name: value for name, value in config.items() if name != "tracking"}
    if "scene" not in config and model.is_file():  # a record that ships, or an evaluation
        from gran_bench.surrogate import checkpoint  # with PyTorch, which others need not wait for

        card, _ = checkpoint.load_card(model)
        whole |= {"scene": card.scene, "boundary": card.boundary}
    keys = {"seed": training.get("seed"), "dataset.training_speeds_rpm": training.get("training_speeds_rpm")}
    keys = {name: value for name, value in keys.items() if value is not None}
    return ComparedRun(folder, summary, keys | pd.json_normalize(whole).to_dict("records")[0], frozenset(whole))


def _read(path: Path) -> dict[str, Any]:
    try:
        return dict(json.loads(path.read_text("utf-8")))
    except (OSError, TypeError, ValueError) as error:
        raise RunError(f"{path} cannot be read ({error}); get it again, or leave the run out") from error
