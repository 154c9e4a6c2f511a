"""The command around an export: what is meant, where it goes, what was written."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from gran_bench.dataset import DatasetError
from gran_bench.export.formats import write_npz, write_vtkhdf, write_xyz
from gran_bench.export.source import ExportError, FolderOf, exported_case, exported_rollout, find

FAILED, REFUSED = 1, 2
FORMATS = {"vtkhdf": write_vtkhdf, "xyz": write_xyz, "npz": write_npz}


def export_command(words: Sequence[str] | None = None, folder_of: FolderOf = lambda run_id, root: None) -> int:
    """Export what a command line names.

    Args:
        words: of the command line.
        folder_of: looks a run's id up in MLflow.

    Returns:
        The exit code: 0; 1 where the file cannot be written; 2 where nothing of the name is there.
    """
    parser = argparse.ArgumentParser(
        "python -m gran_bench.export", description="Write a case, or the rollout of a run, for another program."
    )
    add = parser.add_argument
    add("what", metavar="CASE|RUN", help="file or name of a case; folder, name, key or MLflow id of a run")
    add("--to", required=True, choices=FORMATS, help="vtkhdf: ParaView, VTK; xyz: OVITO; npz: NumPy, in SI units")
    add("--out", type=Path, metavar="FILE", help="default: NAME.FORMAT in this folder")
    add("--rollout", metavar="NAME", help="of a run, such as 30rpm (default: the judged one)")
    add("--data", type=Path, default=Path("data"), help="data cache (default: data)")
    add("--results", type=Path, default=Path("results"), help="results folder (default: results)")
    chosen = parser.parse_args(words)
    try:
        place = find(chosen.what, chosen.data, chosen.results, folder_of)
        if chosen.rollout is not None and not place.is_dir():
            raise ExportError(f"--rollout {chosen.rollout}: {place} is a case; a run has rollouts")
        exported = exported_rollout(place, chosen.data, chosen.rollout) if place.is_dir() else exported_case(place)
        path = chosen.out or Path(f"{exported.name}.{chosen.to}")
        FORMATS[chosen.to](exported, path, print)
    except BrokenPipeError:
        raise
    except (ExportError, DatasetError, OSError) as error:
        if isinstance(error, OSError):
            error = f"{error.filename}: {error.strerror or error}; choose another --out"
        print(f"error: {error}", file=sys.stderr)
        return FAILED if isinstance(error, str) else REFUSED
    time = exported.trajectory.time
    print(f"{len(exported.material)} spheres, {len(time)} frames, {time[0]:g} to {time[-1]:g} s: {path}")
    return 0
