"""Time of the continuous convolution and of a CCNN frame: the fused path beside plain torch, and what each skip saves.

    python benchmarks/cconv.py [--repeats 9] [--threads 1]

All rows of a table alternate in one run, on the settled bed of `drum` (3000 spheres, R = 2.25 d). The figures are
medians of the processor time of this process (one thread) or of the clock on the wall (more threads), in ms.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from statistics import median

import torch

from gran_bench.config import BoundaryConfig, CconvModelConfig, SceneConfig
from gran_bench.dem.simulate import settle
from gran_bench.scene import Scene, build_scene
from gran_bench.surrogate.convolution.cconv import ContinuousConvolution
from gran_bench.surrogate.convolution.kernels.lattice import LatticeBasis
from gran_bench.surrogate.convolution.kernels.radial import RadialBasis
from gran_bench.surrogate.convolution.neighborhood import KernelBasis, particle_neighborhood
from gran_bench.surrogate.step import build_model

RADIUS = 0.1125  # m

Rows = dict[str, Callable[[], object]]


def interleaved(rows: Rows, repeats: int, clock: Callable[[], float]) -> dict[str, float]:
    """Median ms of each row; every round runs every row once, after one round that only warms up."""
    seconds: dict[str, list[float]] = {name: [] for name in rows}
    for round_ in range(repeats + 1):
        for name, run in rows.items():
            begin = clock()
            run()
            if round_:
                seconds[name].append(clock() - begin)
    return {name: 1e3 * median(values) for name, values in seconds.items()}


def layer_rows(basis: KernelBasis, position: torch.Tensor, width_in: int, width_out: int, name: str) -> Rows:
    """Forward, and forward with backward, of one layer on both backends."""
    pairs = particle_neighborhood(basis, position)
    rows: Rows = {}
    for backend in ("fused", "torch"):
        layer = ContinuousConvolution(width_in, width_out, basis, backend)
        features = torch.randn(len(position), width_in, requires_grad=True)

        def forward(layer=layer, features=features) -> None:
            with torch.no_grad():
                layer(features, pairs)

        def both(layer=layer, features=features) -> None:
            layer(features, pairs).sum().backward()

        label = f"{name} {width_in}→{width_out}, {backend}"
        rows |= {f"{label}, forward": forward, f"{label}, with backward": both}
    return rows


def frame_rows(scene: Scene, position: torch.Tensor, velocity: torch.Tensor) -> Rows:
    """A frame of the whole network, forward and with backward, for each kernel and boundary, and without the skips."""
    everywhere = torch.arange(len(position))
    rows: Rows = {}

    def add(label: str, model: torch.nn.Module, scene: Scene) -> None:
        def forward() -> None:
            with torch.no_grad():
                model(model.begin(scene, position, velocity), scene, 1.5)

        def both() -> None:
            model(model.begin(scene, position, velocity), scene, 1.5).position.sum().backward()

        rows.update({f"{label}, forward": forward, f"{label}, with backward": both})

    for kernel, width in (("lattice", 64), ("radial", 32)):
        for kind in ("spheres", "analytic", "none"):
            config = CconvModelConfig(kernel=kernel, width=width)
            add(f"{kernel} {width}, walls {kind}", build_model(config, BoundaryConfig(kind=kind), scene), scene)
    paper = build_model(CconvModelConfig(), BoundaryConfig(), scene)
    add("lattice 64, walls spheres, walls at rest", paper, scene.at_rest())
    unskipped = build_model(CconvModelConfig(), BoundaryConfig(), scene)
    see = unskipped._see_walls
    unskipped._see_walls = lambda *frame: _seen_by_all(see(*frame), everywhere)
    add("lattice 64, walls spheres, wall branch for all particles", unskipped, scene)
    return rows


def _seen_by_all(wall, everywhere: torch.Tensor):
    """The same wall pairs with the wall branch computed for every particle."""
    return replace(wall, near=everywhere, query=wall.near[wall.query])


def show(title: str, figures: dict[str, float]) -> None:
    print(f"\n{title}\n{'-' * len(title)}")
    for name, value in figures.items():
        print(f"{name:<72s}{value:8.1f} ms")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--threads", type=int, default=1)
    options = parser.parse_args()
    torch.manual_seed(0)
    torch.set_num_threads(options.threads)
    clock = time.process_time if options.threads == 1 else time.perf_counter
    scene = build_scene(SceneConfig(name="drum")).at_speed(30.0)
    position = torch.from_numpy(settle(scene, seed=0).position).float()
    velocity = 0.3 * torch.randn(position.shape)
    lattice, radial = LatticeBasis(RADIUS, 4), RadialBasis.around_contact(0.05, RADIUS)
    neighbors = len(particle_neighborhood(lattice, position).source) / len(position)
    print(f"{len(position)} spheres, {neighbors:.1f} neighbours, {options.threads} thread(s)")

    layers = {
        "geometry of a frame, lattice": lambda: particle_neighborhood(lattice, position),
        "geometry of a frame, radial": lambda: particle_neighborhood(radial, position),
    }
    layers |= layer_rows(lattice, position, 64, 64, "lattice")
    layers |= layer_rows(radial, position, 32, 32, "radial")
    show("One layer", interleaved(layers, options.repeats, clock))
    show("One frame", interleaved(frame_rows(scene, position, velocity), options.repeats, clock))


if __name__ == "__main__":
    main()
