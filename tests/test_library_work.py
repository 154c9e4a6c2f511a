"""What runs, judges or reads files refuses what cannot be, in one clear sentence."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from beds import flowing
from doors import (
    GLASS,
    HOPPER,
    NOWHERE,
    RUN,
    SCENE,
    TWIN,
    Still,
    doors,
    history,
    refused,
    state,
)

from gran_bench.baselines import ballistic, interpolated_statistics, rigid_rotation
from gran_bench.config import (
    BoundaryConfig,
    ContactModelConfig,
    DemConfig,
    SceneConfig,
)
from gran_bench.dataset import read_case, read_settled
from gran_bench.dataset.case_spec import CaseSpec, split_cases
from gran_bench.dem.simulate import settle, simulate
from gran_bench.metrics import (
    judge,
    nearest_case,
    short_horizon_errors,
    spread_starts,
    summarise,
)
from gran_bench.metrics.angle_of_repose import center_of_mass_angles, cross_section_axes, surface_angle, surface_lines
from gran_bench.metrics.bed import mixing, overlap_series
from gran_bench.metrics.measured import Measured, noise_floor
from gran_bench.metrics.outside import count_failures
from gran_bench.metrics.position_error import mean_spread, separation
from gran_bench.metrics.speeds import velocities, wasserstein_series
from gran_bench.scene import (
    box,
)
from gran_bench.shipped import shipped_model
from gran_bench.state import Trajectory
from gran_bench.surrogate.checkpoint import ModelCard, load_model, save_model
from gran_bench.surrogate.rollout import rollout, step_frames
from gran_bench.surrogate.step import build_model

# ---- running -------------------------------------------------------------------------------------------------


@doors(
    (lambda: settle(SCENE, -1), "seed=-1 is impossible; choose a value ≥ 0"),
    (lambda: settle(SCENE, 1.5), "seed=1.5 has the wrong type; give a whole number"),
    (lambda: settle(SCENE, None), "seed=null has the wrong type; give a whole number"),
    (lambda: settle("drum", 0), "scene=drum has the wrong type; give a Scene"),
    (lambda: settle(SCENE, 0, dem={"engine": "numpy"}), "dem={'engine': 'numpy'} has the wrong type; give a DemConfig"),
    (lambda: settle(SCENE, 0, dem={}), "dem={} has the wrong type; give a DemConfig"),
    (lambda: simulate(SCENE, state(), 1.0), "end_time=1 s lies before the state's time=1.5 s; choose a later end"),
    (lambda: simulate(SCENE, state(), 1.52), "end_time=1.52 s is not a whole number of frames of 0.04 s after 1.5 s"),
    (lambda: simulate(SCENE, state(), math.nan), "end_time=nan is impossible; choose a finite value"),
    (lambda: simulate(SCENE, state(), "2"), "end_time=2 has the wrong type; give a number"),
    (lambda: simulate(SCENE, RUN, 2.0), "state=Trajectory(…) has the wrong type; give a ParticleState"),
    (lambda: simulate(SceneConfig("a"), state(), 2.0), "scene=SceneConfig(…) has the wrong type; give a Scene"),
    (
        lambda: simulate(SCENE, state(history=history(second=[7])), 2.7),
        "the contact history names 1 contacts whose particles or walls this scene does not have",
    ),
    (
        lambda: simulate(SCENE, state(history=history(force=[[0, 0, math.nan]])), 2.7),
        "the contact history is not finite for 1 contacts",
    ),
    (lambda: rollout(Still(), SCENE, state(), frames=0), "frames=0 is impossible; choose a value ≥ 1"),
    (lambda: rollout(Still(), SCENE, state(), frames=2.0), "frames=2 has the wrong type; give a whole number"),
    (lambda: rollout("model.pt", SCENE, state()), "model=model.pt has the wrong type; give a Surrogate"),
    (lambda: rollout(Still(), GLASS, state()), "scene=Material(…) has the wrong type; give a Scene"),
    (lambda: rollout(Still(), SCENE, RUN), "state=Trajectory(…) has the wrong type; give a ParticleState"),
    (lambda: next(step_frames(None, SCENE, state())), "model=null has the wrong type; give a Surrogate"),
    (lambda: build_model("contact", BoundaryConfig(), SCENE), "model=contact has the wrong type; give a ContactModel"),
    (
        lambda: build_model(ContactModelConfig(hidden=8), BoundaryConfig(), SCENE),
        "model.hidden=8 with model.channels=4 is not what model.backend=fused is compiled for; choose 16 and 4, or",
    ),
    (lambda: ballistic(SCENE, RUN), "settled=Trajectory(…) has the wrong type; give a ParticleState"),
    (lambda: rigid_rotation(None, state()), "scene=null has the wrong type; give a Scene"),
    (lambda: interpolated_statistics("30", {}), "speed_rpm=30 has the wrong type; give a number"),
    (lambda: interpolated_statistics(math.nan, {}), "speed_rpm=nan is impossible; choose a finite value"),
)
def test_a_run_that_cannot_be_is_refused(door, sentence):
    refused(door, sentence)


# ---- judging -------------------------------------------------------------------------------------------------


def resampled(run: Trajectory, step: int) -> Trajectory:
    by_frame = ("time", "position", "velocity", "angular_velocity")
    return replace(run, **{name: getattr(run, name)[::step] for name in by_frame})


@doors(
    (lambda: judge(RUN, [], SCENE), "no replica to judge against; make at least one run of the DEM"),
    (lambda: judge(RUN, TWIN, SCENE), "replicas=Trajectory(…) is no list; write replicas=[Trajectory(…)]"),
    (lambda: judge(RUN, [TWIN, None], SCENE), "replicas[1]=null has the wrong type; give a Trajectory or Trajectory"),
    (lambda: judge(state(), [TWIN], SCENE), "candidate=ParticleState(…) has the wrong type; give a Trajectory or"),
    (lambda: judge(RUN, [TWIN], "drum"), "scene=drum has the wrong type; give a Scene"),
    (lambda: judge(RUN, [TWIN], SCENE, [TWIN]), "others=[Trajectory("),
    (lambda: judge(RUN, [TWIN], SCENE, {"half": 1}), "others[half]=1 has the wrong type; give a Trajectory"),
    (
        lambda: judge(RUN, [flowing(SCENE, 1, spheres=300)], SCENE),
        "candidate has 200 spheres and replica 0 has 300; compare runs of one scene's spheres",
    ),
    (
        lambda: judge(RUN, [TWIN], SCENE, {"half": flowing(SCENE, 1, spheres=300)}),
        "candidate has 200 spheres and half has 300; compare runs of one scene's spheres",
    ),
    (
        lambda: judge(resampled(RUN, 2), [TWIN], SCENE),
        "candidate has a state every 0.08 s and scene 'drum' every 0.04 s; give the scene that it was made for",
    ),
    (
        lambda: judge(replace(RUN, time=RUN.time + 1), [TWIN], SCENE),
        "states lie at different times (2.5 s and 1.5 s at frame 0)",
    ),
    (
        lambda: judge(RUN, [TWIN], replace(SCENE, walls=box((-0.2, -1, -1), (1, 1, 1)))),
        "replica 0 starts with spheres outside the walls of scene 'drum'; give the scene that it was made for",
    ),
    (lambda: judge(replace(RUN, velocity_kind="mean"), [summarise(TWIN, SCENE)], SCENE), "speeds of two definitions"),
    (lambda: nearest_case(RUN, {}), "no case to compare with; give runs of the DEM by their speed"),
    (lambda: nearest_case(RUN, [TWIN]), "cases=[Trajectory("),
    (lambda: summarise(state(), SCENE), "trajectory=ParticleState(…) has the wrong type; give a Trajectory"),
    (lambda: surface_angle(RUN, "drum"), "scene=drum has the wrong type; give a Scene"),
    (lambda: surface_lines(RUN.position, RUN.radius, HOPPER), "scene 'hopper' has no drum, so its beds have no"),
    (lambda: cross_section_axes(NOWHERE), "scene 'nowhere' has no gravity, so nothing is up; choose scene.gravity"),
    (lambda: center_of_mass_angles(RUN.position, RUN.radius, NOWHERE), "scene 'nowhere' has no gravity"),
    (lambda: mixing(None, SCENE), "trajectory=null has the wrong type; give a Trajectory"),
    (lambda: overlap_series(RUN, None), "scene=null has the wrong type; give a Scene"),
    (lambda: count_failures([RUN], SCENE), "trajectory=[Trajectory("),
    (lambda: velocities(RUN.velocity, "mean"), "has the wrong type; give a Trajectory"),
    (lambda: velocities(RUN, "median"), "velocity_kind='median'; choose one of instantaneous, mean"),
    (lambda: wasserstein_series([0, 1], np.zeros((2, 1)), [1, 2], np.zeros((2, 1))), "states lie at different times"),
    (lambda: separation(np.zeros((1, 2, 3)), np.zeros((1, 3, 3))), "positions have shapes (1, 2, 3) and (1, 3, 3)"),
    (lambda: mean_spread([RUN.position]), "1 replica has no spread; give two or more"),
    (lambda: short_horizon_errors(len, RUN, [0], horizons=()), "horizons=() look nowhere; give frames ahead, each ≥ 1"),
    (lambda: short_horizon_errors(len, RUN, [0], horizons=(0,)), "horizons=(0,) look nowhere; give frames ahead"),
    (lambda: short_horizon_errors(lambda *_: np.zeros((1, 9, 3)), RUN, [0]), "positions have shapes (1, 9, 3) and (10"),
    (lambda: spread_starts(50, 0), "judge.short_horizon_starts=0 is impossible; choose a value ≥ 1"),
)
def test_what_cannot_be_compared_is_refused(door, sentence):
    refused(door, sentence)


def test_what_failed_is_judged_and_not_refused():
    broken = replace(RUN, position=np.where(RUN.time[:, None, None] > 2.0, np.nan, RUN.position))
    judgement = judge(broken, [RUN, TWIN], SCENE)
    assert judgement.failures.non_finite_states == (RUN.time > 2.0).sum()
    assert not judgement.error("center_height").error.defined
    by_frame = ("time", "position", "velocity", "angular_velocity")
    early = replace(RUN, **{name: getattr(RUN, name)[:10] for name in by_frame})
    assert judge(early, [RUN, TWIN], SCENE).failures.states == 10
    spinless = judge(replace(RUN, angular_velocity=None), [RUN, TWIN], SCENE)
    assert "the model has no spin" in str(spinless)


def test_one_replica_has_no_noise_floor_and_says_so():
    floor = noise_floor(lambda a, b: Measured(1.0, "m"), [RUN], "m")
    assert floor == Measured.undefined("m", "a single replica has no noise floor; make two or more")
    assert "has no noise floor" in str(judge(RUN, [TWIN], SCENE))


# ---- files ---------------------------------------------------------------------------------------------------


def model_file(path: Path, **changes) -> Path:
    card = {"model": {"name": "contact"}, "boundary": {"kind": "own"}, "scene": {"name": "drum"}, "origin": {}}
    save_model(path, {"weight": torch.zeros(1)}, ModelCard(**(card | changes)))
    return path


@doors(
    (lambda folder: load_model(folder / "none.pt"), "none.pt does not exist; train one"),
    (lambda folder: load_model(None), "path=null has the wrong type; give a word"),
    (lambda folder: load_model(folder), "is not a whole gran-bench model file"),
    (lambda folder: load_model(model_file(folder / "a.pt", model={})), "a.pt describes no model that can be built"),
    (lambda folder: load_model(model_file(folder / "b.pt")), "b.pt describes no model that can be built"),
    (lambda folder: load_model(model_file(folder / "c.pt", scene=3)), "scene=3 is no section"),
    (lambda folder: load_model(shipped_model(), device="gpu9"), "device=gpu9 cannot be used"),
    (lambda folder: load_model(shipped_model(), SCENE), "device=Scene(…) has the wrong type; give a word"),
    (lambda folder: shipped_model("holdout"), "model holdout: none of that name ships with the package; choose"),
    (lambda folder: shipped_model(3), "model=3 has the wrong type; give a word"),
    (lambda folder: read_case(folder), "is a folder; give the file of a case"),
    (lambda folder: read_case(None), "path=null has the wrong type; give a word"),
    (lambda folder: read_case(folder / "none.h5", frames=3), "frames=3 has the wrong type; give a slice, or null"),
    (lambda folder: read_settled(folder / "none.h5"), "does not exist; make it with python -m gran_bench.generate"),
    (lambda folder: CaseSpec("drum"), "scene=drum has the wrong type; give a Scene"),
    (lambda folder: CaseSpec(SCENE, packing_seed=-1), "packing_seed=-1 is impossible; choose a value ≥ 0"),
    (lambda folder: split_cases(SCENE, DemConfig(), {}), "dataset={} has the wrong type; give a DatasetConfig"),
)
def test_a_file_or_a_case_that_cannot_be_used_is_refused(door, sentence, tmp_path):
    refused(lambda: door(tmp_path), sentence)
