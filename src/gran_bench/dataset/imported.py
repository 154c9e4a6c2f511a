"""Cases of another code: found by speed, packing and replica among the files of ``dataset.files``."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from gran_bench.config import DatasetConfig, DemConfig
from gran_bench.config.rules import ConfigError
from gran_bench.dataset import case_spec
from gran_bench.dataset.case_file import read_attributes
from gran_bench.dataset.case_spec import CaseSpec, DatasetError, Split, rotation_label
from gran_bench.dataset.scene_document import from_document, to_document
from gran_bench.scene import Scene

ENGINE = "imported"  # the attribute ``engine`` of such a case
# What may differ from the scene that a command names: cases may be of different lengths, and nothing is filled.
_FREE = ("name", "end_time", "rotation", "room", "filling")


class FilesError(DatasetError, ConfigError):
    """``dataset.files`` that do not have the cases that a config asks for, once each."""


@dataclass(frozen=True)
class ImportedCase(CaseSpec):
    """A case that is there and cannot be made."""

    file: Path = Path()
    digest: str = ""  # of its contents

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
        DatasetError: as :func:`case_spec.split_cases`.
        FilesError: no imported case of a speed, or several.
    """
    sides = vars(case_spec.split_cases(scene, dem, dataset)).values()
    return Split(*([case_at(spec.scene, dem, dataset, spec.packing_seed) for spec in side] for side in sides))


def case_at(scene: Scene, dem: DemConfig, dataset: DatasetConfig, packing: int) -> CaseSpec:
    """The case of a scene from a packing: to be made, or imported where ``dataset.files`` names some.

    Raises:
        FilesError: no imported case, or several; one of another scene.
    """
    if not dataset.files:
        return CaseSpec(scene, dem, packing)
    found = [case for case in _like(scene, dataset, packing) if not case.nudge_seed]
    if len(found) > 1:
        raise FilesError(
            f"dataset.files has {rotation_label(scene)} of packing {packing} {len(found)} times; delete one of: "
            f"{', '.join(sorted(str(case.file) for case in found))}"
        )
    if not found:
        there = ", ".join(sorted(case.file.stem for case in imported_cases(dataset.files)))
        raise FilesError(
            f"dataset.files has no {rotation_label(scene)} of packing {packing}; it has {there}. "
            "Import it (python -m gran_bench.import_case), or change dataset.*_speeds_rpm or dataset.packing_seed; "
            "without a packing that training never saw, judge.unseen_packing=false"
        )
    return found[0]


def imported_replicas(spec: CaseSpec, dataset: DatasetConfig) -> list[CaseSpec]:
    """The imported runs of a case from nudged starts; without any the case itself, which gives no noise floor."""
    return [case for case in _like(spec.scene, dataset, spec.packing_seed) if case.nudge_seed] or [spec]


def imported_cases(files: Iterable[Path | str]) -> list[ImportedCase]:
    """The imported cases among files and in folders.

    Raises:
        FilesError: a file that is no imported case; a folder without any.
        DatasetError: a file that is missing or damaged.
    """
    found = []
    for place in map(Path, files):
        inside = sorted(place.glob("*.h5")) if place.is_dir() else [place]
        if not inside:
            raise FilesError(f"dataset.files={place} is a folder without a case; import one into it, or name another")
        for path in inside:
            facts = read_attributes(path)
            if facts["engine"] != ENGINE:
                raise FilesError(f"dataset.files has {path}, which this DEM made; leave it out, speeds name it")
            scene, seeds = from_document(yaml.safe_load(facts["scene"])), (facts["packing_seed"], facts["nudge_seed"])
            found.append(ImportedCase(scene, DemConfig(), seeds[0], 0.0, seeds[1], file=path, digest=facts["digest"]))
    return found


def _like(scene: Scene, dataset: DatasetConfig, packing: int) -> list[ImportedCase]:
    """The cases that turn as the scene does, from a packing; of another scene none, or a model would learn that."""
    wanted = packing, scene.rotation.speeds_rpm
    cases = imported_cases(dataset.files)
    cases = [case for case in cases if (case.packing_seed, case.scene.rotation.speeds_rpm) == wanted]
    for case in cases:
        here, there = to_document(scene), to_document(case.scene)
        for document in (here, there):
            document |= {f"filling.{name}": document["filling"][name] for name in ("count", "diameter")}
        for name in here:
            if name not in _FREE and here[name] != there.get(name):
                raise FilesError(
                    f"scene.{name} is {here[name]} and {case.file} was imported with {there.get(name)}; give the "
                    f"command the scene of the import, such as scene.{name}={there.get(name)}"
                )
    return cases
