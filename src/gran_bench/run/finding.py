"""The folder of a run, found by a word of the command line."""

from __future__ import annotations

import re
from collections.abc import Iterable
from difflib import get_close_matches
from pathlib import Path

import gran_bench
from gran_bench.config.rules import ConfigError
from gran_bench.tracking import shown_name
from gran_bench.tracking.search import stored_runs

SUMMARY, CONFIG = "summary.json", "config.json"  # a finished run has the first, any run the second
CLONE = Path(gran_bench.__file__).resolve().parents[2] / "results"  # with the records that ship
_SUGGESTED = 8  # names in an error


def is_run(folder: Path) -> bool:
    """Whether a folder holds a run, finished or not."""
    return (folder / SUMMARY).is_file() or (folder / CONFIG).is_file()


def find_run(word: str, root: Path, beginnings: bool = True) -> Path:
    """The folder of the run that a word names.

    Args:
        word: a folder; or the name of a run, as its folder or the UI spells it, its key, its id in MLflow, or the
            beginning of one of these.
        root: of the results.
        beginnings: whether the beginning of a name will do; that of an id always does.

    Raises:
        ConfigError: no such run (with names that are near), or several.
        TrackingError: the word may be an id, and the store does not answer.
    """
    if is_run(Path(word)):
        return Path(word)
    places = (CLONE, root, root / "evaluations", root / "runs")
    there = {path.resolve(): path for place in places for path in sorted(place.glob("*")) if is_run(path)}.values()
    names = {path: (path.name, shown_name(path.name), path.name.rpartition("-")[2]) for path in there}
    found = [path for path in there if word in names[path]]
    if beginnings and not found:
        found = [path for path in there if any(name.startswith(word) for name in names[path])]
    if not found and re.fullmatch("[0-9a-f]{4,32}", word):
        stored = [run for run in stored_runs(root) if run.run_id.startswith(word)]
        if len(stored) > 1:
            found = [f"{run.run_id} ({run.name})" for run in stored]
        elif stored:
            found = [path for path in there if path.name == Path(stored[0].folder or "").name]
            if not found:
                raise ConfigError(
                    f"{word}: the files of this run, {stored[0].name!r}, are not in {root}; give a folder"
                )
    if len(found) > 1:
        raise ConfigError(f"{word}: this is the beginning of {_listed(found)}; give more of one, or a folder")
    if not found:
        every = {name: path.name for path, spellings in names.items() for name in spellings[:2]}
        near = [name for name in every if word in name] or get_close_matches(word, every, _SUGGESTED, 0.4) or every
        near = dict.fromkeys(every[name] for name in near)
        known = f"there are {_listed(near)}" if near else "it holds no run yet; name another folder of results"
        raise ConfigError(f"{word}: no run has this name, id or folder in {root}; {known}")
    return found[0]


def _listed(names: Iterable[object]) -> str:
    words = [str(name) for name in names]
    return ", ".join(words[:_SUGGESTED]) + (f" and {len(words) - _SUGGESTED} more" if len(words) > _SUGGESTED else "")
