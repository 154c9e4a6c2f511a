"""Names as the UI shows them: of runs, short; of metrics, in groups that it draws in the order of the alphabet."""

from __future__ import annotations

import re

HEADLINE = "headline/"  # sorts before every other group, so that its charts come first
# What a person looks at first, by name, in this order; an undefined one is absent from a run.
HEADLINE_FIGURES = (
    "angle error deg",
    "angle error floors",
    "com angle error deg",
    "com angle error floors",
    "speed W1 m per s",
    "speed W1 floors",
    "position error 10 frames mm",
    "rollout ms per frame",
    "training minutes",
    "requirements failed",
    "rollouts failed",
)
_SECTION = re.compile(r"[\w.]*\.(?=\w+-)", re.ASCII)


def shown_name(name: str) -> str:
    """The name of a run in the UI: what was changed in the recipe, without the keys' sections, and the run's key.

    ``sweep+model-radial+model.radius-0.08-1a2b3c4d`` becomes ``model-radial radius-0.08-1a2b3c4d``: in a column of
    the run table the first words count, and those of the recipe are the same in all rows of a sweep. A name without
    changes stays as it is.

    Args:
        name: of the run's folder.
    """
    _, *changed = name.split("+")
    return " ".join(_SECTION.sub("", word, count=1) if _SECTION.match(word) else word for word in changed) or name
