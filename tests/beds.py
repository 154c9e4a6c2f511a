"""Beds of known geometry that the tests of metrics, baselines and plots judge."""

from __future__ import annotations

import numpy as np

from gran_bench.config import ContainerConfig, FillingConfig, SceneConfig
from gran_bench.scene import Scene, build_scene
from gran_bench.state import Trajectory

RADIUS = 0.025
# A drum whose case is made in a second.
DRUM_TINY = SceneConfig(
    name="drum_tiny",
    container=ContainerConfig(diameter=0.4, length=0.2),
    filling=FillingConfig(count=40),
    start_time=0.4,
    end_time=0.6,
)


def drum(speed_rpm: float = 30.0, periodic: bool = False, length: float = 1.0, end_time: float = 5.5) -> Scene:
    """The paper's drum at one speed."""
    config = SceneConfig(name="drum", end_time=end_time)
    config.container.periodic_axis = periodic
    config.container.length = length
    config.rotation.speeds_rpm = [speed_rpm]
    return build_scene(config)


def inclined_bed(angle_deg: float, seed: int = 0, depth: float = 0.05, jitter: float = 0.4) -> np.ndarray:
    """Spheres under a plane inclined by an angle, ``(N, 3)`` m, climbing towards −x as in a drum turning forwards.

    Layers parallel to the plane; within a layer the spheres are jittered so that no column of the metric resonates
    with the lattice. The highest centres lie ``depth`` under the axis.
    """
    rng = np.random.default_rng(seed)
    line = np.arange(-9, 10) * 0.052
    along, y, below = np.meshgrid(line, np.arange(-9, 10) * 0.052, np.arange(0, 9) * 0.052, indexing="ij")
    along = along + rng.uniform(-jitter, jitter, along.shape) * 0.052
    angle = np.radians(angle_deg)
    w = -depth - below
    climb, height = along * np.cos(angle) - w * np.sin(angle), along * np.sin(angle) + w * np.cos(angle)
    position = np.stack((-climb, y, height), axis=-1).reshape(-1, 3)
    return position[np.hypot(position[:, 0], position[:, 2]) < 0.475]


def resting(scene: Scene, position: np.ndarray, frames: int | None = None, speed: float = 0.0) -> Trajectory:
    """A trajectory in which nothing moves, though every sphere says that it does at ``speed`` along y."""
    frames = frames or scene.frame_count
    time = scene.start_time + scene.frame_interval * np.arange(frames)
    still = np.repeat(position[None].astype(np.float32), frames, axis=0)
    velocity = np.zeros_like(still)
    velocity[..., 1] = speed
    return Trajectory(time, still, velocity, np.zeros_like(still), np.full(len(position), RADIUS))


def flowing(scene: Scene, seed: int = 0, spheres: int = 200, frames: int | None = None) -> Trajectory:
    """Spheres on random circles about the axis with random speeds: every metric has something to see."""
    rng = np.random.default_rng(seed)
    frames = frames or scene.frame_count
    time = scene.start_time + scene.frame_interval * np.arange(frames)
    reach, phase = 0.47 * np.sqrt(rng.random(spheres)), rng.normal(np.pi, 0.5, spheres)
    rate = rng.normal(1.0, 0.3, spheres)
    turned = phase + rate * (time[:, None] - scene.start_time)
    y = np.broadcast_to(rng.uniform(-0.4, 0.4, spheres), turned.shape)
    position = np.stack((reach * np.sin(turned), y, reach * np.cos(turned)), axis=-1)
    tangent = np.stack((np.cos(turned), np.zeros_like(turned), -np.sin(turned)), axis=-1)
    velocity = (reach * rate)[:, None] * tangent
    spin = np.broadcast_to(np.array([0.0, 1.0, 0.0]), position.shape)
    single = [a.astype(np.float32) for a in (position, velocity, spin)]
    return Trajectory(time, *single, np.full(spheres, RADIUS))


def every_neighbor(
    query: np.ndarray, source: np.ndarray, reach: float, period: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Query and source index of all closer than ``reach``, by looking at all of them; sorted by query, then source."""
    offset = np.asarray(source)[None] - np.asarray(query)[:, None]
    if period:
        offset[..., 1] -= period * np.round(offset[..., 1] / period)
    near = np.einsum("qsk,qsk->qs", offset, offset) < reach**2
    return np.nonzero(near)
