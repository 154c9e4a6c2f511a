"""Time of the continuous convolution and of a CCNN frame: the fused path beside plain torch, and what each skip saves.

    python benchmarks/cconv.py [--repeats 9] [--threads 1] [--open3d-python open3d-venv/bin/python]

All rows of a table alternate in one run, on the settled bed of `drum` (3000 spheres, R = 2.25 d). The figures are
medians of the processor time of this process (one thread) or of the clock on the wall (more threads), in ms.

With an interpreter that has Open3D (only here, no dependency of the project), a first table sets one layer beside
Open3D's `ContinuousConv` on one thread, R = 2.4 d for 53 neighbours; both are given neighbours and window, and their
outputs and gradients must agree:

    python -m venv open3d-venv && open3d-venv/bin/pip install open3d-cpu torch==2.13.0    # the torch of Open3D 0.20
    apt-get install libusb-1.0-0 libgl1 libx11-6 libgomp1    # what its wheel leaves out
"""

from __future__ import annotations

import argparse
import os
import subprocess
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from statistics import median

import numpy as np
import torch

from gran_bench.config import BoundaryConfig, CconvModelConfig, SceneConfig
from gran_bench.dem.simulate import settle
from gran_bench.processes import ONE_THREAD, MissingProgramError, kill_group, require_program, start_program
from gran_bench.scene import Scene, build_scene
from gran_bench.surrogate.convolution.cconv import ContinuousConvolution
from gran_bench.surrogate.convolution.kernels.lattice import LatticeBasis
from gran_bench.surrogate.convolution.kernels.radial import RadialBasis
from gran_bench.surrogate.convolution.neighborhood import KernelBasis, particle_neighborhood
from gran_bench.surrogate.step import build_model

RADIUS = 0.1125  # m
OPEN3D_RADIUS = 0.12  # m: 53 neighbours
TABLES = ("open3d", "layer", "frame", "many")
OPEN3D_AGREES = {"float32": 1e-5, "bfloat16": 5e-3}  # relative RMS difference of outputs and gradients

Rows = dict[str, Callable[[], float | None]]


def interleaved(rows: Rows, repeats: int, clock: Callable[[], float]) -> dict[str, list[float]]:
    """ms of each row in each round; every round runs every row once, after one round that only warms up.

    A row that runs elsewhere gives the seconds that it took.
    """
    figures: dict[str, list[float]] = {name: [] for name in rows}
    for round_ in range(repeats + 1):
        for name, run in rows.items():
            begin = clock()
            told = run()
            seconds = clock() - begin if told is None else told
            if round_:
                figures[name].append(1e3 * seconds)
    return figures


class Open3dLayer:
    """Open3D's layer in a process of its own."""

    def __init__(self, python: str, folder: Path, problem: dict[str, np.ndarray]) -> None:
        np.savez(folder / "problem.npz", **problem)
        command = [python, str(Path(__file__).with_name("open3d_cconv.py"))]
        command += [str(folder / "problem.npz"), str(folder / "answer.npz")]
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
        self.process = start_program(command, ONE_THREAD, **pipes)
        while (line := self.process.stdout.readline()) != "ready\n":
            if not line:
                raise SystemExit("error: Open3D ended; see its message above")
        with np.load(folder / "answer.npz") as answer:
            self.results = [torch.from_numpy(answer[name]) for name in ("output", "features", "kernel")]

    def seconds(self, what: str) -> float:
        """Processor time of one pass: ``forward`` or ``with backward``."""
        self.process.stdin.write(f"{what}\n")
        self.process.stdin.flush()
        return float(self.process.stdout.readline())


def beside_open3d(python: str, position: torch.Tensor, repeats: int) -> None:
    """Times one 64→64 layer of 4³ nodes in both precisions beside Open3D, and prints the ratios."""
    basis = LatticeBasis(OPEN3D_RADIUS, 4)
    pairs = particle_neighborhood(basis, position)
    features, gradient = torch.randn(2, len(position), 64)
    kernel = torch.randn(basis.size, 64, 64)
    problem = {"index": pairs.source.int(), "row_splits": pairs.row_start, "importance": pairs.window}
    problem |= {"position": position, "extent": torch.tensor(2.0 * OPEN3D_RADIUS), "features": features}
    problem |= {"gradient": gradient, "kernel": kernel.view(4, 4, 4, 64, 64)}
    rows: Rows = {"geometry of a frame, shared by its layers": lambda: particle_neighborhood(basis, position) and None}
    with tempfile.TemporaryDirectory() as folder:
        open3d = Open3dLayer(python, Path(folder), {name: values.numpy() for name, values in problem.items()})
        for what in ("forward", "with backward"):
            rows[f"Open3D, {what}"] = lambda what=what: open3d.seconds(what)
        for precision, bound in OPEN3D_AGREES.items():
            layer = ContinuousConvolution(64, 64, basis, precision=precision)
            layer.weight.data.copy_(kernel)
            own = features.clone().requires_grad_()

            def forward(layer=layer, own=own) -> None:
                with torch.no_grad():
                    layer(own, pairs)

            def both(layer=layer, own=own) -> None:
                own.grad = layer.weight.grad = None
                layer(own, pairs).backward(gradient)

            both()
            found = layer(own, pairs).detach(), own.grad, layer.weight.grad.view(4, 4, 4, 64, 64)
            apart = [float((a - b).norm() / b.norm()) for a, b in zip(found, open3d.results, strict=True)]
            if not max(apart) < bound:
                raise SystemExit(f"error: {precision} differs from Open3D by {apart}, at most {bound} is right")
            rows |= {f"fused, {precision}, forward": forward, f"fused, {precision}, with backward": both}
        try:
            figures = interleaved(rows, repeats, time.process_time)
        finally:
            kill_group(open3d.process)
    neighbors = len(pairs.source) / len(position)
    show(f"One layer 64→64 of 4³ nodes beside Open3D, {neighbors:.1f} neighbours, one thread", figures)
    print()
    for what in ("forward", "with backward"):
        for precision in OPEN3D_AGREES:
            ratio = np.divide(figures[f"Open3D, {what}"], figures[f"fused, {precision}, {what}"])
            spread = f"rounds {ratio.min():.2f}–{ratio.max():.2f}"
            print(f"{precision}, {what}: {np.median(ratio):.2f} times as fast as Open3D ({spread})")


