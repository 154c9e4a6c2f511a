"""How a run looks in the UI: legal names, the headline first, a saved view, a description, signed figures."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from beds import flowing
from finished_runs import SCENE, broken, summary_of
from PIL import Image

from gran_bench.config import LossConfig, RolloutConfig, TrackingConfig
from gran_bench.plots.style import drawing, drawn_for
from gran_bench.run.summary import (
    description,
    flat_metrics,
    headline,
    loss_in_words,
    missed_requirements,
    params_of,
    rollout_in_words,
    undefined_figures,
)
from gran_bench.tracking import HEADLINE, HEADLINE_FIGURES, Store, shown_name
from gran_bench.tracking.store import legal_name
from gran_bench.tracking.views import COLUMN_METRICS, VIEW_TAG, experiment_tags, view_state


@pytest.fixture(scope="module")
def summary() -> dict:
    return summary_of(flowing(SCENE, seed=3))


def test_headline_figures_are_the_named_ones_and_legal(summary: dict):
    assert set(headline(summary)) <= set(HEADLINE_FIGURES)
    assert set(headline(summary)) | set(undefined_figures(summary)) == set(HEADLINE_FIGURES)
    assert all(legal_name(name) == name for name in flat_metrics(summary))


def test_the_headline_group_sorts_before_all_others(summary: dict):
    groups = sorted({name.partition("/")[0] for name in flat_metrics(summary)} | {"training"})
    assert groups[0] + "/" == HEADLINE
    assert all("/" in name for name in flat_metrics(summary)), "the UI puts what has no group last"


def test_the_view_shows_metrics_and_params_that_exist(summary: dict):
    state = view_state()
    named = {HEADLINE + name for name in HEADLINE_FIGURES} | {"training/loss"}
    shown = {column.split("`")[1] for column in state["selectedColumns"] if column.startswith("metrics.")}
    for chart in state["compareRunCharts"]:
        shown |= {chart[axis]["key"] for axis in ("xaxis", "yaxis") if axis in chart}
        shown |= {*chart.get("selectedMetrics", ()), *([chart["metricKey"]] if "metricKey" in chart else [])}
    assert shown <= named
    assert {HEADLINE + name for name in COLUMN_METRICS} <= shown
    sections = {section["uuid"] for section in state["compareRunSections"]}
    assert {chart["metricSectionId"] for chart in state["compareRunCharts"]} == sections
    assert len({chart["uuid"] for chart in state["compareRunCharts"]}) == len(state["compareRunCharts"])


@pytest.mark.parametrize("model", ["contact", "radial", "ccnn"])
def test_the_views_params_exist_in_every_model(model: str):
    from gran_bench.compose import checked_config, compose
    from gran_bench.config import TrainConfig
    from gran_bench.tracking.opening import dotted

    config = checked_config(compose("train", ["+experiment=smoke", f"model={model}"]), TrainConfig)
    params = {column.split("`")[1] for column in view_state()["selectedColumns"] if column.startswith("params.")}
    for chart in view_state()["compareRunCharts"]:
        params |= {*chart.get("selectedParams", ())}
    assert params <= set(dotted(params_of(config)))


@pytest.mark.parametrize(
    ("loss", "words"),
    [
        (LossConfig(), "position_l2"),
        (LossConfig(energy=0.1, frame_weights="inverse"), "position_l2 + 0.1 energy, inverse"),
        (LossConfig(position_l2=0.0, huber=1.0, frame_weights="discounted", discount=0.9), "huber, discounted 0.9"),
        (LossConfig(spin=0.2, frame_weights="inverse"), "position_l2 + 0.2 spin, inverse, spin uniform"),
        (LossConfig(spin_frame_weights="rising"), "position_l2"),
    ],
)
def test_a_loss_in_words_names_what_is_minimised(loss: LossConfig, words: str):
    assert loss_in_words(loss) == words


@pytest.mark.parametrize(
    ("rollout", "words"),
    [
        (RolloutConfig(frames=3), "3"),
        (RolloutConfig(frames=3, final_frames=3), "3"),
        (RolloutConfig(frames=3, final_frames=5), "3 to 5"),
        (RolloutConfig(frames=1, final_frames=8, growth="linear"), "1 to 8, linear"),
        (RolloutConfig(frames=2, gradient_through_time=False), "2, gradient cut"),
    ],
)
def test_a_rollout_in_words_says_how_far_it_looks(rollout: RolloutConfig, words: str):
    assert rollout_in_words(rollout) == words


def test_an_experiment_is_dressed_once_and_a_users_words_stay(tmp_path: Path):
    store = Store(TrackingConfig(root=str(tmp_path)))
    store.dress_experiment()
    tags = store.client.get_experiment(store.experiment_id).tags
    envelope = json.loads(tags[VIEW_TAG])
    assert json.loads(envelope["state"]) == view_state()
    store.client.set_experiment_tag(store.experiment_id, "mlflow.note.content", "my own words")
    store.client.set_experiment_tag(store.experiment_id, VIEW_TAG, "of an older version")
    store.dress_experiment()
    tags = store.client.get_experiment(store.experiment_id).tags
    assert tags["mlflow.note.content"] == "my own words"
    assert tags[VIEW_TAG] == experiment_tags()[VIEW_TAG]
    assert all(len(value) <= 5000 or name == VIEW_TAG for name, value in tags.items())


def test_a_description_has_every_figure_what_is_missed_and_the_way_back():
    summary = summary_of(broken(3), failed_frames=(3, None), own=False)
    text = description(summary, Path("results/runs/smoke-1a2b"), ["angle_of_repose.png", "depth.png"], "abc")
    for name, value in headline(summary).items():
        assert f"| {name} | {value:.4g} |" in text
    assert "| speed W1 m per s | undefined |" in text
    assert len(missed_requirements(summary)) == headline(summary)["requirements failed"] >= 2
    assert all(f"- {row}" in text for row in missed_requirements(summary))
    assert "broke down at frame 3" in text
    assert "![angle_of_repose.png](get-artifact?path=figures%2Fangle_of_repose.png&run_uuid=abc)" in text
    assert "`smoke-1a2b`" in text


@pytest.mark.parametrize(
    ("name", "shown"),
    [
        ("sweep_radius+model-radial+model.radius-0.08-1a2b3c4d", "model-radial radius-0.08-1a2b3c4d"),
        ("smoke+scene.end_time-2.2+seed-1e-05-1a2b3c4d", "end_time-2.2 seed-1e-05-1a2b3c4d"),
        ("holdout30rpm-1a2b3c4d", "holdout30rpm-1a2b3c4d"),
    ],
)
def test_a_run_is_called_by_what_was_changed(name: str, shown: str):
    assert shown_name(name) == shown


def test_a_figure_carries_the_name_of_its_run(tmp_path: Path):
    def draw(name: str) -> Image.Image:
        with drawing(tmp_path / name, 4.0, 3.0) as figure:
            figure.subplots().plot([0, 1])
        return Image.open(tmp_path / name)

    bare = draw("bare.png")
    with drawn_for("smoke+seed-1-1a2b"):
        signed = draw("signed.png")
    after = draw("after.png")
    assert signed.text["Description"] == "gran-bench run smoke+seed-1-1a2b"
    assert "Description" not in bare.text
    assert bare.tobytes() == after.tobytes() != signed.tobytes()
