"""The contact network's kernels, compiled by a process of their own before a run needs them.

A process that compiles runs the helpers as it compiled them by themselves; one that finds the entries on disk runs the
copies inside these. Both are right to rounding, but the sums may go in another order. So without this the first run
of an installation would train other weights than the same run does later.
"""

import subprocess
from pathlib import Path

import numba
import torch

from gran_bench.config import ContactModelConfig
from gran_bench.files import locked, write_text
from gran_bench.processes import kill_group, start_module
from gran_bench.scene import Cylinder, Filling, Material, Rotation, Scene
from gran_bench.surrogate.contact.kernels import frame as contact_frame
from gran_bench.surrogate.contact.kernels.frame import digest_of_sources, frame_forward
from gran_bench.surrogate.contact.network import ContactNetwork

MARK = "contact_frame.compiled"  # beside the kernels: what was compiled by another process
PATIENCE = 900.0  # s; beyond it the run compiles for itself


def kernels_missing(model: str) -> bool:
    """Whether a model, by its name, has kernels that are not on disk as another process compiled them, and could be."""
    folder = frame_forward.stats.cache_path
    if model != "contact" or folder is None:
        return False
    try:
        entries = Path(folder).glob(f"{Path(contact_frame.__file__).stem}.*.nbc")
        return (Path(folder) / MARK).read_text("utf-8") != _wanted() or not any(entries)
    except OSError:
        return True


def _wanted() -> str:
    """What Numba finds its cache by: the compiler, the sources, and when the entries' file was written."""
    return f"{numba.__version__} {digest_of_sources()} {Path(contact_frame.__file__).stat().st_mtime_ns}"


def compile_kernels(model: str) -> None:
    """Have another process compile what is missing; several runs that start at once wait for one.

    Where that fails, the run compiles for itself, as it would without.
    """
    folder = Path(frame_forward.stats.cache_path)
    try:
        with locked(folder / "contact_frame.lock"):
            if not kernels_missing(model):
                return
            quiet = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.DEVNULL)
            process = start_module("gran_bench.surrogate.contact.compiling", **quiet)
            if process.wait(PATIENCE) == 0:
                write_text(folder / MARK, _wanted())
    except subprocess.TimeoutExpired:
        kill_group(process)
    except OSError:
        pass


def main() -> None:
    """One frame of two spheres in a drum, and its gradient: the kinds of array that every run has."""
    stone = Material(1e7, 0.29, 2500.0, 0.5, 0.3)
    drum = Cylinder((0.0, 0.0, 0.0), (0.0, 1.0, 0.0), 0.1)
    scene = Scene("two spheres", (drum,), Filling(2, 0.05), stone, stone, rotation=Rotation((0.0,), (30.0,)))
    model = ContactNetwork(ContactModelConfig(), scene)
    position = torch.tensor([[0.0, 0.0, -0.076], [0.0, 0.0, -0.027]])
    still = torch.zeros(2, 3)
    model(model.begin(scene, position, still, still), scene, 0.0).position.sum().backward()


if __name__ == "__main__":
    main()
