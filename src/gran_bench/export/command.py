"""``python -m gran_bench.export CASE|RUN --to FORMAT``: what is meant, where it goes, what was written."""

import argparse
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from gran_bench.dataset import Case, DatasetError, read_attributes, read_case
from gran_bench.evaluation.plan import rollout_name
from gran_bench.export.formats import FORMATS
from gran_bench.processes import run_command
from gran_bench.run.summary import read_summary
from gran_bench.state import Trajectory
from gran_bench.tracking.search import RunError, find_run


def export_command(words: Sequence[str] | None = None) -> int:
    """Write the case, or the stored rollout of the run, that a command line names; the exit code."""
    parser = argparse.ArgumentParser("python -m gran_bench.export", description="Open a case or a rollout elsewhere.")
    add = parser.add_argument
    add("what", metavar="CASE|RUN", help="file or name of a case; folder, name, key or MLflow id of a run")
    add("--to", required=True, choices=FORMATS, help="vtkhdf: ParaView, VTK; xyz: OVITO; npz: NumPy, in SI units")
    add("--out", type=Path, metavar="FILE", help="default: NAME.FORMAT in this folder")
    add("--rollout", metavar="NAME", help="of a run, such as 30rpm (default: the judged one)")
    add("--data", type=Path, default=Path("data"), help="data cache (default: data)")
    add("--results", type=Path, default=Path("results"), help="results folder (default: results)")
    return run_command(parser, _export, words)


def _export(chosen: argparse.Namespace) -> None:
    cases = [path for path in sorted(chosen.data.rglob("*.h5")) if path.parent.name != "settled"]
    place = Path(chosen.what)
    place = place if place.is_file() else find_run(chosen.what, chosen.results, cases)
    if chosen.rollout is not None and not place.is_dir():
        raise RunError(f"--rollout {chosen.rollout}: {place} is a case; a run has rollouts")
    case, name = _rollout(place, cases, chosen) if place.is_dir() else (read_case(place), place.stem)
    path = chosen.out or Path(f"{name}.{chosen.to}")
    FORMATS[chosen.to](case, path)
    time = case.trajectory.time
    print(f"{case.settled.count} spheres, {len(time)} frames, {time[0]:g} to {time[-1]:g} s: {path}")


def _rollout(folder: Path, cases: Sequence[Path], chosen: argparse.Namespace) -> tuple[Case, str]:
    """The case that a stored rollout started from with the rollout's motion, and a name for the file."""
    files = {path.stem: path for path in sorted((folder / "rollouts").glob("*.npz"))}
    summary = read_summary(folder)
    name = chosen.rollout or (rollout_name(summary["judged_rpm"]) if summary else "")
    if name not in files:
        there = f"has {', '.join(files)}; choose one" if files else "holds no rollouts/*.npz; finish the run"
        raise RunError(f"--rollout {name}: {folder} {there}")
    with np.load(files[name]) as kept:
        spins, digest = kept.get("angular_velocity"), str(kept["made_of"]).split()[0]
        position, velocity = kept["position"], kept["velocity"]
    for path in cases:
        with suppress(DatasetError):  # of another format, or damaged: not the one
            if read_attributes(path)["digest"] == digest:
                case = read_case(path)
                time = case.settled.time + case.scene.frame_interval * np.arange(len(position))
                motion = Trajectory(time, position, velocity, spins, case.trajectory.radius)
                return replace(case, trajectory=motion), f"{folder.name}_{name}"
    raise RunError(
        f"the case that rollout {name} started from is not in {chosen.data}; name the cache with --data, or make it "
        "again with python -m gran_bench.generate"
    )
