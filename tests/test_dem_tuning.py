"""Skin and threads follow the clock: the fastest is found, and found again when it is another."""

from __future__ import annotations

import math

import pytest

from gran_bench.config import SceneConfig
from gran_bench.dem.fast import tuning
from gran_bench.dem.fast.tuning import STRETCHES_BETWEEN, Tuner
from gran_bench.dem.integrate import Physics
from gran_bench.scene import build_scene


@pytest.fixture
def physics(monkeypatch) -> Physics:
    """Of the drum, on a machine of four cores."""
    monkeypatch.setattr(tuning, "available_threads", lambda: 4)
    return Physics.of(build_scene(SceneConfig(name="drum")), 0.025)


def cost(best_skin: float, speed_up: float):
    """Time of a frame that is least at one skin, and divided by ``speed_up`` on every doubling of the threads."""
    return lambda p: (1.0 + math.log(p.skin / best_skin) ** 2) / speed_up ** math.log2(p.threads)


def tuned(tuner: Tuner, time_of, frames: int) -> Physics:
    for _ in range(frames):
        tuner.took(time_of(tuner.physics))
    return tuner.chosen


@pytest.mark.parametrize("share", [0.35, 0.7, 1.0, 2.0])
def test_the_fastest_skin_is_found(physics, share):
    tuner = Tuner(physics, 3000, skin_is_given=False, threads=1)
    assert tuned(tuner, cost(share * physics.skin, 1.0), 60).skin == pytest.approx(share * physics.skin)


@pytest.mark.parametrize(("speed_up", "threads"), [(1.8, 4), (1.0, 1), (0.5, 1)])
def test_threads_are_used_where_they_pay(physics, speed_up, threads):
    tuner = Tuner(physics, 30_000, skin_is_given=False, threads=None)
    assert tuned(tuner, cost(physics.skin, speed_up), 60).threads == threads


def test_a_bed_too_small_to_share_stays_on_one_thread(physics):
    tuner = Tuner(physics, 300, skin_is_given=True, threads=None)
    assert tuned(tuner, cost(physics.skin, 2.0), 60).threads == 1


def test_what_the_user_chose_stays(physics):
    tuner = Tuner(physics, 30_000, skin_is_given=True, threads=2)
    chosen = tuned(tuner, cost(0.5 * physics.skin, 3.0), 60)
    assert (chosen.skin, chosen.threads) == (physics.skin, 2)


def test_a_bed_that_changes_is_tuned_again(physics):
    tuner = Tuner(physics, 3000, skin_is_given=False, threads=1)
    tuned(tuner, cost(physics.skin, 1.0), 60)
    later = tuned(tuner, cost(0.5 * physics.skin, 1.0), STRETCHES_BETWEEN + 60)
    assert later.skin == pytest.approx(0.5 * physics.skin)


def test_one_disturbed_frame_does_not_decide(physics):
    tuner, time_of = Tuner(physics, 3000, skin_is_given=False, threads=1), cost(physics.skin, 1.0)
    tuner.took(50.0)
    assert tuned(tuner, time_of, 60).skin == physics.skin
