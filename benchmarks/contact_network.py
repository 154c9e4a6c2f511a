"""Time of a frame of the contact network: the fused path beside plain torch, and beside another checkout of the code.

    python benchmarks/contact_network.py [--rounds 9] [--beside ../older/src]

All rows take turns on one thread, on two beds of `drum` (3000 spheres): at rest before it turns, and half a second
after it started to turn at 30 rpm. "forward" is a frame of a rollout of ten, "training" a frame of a window of three
with its gradient. The figures are medians of the processor time of the thread, in ms a frame. Ratios are of one turn:
their median, lowest and highest. `--beside` names a folder that holds another ``gran_bench``, of an older commit for
example; a process of its own runs the fused rows of it, in the same turns.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import torch

SPEED, FRAMES, AHEAD = 30.0, 10, 3  # rpm; frames of a rollout and of a window
BEDS = ("at rest", "flowing")
MODELS = {
    "K=4": {"iterations": 4},
    "K=8": {"iterations": 8},
    "K=8 with memory": {"iterations": 8, "memory": True},
    "as shipped": {"iterations": 8, "memory": True, "velocity": "instantaneous"},
}
MOVING = ("position", "velocity", "angular_velocity")
Row = tuple[str, str, str, str]  # bed, model, backend, kind


def rows() -> list[Row]:
    """Every row; plain torch is slow, and shown for one bed."""
    kinds = ("forward", "training")
    fused = [(bed, model, "fused", kind) for bed in BEDS for model in MODELS for kind in kinds]
    return fused + [(BEDS[1], model, "torch", kind) for model in ("K=8", "as shipped") for kind in kinds]


def keep_beds(folder: Path) -> None:
    """Writes the beds and the shipped weights, which every checkout starts from."""
    from gran_bench.config import SceneConfig
    from gran_bench.dem.simulate import settle, simulate
    from gran_bench.scene import build_scene
    from gran_bench.shipped import shipped_model
    from gran_bench.surrogate.checkpoint import load_card

    scene = build_scene(SceneConfig("drum")).at_speed(SPEED)
    settled = settle(scene, seed=0)
    for bed, state in zip(BEDS, (settled, simulate(scene, settled, scene.start_time + 0.5).final), strict=True):
        np.savez(folder / f"{bed}.npz", time=state.time, **{name: getattr(state, name) for name in MOVING})
    torch.save(load_card(shipped_model())[1], folder / "weights.pt")


class Clock:
    """Runs rows on the ``gran_bench`` that this process imports."""

    def __init__(self, folder: Path) -> None:
        from gran_bench.config import ContactModelConfig, SceneConfig
        from gran_bench.scene import build_scene

        try:
            from gran_bench.surrogate.contact.network import ContactNetwork
        except ImportError:  # where it was in earlier commits
            from gran_bench.surrogate.contact import ContactNetwork

        self.scene = build_scene(SceneConfig("drum")).at_speed(SPEED)
        self.models, self.states, weights = {}, {}, torch.load(folder / "weights.pt", weights_only=True)
        for backend in ("fused", "torch"):
            for name, choices in MODELS.items():
                torch.manual_seed(0)
                model = ContactNetwork(ContactModelConfig(**choices, backend=backend), self.scene)
                if name == "as shipped":
                    model.load_state_dict(weights)
                self.models[name, backend] = model
        for bed in BEDS:
            with np.load(folder / f"{bed}.npz") as kept:
                moving = [torch.as_tensor(kept[name], dtype=torch.float32) for name in MOVING]
                self.states[bed] = float(kept["time"]), moving

    def seconds(self, bed: str, model: str, backend: str, kind: str) -> float:
        """Processor time of this thread a frame, s; a frame before it fills the memory."""
        network, (start, moving) = self.models[model, backend], self.states[bed]
        with torch.no_grad():
            state = network(network.begin(self.scene, *moving), self.scene, start)
        frames, loss = AHEAD if kind == "training" else FRAMES if backend == "fused" else 1, 0.0
        began = time.thread_time()
        with torch.set_grad_enabled(kind == "training"):
            for k in range(1, frames + 1):
                state = network(state, self.scene, start + k * self.scene.frame_interval)
                loss = loss + state.position.sum() + state.velocity.sum() if kind == "training" else loss
        if kind == "training":
            torch.autograd.grad(loss, list(network.parameters()))
        return (time.thread_time() - began) / frames


def work(folder: Path) -> None:
    """Answers each row that it reads with its time, s a frame."""
    torch.set_num_threads(1)
    clock = Clock(folder)
    for line in sys.stdin:
        print(clock.seconds(*json.loads(line)), flush=True)


def measured(rounds: int, beside: Path | None) -> dict[tuple[Row, str], np.ndarray]:
    """Seconds a frame of each row here, and of the fused ones beside, one for each turn."""
    paths = {"here": None} | ({"beside": beside} if beside else {})
    with tempfile.TemporaryDirectory() as folder:
        keep_beds(Path(folder))
        workers = {}
        for place, path in paths.items():
            environment = os.environ | {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
            environment |= {"PYTHONPATH": str(path.resolve())} if path else {}
            command = [sys.executable, __file__, "--work", folder]
            pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
            workers[place] = subprocess.Popen(command, env=environment, text=True, **pipes)
        times: dict[tuple[Row, str], list[float]] = {}
        for turn in range(rounds + 1):
            for row in rows():
                for place in list(workers)[:: 1 if turn % 2 else -1]:
                    if place == "beside" and row[2] != "fused":
                        continue
                    print(json.dumps(row), file=workers[place].stdin, flush=True)
                    took = float(workers[place].stdout.readline())
                    if turn:  # the first turn compiles
                        times.setdefault((row, place), []).append(took)
        for worker in workers.values():
            worker.stdin.close()
            worker.wait()
    return {key: np.array(values) for key, values in times.items()}


def main(rounds: int, beside: Path | None) -> None:
    """Prints the table."""
    times = measured(rounds, beside)
    print(f"{'ms a frame':44s}{'here':>8s}" + (f"{'beside':>10s}   beside / here" if beside else ""))
    for row in rows():
        here = times[row, "here"]
        line = f"{', '.join(row):44s}{1e3 * np.median(here):8.2f}"
        other, what = times.get((row, "beside")), ""
        if row[2] == "torch":
            other, what = here, " of torch / fused"
            here = times[(*row[:2], "fused", row[3]), "here"]
        if other is not None:
            ratio, seen = other / here, "" if what else f"{1e3 * np.median(other):10.2f}"
            line += f"{seen:10s}   {np.median(ratio):.2f} ({ratio.min():.2f}–{ratio.max():.2f}){what}"
        print(line)
    print(f"{rounds} turns; medians, one thread, processor time")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--beside", type=Path, help="folder with another gran_bench, such as ../older/src")
    parser.add_argument("--work", type=Path, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.work:
        work(given.work)
    else:
        main(given.rounds, given.beside)
