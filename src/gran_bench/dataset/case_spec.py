"""What determines a case, and the file name that follows from it."""

import functools
import hashlib
import json
import re
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from gran_bench.config import SEED, DatasetConfig, DemConfig
from gran_bench.config.rules import check_arguments, checked_value
from gran_bench.dataset.scene_document import to_document
from gran_bench.dem.simulate import choose_time_step
from gran_bench.provenance.source_digest import SOLVER, source_digest
from gran_bench.scene import Scene

FORMAT_VERSION = 2  # of the files; a change makes every case anew
NUDGE_DIAMETERS = 2.0e-8  # of a replica's settled state


class DatasetError(RuntimeError):
    """Data that cannot be made, read or used; the message names the file or the key, and the remedy."""


@dataclass(frozen=True)
class CaseSpec:
    """A case to be made: everything that its numbers depend on."""

    scene: Scene  # with the rotation of this case
    dem: DemConfig = field(default_factory=DemConfig)  # the solver's settings
    packing_seed: int = 0  # of the filling
    nudge: float = 0.0  # m, length of a random displacement of every particle of the settled state
    nudge_seed: int = 0  # of its directions
    settling_dem: DemConfig | None = None  # the solver's settings for the settled bed, where they differ from dem

    def __post_init__(self) -> None:
        check_arguments(scene=(self.scene, Scene), dem=(self.dem, DemConfig), nudge=(self.nudge, float))
        for name in ("packing_seed", "nudge_seed"):
            checked_value(int, SEED, getattr(self, name), name)

    @property
    def settling_scene(self) -> Scene:
        """The scene in which the bed settles: at rest, and the same whatever follows."""
        return replace(self.scene.at_rest(), end_time=self.scene.start_time + self.scene.frame_interval)

    @property
    def bed_dem(self) -> DemConfig:
        """The solver's settings that the settled bed was made with."""
        return self.settling_dem or self.dem

    @property
    def settling_key(self) -> dict[str, Any]:
        """What determines the settled bed; cases that differ in what follows share it."""
        key = _key("settled", self.settling_scene, self.bed_dem) | {"packing_seed": int(self.packing_seed)}
        key["scene"].pop("name")
        return key

    @property
    def key(self) -> dict[str, Any]:
        """What determines the case, as plain data; its hash names the file."""
        seed = int(self.nudge_seed) if self.nudge else 0
        own = {"settled": self.settling_key, "nudge": float(self.nudge), "nudge_seed": seed}
        if self.dem.power:  # adds to the file, not to the trajectory
            own["power"] = True
        return _key("case", self.scene, self.dem) | own

    @property
    def label(self) -> str:
        """The case in a few words, for people: scene, speed, packing, replica."""
        words = [self.scene.name, rotation_label(self.scene), f"seed{self.packing_seed}"]
        if self.scene.fine_spheres is not None:
            words.insert(1, f"coarse{self.scene.coarse_graining:.3g}")
        if self.nudge:
            words.append(f"replica{self.nudge_seed}")
        if self.settling_dem is not None:
            words.append(f"dt{_time_step(self.scene, self.dem):.3g}")
        return "_".join(re.sub(r"[^\w.+-]", "-", word) for word in words)

    def path(self, root: Path | str) -> Path:
        """File of the case under ``root``."""
        return Path(root) / f"{self.label}_{key_hash(self.key)}.h5"

    def settled_path(self, root: Path | str) -> Path:
        """File of the settled bed that the case starts from."""
        return Path(root) / "settled" / f"seed{self.packing_seed}_{key_hash(self.settling_key)}.h5"


def rotation_label(scene: Scene) -> str:
    """``30rpm`` for a constant speed, ``still``, or ``schedule``."""
    rotation = scene.rotation
    if rotation.is_still:
        return "still"
    return f"{rotation.speeds_rpm[0]:g}rpm" if len(set(rotation.speeds_rpm)) == 1 else "schedule"


def replicas(spec: CaseSpec, count: int) -> list[CaseSpec]:
    """The same case from ``count`` settled states, each nudged by 2e-8 d in directions of its own."""
    return [replace(spec, nudge=replica_nudge(spec.scene), nudge_seed=k) for k in range(1, count + 1)]


def replica_nudge(scene: Scene) -> float:
    """Length of a nudge, 2e-8 d, m."""
    return NUDGE_DIAMETERS * scene.filling.diameter


