"""What the tests of the library's public doors share: scenes, states, and what a refusal must say."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from beds import drum, flowing
from torch import nn

from gran_bench.config import (
    DemConfig,
)
from gran_bench.scene import (
    Material,
)
from gran_bench.shipped import shipped_scene
from gran_bench.state import ContactHistory, ParticleState, Trajectory
from gran_bench.surrogate.step import Surrogate

UP, ORIGIN = (0.0, 0.0, 1.0), (0.0, 0.0, 0.0)
GLASS = Material(1e7, 0.3, 2500.0, 0.5, 0.3)
SCENE = replace(drum(end_time=3.7), frame_interval=0.04)
HOPPER = shipped_scene("hopper")
NOWHERE = replace(SCENE, name="nowhere", gravity=(0, 0, 0))
SINGLE = DemConfig(engine="numpy", precision="float32")
RUN, TWIN = flowing(SCENE, 0), flowing(SCENE, 1)
Door = Callable[[], object]


def state(count: int = 2, **changes) -> ParticleState:
    """Spheres in a row, at rest."""
    position = np.zeros((count, 3))
    position[:, 1] = 0.1 * np.arange(count)
    values = {"position": position, "velocity": 0 * position, "angular_velocity": 0 * position}
    return ParticleState(**({**values, "radius": np.full(count, 0.025), "time": 1.5} | changes))


class Still(Surrogate):
    """Leaves everything where it is."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(()))

    def forward(self, state, scene, time):
        return state


def refused(door: Door, sentence: str) -> None:
    """The door raises one of the house's errors, in one line that has the sentence."""
    with pytest.raises((ValueError, RuntimeError)) as caught:
        door()
    message = str(caught.value)
    assert sentence in message
    assert "\n" not in message
    assert len(message) < 500
    assert type(caught.value) is ValueError or type(caught.value).__module__.startswith("gran_bench.")


def doors(*rows: tuple[Door, str]) -> pytest.MarkDecorator:
    return pytest.mark.parametrize(("door", "sentence"), rows, ids=[sentence for _, sentence in rows])


def history(**changes) -> ContactHistory:
    one = {"first": [0], "second": [1], "force": [[0, 0, 0]], "overlap": [1e-4]}
    return ContactHistory(**(one | changes))


def trajectory(**changes) -> Trajectory:
    """Two frames of one sphere."""
    zeros = [[[0.0, 0, 0]], [[0, 0, 0]]]
    values = {"position": zeros, "velocity": zeros, "angular_velocity": zeros, "radius": [0.1], "time": [0, 1]}
    return Trajectory(**(values | changes))
