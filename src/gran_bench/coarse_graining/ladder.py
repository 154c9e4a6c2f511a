"""The DEM on coarser spheres, at its automatic and its largest step, judged against replicas of the fine spheres."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from gran_bench.config import CoarseGrainingConfig
from gran_bench.config.reading import validate
from gran_bench.dataset import CaseSpec, ensure_cases, read_attributes, read_case, replicas, rotation_label
from gran_bench.dem.time_step import choose_time_step, largest_allowed_step
from gran_bench.evaluation.evaluation import COMPARED
from gran_bench.files import markdown, write_part, write_text
from gran_bench.metrics.angle_of_repose import SurfaceAngle
from gran_bench.metrics.judge import judge
from gran_bench.metrics.judgement import ErrorRow
from gran_bench.metrics.summary import TrajectorySummary, summarise
from gran_bench.processes import stop_on_signals, tell
from gran_bench.provenance import provenance, stamp
from gran_bench.run.cost import Cost, data_cost, flow_cost
from gran_bench.run.pace import summary_pace
from gran_bench.scene import Scene, build_scene

PAGE = "README.md"
Errors = dict[str, ErrorRow]  # by the key of a comparison


@dataclass(frozen=True)
class Rung:
    """One DEM of the ladder: the same spheres and step, from several packings."""

    name: str
    scene: Scene
    specs: list[CaseSpec]

    @property
    def step(self) -> float:
        """s."""
        dem = self.specs[0].dem
        return choose_time_step(self.scene, dem.time_step, dem.allow_unsafe_step)[0]


class Ladder:
    """The DEMs that a config compares on its scene, at the held-out speed where the scene takes speeds."""

    def __init__(self, config: CoarseGrainingConfig) -> None:
        self.config, data, dem = config, config.dataset, config.dem
        scene = build_scene(config.scene)
        if scene.takes_speeds:
            scene = scene.at_speed(data.holdout_speeds_rpm[0])
        self.scene = scene.fine  # that all are judged by: its diameters, its replicas
        self.replicas = replicas(CaseSpec(self.scene, dem, data.packing_seed), data.replicas)
        coarse = [scene] if scene.fine_spheres else [scene.coarse_grained(factor) for factor in config.factors]
        seeds = (data.packing_seed, data.unseen_packing_seed)
        self.rungs = [Rung("another packing", self.scene, [CaseSpec(self.scene, dem, data.unseen_packing_seed)])]
        for one in coarse:
            specs = [CaseSpec(one, dem, seed) for seed in seeds]
            words = f"coarse-grained {one.coarse_graining:.3g}"
            for coefficient in ("friction", "rolling_friction"):
                if (own := getattr(one.material, coefficient)) != getattr(one.fine.material, coefficient):
                    words += f", {coefficient.replace('_', ' ')} {own:g}"
            self.rungs.append(Rung(words, one, specs))
            largest = replace(dem, time_step=largest_allowed_step(one))
            specs = [replace(spec, dem=largest, settling_dem=dem) for spec in specs]
            self.rungs.append(Rung(f"{words}, largest step", one, specs))

    @property
    def cases(self) -> list[CaseSpec]:
        """Every run of the DEM."""
        return [*self.replicas, *(spec for rung in self.rungs for spec in rung.specs)]

    @property
    def cost(self) -> Cost:
        """What is left to make, and what it will take."""
        config, data = self.config, self.config.dataset
        cost = flow_cost(self.scene, config.dem)
        cost.lines += dict.fromkeys(rung.scene.spheres for rung in self.rungs[1:])
        cost += data_cost(self.scene, config.dem, self.cases, data.root, data.workers)
        seconds = summary_pace(self.scene) * self.scene.frame_count * len(self.cases)
        return cost + Cost([f"judging: {len(self.cases)} runs of the DEM"], {"judging": seconds})


def run_ladder(config: CoarseGrainingConfig) -> pd.DataFrame:
    """Judge coarse-grained DEMs against the fine one: the table, as in ``<root>/<scene>.csv``; empty with ``dry_run``.

    Raises:
        ConfigError, SceneError: an impossible value, or a factor that leaves no bed.
        DatasetError: a run of the DEM that failed.
    """
    validate(config)
    ladder, root = Ladder(config), config.dataset.root
    if ladder.cost.tell(config.dry_run):
        return pd.DataFrame()
    with stop_on_signals():
        ensure_cases(ladder.cases, root, config.dataset.workers)
        tell("judging")
        truth = [summary_of(spec, root) for spec in ladder.replicas]
        table = pd.DataFrame(_rows(ladder, truth))
    factor = config.scene.coarse_graining
    name = ladder.scene.name + f"_coarse{factor:.3g}" * (factor > 1.0)
    path = Path(config.root) / f"{name}.csv"
    write_text(path, table.to_csv(index=False))
    part = [*shown(table), "", f"{stamp(provenance())} [CSV]({path.name})."]
    write_part(path.with_name(PAGE), name, "\n".join(part), "Coarse-grained DEMs against the fine one", name)
    print(f"{ladder.scene.name}, {rotation_label(ladder.scene)}: mean difference from {len(truth)} replicas")
    print("\n".join(shown(table, aligned=True)))
    tell(f"each run is a row of {path}; the table is in {path.with_name(PAGE)}")
    return table


def summary_of(spec: CaseSpec, root: Path | str) -> TrajectorySummary:
    """A run of the DEM as it is judged: with the diameter of the fine spheres, whatever its own are."""
    return summarise(read_case(spec.path(root)).trajectory, spec.scene.fine)


def errors_of(found: TrajectorySummary, truth: Sequence[TrajectorySummary], scene: Scene) -> Errors:
    """How far a run is from the replicas of the fine scene: angle of repose, centre-of-mass angle, speeds."""
    judgement = judge(found, truth, scene.fine)
    return {key: judgement.error(key) for key in COMPARED}


def _rows(ladder: Ladder, truth: Sequence[TrajectorySummary]) -> Iterator[dict[str, Any]]:
    """A row for each run: spheres, step, wall time of the run beside a replica's, errors and floors."""
    root = ladder.config.dataset.root
    fine = float(np.mean([read_attributes(spec.path(root))["wall_seconds"] for spec in ladder.replicas]))
    for rung in ladder.rungs:
        for spec in rung.specs:
            seconds = float(read_attributes(spec.path(root))["wall_seconds"])
            row = {"method": rung.name, "spheres": rung.scene.filling.count, "step_s": rung.step}
            row |= {"packing": spec.packing_seed, "seconds": seconds, "share_of_the_fine": seconds / fine}
            run = summary_of(spec, root)
            row |= dict(zip(("valid_surfaces", "surface_angle_as_fitted_deg"), _as_fitted(run, truth), strict=True))
            for key, error in errors_of(run, truth, ladder.scene).items():
                unit = error.unit.replace("/", "_per_")
                found = {unit: error.error.value, "floors": error.multiple, f"floor_{unit}": error.floor.value}
                row |= {f"{key}_{name}": math.nan if value is None else value for name, value in found.items()}
            yield row