def half_step(spec: CaseSpec) -> CaseSpec:
    """The same case from the same settled bed with half the time step."""
    finer = replace(spec.dem, time_step=0.5 * _time_step(spec.scene, spec.dem))
    return replace(spec, dem=finer, settling_dem=spec.bed_dem)


@dataclass(frozen=True)
class Split:
    """Which cases train, which help to choose, and which are judged after everything is chosen."""

    training: list[CaseSpec]
    validation: list[CaseSpec]
    holdout: list[CaseSpec]

    @property
    def all(self) -> list[CaseSpec]:
        """Every case, by speed."""
        cases = [*self.training, *self.validation, *self.holdout]
        return sorted(cases, key=lambda spec: spec.scene.rotation.speeds_rpm)


def split_cases(scene: Scene, dem: DemConfig, dataset: DatasetConfig) -> Split:
    """The cases of a data set: one for each speed, all from one packing.

    A scene that keeps its own motion has one for each packing: ``training_packings``, and ``packing_seed`` held out.

    Raises:
        DatasetError: a speed that is in two splits or twice in one, or nothing left to train on.
    """
    check_arguments(scene=(scene, Scene), dem=(dem, DemConfig), dataset=(dataset, DatasetConfig))
    if not has_splits(scene, dataset):
        raise DatasetError(
            f"scene {scene.name!r} keeps its own motion, so it makes one case and no splits by speed; "
            "give dataset.training_packings, or choose a drum with one speed"
        )
    if not scene.takes_speeds:
        packings = dataset.training_packings, [], [dataset.packing_seed]
        return Split(*([CaseSpec(scene, dem, seed) for seed in seeds] for seeds in packings))
    sides = {side: getattr(dataset, f"{side}_speeds_rpm") for side in ("training", "validation", "holdout")}
    seen: dict[float, str] = {}
    for side, speeds in sides.items():
        for speed in map(float, speeds):
            if speed in seen:
                raise DatasetError(
                    f"dataset.{side}_speeds_rpm has {speed:g} rpm, which is also in dataset.{seen[speed]}_speeds_rpm; "
                    "a speed may be in one place only, or training would see what it is judged on"
                )
            if seen.get(-speed, side) != side:
                raise DatasetError(
                    f"dataset.{side}_speeds_rpm has {speed:g} rpm, whose mirror image is in "
                    f"dataset.{seen[-speed]}_speeds_rpm; keep both in one split, or training would see what it is "
                    "judged on"
                )
            seen[speed] = side
    if not sides["training"]:
        raise DatasetError("dataset.training_speeds_rpm is empty; give at least one speed to train on")
    cases = [[CaseSpec(scene.at_speed(v), dem, dataset.packing_seed) for v in speeds] for speeds in sides.values()]
    return Split(*cases)


def has_splits(scene: Scene, dataset: DatasetConfig) -> bool:
    """Whether a scene's cases are split by what training may see: of a drum by speed, of others by packing."""
    return scene.takes_speeds or bool(dataset.training_packings)


def own_case(scene: Scene, dem: DemConfig, dataset: DatasetConfig) -> CaseSpec:
    """The one case of a scene that keeps its own motion: a schedule, or a container that is no drum."""
    return CaseSpec(scene, dem, dataset.packing_seed)


def key_hash(key: dict[str, Any]) -> str:
    """16 hex digits of the SHA-256 of plain data, the same in every process and on every machine."""
    text = json.dumps(key, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _time_step(scene: Scene, dem: DemConfig) -> float:
    return float(choose_time_step(scene, dem.time_step, dem.allow_unsafe_step)[0])


def _key(kind: str, scene: Scene, dem: DemConfig) -> dict[str, Any]:
    """A scene, the solver's settings that change numbers (skin and threads don't), and its code."""
    solver = {"engine": dem.engine, "time_step": _time_step(scene, dem), "precision": dem.precision, "slip": dem.slip}
    if dem.engine == "lammps":
        solver["ranks"] = dem.ranks
    document = to_document(scene)
    return {"kind": kind, "format": FORMAT_VERSION, "scene": document, "dem": solver, "code": dem_source_hash()}


@functools.cache
def dem_source_hash() -> str:
    """Hash of the code that moves particles; comments, docstrings and layout don't count."""
    return source_digest(SOLVER)[:16]
