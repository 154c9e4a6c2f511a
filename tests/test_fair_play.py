"""Fair play: the main job's own training opens the training cases and no other file of the data, whatever is in it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import h5py
import pandas as pd
import pytest
import torch

from gran_bench.config import (
    ContactModelConfig,
    ContainerConfig,
    DatasetConfig,
    DemConfig,
    FillingConfig,
    JudgeConfig,
    LossConfig,
    OptimConfig,
    RolloutConfig,
    SceneConfig,
    TrackingConfig,
    TrainConfig,
    TrainerConfig,
)
from gran_bench.dataset import DatasetError, ensure_cases, read_case, split_cases
from gran_bench.evaluation.plan import Plan
from gran_bench.processes import StopRequest
from gran_bench.run.experiment import make_model, train_stage, training_windows, validation_windows
from gran_bench.scene import build_scene
from gran_bench.tracking import open_run
from gran_bench.trainer import Trainer
from gran_bench.trainer import validation as looks
from gran_bench.trainer.validation import Validation

Weights = dict[str, torch.Tensor]


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> TrainConfig:
    """A tiny job whose every case is there: training, validation, hold-out, replicas, unseen packing, half step."""
    config = TrainConfig(
        experiment="fair",
        device="cpu",
        threads=1,
        scene=SceneConfig(
            name="drum_tiny",
            container=ContainerConfig(diameter=0.4, length=0.2, periodic_axis=True),
            filling=FillingConfig(count=40),
            start_time=0.4,
            end_time=0.6,
        ),
        dataset=DatasetConfig(
            root=str(tmp_path_factory.mktemp("data")),
            training_speeds_rpm=[25.0, 35.0],
            validation_speeds_rpm=[40.0],
            holdout_speeds_rpm=[30.0],
            replicas=2,
            workers=1,
        ),
        # Every term of the loss that looks at the data in a way of its own.
        loss=LossConfig(position_l2=1.0, acceleration=0.1, spin=0.1, overlap=0.1, cell_displacement=0.1),
        model=ContactModelConfig(iterations=2, memory=True),
        rollout=RolloutConfig(frames=2, noise_m=1e-4),
        optim=OptimConfig(learning_rate=1e-3, accumulate=2, weight_average=0.9),
        trainer=TrainerConfig(steps=4, log_every=1, startup_fraction=0.3, startup_seconds=0.05),
        judge=JudgeConfig(speeds_rpm=[25.0, 30.0, 35.0]),
        tracking=TrackingConfig(enabled=False),
    )
    scene = build_scene(config.scene)
    frozen = replace(config.dataset, validation_speeds_rpm=[])  # the hold-out is judged when all is chosen
    judged = [Plan(scene, config.dem, dataset, config.judge) for dataset in (config.dataset, frozen)]
    wanted = [*split_cases(scene, config.dem, config.dataset).all, *(case for plan in judged for case in plan.cases)]
    ensure_cases(wanted, config.dataset.root, workers=1, progress=False)
    return config


@pytest.fixture(scope="module")
def training_files(config: TrainConfig) -> set[Path]:
    split = split_cases(build_scene(config.scene), DemConfig(), config.dataset)
    return {spec.path(config.dataset.root) for spec in split.training}


@pytest.fixture
def watched(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """The HDF5 files that were opened, in order."""
    opened: list[Path] = []
    original = h5py.File

    def watch(path: Path, *arguments: object, **options: object) -> h5py.File:
        opened.append(Path(path))
        return original(path, *arguments, **options)

    monkeypatch.setattr(h5py, "File", watch)
    return opened


@pytest.fixture
def train(config: TrainConfig, tmp_path: Path) -> Callable[[str], Weights]:
    """Train as the main job does, in a folder of the given name; returns the weights to judge."""

    def trained(name: str, looked_at: bool = False) -> Weights:
        scene = build_scene(config.scene)
        (tmp_path / name).mkdir()
        split = split_cases(scene, config.dem, config.dataset)
        windows, model = training_windows(config, split), make_model(config, scene)
        beside = Validation(model, validation_windows(config, split), config.loss) if looked_at else None
        with open_run(config.tracking, name, name, config) as run:
            training = train_stage(config, model, windows, tmp_path / name, run, StopRequest(), validation=beside)
        assert training["steps"] == config.trainer.steps
        return model.state_dict()

    return trained


@pytest.fixture
def spoil(config: TrainConfig, training_files: set[Path]):
    """Replace every file of the data that training has no business with by garbage; intact again afterwards."""
    kept: dict[Path, bytes] = {}

    def garbage() -> set[Path]:
        for path in set(Path(config.dataset.root).rglob("*.h5")) - training_files:
            kept[path] = path.read_bytes()
            path.write_bytes(b"nobody may read this")
        return set(kept)

    yield garbage
    for path, content in kept.items():
        path.write_bytes(content)


def test_training_opens_the_training_cases_and_nothing_else(
    train: Callable[[str], Weights], watched: list[Path], training_files: set[Path]
):
    train("watched")
    assert set(watched) == training_files


def test_the_weights_are_the_same_where_nothing_else_can_be_read(
    train: Callable[[str], Weights], spoil: Callable[[], set[Path]], config: TrainConfig, watched: list[Path]
):
    intact = train("intact")
    spoiled = spoil()
    names = " ".join(sorted(path.name for path in spoiled))
    for case in (
        "30rpm_seed0_",
        "30rpm_seed0_replica1",
        "30rpm_seed1_",
        "30rpm_seed1_replica2",
        "40rpm_seed0_",
        "40rpm_seed1_",
    ):
        assert case in names, f"{case} is not among the files that were spoiled"
    watched.clear()
    alone = train("alone")
    assert not spoiled & set(watched)
    assert all(torch.equal(alone[name], intact[name]) for name in intact)


def test_a_look_at_the_hold_out_would_be_seen(
    spoil: Callable[[], set[Path]], watched: list[Path], training_files: set[Path]
):
    for path in spoil():
        if path.parent == next(iter(training_files)).parent:
            with pytest.raises(DatasetError):
                read_case(path)
            assert watched[-1] == path


def test_the_weights_depend_on_what_training_reads(
    train: Callable[[str], Weights], config: TrainConfig, monkeypatch: pytest.MonkeyPatch
):
    before = train("before")
    monkeypatch.setattr(config.dataset, "training_speeds_rpm", [25.0])
    after = train("after")
    assert not all(torch.equal(after[name], before[name]) for name in before)


def test_a_look_at_the_validation_changes_no_weight_and_reads_its_cases_alone(
    train: Callable[..., Weights], config: TrainConfig, training_files: set[Path], watched: list[Path], tmp_path: Path
):
    plain = train("unseen")
    watched.clear()
    looked = train("seen", looked_at=True)
    assert all(torch.equal(plain[name], looked[name]) for name in plain)
    split = split_cases(build_scene(config.scene), config.dem, config.dataset)
    assert set(watched) == training_files | {spec.path(config.dataset.root) for spec in split.validation}
    losses = pd.read_csv(tmp_path / "seen" / "losses.csv")["validation_loss"]
    assert losses.notna().all()
    assert losses.nunique() == len(losses) == config.trainer.steps


def test_the_validation_loss_is_the_training_loss_of_its_windows(
    config: TrainConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    quiet = replace(config, rollout=replace(config.rollout, noise_m=0.0, mirror=False))
    scene = build_scene(config.scene)
    windows = validation_windows(quiet, split_cases(scene, config.dem, config.dataset))
    model = make_model(quiet, scene)
    monkeypatch.setattr(windows, "draw", lambda number, frames, progress: windows.window(0, number, frames))
    found = [Trainer(model, windows, quiet, tmp_path)._window_gradients(model, start, 2)[0] for start in (0, 6)]
    assert windows.cases[0].trajectory.frame_count == 21
    monkeypatch.setattr(looks, "STARTS", (0.0, 0.3))
    assert Validation(model, windows, quiet.loss).loss(2) == pytest.approx(sum(found) / 2, rel=1e-6)
