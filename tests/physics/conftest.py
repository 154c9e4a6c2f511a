"""Bodies for experiments with known answers: free spheres, a floor, and runs whose every step is a frame."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from gran_bench.config import DemConfig
from gran_bench.dem.simulate import SimulationResult, simulate
from gran_bench.scene import Filling, Material, Rotation, Scene
from gran_bench.state import ParticleState


@pytest.fixture(params=["numba", "numpy"])
def engine(request: pytest.FixtureRequest) -> str:
    """Every law must hold in both engines."""
    return request.param


@pytest.fixture
def laboratory() -> Callable[..., Scene]:
    """Builds a scene of 50 mm spheres (E = 1e7 Pa, ν = 0.3, 2500 kg/m³) with the given walls and gravity."""

    def build(
        walls: tuple = (),
        gravity: float = 0.0,
        restitution: float = 1.0,
        friction: float = 0.0,
        rolling_friction: float = 0.0,
        youngs_modulus: float = 1e7,
        rotation: Rotation | None = None,
    ) -> Scene:
        material = Material(youngs_modulus, 0.3, 2500.0, restitution, friction, rolling_friction)
        return Scene(
            "laboratory",
            walls,
            Filling(2, 0.05),
            material,
            material,
            gravity=(0.0, 0.0, -gravity),
            rotation=rotation or Rotation(),
            start_time=0.0,
            end_time=1.0,
        )

    return build


@pytest.fixture
def spheres() -> Callable[..., ParticleState]:
    """Builds a state from lists of positions, velocities and spins; 25 mm radius unless told."""

    def build(position: list, velocity: list | None = None, spin: list | None = None, radius: list | None = None):
        position = np.array(position, float)
        still = np.zeros_like(position)
        return ParticleState(
            position,
            still if velocity is None else np.array(velocity, float),
            still.copy() if spin is None else np.array(spin, float),
            np.full(len(position), 0.025) if radius is None else np.array(radius, float),
        )

    return build


@pytest.fixture
def run(engine: str) -> Callable[..., SimulationResult]:
    """Runs a state for ``steps`` steps of ``time_step``, a frame every ``stride`` steps."""

    def go(scene: Scene, state: ParticleState, time_step: float, steps: int, stride: int = 1) -> SimulationResult:
        scene = replace(scene, frame_interval=stride * time_step)
        dem = DemConfig(engine=engine, time_step=time_step)
        return simulate(scene, state, state.time + steps // stride * scene.frame_interval, dem=dem)

    return go
