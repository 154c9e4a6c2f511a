"""What is exported: a case by its file or name, or the stored rollout of a run by its folder, name or id."""

from __future__ import annotations

import glob
import json
import re
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gran_bench.dataset import Case, DatasetError, read_attributes, read_case
from gran_bench.scene import Scene
from gran_bench.state import FloatArray, Trajectory

# Of a run's id in MLflow and its results folder: its own folder, or None.
FolderOf = Callable[[str, Path], str | None]


class ExportError(ValueError):
    """What cannot be exported; the message names it and the remedy."""


@dataclass(frozen=True)
class Exported:
    """A trajectory with what a picture of it needs.

    Attributes:
        name: of the case or the rollout, and of its file unless another is given.
        scene: walls and their motion.
        trajectory: F frames of N spheres.
        material: ``(N,)`` index of each sphere's material.
    """

    name: str
    scene: Scene
    trajectory: Trajectory
    material: np.ndarray

    @property
    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Lower and upper corner of the container, ``(3,)`` m each; of the spheres where it has none."""
        scene = self.scene
        if scene.drum_radius is not None and scene.length is not None:
            reach = np.array([scene.drum_radius, 0.5 * scene.length, scene.drum_radius])
            return -reach, reach
        if scene.room is not None:
            return np.array(scene.room.lower, float), np.array(scene.room.upper, float)
        centre = self.trajectory.position.reshape(-1, 3).astype(np.float64)
        centre, edge = centre[np.isfinite(centre).all(axis=1)], float(self.trajectory.radius.max(initial=0.0))
        return centre.min(axis=0, initial=np.inf) - edge, centre.max(axis=0, initial=-np.inf) + edge


def exported_case(path: Path | str) -> Exported:
    """A case file as it is exported.

    Raises:
        DatasetError: the file is missing or damaged.
    """
    case = read_case(path)
    return Exported(Path(path).stem, case.scene, case.trajectory, case.settled.material)


def exported_rollout(folder: Path, data: Path, name: str | None = None) -> Exported:
    """The stored rollout of a run.

    Args:
        folder: of the run.
        data: data cache with the case that the rollout started from: it has the scene and the radii.
        name: of the rollout, such as ``30rpm``; None for the judged one, or the only one.

    Raises:
        ExportError: no such rollout, or its case is not in the cache.
    """
    files = {path.stem: path for path in sorted((folder / "rollouts").glob("*.npz"))}
    if name is None:
        with suppress(OSError, ValueError, KeyError):
            name = f"{json.loads((folder / 'summary.json').read_text('utf-8'))['judged_rpm']:g}rpm"
    name = next(iter(files)) if name is None and len(files) == 1 else name
    if name not in files:
        there = (
            f"has the rollouts {', '.join(files)}; choose one" if files else "holds no rollouts/*.npz; finish the run"
        )
        raise ExportError(f"--rollout {name}: {folder} {there}")
    with np.load(files[name]) as kept:
        spins = kept.get("angular_velocity")
        position, velocity, digest = kept["position"], kept["velocity"], str(kept["made_of"]).split()[0]
    case = _case_of(digest, data)
    if case is None:
        raise ExportError(
            f"the case that rollout {name} started from is not in {data}; name the cache with --data, or make it "
            "again with python -m gran_bench.generate"
        )
    time = case.settled.time + case.scene.frame_interval * np.arange(len(position))
    trajectory = Trajectory(time, position, velocity, spins, case.trajectory.radius)
    return Exported(f"{folder.name}_{name}", case.scene, trajectory, case.settled.material)


def find(named: str, data: Path, results: Path, folder_of: FolderOf) -> Path:
    """The file of a case or the folder of a run.

    Args:
        named: a path; a case's name in the data cache, or its beginning; a run's name or key, or its id in MLflow.
        data: data cache.
        results: folder of the results.
        folder_of: looks a run's id up in MLflow.

    Raises:
        ExportError: nothing of the name, or several things.
    """
    if Path(named).exists():
        return Path(named)
    pattern = glob.escape(named)
    cases = [path for path in sorted(data.rglob(f"{pattern}*.h5")) if path.parent.name != "settled"]
    cases = [path for path in cases if named in (path.stem, path.name)] or cases
    places = {*results.glob(f"*/{pattern}"), *results.glob(f"*/*-{pattern}")}
    if re.fullmatch("[0-9a-f]{32}", named) and (folder := folder_of(named, results)) is not None:
        # A moved results folder has its runs under their old names.
        places.add(Path(folder) if Path(folder).is_dir() else results / "runs" / Path(folder).name)
    found = [*cases, *sorted(path for path in places if (path / "rollouts").is_dir())]
    if len(found) != 1:
        what = (
            f"may be {', '.join(map(str, found[:4]))}"
            if found
            else f"is no file, no case in {data}, no run in {results}"
        )
        raise ExportError(f"{named} {what}; give a path, or the folders with --data and --results")
    return found[0]


def _case_of(digest: str, data: Path) -> Case | None:
    for path in sorted(data.rglob("*.h5")):
        with suppress(DatasetError):  # of another format, or damaged: not the one
            if path.parent.name != "settled" and read_attributes(path)["digest"] == digest:
                return read_case(path)
    return None
