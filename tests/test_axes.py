"""What is compared in sweeps: every choice of loss, rollout, radius and boundary trains, and so do the other keys."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path

import pytest
import torch

import gran_bench.conf
from gran_bench.compose import checked_config, compose
from gran_bench.config import TrainConfig
from gran_bench.config.choices import loss_terms
from gran_bench.config.reading import validate
from gran_bench.dataset import DatasetError, Windows, ensure_cases, split_cases
from gran_bench.dataset.case_file import read_case
from gran_bench.losses import LossError
from gran_bench.run.experiment import make_model
from gran_bench.scene import build_scene
from gran_bench.surrogate.convolution.ccnn import ContinuousConvolutionNetwork
from gran_bench.surrogate.convolution.kernels.radial import RadialBasis
from gran_bench.trainer import Trainer

CONF = Path(gran_bench.conf.__path__[0])
D = 0.05  # m, of the spheres
RADII = [1.1 * D, 1.25 * D, 1.5 * D, 2.0 * D, 2.25 * D, 3.0 * D]
# Half a drum, no caps, forty spheres, just after they have fallen: a bed that moves, made in a second.
TINY = [
    *("+experiment=smoke", "device=cpu", "threads=1", "scene.container.diameter=0.4", "scene.container.length=0.3"),
    *("scene.container.periodic_axis=true", "scene.filling.count=40", "scene.start_time=0.4", "scene.end_time=0.8"),
    *("scene.rotation.times=[0.4]", "dataset.training_speeds_rpm=[30]", "judge.speeds_rpm=[]", "dem.threads=1"),
    *("trainer.steps=2", "optim.accumulate=1", "tracking.enabled=false"),
]
FRAMES = 40


def choices(group: str) -> list[str]:
    return sorted(path.stem for path in (CONF / group).glob("*.yaml"))


def tiny(*overrides: str) -> TrainConfig:
    return checked_config(compose("train", [*TINY, *overrides]), TrainConfig)


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> str:
    return str(tmp_path_factory.mktemp("cases"))


@pytest.fixture(scope="module")
def models() -> dict[str, TrainConfig]:
    """A config of each model; the convolutions narrow, for the test's time alone."""
    narrow = ["model.width=8", "model.layers=2"]
    return {
        "contact": tiny("model.iterations=2"),
        "radial": tiny("model=radial", *narrow),
        "ccnn": tiny("model=ccnn", *narrow, "model.kernel_size=3"),
    }


class Trained:
    """A few updates on the tiny drum: what was logged, and whether each weight moved."""

    def __init__(self, config: TrainConfig, root: str, folder: Path) -> None:
        validate(config)
        scene = build_scene(config.scene)
        specs = split_cases(scene, config.dem, config.dataset).training
        ensure_cases(specs, root, workers=1, progress=False)
        self.windows = Windows([read_case(spec.path(root)) for spec in specs], config.seed)
        self.model = make_model(config, scene)
        first = {name: weight.detach().clone() for name, weight in self.model.named_parameters()}
        self.logged: list[dict[str, float]] = []
        log = replace(config, trainer=replace(config.trainer, log_every=1))
        trainer = Trainer(self.model, self.windows, log, folder, lambda metrics, step: self.logged.append(metrics))
        self.result = trainer.run(progress=False)
        self.moved = {name: not torch.equal(w, first[name]) for name, w in self.model.named_parameters()}
        assert len(self.logged) == config.trainer.steps
        assert all(torch.isfinite(torch.tensor(list(metrics.values()))).all() for metrics in self.logged)


# ---- losses ----------------------------------------------------------------------------------------------


def test_every_term_ships_as_a_choice_alone_or_beside_the_position_error():
    alone = {"position_l2", "position_mse", "huber", "velocity", "acceleration"}
    assert {f"with_{term}" for term in set(loss_terms()) - alone} | alone <= set(choices("loss"))
    for term in loss_terms():
        name = term if term in alone else f"with_{term}"
        model = "contact" if term == "spin" else "radial"
        loss = checked_config(compose("train", [f"model={model}", f"loss={name}"]), TrainConfig).loss
        on = {other for other in loss_terms() if getattr(loss, other) > 0}
        assert on == ({term} if term in alone else {term, "position_l2"})


