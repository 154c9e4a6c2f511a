"""Threads of the fast engine share a stretch; whatever their number, not a bit of the result changes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gran_bench.config import ContainerConfig, DemConfig, FillingConfig, RotationConfig, SceneConfig
from gran_bench.dem import engine_numpy
from gran_bench.dem.fast import barrier
from gran_bench.dem.fast import engine as engine_numba
from gran_bench.dem.integrate import Divergence, Physics
from gran_bench.dem.simulate import simulate
from gran_bench.dem.walls import wall_poses
from gran_bench.scene import Scene, build_scene
from gran_bench.state import ContactHistory, ParticleState

STEP, STEPS = 2e-4, 100
FIELDS = ("position", "velocity", "angular_velocity")


@pytest.fixture(autouse=True)
def small_chunks(monkeypatch):
    """Four chunks for a few hundred particles."""
    monkeypatch.setattr(engine_numba, "CHUNK_SIZES", (50, 100, 1000, 2000))


@pytest.fixture(params=[False, True], ids=["caps", "periodic"])
def scene(request) -> Scene:
    """A small turning drum."""
    return build_scene(
        SceneConfig(
            name="small",
            container=ContainerConfig(length=0.25, periodic_axis=request.param),
            filling=FillingConfig(count=300),
            rotation=RotationConfig(times=[0.0], speeds_rpm=[30.0]),
        )
    )


def moving(scene: Scene) -> ParticleState:
    """A filling that flies about, so that contacts cross every border of chunks."""
    rng, state = np.random.default_rng(1), scene.fresh_filling(0)
    return replace(
        state, velocity=rng.normal(0, 2, (state.count, 3)), angular_velocity=rng.normal(0, 20, (state.count, 3))
    )


def run(scene: Scene, state: ParticleState, threads: int, **changes) -> ParticleState:
    """A stretch on so many threads."""
    physics = replace(Physics.of(scene, 0.025), threads=threads, **changes)
    return engine_numba.advance(state, physics, STEP, wall_poses(scene, 0.0, STEP, STEPS))


@pytest.mark.parametrize("threads", [2, 3, 4, 7])
def test_any_number_of_threads_gives_the_same_bits(scene, threads):
    one, many = (run(scene, moving(scene), number) for number in (1, threads))
    assert len(one.history) > 100
    for name in FIELDS:
        assert np.array_equal(getattr(one, name), getattr(many, name)), name
    orders = [np.lexsort((state.history.second, state.history.first)) for state in (one, many)]
    for name in ("first", "second", "force", "overlap"):
        first, second = (getattr(s.history, name)[o] for s, o in zip((one, many), orders, strict=True))
        assert np.array_equal(first, second), name


def test_chunks_agree_with_the_reference_engine(scene):
    fast, state = run(scene, moving(scene), 2), moving(scene)
    reference = engine_numpy.advance(state, Physics.of(scene, 0.025), STEP, wall_poses(scene, 0.0, STEP, STEPS))
    assert np.abs(reference.position - state.position).max() > 1e-3
    assert np.abs(fast.position - reference.position).max() < 1e-10


def test_a_skin_changes_no_bit_of_a_run_in_chunks_either(scene):
    one, other = (run(scene, moving(scene), 2, skin=skin) for skin in (2e-3, 0.02))
    assert np.array_equal(one.position, other.position)


@pytest.mark.parametrize("threads", [1, 2, 4])
def test_divergence_is_found_by_whichever_thread_has_it(scene, threads):
    state = moving(scene)
    velocity = state.velocity.copy()
    velocity[250] = (0.0, 0.0, 500.0)
    with pytest.raises(Divergence) as caught:
        run(scene, replace(state, velocity=velocity), threads)
    assert (caught.value.particle, caught.value.steps) == (250, 0)
    assert caught.value.position == pytest.approx(state.position, abs=1e-15)  # where the step began


@pytest.mark.parametrize("steps", [1, 2, 3, 4])
def test_divergence_is_found_in_whatever_step_there_are(scene, steps, monkeypatch):
    # Nothing is read of the contacts of an evaluation that was not reached: room that is not cleared shows it.
    empty = np.empty

    def littered(*arguments, **options):
        array = empty(*arguments, **options)
        array.view(np.uint8).fill(255)
        return array

    monkeypatch.setattr(np, "empty", littered)
    state = replace(run(scene, moving(scene), 1), history=ContactHistory.empty())
    velocity = state.velocity.copy()
    velocity[7] = (1e4, 0.0, 0.0)
    physics, walls = Physics.of(scene, 0.025), wall_poses(scene, 0.0, STEP, steps)
    with pytest.raises(Divergence):
        engine_numba.advance(replace(state, velocity=velocity), physics, STEP, walls)


def test_the_number_of_chunks_depends_on_the_particles_alone(monkeypatch):
    monkeypatch.undo()
    assert [len(engine_numba.chunk_bounds(n)) - 1 for n in (1, 1499, 1500, 3000, 24000, 100_000)] == [1, 1, 2, 2, 4, 8]
    bounds = engine_numba.chunk_bounds(24001)
    assert bounds[0] == 0
    assert bounds[-1] == 24001
    assert np.diff(bounds).min() > 5000


def test_an_error_in_one_thread_leaves_no_other_waiting():
    gate = barrier.new_gate()

    def work(thread: int) -> None:
        if thread == 1:
            raise MemoryError("no room")
        while not gate[barrier.ABANDONED]:
            pass

    with pytest.raises(MemoryError, match="no room"):
        barrier.run_together(work, 2, gate)


def test_single_precision_is_wrong_by_as_little_as_is_stated(scene):
    # Contact forces to seven digits: 10 ms of impacts at 2 m/s end within a tenth of a micrometre (DemConfig).
    state, end = moving(scene), scene.frame_interval
    state = replace(state, velocity=0.5 * state.velocity)
    exact, single = (
        simulate(scene, state, end, dem=DemConfig(precision=precision)).final for precision in ("float64", "float32")
    )
    error = np.abs(exact.position - single.position).max()
    assert 0.0 < error < 1e-7


def test_the_reference_engine_has_no_single_precision(scene):
    with pytest.raises(ValueError, match=r"dem\.precision=float32 is for dem\.engine=numba"):
        simulate(scene, moving(scene), 0.01, dem=DemConfig(engine="numpy", precision="float32"))
