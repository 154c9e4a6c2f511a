"""Names as the UI shows them: of runs, short; of metrics, in groups that it draws in the order of the alphabet."""

import re
import shlex
from pathlib import Path

import gran_bench
from gran_bench.config import TrackingConfig

HEADLINE = "headline/"  # sorts before every other group, so that its charts come first
# What a person looks at first, by name, in this order; an undefined one is absent from a run.
HEADLINE_FIGURES = (
    *("angle error deg", "angle error floors", "com angle error deg", "com angle error floors"),
    *("speed W1 m per s", "speed W1 floors", "position error 10 frames mm", "rollout ms per frame"),
    *("training minutes", "requirements failed", "rollouts failed"),
)
VERDICT = "verdict"  # tag, a column of the run table: pass, fail, or what became of a run that was not judged
STOPPED, FAILED = "stopped: the same command goes on", "failed: see ended_by"
_SECTION = re.compile(r"[\w.]*\.(?=\w+-)", re.ASCII)


def ui_command(config: TrackingConfig, port: int | None = None) -> str:
    """What opens the UI on the runs of a config (at a port, or the usual one): ``make ui`` in a clone's folder."""
    usual, clone = TrackingConfig(), Path(gran_bench.__file__).resolve().parents[2]
    changed = {f"tracking.{name}": getattr(config, name) for name in ("root", "experiment")}
    words = [f"{key}={_quoted(value)}" for key, value in changed.items() if value != getattr(usual, key[9:])]
    if not words and clone == Path.cwd() and (clone / "Makefile").exists():
        return "make ui" if port is None else f"make ui PORT={port}"
    return shlex.join(["python", "-m", "gran_bench.ui", *words, *([] if port is None else [f"port={port}"])])


def how_to_compare(config: TrackingConfig) -> str:
    """The end of the last line of a run; empty where it was not recorded."""
    return f"; compare runs with `{ui_command(config)}`" if config.enabled else ""


def _quoted(value: str) -> str:
    """A value as Hydra reads it."""
    if re.fullmatch(r"[\w./+-]+", value, re.ASCII):
        return value
    return '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'


def three_figures(value: float) -> float:
    """A number as the run table shows it, which has no rounding of its own."""
    return float(f"{value:.3g}")


def shown_name(name: str) -> str:
    """The name of a run in the UI: what was changed in the recipe, without the keys' sections, and the run's key.

    ``sweep+model-radial+model.radius-0.08-1a2b3c4d`` becomes ``model-radial radius-0.08-1a2b3c4d``: in a column of
    the run table the first words count. A name without changes stays as it is.
    """
    _, *changed = name.split("+")
    return " ".join(_SECTION.sub("", word, count=1) if _SECTION.match(word) else word for word in changed) or name