def _as_fitted(run: TrajectorySummary, truth: Sequence[TrajectorySummary]) -> tuple[float, float]:
    """Share of states whose surface is valid, −, and the difference of all fitted angles, valid or not, degrees.

    Surfaces of few large spheres are seldom straight to half a diameter of the fine ones.
    """
    surfaces = [one.series["surface_angle"] for one in (run, *truth)]
    if not all(isinstance(surface, SurfaceAngle) for surface in surfaces):
        return math.nan, math.nan
    mine, *theirs = (np.degrees([line.angle for line in surface.lines]) for surface in surfaces)
    apart = [np.nanmean(np.abs(mine - other)) if np.isfinite(mine - other).any() else math.nan for other in theirs]
    return float(surfaces[0].valid.mean()), float(np.mean(apart))


def shown(table: pd.DataFrame, aligned: bool = False) -> list[str]:
    """The table for people, the mean over packings in a row; the first row has the noise floors."""
    first, units = table.iloc[0], ("deg", "deg", "m_per_s")
    keys = [f"{key}_{unit}" for key, unit in zip(COMPARED, units, strict=True)]
    floors = [f"{key}_floor_{unit}" for key, unit in zip(COMPARED, units, strict=True)]
    rows = [("method", "spheres", "step, ms", "time", "angle, °", "centre of mass, °", "speeds W1, m/s", "floors")]
    rows[0] += ("angle as fitted, °", "valid, %")
    own = (f"{first.spheres}", f"{1e3 * first.step_s:.3g}", "1", *map(_figure, first[floors]), "1", "", "")
    rows.append(("a replica", *own))
    for name, runs in table.groupby("method", sort=False):
        mean, one = runs.mean(numeric_only=True), runs.iloc[0]
        found = [runs[key].mean(skipna=False) for key in keys]
        multiples = [runs[f"{key}_floors"].mean(skipna=False) for key in COMPARED]
        cells = f"{one.spheres}", f"{1e3 * one.step_s:.3g}", f"{mean.share_of_the_fine:.2f}"
        fitted = map(_figure, (mean.surface_angle_as_fitted_deg, 100.0 * mean.valid_surfaces))
        rows.append((name, *cells, *map(_figure, found), ", ".join(map(_figure, multiples)), *fitted))
    return markdown(rows, aligned)


def _figure(value: float) -> str:
    return "–" if math.isnan(value) else f"{value:.2g}"