def layer_rows(basis: KernelBasis, position: torch.Tensor, width_in: int, width_out: int, name: str) -> Rows:
    """Forward, and forward with backward, of one layer on both backends, in both precisions on the fused one."""
    pairs = particle_neighborhood(basis, position)
    rows: Rows = {}
    for backend, precision in (("fused", "float32"), ("fused", "bfloat16"), ("torch", "float32")):
        layer = ContinuousConvolution(width_in, width_out, basis, backend, precision=precision)
        features = torch.randn(len(position), width_in, requires_grad=True)

        def forward(layer=layer, features=features) -> None:
            with torch.no_grad():
                layer(features, pairs)

        def both(layer=layer, features=features) -> None:
            layer(features, pairs).sum().backward()

        label = f"{name} {width_in}→{width_out}, {backend} {precision}"
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


def show(title: str, figures: dict[str, list[float]]) -> None:
    print(f"\n{title}\n{'-' * len(title)}")
    for name, values in figures.items():
        print(f"{name:<72s}{median(values):8.1f} ms  ({min(values):.1f}–{max(values):.1f})")


def peak_growth(run: Callable[[], object]) -> float:
    """MB by which a run raises the memory of this process at its highest; needs Linux."""

    def status(name: str) -> float:
        line = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith(name))
        return int(line.split()[1]) / 1024

    Path("/proc/self/clear_refs").write_text("5")  # the highest so far is now
    before = status("VmRSS")
    run()
    return status("VmHWM") - before


def many_particles(count: int) -> None:
    """Time and memory of one 64→64 layer on so many particles, as dense as a settled bed."""
    side = (count / (0.58 * 6.0 / (np.pi * 0.05**3))) ** (1.0 / 3.0)
    position, basis, made = side * torch.rand(count, 3), LatticeBasis(RADIUS, 4), []
    geometry = peak_growth(lambda: made.append(particle_neighborhood(basis, position)))
    pairs, features = made[0], torch.randn(count, 64, requires_grad=True)
    print(f"\n{count} particles, {len(pairs.source) / count:.1f} neighbours: geometry {geometry:.0f} MB at its highest")
    for precision in OPEN3D_AGREES:
        layer = ContinuousConvolution(64, 64, basis, precision=precision)
        layer(features[:1000].detach(), particle_neighborhood(basis, position[:1000]))  # what is made once
        began = time.perf_counter()
        grown = peak_growth(lambda layer=layer: layer(features, pairs).sum().backward())
        seconds = time.perf_counter() - began
        print(f"fused, {precision}, with backward: {seconds:.2f} s, {grown:.0f} MB more (features are 26 MB)")
        features.grad = None


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--open3d-python", help="interpreter that has open3d; leave it out for no such table")
    parser.add_argument("--tables", nargs="+", choices=TABLES, default=TABLES, help="which to make")
    options = parser.parse_args()
    if options.open3d_python:
        try:
            require_program(options.open3d_python, "give --open3d-python an interpreter that has the package open3d")
        except MissingProgramError as error:
            raise SystemExit(f"error: {error}") from None
    torch.manual_seed(0)
    torch.set_num_threads(options.threads)
    clock = time.process_time if options.threads == 1 else time.perf_counter
    scene = build_scene(SceneConfig(name="drum")).at_speed(30.0)
    position = torch.from_numpy(settle(scene, seed=0).position).float()
    velocity = 0.3 * torch.randn(position.shape)
    lattice, radial = LatticeBasis(RADIUS, 4), RadialBasis.around_contact(0.05, RADIUS)
    neighbors = len(particle_neighborhood(lattice, position).source) / len(position)
    print(f"{len(position)} spheres, {neighbors:.1f} neighbours, {options.threads} thread(s)")

    if options.open3d_python and "open3d" in options.tables:
        cores = os.sched_getaffinity(0)
        os.sched_setaffinity(0, {max(cores)})  # both have one core, and Open3D can start no more threads than that
        torch.set_num_threads(1)
        beside_open3d(options.open3d_python, position, options.repeats)
        os.sched_setaffinity(0, cores)
        torch.set_num_threads(options.threads)
    if "layer" in options.tables:
        layers = {
            "geometry of a frame, lattice": lambda: particle_neighborhood(lattice, position) and None,
            "geometry of a frame, radial": lambda: particle_neighborhood(radial, position) and None,
        }
        layers |= layer_rows(lattice, position, 64, 64, "lattice")
        layers |= layer_rows(radial, position, 32, 32, "radial")
        show("One layer", interleaved(layers, options.repeats, clock))
    if "frame" in options.tables:
        show("One frame", interleaved(frame_rows(scene, position, velocity), options.repeats, clock))
    if "many" in options.tables:
        many_particles(100_000)


if __name__ == "__main__":
    main()
