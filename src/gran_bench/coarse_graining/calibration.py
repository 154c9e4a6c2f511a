"""Friction and rolling friction of coarse spheres, fitted to the fine DEM's statistics at the training speeds."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import minimize

from gran_bench.coarse_graining.ladder import Errors, errors_of, summary_of
from gran_bench.config import CalibrateConfig
from gran_bench.config.reading import validate
from gran_bench.dataset import CaseSpec, ensure_cases, read_attributes, replicas
from gran_bench.files import markdown, write_text
from gran_bench.metrics.summary import TrajectorySummary
from gran_bench.processes import stop_on_signals, tell
from gran_bench.progress import Progress
from gran_bench.provenance import provenance
from gran_bench.run.cost import STARTING, Cost, data_cost, flow_cost
from gran_bench.run.pace import summary_pace
from gran_bench.scene import Scene, build_scene

DIGITS = 3  # of a coefficient: finer ones are chance, and a search that comes back finds its runs
LARGEST = (2.0, 0.5)  # friction and rolling friction that are looked at, −
SIMPLEX = ((1.0, 0.0), (0.75, 0.02), (1.0, 0.05))  # the first: shares of the friction, and more rolling friction, −
TOLERANCE = {"xatol": 0.005, "fatol": 0.02}  # of the search, − and noise floors

Pair = tuple[float, float]  # friction and rolling friction, −


class _Spent(Exception):
    """No trial is left."""


@dataclass(frozen=True)
class Trial:
    """One pair of coefficients."""

    friction: float  # −
    rolling_friction: float  # −
    errors: dict[float, Errors]  # by speed in rpm
    counted: frozenset[tuple[float, str]]  # speed and key of the errors that the search goes by
    seconds: float  # wall time of its runs of the DEM, the settling of the bed included

    @property
    def loss(self) -> float:
        """Mean of the errors that count, in noise floors; infinite where one of them is not defined."""
        multiples = [self.errors[rpm][key].multiple for rpm, key in self.counted]
        return math.inf if None in multiples else float(np.mean(multiples))

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON; an error that is not defined is null."""
        errors = {
            f"{rpm:g}rpm": {key: {"error": row.error.value, "floors": row.multiple} for key, row in found.items()}
            for rpm, found in self.errors.items()
        }
        found = {"friction": self.friction, "rolling_friction": self.rolling_friction, "seconds": self.seconds}
        return found | {"loss_floors": self.loss if math.isfinite(self.loss) else None, "errors": errors}


class Calibration:
    """A coarse-grained scene, and the fine DEM's runs at the training speeds; no other speed is made or read."""

    def __init__(self, config: CalibrateConfig) -> None:
        self.config, self.scene = config, build_scene(config.scene)
        self.speeds = sorted(set(config.speeds_rpm or config.dataset.training_speeds_rpm))
        self.counted: frozenset[tuple[float, str]] | None = None  # what the first trial has
        self.start: Pair = (self.scene.material.friction, self.scene.material.rolling_friction)

    @property
    def references(self) -> dict[float, list[CaseSpec]]:
        """The replicas of the fine scene by speed."""
        fine, data = self.scene.fine, self.config.dataset
        case = CaseSpec(fine, self.config.dem, data.packing_seed)
        return {rpm: replicas(replace(case, scene=fine.at_speed(rpm)), data.replicas) for rpm in self.speeds}

    def cases(self, pair: Pair) -> dict[float, CaseSpec]:
        """The coarse runs of a trial by speed."""
        coarse, data = self.scene.coarse_grained(self.scene.coarse_graining, *pair), self.config.dataset
        return {rpm: CaseSpec(coarse.at_speed(rpm), self.config.dem, data.packing_seed) for rpm in self.speeds}

    def try_out(self, pair: Pair, truth: dict[float, Sequence[TrajectorySummary]]) -> Trial:
        """Make what is missing of a trial, and judge it."""
        data, cases = self.config.dataset, self.cases(pair)
        # In this process: a coarse case takes less time than a process to start.
        paths = ensure_cases(cases.values(), data.root, workers=1, progress=False)
        facts = [read_attributes(path) for path in paths]
        seconds = sum(float(one["wall_seconds"]) for one in facts) + float(facts[0]["settling_wall_seconds"])
        errors = {rpm: errors_of(summary_of(spec, data.root), truth[rpm], spec.scene) for rpm, spec in cases.items()}
        # The scene as it is says what these spheres have at all: a bed of large ones may have no straight surface.
        if self.counted is None:
            defined = {
                (rpm, key) for rpm, rows in errors.items() for key, row in rows.items() if row.multiple is not None
            }
            self.counted = frozenset(defined)
        return Trial(*pair, errors, self.counted, seconds)

    @property
    def cost(self) -> Cost:
        """What references and search will take at most."""
        config, data, scene = self.config, self.config.dataset, self.scene
        needed = [spec for specs in self.references.values() for spec in specs]
        cost = flow_cost(scene, config.dem) + data_cost(scene.fine, config.dem, needed, data.root, data.workers)
        # A pair with more digits than any that is tried, so that its runs are all to make.
        unlike = (self.start[0] + 10.0 ** -(DIGITS + 2), self.start[1])
        one = data_cost(scene, config.dem, self.cases(unlike).values(), data.root, workers=1)
        line = f"search: at most {config.trials} pairs of coefficients, each at {len(self.speeds)} speeds"
        stages = {"search": config.trials * (one.seconds["data"] - STARTING * (len(self.speeds) + 1))}
        fine, coarse = (summary_pace(one) * one.frame_count for one in (scene.fine, scene))
        stages["judging"] = fine * len(needed) + coarse * config.trials * len(self.speeds)
        return cost + Cost([line], stages, one.memory, config.trials * one.disk)