@pytest.mark.parametrize("model", ["contact", "radial"])
@pytest.mark.parametrize("term", [None, *loss_terms()])
def test_each_loss_trains_alone_and_all_together(model, term, models, root, tmp_path):
    config = models[model]
    unusable = {"contact": {"momentum"}, "radial": {"spin"}}[model]
    weights = {name: float(name == term or (term is None and name not in unusable)) for name in loss_terms()}
    config = replace(config, loss=replace(config.loss, **weights, frame_weights="uniform"))
    if term in unusable:
        with pytest.raises(ValueError, match=rf"loss\.{term}=1 .*choose loss\.{term}=0"):
            validate(config)
        return
    trained = Trained(config, root, tmp_path)
    assert {name for name in trained.logged[0] if name.startswith("term/")} == {
        f"term/{name}" for name, weight in weights.items() if weight
    }
    assert any(trained.moved.values())
    if term not in ("overlap", "momentum"):  # nothing may be too deep, and pairs may balance; an error there is always
        assert trained.logged[0]["gradient_norm"] > 0


def test_a_loss_that_the_config_did_not_refuse_is_refused_by_its_term(models, root, tmp_path):
    trained = Trained(models["contact"], root, tmp_path)
    (tmp_path / "other").mkdir()
    unchecked = replace(models["contact"], loss=replace(models["contact"].loss, momentum=1.0))
    with pytest.raises(LossError, match=r"loss\.momentum=0"):
        Trainer(trained.model, trained.windows, unchecked, tmp_path / "other").run(progress=False)


@pytest.mark.parametrize("weights", ["uniform", "discounted", "inverse", "rising"])
def test_frame_weights_are_settable_beside_any_loss(weights):
    config = checked_config(compose("train", ["loss=with_energy", f"loss.frame_weights={weights}"]), TrainConfig)
    assert (config.loss.frame_weights, config.loss.energy > 0) == (weights, True)


# ---- rollouts --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("model", ["contact", "radial"])
@pytest.mark.parametrize("frames", [1, 2, 3, 5, 8, 12])
def test_a_named_rollout_changes_how_far_the_model_looks_and_leaves_its_noise(model, frames):
    own, named = (
        checked_config(compose("train", [f"model={model}", *more]), TrainConfig).rollout
        for more in ([], [f"rollout=frames{frames}"])
    )
    assert named == replace(own, frames=frames, final_frames=None)


def test_a_named_rollout_takes_the_noise_of_the_model_that_a_recipe_or_the_command_line_chose():
    for overrides in (["+experiment=smoke", "model=radial"], ["+experiment=paper", "model=radial"]):
        found = checked_config(compose("train", [*overrides, "rollout=growing"]), TrainConfig).rollout
        assert (found.noise_diameters, found.growth, found.frames, found.final_frames) == (0.006, "linear", 1, 8)


@pytest.mark.parametrize("model", ["contact", "radial"])
@pytest.mark.parametrize(
    "changes",
    [
        *({"frames": frames, "final_frames": None} for frames in (1, 2, 5, 8, 12)),
        {"frames": 3, "final_frames": None, "gradient_through_time": False},
        {"frames": 12, "final_frames": None, "gradient_through_time": False},
        {"frames": 1, "final_frames": 3, "final_from": 0.5, "growth": "linear"},
        {"frames": 1, "final_frames": 2, "final_from": 0.5, "growth": "jump"},
    ],
    ids=str,
)
def test_each_rollout_trains(model, changes, models, root, tmp_path):
    config = models[model]
    trained = Trained(replace(config, rollout=replace(config.rollout, **changes)), root, tmp_path)
    last = changes.get("final_frames") or changes["frames"]
    assert [metrics["frames_ahead"] for metrics in trained.logged][-1] == last
    assert any(trained.moved.values())


def test_windows_reach_the_last_frame_of_a_case_and_never_beyond(models, root, tmp_path):
    windows = Trained(models["contact"], root, tmp_path).windows
    starts = {windows.draw(number, 12).start for number in range(600)}
    assert starts == set(range(FRAMES - 12 + 1))
    last = windows.window(0, FRAMES - 12, 12)
    assert len(last.position) == 13
    assert {windows.draw(number, FRAMES).start for number in range(20)} == {0}
    with pytest.raises(DatasetError, match=r"rollout\.frames=41"):
        windows.draw(0, FRAMES + 1)


# ---- radius ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("model", "radius"), list(itertools.product(["contact", "radial", "ccnn"], RADII)))
def test_each_radius_trains(model, radius, models, root, tmp_path):
    config = models[model]
    trained = Trained(replace(config, model=replace(config.model, radius_m=round(radius, 4))), root, tmp_path)
    assert any(trained.moved.values())


