"""How old a record is: the day of its commit, and what has changed since among the code that made it.

Both follow from the history and from today's code, not from the record. So on a page they stand between marks
(`today`), and two pages that differ in them alone are the same (`without_today`): a change of the code makes records
old, and does not make the page wrong.
"""

from __future__ import annotations

import re
import subprocess
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import gran_bench
from gran_bench.code_identity import modules_behind
from gran_bench.front_page.records import Origin
from gran_bench.source_digest import bare_code, digest_of, source_digest

# Rooms of the solver: their code may differ and give the same bits (source_digest.py).
SOLVER = ("dem", "neighbors", "scene")
OPEN, CLOSE = "<!--today-->", "<!--/today-->"
STALE = "**STALE**"
# Rooms in a reader's words; others go by their name.
WORDS = {
    "dem": "the DEM",
    "neighbors": "the search of neighbours",
    "scene": "scenes",
    "dataset": "the data's reading and making",
    "surrogate": "networks",
    "losses": "losses",
    "trainer": "the trainer",
    "training_start": "first weights and windows",
    "state": "states",
    "rollout": "rollouts",
    "baselines": "baselines",
    "metrics": "the judge",
    "evaluation": "the evaluation",
    "evaluation_plan": "what is judged",
    "comparison": "the benchmark",
    "stability": "the stress test",
}


@dataclass(frozen=True)
class Age:
    """How old a record is.

    Attributes:
        date: of its commit, ``2026-11-22``; empty where the history does not have it.
        changed: rooms whose code differs from that of the commit; None where the history does not have it.
    """

    date: str
    changed: tuple[str, ...] | None

    @property
    def stale(self) -> bool:
        """Whether code that made the record differs today."""
        return bool(self.changed)

    def __str__(self) -> str:
        if self.changed is None:
            return "its commit is not in this history"
        if not self.changed:
            return f"{self.date}; by today's code"
        return f"{self.date}; {STALE}: since then changed {_listed([WORDS.get(room, room) for room in self.changed])}"


AgeOf = Callable[[Origin], Age]


def unknown_age(origin: Origin) -> Age:
    """The age of a record where there is no history."""
    return Age("", None)


def age_of(origin: Origin) -> Age:
    """The age of a record by the history of this checkout."""
    commit = origin.commit.removesuffix("+")
    date = _git("show", "--no-patch", "--format=%cs", f"{commit}^{{commit}}") if commit else None
    if date is None:
        return unknown_age(origin)
    names = (_git("ls-tree", "-r", "--name-only", commit, "src/gran_bench") or "").split("\n")
    differing = (_git("diff", "--name-only", commit, "--", "src/gran_bench") or "").split("\n")
    changed = set()
    for module in modules_behind(*origin.roots):
        name = f"src/gran_bench/{module.replace('.', '/')}.py"
        if name not in names or (name in differing and _code_differs(commit, name)):
            changed.add(module.partition(".")[0])
    if not origin.about_code and changed.intersection(SOLVER) and _same_bits(commit, names):
        changed.difference_update(SOLVER)
    return Age(date.strip(), tuple(sorted(changed)))


def today(text: str) -> str:
    """Text that follows from more than the records, between marks that a reader doesn't see."""
    return f"{OPEN}{text}{CLOSE}"


def without_today(page: str) -> str:
    """A page without what stands between such marks."""
    return re.sub(f"{re.escape(OPEN)}.*?{re.escape(CLOSE)}", "", page, flags=re.DOTALL)


def _code_differs(commit: str, name: str) -> bool:
    """Whether a file's code differs today from a commit's; comments, docstrings and layout don't count."""
    before = _git("show", f"{commit}:{name}")
    return before is None or bare_code(before) != bare_code((_folder() / name).read_text("utf-8"))


def _same_bits(commit: str, names: Sequence[str]) -> bool:
    """Whether the solver of today gives the bits of a commit's, whose files have these names."""
    below = "src/gran_bench/"
    files = [
        name
        for room in SOLVER
        for name in sorted(names, key=lambda name: PurePosixPath(name))
        if name.startswith(f"{below}{room}/") and name.endswith(".py")
    ]
    sources = [(name.removeprefix(below), _git("show", f"{commit}:{name}") or "") for name in files]
    return digest_of(sources) == source_digest(SOLVER)


def _folder() -> Path:
    return Path(gran_bench.__file__).resolve().parents[2]


def _git(*arguments: str) -> str | None:
    """What git says in this checkout; None where it refuses, or where there is no checkout."""
    if not (_folder() / ".git").exists():
        return None
    words = ["git", "-C", str(_folder()), *arguments]
    done = subprocess.run(words, capture_output=True, encoding="utf-8", check=False)
    return done.stdout if done.returncode == 0 else None


def _listed(words: list[str]) -> str:
    return " and ".join([", ".join(words[:-1]), words[-1]]) if len(words) > 1 else words[0]
