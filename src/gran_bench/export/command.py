"""The command around an export: what is meant, where it goes, what was written."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from gran_bench.dataset import DatasetError
from gran_bench.export.source import Exported, ExportError, FolderOf, exported_case, exported_rollout, find
from gran_bench.export.vtkhdf import write_vtkhdf
from gran_bench.export.xyz import write_npz, write_xyz

REFUSED = 2
FORMATS: dict[str, Callable[..., Path]] = {"vtkhdf": write_vtkhdf, "xyz": write_xyz, "npz": write_npz}


def export_command(words: Sequence[str] | None = None, folder_of: FolderOf = lambda run_id, root: None) -> int:
    """Export what a command line names.

    Args:
        words: of the command line.
        folder_of: looks a run's id up in MLflow.

    Returns:
        The exit code: 0; 1 where the file cannot be written; 2 where nothing of the name or the format is there.
    """
    chosen = _parser().parse_args(words)
    try:
        exported = _chosen(chosen, folder_of)
        path = chosen.out or Path(f"{exported.name}.{chosen.to}")
        FORMATS[chosen.to](exported, path, print)
    except (ExportError, DatasetError) as error:
        print(f"error: {error}", file=sys.stderr)
        return REFUSED
    except OSError as error:
        if isinstance(error, BrokenPipeError):
            raise
        print(f"error: {error.filename}: {error.strerror or error}; choose another --out", file=sys.stderr)
        return 1
    frames, count = exported.trajectory.position.shape[:2]
    span = f"{exported.trajectory.time[0]:g} to {exported.trajectory.time[-1]:g} s"
    print(f"{count} spheres, {frames} frames, {span}, {path.stat().st_size / 1e6:.1f} MB: {path}")
    return 0


def _chosen(chosen: argparse.Namespace, folder_of: FolderOf) -> Exported:
    if chosen.every < 1:
        raise ExportError(f"--every {chosen.every} leaves no frame; choose 1 or more")
    place = find(chosen.what, chosen.data, chosen.results, folder_of)
    if place.is_dir():
        exported = exported_rollout(place, chosen.data, chosen.rollout)
    elif chosen.rollout is not None:
        raise ExportError(f"--rollout {chosen.rollout}: {place} is a case; a run has rollouts")
    else:
        exported = exported_case(place)
    return exported.every(chosen.every)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        "python -m gran_bench.export", description="Write a case, or the rollout of a run, for another program."
    )
    parser.add_argument(
        "what", metavar="CASE|RUN", help="file or name of a case; folder, name, key or MLflow id of a run"
    )
    parser.add_argument(
        "--to", required=True, choices=FORMATS, help="vtkhdf: ParaView, VTK; xyz: OVITO; npz: NumPy arrays in SI units"
    )
    parser.add_argument("--out", type=Path, metavar="FILE", help="default: NAME.FORMAT in this folder")
    parser.add_argument("--every", type=int, default=1, metavar="K", help="every K-th frame (default: 1)")
    parser.add_argument("--rollout", metavar="NAME", help="of a run, such as 30rpm (default: the judged one)")
    parser.add_argument("--data", type=Path, default=Path("data"), help="data cache (default: data)")
    parser.add_argument("--results", type=Path, default=Path("results"), help="results folder (default: results)")
    return parser
