"""What scenes without an angle are for: discharge rate and packing fraction, by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from beds import drum, flowing

from gran_bench import shipped_scene
from gran_bench.metrics.purpose import discharge_rate, packing_fraction
from gran_bench.state import Trajectory


def still(scene, position, radius) -> Trajectory:
    """Positions ``(F, N, 3)`` m at rest."""
    time = scene.start_time + scene.frame_interval * np.arange(len(position))
    nothing = np.zeros_like(position, dtype=np.float32)
    return Trajectory(time, position.astype(np.float32), nothing, nothing, np.full(position.shape[1], radius))


def test_spheres_that_leave_at_a_constant_rate_have_this_rate():
    scene, radius = shipped_scene("hopper"), 0.01
    below, frames = -0.2, 60
    position = np.tile([0.0, 0.0, 0.3], (frames, frames, 1))
    for frame in range(frames):
        position[frame, :frame, 2] = below  # one more in each frame
    rate = discharge_rate(still(scene, position, radius), scene)
    mass = scene.material.density * 4.0 / 3.0 * np.pi * radius**3
    assert rate.value == pytest.approx(mass / scene.frame_interval)
    position[30, 0] = np.nan
    assert not discharge_rate(still(scene, position, radius), scene).valid.all()


def test_a_cubic_lattice_in_a_box_has_the_fraction_of_a_cubic_lattice():
    scene = shipped_scene("packing")
    d = scene.filling.diameter
    line = d * (np.arange(10) + 0.5)
    lattice = np.stack(np.meshgrid(line - 0.25, line - 0.25, line, indexing="ij"), axis=-1).reshape(1, -1, 3)
    fraction = packing_fraction(still(scene, lattice, 0.5 * d), scene)
    assert fraction.value == pytest.approx([np.pi / 6.0], rel=1e-6)


def test_a_scene_without_outlet_or_box_has_neither():
    scene = drum(end_time=1.6)
    assert "no outlet" in discharge_rate(flowing(scene), scene).undefined_because
    assert "no box" in packing_fraction(flowing(scene), scene).undefined_because
    hopper = shipped_scene("hopper")
    assert "no box" in packing_fraction(still(hopper, np.zeros((1, 1, 3)), 0.01), hopper).undefined_because
    box = replace(shipped_scene("packing"), gravity=(0.0, 0.0, 0.0))
    assert "no box" in packing_fraction(still(box, np.zeros((1, 1, 3)), 0.01), box).undefined_because