def calibrate(config: CalibrateConfig) -> dict[str, Any]:
    """Fit the friction and rolling friction of coarse spheres to the fine DEM; gives what ``<root>/*.json`` holds.

    The loss of a pair is its error in noise floors, the mean over speeds of rotation and over angle of repose,
    centre-of-mass angle and speeds of the spheres, as far as the scene has them before. Nelder and Mead's simplex
    starts from the scene's own coefficients. Every run is a case of the data cache, so a killed search goes on from
    there. Empty with ``dry_run``.

    Raises:
        ConfigError: an impossible value, a speed that is held out or is no training speed.
        DatasetError: a run of the DEM that failed.
    """
    validate(config)
    work = Calibration(config)
    if work.cost.tell(config.dry_run):
        return {}
    data, scene, trials = config.dataset, work.scene, {}
    with stop_on_signals():
        tell("runs of the fine DEM at the training speeds")
        ensure_cases([s for specs in work.references.values() for s in specs], data.root, data.workers)
        truth = {rpm: [summary_of(one, data.root) for one in specs] for rpm, specs in work.references.items()}
        with Progress(total=config.trials, desc="calibration", unit="trial") as bar:

            def loss(pair: Pair) -> float:
                if pair not in trials:
                    trials[pair] = work.try_out(pair, truth)
                    best = min(trial.loss for trial in trials.values())
                    bar.set_postfix_str(f"friction {pair[0]:g}, rolling {pair[1]:g}; best {best:.2f} floors")
                    bar.update()
                return trials[pair].loss

            search(loss, work.start, config.trials)
    first, best = trials[work.start], min(trials.values(), key=lambda trial: trial.loss)
    spent = sum(trial.seconds for trial in trials.values())
    found = {"scene": scene.name, "spheres": scene.spheres, "speeds_rpm": work.speeds}
    found |= {
        "overrides": overrides(scene, best),
        "before": first.to_dict(),
        "found": best.to_dict(),
        "dem_seconds": spent,
    }
    found |= {"trials": [trial.to_dict() for trial in trials.values()], "provenance": provenance()}
    path = Path(config.root) / f"{scene.name}_coarse{scene.coarse_graining:.3g}.json"
    write_text(path, json.dumps(found, indent=1, allow_nan=False) + "\n")
    print("\n".join(told(scene, first, best)))
    print(f"{len(trials)} trials at {len(work.speeds)} speeds took {spent:.0f} s of the DEM's wall time; {path}")
    print(f"use: {found['overrides']}")
    return found


def search(loss: Callable[[Pair], float], start: Pair, trials: int) -> None:
    """Nelder and Mead's simplex over pairs that are rounded and within bounds; ``loss`` remembers what it was asked.

    A step along an edge of the bounds or below the last digit asks again for a pair that is known, and costs nothing.
    """

    def rounded(point: np.ndarray) -> Pair:
        return round(float(point[0]), DIGITS), round(float(point[1]), DIGITS)

    asked: set[Pair] = set()

    def counted(point: np.ndarray) -> float:
        pair = rounded(point)
        asked.add(pair)
        if len(asked) > trials:
            raise _Spent
        return loss(start if pair == rounded(np.array(start)) else pair)

    simplex = np.array([(share * start[0], start[1] + more) for share, more in SIMPLEX])
    bounds = [(10.0**-DIGITS, LARGEST[0]), (0.0, LARGEST[1])]
    options = {"initial_simplex": simplex, "maxfev": 4 * trials, **TOLERANCE}
    try:
        minimize(counted, start, method="Nelder-Mead", bounds=bounds, options=options)
    except _Spent:
        return


def overrides(scene: Scene, trial: Trial) -> str:
    """What a command line is given for the coarse spheres of a trial."""
    own = f"scene.coarse_friction={trial.friction:g} scene.coarse_rolling_friction={trial.rolling_friction:g}"
    return f"scene.coarse_graining={scene.coarse_graining:.6g} {own}"


def told(scene: Scene, first: Trial, best: Trial) -> Iterator[str]:
    """Errors before and after, in noise floors, a row for each speed."""
    yield f"{scene.name}, {scene.spheres}"
    for rpm, key in sorted({(rpm, key) for rpm, rows in first.errors.items() for key in rows} - first.counted):
        row = first.errors[rpm][key]
        yield f"not counted at {rpm:g} rpm: {row.label}, {row.floor.note or row.error.note}"
    for word, one in (("as it is", first), ("found", best)):
        pair = f"friction {one.friction:g}, rolling friction {one.rolling_friction:g}"
        yield f"{word}: {pair}, {one.loss:.2f} noise floors in the mean"
    heads = ("speed, rpm", *(row.label for row in next(iter(best.errors.values())).values()))
    rows = [heads]
    for rpm, errors in best.errors.items():
        pairs = zip(first.errors[rpm].values(), errors.values(), strict=True)
        rows.append((f"{rpm:g}", *(" → ".join(_floors(row.multiple) for row in pair) for pair in pairs)))
    yield from markdown(rows, aligned=True)


def _floors(multiple: float | None) -> str:
    return "–" if multiple is None else f"{multiple:.2g}"
