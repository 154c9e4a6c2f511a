"""Time of a frame of the contact network: the fused path beside plain torch, and what memory and iterations cost.

    python benchmarks/contact_network.py [--repeats 9]

All rows alternate in one run on one thread, on the bed of `drum` after half a second at 30 rpm (3000 spheres). The
figures are medians of the processor time of the thread, in ms; "x" is the ratio to the fused row of the same model.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from statistics import median

import torch

from gran_bench.config import ContactModelConfig, SceneConfig
from gran_bench.dem.simulate import settle, simulate
from gran_bench.scene import Scene, build_scene
from gran_bench.state import ParticleState
from gran_bench.surrogate.contact.network import ContactNetwork

Rows = dict[str, Callable[[], object]]
MODELS = {
    "K=4": ContactModelConfig(iterations=4),
    "K=8": ContactModelConfig(iterations=8),
    "K=8 with memory": ContactModelConfig(iterations=8, memory=True),
}


def flowing_bed() -> tuple[Scene, ParticleState]:
    """The full drum, half a second after it started to turn."""
    scene = build_scene(SceneConfig("drum")).at_speed(30.0)
    return scene, simulate(scene, settle(scene, seed=0), scene.start_time + 0.5).final


def frame_rows(scene: Scene, bed: ParticleState, label: str, config: ContactModelConfig) -> Rows:
    """A frame forward, and with backward, on both backends."""
    arrays = (torch.as_tensor(a, dtype=torch.float32) for a in (bed.position, bed.velocity, bed.angular_velocity))
    position, velocity, spin = arrays
    rows: Rows = {}
    for backend in ("fused", "torch"):
        model = ContactNetwork(replace(config, backend=backend), scene)
        with torch.no_grad():
            state = model(
                model.begin(scene, position, velocity, spin), scene, bed.time
            )  # a frame that fills the memory

        def forward(model=model, state=state) -> None:
            with torch.no_grad():
                model(state, scene, bed.time)

        def both(model=model, state=state) -> None:
            state.position.requires_grad_()
            model(state, scene, bed.time).position.sum().backward()

        rows |= {f"{label}, {backend}, forward": forward, f"{label}, {backend}, with backward": both}
    return rows


def interleaved(rows: Rows, repeats: int) -> dict[str, float]:
    """Median ms of each row; every round runs every row once, after one round that only warms up."""
    seconds: dict[str, list[float]] = {name: [] for name in rows}
    for round_ in range(repeats + 1):
        for name, run in rows.items():
            begin = time.thread_time()
            run()
            if round_:
                seconds[name].append(time.thread_time() - begin)
    return {name: 1e3 * median(values) for name, values in seconds.items()}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=9)
    options = parser.parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(0)
    scene, bed = flowing_bed()
    rows: Rows = {}
    for label, config in MODELS.items():
        rows |= frame_rows(scene, bed, label, config)
    times = interleaved(rows, options.repeats)
    for name, milliseconds in times.items():
        ratio = milliseconds / times[name.replace("torch", "fused")]
        print(f"{name:42s} {milliseconds:8.2f} ms {ratio:6.1f} x")


if __name__ == "__main__":
    main()