@pytest.mark.parametrize("radius", RADII)
@pytest.mark.parametrize("contact", [D, 0.5 * D], ids=["pairs", "walls"])
def test_the_hats_of_a_radial_kernel_lie_within_its_radius_and_add_up_to_one(radius, contact):
    basis = RadialBasis.around_contact(D, radius, contact)
    assert basis.nodes[-1] == radius
    assert all(node < radius for node in basis.nodes[:-1])
    assert len(basis.nodes) >= 3
    distance = torch.linspace(0.01 * D, radius, 200, dtype=torch.float64)
    relative = distance[:, None] * torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64)
    first, value = basis.evaluate(relative)
    assert int(first.max()) + 8 <= basis.size
    assert torch.allclose(value[:, 0] + value[:, 4], torch.ones_like(distance))
    # An overlap and a gap of a fiftieth of a diameter look different.
    near = torch.tensor([[contact - 0.02 * D, 0.0, 0.0], [contact + 0.02 * D, 0.0, 0.0]], dtype=torch.float64)
    (one, other), (here, there) = basis.evaluate(near)
    hats = torch.zeros(2, basis.size, dtype=torch.float64)
    hats[0, one : one + 8], hats[1, other : other + 8] = here, there
    assert (hats[0] - hats[1]).abs().max() > 0.1


def test_a_touching_pair_is_answered_in_full_at_the_smallest_radius(models):
    config = replace(models["contact"], model=replace(models["contact"].model, radius_diameters=1.1))
    reach, width = make_model(config, build_scene(config.scene)).fades[0]
    assert reach == pytest.approx(width, rel=1e-6)  # the answer begins to fade where the gap opens


# ---- boundary --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("model", ["radial", "ccnn"])
@pytest.mark.parametrize("name", [name for name in choices("boundary") if name not in choices("model")])
def test_each_boundary_trains_and_its_features_are_learnt(model, name, models, root, tmp_path):
    boundary = checked_config(compose("train", ["model=ccnn", f"boundary={name}"]), TrainConfig).boundary
    trained = Trained(replace(models[model], boundary=boundary), root, tmp_path)
    walls = {part: trained.moved.get(f"wall_{part}.weight") for part in ("normal", "velocity")}
    sees = name != "none"
    assert walls["normal"] is (True if sees else None)
    assert walls["velocity"] is (True if name in ("spheres", "analytic") else None)
    channels = {"spheres": 3, "spheres_normal": 3, "spheres_position": 1, "analytic": 4}
    if sees:
        assert trained.model.wall_normal.weight.shape[1] == channels[name]


@pytest.mark.parametrize("spacing", [0.25, 1.0])
def test_the_spacing_of_wall_spheres_is_a_choice(spacing, models, root, tmp_path):
    config = models["radial"]
    trained = Trained(replace(config, boundary=replace(config.boundary, spacing=spacing)), root, tmp_path)
    assert trained.moved["wall_normal.weight"]


@pytest.mark.parametrize("feature", ["gap", "normal", "velocity", "slip"])
def test_each_feature_of_an_analytic_wall_reaches_the_network(feature, models):
    config = replace(models["radial"], boundary=replace(models["radial"].boundary, kind="analytic"))
    scene = build_scene(config.scene)
    model = make_model(config, scene)
    assert isinstance(model, ContinuousConvolutionNetwork)
    position = torch.tensor([[0.0, 0.0, -0.172], [0.1, 0.05, -0.13]])
    velocity = torch.tensor([[0.3, 0.0, -0.1], [-0.2, 0.1, 0.0]])
    wall = model._see_walls(position, velocity, scene, 0.5)
    assert wall.gap.abs().max() < 0.3
    assert torch.allclose(wall.slip, wall.velocity - velocity)
    plain = model._wall_input(velocity, wall)
    changed = replace(wall, **{feature: getattr(wall, feature) + 0.1})
    assert not torch.allclose(plain, model._wall_input(velocity, changed), atol=1e-4)


# ---- other keys ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("model", ["contact", "radial"])
@pytest.mark.parametrize(
    "change",
    [
        {"scene": {"frame_interval": 0.02}},
        {"scene": {"frame_interval": 0.04}},
        {"rollout": {"noise_diameters": 0.0}},
        {"rollout": {"noise_m": 1e-3}},
        {"dataset": {"training_speeds_rpm": [30.0, 50.0]}},
        {"seed": 1},
    ],
    ids=str,
)
def test_other_keys_sweep_too(model, change, models, root, tmp_path):
    config = models[model]
    parts = {
        name: replace(getattr(config, name), **value) if isinstance(value, dict) else value
        for name, value in change.items()
    }
    trained = Trained(replace(config, **parts), root, tmp_path)
    assert any(trained.moved.values())
    assert trained.result.loss > 0
