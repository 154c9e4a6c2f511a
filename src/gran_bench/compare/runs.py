"""Finished runs: found by a word of the command line, read from their folders."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import gran_bench
from gran_bench.tracking import TrackingError, shown_name
from gran_bench.tracking.search import stored_runs

SUMMARY, CONFIG = "summary.json", "config.json"  # a finished run has the first, any run the second
CLONE = Path(gran_bench.__file__).resolve().parents[2] / "results"  # with the records that ship
_PARTS = {"judged", "judged_rpm", "model", "training", "rollouts", "nearest_case", "position_error"}  # of a summary
_SUGGESTED = 8  # names in an error


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


def is_run(folder: Path) -> bool:
    """Whether a folder holds a run, finished or not."""
    return (folder / SUMMARY).is_file() or (folder / CONFIG).is_file()


def find_run(word: str, root: Path) -> Path:
    """The folder of the run that a word names.

    Args:
        word: a folder; or the name of a run, as its folder or the UI spells it, its key, its id in MLflow, or the
            beginning of one of these.
        root: of the results.

    Raises:
        CompareError: no such run (with names that are near), or several.
        TrackingError: the word may be an id, and the store does not answer.
    """
    if is_run(Path(word)):
        return Path(word)
    places = (CLONE, root, root / "evaluations", root / "runs")
    there = {path.resolve(): path for place in places for path in sorted(place.glob("*")) if is_run(path)}.values()
    names = {path: (path.name, shown_name(path.name), path.name.rpartition("-")[2]) for path in there}
    found = [path for path in there if word in names[path]]
    found = found or [path for path in there if any(name.startswith(word) for name in names[path])]
    if not found and re.fullmatch("[0-9a-f]{4,32}", word):
        stored = [run for run in stored_runs(root) if run.run_id.startswith(word)]
        if len(stored) > 1:
            found = [f"{run.run_id} ({run.name})" for run in stored]
        elif stored:
            found = [path for path in there if path.name == Path(stored[0].folder or "").name]
            if not found:
                raise CompareError(
                    f"{word}: the files of this run, {stored[0].name!r}, are not in {root}; give a folder"
                )
    if len(found) > 1:
        raise CompareError(f"{word}: this is the beginning of {_listed(found)}; give more of one, or a folder")
    if not found:
        every = {name: path.name for path, spellings in names.items() for name in spellings[:2]}
        near = [name for name in every if word in name] or get_close_matches(word, every, _SUGGESTED, 0.4) or every
        near = dict.fromkeys(every[name] for name in near)
        known = f"there are {_listed(near)}" if near else "it holds no run yet; name another folder with --root"
        raise CompareError(f"{word}: no run has this name, id or folder in {root}; {known}")
    return found[0]


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


def _listed(names: Iterable[object]) -> str:
    words = [str(name) for name in names]
    return ", ".join(words[:_SUGGESTED]) + (f" and {len(words) - _SUGGESTED} more" if len(words) > _SUGGESTED else "")
