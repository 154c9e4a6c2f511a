"""Cases of another code: found by speed, packing and replica among the files of ``dataset.files``."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from gran_bench.config import DatasetConfig, DemConfig
from gran_bench.dataset import case_spec
from gran_bench.dataset.case_file import read_attributes
from gran_bench.dataset.case_spec import CaseSpec, DatasetError, Split, rotation_label
from gran_bench.dataset.scene_document import from_document, to_document
from gran_bench.scene import Scene

ENGINE = "imported"  # the attribute ``engine`` of such a case
# What may differ from the scene that a command names: cases may be of different lengths, and nothing is filled.
_FREE = ("name", "end_time", "rotation", "room", "filling")


@dataclass(frozen=True)
class ImportedCase(CaseSpec):
    """A case that is there and cannot be made.

    Attributes:
        file: the case.
        digest: of its contents.
    """

    file: Path = Path()
    digest: str = ""

    @property
    def key(self) -> dict[str, Any]:
        """The contents; nothing else determines them."""
        return {"kind": ENGINE, "digest": self.digest}

    def path(self, root: Path | str) -> Path:
        """The file, wherever the data cache is."""
        return self.file


def split_cases(scene: Scene, dem: DemConfig, dataset: DatasetConfig) -> Split:
    """The cases of a data set, one for each speed: to be made, or imported where ``dataset.files`` names some.

    Raises:
        DatasetError: as :func:`case_spec.split_cases`, or no imported case of a speed.
    """
    split = case_spec.split_cases(scene, dem, dataset)
    sides = {side: getattr(split, side) for side in ("training", "validation", "holdout")}
    seed = dataset.packing_seed
    return Split(**{side: [case_at(s.scene, dem, dataset, seed) for s in specs] for side, specs in sides.items()})


def case_at(scene: Scene, dem: DemConfig, dataset: DatasetConfig, packing: int) -> CaseSpec:
    """The case of a scene from a packing: to be made, or imported where ``dataset.files`` names some.

    Raises:
        DatasetError: no imported case, or several; one of another scene.
    """
    if not dataset.files:
        return CaseSpec(scene, dem, packing)
    found = [case for case in _like(scene, dataset, packing) if not case.nudge_seed]
    if len(found) != 1:
        there = ", ".join(sorted(case.file.stem for case in imported_cases(dataset.files)))
        problem = f"{len(found)} times" if found else "nowhere"
        raise DatasetError(
            f"dataset.files has {rotation_label(scene)} from packing {packing} {problem}; it has {there}. Import it "
            "(python -m gran_bench.import_case), or change dataset.*_speeds_rpm or dataset.packing_seed; without a "
            "packing that training never saw, judge.unseen_packing=false"
        )
    return found[0]


def imported_replicas(spec: CaseSpec, dataset: DatasetConfig) -> list[CaseSpec]:
    """The imported runs of a case from nudged starts; without any the case itself, which gives no noise floor."""
    return [case for case in _like(spec.scene, dataset, spec.packing_seed) if case.nudge_seed] or [spec]


def imported_cases(files: Iterable[Path | str]) -> list[ImportedCase]:
    """The imported cases among files and in folders.

    Raises:
        DatasetError: a file that is missing, damaged or no imported case; a folder without any.
    """
    found = []
    for place in map(Path, files):
        inside = sorted(place.glob("*.h5")) if place.is_dir() else [place]
        if not inside:
            raise DatasetError(f"dataset.files={place} is a folder without a case; import one into it, or name another")
        found += map(_read, inside)
    return found


def _read(path: Path) -> ImportedCase:
    facts = read_attributes(path)
    if facts["engine"] != ENGINE:
        raise DatasetError(f"dataset.files has {path}, which this DEM made; leave it out, the speeds name such cases")
    return ImportedCase(
        from_document(yaml.safe_load(facts["scene"])),
        packing_seed=int(facts["packing_seed"]),
        nudge_seed=int(facts["nudge_seed"]),
        file=path,
        digest=facts["digest"],
    )


def _like(scene: Scene, dataset: DatasetConfig, packing: int) -> list[ImportedCase]:
    """The cases that turn as the scene does, from a packing."""
    cases = [case for case in imported_cases(dataset.files) if case.packing_seed == packing]
    cases = [case for case in cases if case.scene.rotation.speeds_rpm == scene.rotation.speeds_rpm]
    for case in cases:
        _hold_scene(case, scene)
    return cases


def _hold_scene(case: ImportedCase, scene: Scene) -> None:
    """Refuse a case of another scene than the command's: a model would learn one and be told of the other."""
    here, there = to_document(scene), to_document(case.scene)
    for name in ("count", "diameter"):
        here[f"filling.{name}"], there[f"filling.{name}"] = here["filling"][name], there["filling"][name]
    for name in here:
        if name not in _FREE and here[name] != there[name]:
            raise DatasetError(
                f"scene.{name} is {here[name]} and {case.file} was imported with {there[name]}; give the command the "
                f"scene of the import, such as scene.{name}={there[name]}"
            )
