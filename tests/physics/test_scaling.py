"""No hidden metre or second: lengths × 1/4, times × 1/2, E × 1/4, with density and gravity as they are, is one flow.

All factors are powers of two, so that every number is the same bits but for a power of two.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf

from gran_bench.compose import compose
from gran_bench.config import DemConfig, GenerateConfig, TrainConfig
from gran_bench.config.choices import loss_terms
from gran_bench.config.reading import read_config
from gran_bench.config.registry import LOSS_TERMS
from gran_bench.dataset import Windows, ensure_cases, split_cases
from gran_bench.dataset.case_file import Case, read_case
from gran_bench.dataset.case_spec import replica_nudge
from gran_bench.dataset.generation import nudged
from gran_bench.dem.simulate import settle, simulate
from gran_bench.losses import FrameAhead, Target
from gran_bench.metrics import judge
from gran_bench.metrics.measured import Measured
from gran_bench.run.experiment import make_model
from gran_bench.scene import Scene, build_scene
from gran_bench.state import Trajectory
from gran_bench.surrogate.rollout import rollout
from gran_bench.surrogate.step import FrameState
from gran_bench.trainer import Trainer

LENGTH, TIME = 0.25, 0.5
SPEED, SPIN, ENERGY = LENGTH / TIME, 1.0 / TIME, LENGTH**3 * (LENGTH / TIME) ** 2
# Keys that are a length, a time, a modulus, a rotation. All others have no unit, or are of density and gravity.
FACTORS = dict.fromkeys(["diameter", "length", "width", "height", "orifice", "outlet_depth"], LENGTH)
FACTORS |= dict.fromkeys(["start_time", "end_time", "frame_interval", "times"], TIME)
FACTORS |= {"youngs_modulus": 0.25, "speeds_rpm": SPIN, "training_speeds_rpm": SPIN}
SOON = ["scene.filling.settled_froude=0.2", "scene.start_time=0.5", "scene.end_time=0.7"]
SCENES = {
    "drum_small": ["scene.filling.count=80", "scene.container.length=0.25", "scene.rotation.times=[0.5]"],
    "drum_slice": ["scene.filling.count=120", "scene.rotation.times=[0.5]", "scene.material.rolling_friction=0.1"],
    "packing_polydisperse": ["scene.filling.count=60"],
    "hopper": ["scene.filling.count=100"],
}
TRAINED = [
    *("+experiment=smoke", "device=cpu", "threads=1", "scene.container.diameter=0.4", "scene.container.length=0.3"),
    *("scene.container.periodic_axis=true", "scene.filling.count=40", "scene.rotation.times=[0.5]", *SOON),
    *("dataset.training_speeds_rpm=[30]", "judge.speeds_rpm=[]", "dem.threads=1", "trainer.steps=6"),
    *("trainer.log_every=1", "optim.accumulate=2", "tracking.enabled=false"),
]
MODELS = {
    "contact": [],
    "ccnn": ["model=ccnn", "model.width=8", "model.layers=2", "model.kernel_size=3"],
    "ccnn, closest points": ["model=ccnn", "model.width=8", "model.layers=2", "boundary=analytic"],
    "radial": ["model=radial", "model.width=8", "model.layers=2"],
    "gns": ["model=gns", "model.width=8"],
}


def smaller(section: dict) -> dict:
    """The keys of the same flow, smaller."""

    def image(name: str, value: object) -> object:
        if isinstance(value, dict):
            return smaller(value)
        factor = FACTORS.get(name)
        if factor is None or value is None:
            return value
        return [factor * each for each in value] if isinstance(value, list) else factor * value

    return {name: image(name, value) for name, value in section.items()}


def both(command: str, overrides: list[str]) -> list[TrainConfig]:
    """The config of a command, and of its smaller image."""
    config = OmegaConf.to_container(compose(command, overrides), resolve=True)
    config.pop("hydra", None)
    image = config | {name: smaller(config[name]) for name in ("scene", "dataset")}
    return [read_config(TrainConfig, each) if command == "train" else each for each in (config, image)]


def scenes(name: str, overrides: list[str]) -> list[Scene]:
    return [
        build_scene(read_config(GenerateConfig, {"scene": config["scene"]}).scene)
        for config in both("generate", [f"scene={name}", *SOON, *overrides])
    ]


def same(large: object, small: object, factor: float, what: str = "") -> None:
    large, small = (np.asarray(a.detach() if isinstance(a, torch.Tensor) else a) for a in (large, small))
    np.testing.assert_array_equal(large.dtype.type(factor) * large, small, err_msg=what)


def same_motion(large: Trajectory, small: Trajectory) -> None:
    factors = {"time": TIME, "position": LENGTH, "velocity": SPEED, "angular_velocity": SPIN}
    for name, factor in factors.items():
        if getattr(large, name) is not None:
            same(getattr(large, name), getattr(small, name), factor, name)


@pytest.mark.parametrize("engine", ["numba", "numpy"])
@pytest.mark.parametrize("name", SCENES)
def test_the_dem_settles_and_turns_the_same(name, engine):
    found = []
    for scene in scenes(name, SCENES[name]):
        dem = DemConfig(engine=engine, threads=1)
        bed = settle(scene, seed=1, dem=dem) if engine == "numba" else nudged(scene.fresh_filling(1), 0.0, 1)
        bed = nudged(replace(bed, time=scene.start_time), replica_nudge(scene), 1)
        end = scene.start_time + (20 if engine == "numba" else 1) * scene.frame_interval
        found.append(simulate(scene, bed, end, dem=dem))
    large, small = found
    same(large.time_step, small.time_step, TIME, "time step")
    same_motion(large.trajectory, small.trajectory)
    for name, series in large.trajectory.diagnostics.items():
        kinds = {"share": 1.0, "energy": ENERGY, "overlap": LENGTH, "approach": SPEED}
        factor = next((kinds[kind] for kind in kinds if kind in name), 1.0)
        same(series, small.trajectory.diagnostics[name], factor, name)


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("cases")


def case_of(config: TrainConfig, root: Path) -> Case:
    specs = split_cases(build_scene(config.scene), config.dem, config.dataset).training
    ensure_cases(specs, root, workers=1, progress=False)
    return read_case(specs[0].path(root))


def ahead_of(case: Case) -> FrameAhead:
    """A prediction that is off by a few hundredths of a diameter."""
    rng, motion, frame = np.random.default_rng(3), case.trajectory, 10
    error = [torch.tensor(rng.normal(size=motion.position[0].shape), dtype=torch.float32) for _ in range(4)]
    d, dt = case.scene.filling.diameter, case.scene.frame_interval
    x, v, w = (torch.tensor(a[frame : frame + 2]) for a in (motion.position, motion.velocity, motion.angular_velocity))
    predicted = FrameState(
        x[1] + 0.03 * d * error[0], v[1] + 0.03 * d / dt * error[1], w[1] + 0.03 / dt * error[2],
        pair_acceleration=0.03 * d / dt**2 * error[3],
    )  # fmt: skip
    target = Target(x[1], v[1], w[1], v[0], 1e-3 * d)
    return FrameAhead(FrameState(x[0], v[0], w[0]), predicted, target, case.scene, float(motion.time[frame]))


@pytest.mark.parametrize("term", loss_terms())
def test_losses_are_the_same(term, root):
    large, small = (ahead_of(case_of(config, root)) for config in both("train", TRAINED))
    found = LOSS_TERMS[term](large)
    assert found > 0
    same(found, LOSS_TERMS[term](small), 1.0)


@pytest.mark.parametrize("name", MODELS)
def test_training_and_rollout_are_the_same(name, root, tmp_path):
    found = []
    for k, config in enumerate(both("train", [*TRAINED, *MODELS[name]])):
        case, logged = case_of(config, root), []
        torch.manual_seed(0)
        model = make_model(config, case.scene)
        (tmp_path / str(k)).mkdir()
        windows = Windows([case], config.seed, 0.3)
        Trainer(model, windows, config, tmp_path / str(k), lambda m, s, to=logged: to.append(m["loss"])).run(False)
        found.append((model, logged, rollout(model, case.scene, case.settled, case.scene.frame_count)))
    (large, losses, path), (small, losses_small, path_small) = found
    assert len(losses) == 6
    assert losses == losses_small
    for key, weight in large.state_dict().items():
        same(weight, small.state_dict()[key], 1.0, key)
    same_motion(path.trajectory, path_small.trajectory)


def test_the_judges_figures_floors_and_verdicts_are_the_same():
    factors = {"m": LENGTH, "m/s": SPEED, "J": ENERGY, "s": TIME, "deg": 1.0, "-": 1.0}
    factors |= {"N m": ENERGY, "W": ENERGY / TIME}
    overrides = ["scene.filling.count=80", "scene.container.length=0.25", "scene.rotation.times=[0.5]"]
    found = []
    for scene in scenes("drum_small", [*overrides, "scene.end_time=2.5"]):
        bed = settle(scene, seed=10, dem=DemConfig(threads=1))
        starts = [nudged(bed, factor * replica_nudge(scene), k) for k, factor in enumerate([1, 1, 1, 2**16])]
        faster = scene.at_speed(1.5 * scene.rotation.speeds_rpm[0])
        runs = [(scene, start) for start in starts] + [(faster, bed)]
        *replicas, other, replay = (
            simulate(its, start, scene.end_time, dem=DemConfig(threads=1)).trajectory for its, start in runs
        )
        found.append(judge(other, replicas, scene, replays={"faster": replay}))
    large, small = found
    for end in ("steady_from", "peak_before", "pattern_time"):
        ends = [getattr(one.phases, end) for one in found]
        assert ends == [None, None] or None not in ends, end
        if None not in ends:
            same(*ends, TIME, end)
    assert large.phases.steady_from > large.phases.pattern_time - 0.4
    assert {row.key: row.verdict for row in large.requirements} == {row.key: row.verdict for row in small.requirements}
    assert {row.verdict for row in large.requirements} == {"pass"}
    for one, other in zip(large.requirements, small.requirements, strict=True):
        factor = {"noise floors": 1.0, "m/s": SPEED}.get(one.figure.unit, 1.0)
        same(one.figure.number, other.figure.number, factor, one.key)
        same(one.bound, other.bound, factor, one.key)

    def same_figure(one: Measured, other: Measured, what: str) -> None:
        assert one.defined == other.defined, what
        if one.defined:
            same(one.number, other.number, factors[one.unit], what)

    for one, other in zip(large.errors, small.errors, strict=True):
        same_figure(one.error, other.error, one.key)
        same_figure(one.floor, other.floor, one.key)
    for one, other in zip(large.figures, small.figures, strict=True):
        same_figure(one.candidate, other.candidate, one.key)
        same_figure(one.truth, other.truth, one.key)
        assert (one.interval is None) == (other.interval is None)
        for end in ("low", "high") if one.interval else ():
            same(getattr(one.interval, end), getattr(other.interval, end), factors[one.unit], one.key)
    floors = {row.key: row.floor for row in large.errors}
    assert all(floors[key].number > 0 for key in ("com_angle", "speed_w1", "position_30", "translational_energy"))
    same(large.failures.farthest, small.failures.farthest, LENGTH)
    assert replace(large.failures, farthest=0.0) == replace(small.failures, farthest=0.0)
