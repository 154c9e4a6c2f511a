"""What is exported: a case by its file or name, or the stored rollout of a run by its folder, name or id."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
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
        name: of the case or the rollout; of the file unless another is given.
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
        """Lower and upper corner of the container, ``(3,)`` each, m; where it has no end, of the spheres in it."""
        scene, motion = self.scene, self.trajectory
        if scene.drum_radius is not None and scene.length is not None:
            reach = np.array([scene.drum_radius, 0.5 * scene.length, scene.drum_radius])
            return -reach, reach
        if scene.room is not None:
            return np.array(scene.room.lower, float), np.array(scene.room.upper, float)
        centre = motion.position.reshape(-1, 3).astype(np.float64)
        centre = centre[np.isfinite(centre).all(axis=1)]
        if not len(centre):
            return np.zeros(3), np.ones(3)
        edge = float(motion.radius.max())
        return centre.min(axis=0) - edge, centre.max(axis=0) + edge

    def every(self, step: int) -> Exported:
        """Every ``step``-th frame, from the first on."""
        kept = slice(None, None, step)
        motion = self.trajectory
        spin = None if motion.angular_velocity is None else motion.angular_velocity[kept]
        fewer = replace(
            motion,
            time=motion.time[kept],
            position=motion.position[kept],
            velocity=motion.velocity[kept],
            angular_velocity=spin,
            diagnostics={name: values[kept] for name, values in motion.diagnostics.items()},
        )
        return replace(self, trajectory=fewer)


def exported_case(path: Path | str) -> Exported:
    """A case file as it is exported.

    Raises:
        DatasetError: the file is missing or damaged.
    """
    return _of(Path(path).stem, read_case(path))


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
    if not files:
        raise ExportError(f"{folder} holds no rollouts/*.npz; let the run finish, or name another")
    if name is None:
        name = _judged(folder) or ("" if len(files) > 1 else next(iter(files)))
    if name not in files:
        raise ExportError(f"--rollout {name}: {folder} has {', '.join(files)}; choose one of them")
    with np.load(files[name]) as kept:
        arrays = {key: kept[key] for key in ("position", "velocity", "angular_velocity") if key in kept}
        digest = str(kept["made_of"]).split()[0]
    case = _case_of(digest, data)
    if case is None:
        raise ExportError(
            f"the case that rollout {name} started from is not in {data}; name the cache with --data, or make it "
            "again with python -m gran_bench.generate"
        )
    motion, frames = case.trajectory, len(arrays["position"])
    trajectory = Trajectory(
        case.settled.time + case.scene.frame_interval * np.arange(frames),
        arrays["position"],
        arrays["velocity"],
        arrays.get("angular_velocity"),
        motion.radius,
    )
    return replace(_of(f"{folder.name}_{name}", case), trajectory=trajectory)


def find(named: str, data: Path, results: Path, folder_of: FolderOf) -> Path:
    """The file of a case or the folder of a run.

    Args:
        named: a path; a case's name in the data cache, or the beginning of it; a run's name or key; its id in MLflow.
        data: data cache.
        results: folder of the results.
        folder_of: looks a run's id up in MLflow.

    Raises:
        ExportError: nothing of the name, or several things.
    """
    if Path(named).exists():
        return Path(named)
    pattern = re.sub(r"([*?[])", r"[\1]", named)
    cases = [path for path in sorted(data.rglob(f"{pattern}*.h5")) if path.parent.name != "settled"]
    cases = [path for path in cases if path.stem == named or path.name == named] or cases
    runs = sorted({*results.glob(f"*/{pattern}"), *results.glob(f"*/*-{pattern}")})
    found = [*cases, *(path for path in runs if (path / "rollouts").is_dir())]
    if not found and re.fullmatch("[0-9a-f]{32}", named):
        folder = Path(folder_of(named, results) or "nowhere")
        found = [place for place in (folder, results / "runs" / folder.name) if place.is_dir()][:1]
    if len(found) > 1:
        raise ExportError(f"{named} may be {', '.join(map(str, found[:4]))}; give one of these paths")
    if not found:
        raise ExportError(
            f"{named} is no file, no case in {data} and no run in {results}; give a path, or --data and --results"
        )
    return found[0]


def scene_text(exported: Exported) -> str:
    """The scene as YAML."""
    import yaml

    from gran_bench.dataset import to_document

    return yaml.safe_dump(to_document(exported.scene), sort_keys=False)


def _of(name: str, case: Case) -> Exported:
    return Exported(name, case.scene, case.trajectory, case.settled.material)


def _judged(folder: Path) -> str | None:
    """The name of the rollout that the run was judged by."""
    try:
        rpm = json.loads((folder / "summary.json").read_text("utf-8"))["judged_rpm"]
    except (OSError, ValueError, KeyError):
        return None
    return f"{rpm:g}rpm"


def _case_of(digest: str, data: Path) -> Case | None:
    for path in sorted(data.rglob("*.h5")):
        try:
            if path.parent.name != "settled" and read_attributes(path)["digest"] == digest:
                return read_case(path)
        except DatasetError:  # of another format, or damaged: not the one
            continue
    return None
