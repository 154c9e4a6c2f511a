"""Figures: they are written whole, say what they cannot show, and never hide a failure."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import matplotlib
import numpy as np
import pandas as pd
import pytest
from beds import drum, flowing, inclined_bed, resting
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from PIL import Image

from gran_bench.metrics import Measured, nearest_case, summarise
from gran_bench.plots import style
from gran_bench.plots.data_card import case_card, default_title
from gran_bench.plots.evaluation import (
    angle_of_repose,
    diagnostics,
    draw_evaluation,
    nearest_cases,
    position_error,
    speed_by_depth,
    speed_distribution,
)
from gran_bench.plots.flow import draw_pattern, flow_animation, flow_pattern, view_along_axis
from gran_bench.plots.scene_state import scene_state
from gran_bench.plots.time_error import Contender, time_against_error
from gran_bench.plots.training import PANELS, RUN_TIMES, loss_curves, sweep_axis
from gran_bench.plots.verification import HopperDischarge, draw_discharge, draw_drum_flow
from gran_bench.shipped import shipped_scene
from gran_bench.state import Trajectory

SCENE = replace(drum(end_time=2.6), frame_interval=0.1)


@pytest.fixture
def texts(monkeypatch):
    """Every text of the figures that a test draws."""
    found: list[str] = []
    save = Figure.savefig

    def reading(figure, *args, **keys):
        found.extend(text.get_text() for text in figure.findobj(matplotlib.text.Text))
        return save(figure, *args, **{**keys, "dpi": 30})

    monkeypatch.setattr(Figure, "savefig", reading)
    return found


@pytest.fixture(scope="module")
def replicas():
    return [summarise(flowing(SCENE, seed), SCENE) for seed in range(3)]


def broken_run():
    run = flowing(SCENE, 7)
    for array in (run.position, run.velocity, run.angular_velocity):
        array[6:] = np.nan
    return run


def is_png(path):
    with Image.open(path) as image:
        image.load()
        return image.format == "PNG"


# ---- spheres -----------------------------------------------------------------------------------------


def test_spheres_are_drawn_to_scale_from_the_farthest_to_the_nearest_and_the_unseen_are_counted():
    axes = Figure().subplots()
    position = np.array([[0.1, -0.2, 0.3], [0.0, 0.2, 0.0], [np.nan, 0, 0], [3.0, 0, 0], [0, np.nan, 0]])
    draw_pattern(axes, position, np.arange(5.0), np.full(5, 0.1), drum(), Normalize(0.0, 1.0))
    (spheres,) = axes.collections
    assert spheres.get_offsets().tolist() == [[0.0, 0.0], [0.1, 0.3]]
    assert spheres.get_array().tolist() == [1.0, 0.0]
    assert spheres.get_widths() == pytest.approx([0.2, 0.2])
    assert axes.texts[0].get_text() == "3 spheres not finite or out of sight"


def test_the_viewer_sees_x_to_the_right_z_up_and_looks_along_the_axis_whichever_way_it_turns():
    for rpm in (30.0, -30.0):
        across, away = view_along_axis(np.array([[0.1, 0.2, 0.3]]), drum(rpm))
        assert across[0] == pytest.approx([0.1, 0.3])
        assert away[0] == pytest.approx(0.2)


def test_without_gravity_the_viewer_still_sees_z_up():
    weightless = replace(drum(30.0), gravity=(0.0, 0.0, 0.0))
    across, away = view_along_axis(np.array([[0.1, 0.2, 0.3]]), weightless)
    assert across[0] == pytest.approx([0.1, 0.3])
    assert away[0] == pytest.approx(0.2)


# ---- figures -----------------------------------------------------------------------------------------


def test_flow_pattern_says_how_many_spheres_it_cannot_show(tmp_path, texts):
    broken = flowing(SCENE, 2)
    broken.position[10, :3] = np.nan
    flow_pattern({"DEM": flowing(SCENE, 1), "surrogate": broken}, SCENE, tmp_path / "flow.png", 2.5)
    assert is_png(tmp_path / "flow.png")
    assert "3 spheres not finite or out of sight" in texts
    assert {"DEM", "surrogate", "speed, m/s", "x, m", "height z, m"} <= set(texts)


def test_flow_pattern_of_a_run_that_ended_says_so(tmp_path, texts):
    flow_pattern({"short": flowing(SCENE, 1, frames=4)}, SCENE, tmp_path / "flow.png", 2.5)
    assert "no state at 2.5 s" in texts


def test_angle_figure_counts_invalid_states(tmp_path, texts):
    beds = [summarise(resting(SCENE, inclined_bed(20.0, seed)), SCENE) for seed in range(2)]
    half = resting(SCENE, inclined_bed(25.0))
    half.position[8:] = np.nan
    angle_of_repose({"surrogate": summarise(half, SCENE)}, beds, tmp_path / "angle.png")
    assert is_png(tmp_path / "angle.png")
    assert "surrogate (4 of 12 states invalid)" in texts
    assert "DEM, range of 2 replicas" in texts


def test_angle_figure_above_the_critical_speed_shows_no_line(tmp_path, texts):
    scene = SCENE.at_speed(60.0)
    runs = [summarise(flowing(scene, seed), scene) for seed in range(2)]
    angle_of_repose({"surrogate": runs[0]}, runs, tmp_path / "angle.png")
    assert sum("undefined:\nat or above the critical speed" in text for text in texts) == 2


def test_speed_figure_keeps_a_failed_run_in_its_legend(tmp_path, texts, replicas):
    late = [replace(run, phases=replace(run.phases, pattern_time=2.5)) for run in replicas]
    speed_distribution({"surrogate": summarise(broken_run(), SCENE)}, late, tmp_path / "speed.png")
    assert is_png(tmp_path / "speed.png")
    assert "surrogate: not finite at 2.5 s" in texts


def test_position_figure_counts_lost_frames_and_marks_the_horizon(tmp_path, texts, replicas):
    position_error({"surrogate": summarise(broken_run(), SCENE)}, replicas, tmp_path / "position.png")
    assert is_png(tmp_path / "position.png")
    assert "surrogate to DEM (6 frames not finite or missing)" in texts
    assert any(text.startswith("frame 0:") for text in texts)  # these replicas never were one trajectory


@pytest.mark.parametrize(("factor", "lowest", "highest"), [(1.0, 1e-4, 30.0), (1e4, 1e-4, 1e5), (None, 1e-9, 30.0)])
def test_position_figure_reaches_as_far_as_a_run_goes(tmp_path, monkeypatch, replicas, factor, lowest, highest):
    limits = []
    save = Figure.savefig
    monkeypatch.setattr(
        Figure, "savefig", lambda figure, *a, **k: (limits.append(figure.axes[0].get_ylim()), save(figure, *a, **k))
    )
    run = flowing(SCENE, 0 if factor is None else 1)
    if factor is None:
        run.position[3] += 1e-7  # m; next to nothing away from the first replica, which is the only one here
    else:
        run.position[3:] *= factor
    position_error({"surrogate": summarise(run, SCENE)}, replicas[:1], tmp_path / "position.png")
    ((low, high),) = limits
    assert low == pytest.approx(1e-4) if lowest == 1e-4 else lowest < low < 1e-5
    assert high == pytest.approx(30.0) if highest == 30.0 else highest < high < 10 * highest


def test_depth_figure_shows_layers_or_why_there_are_none(tmp_path, texts, replicas):
    scene = replace(drum(), frame_interval=0.5)
    beds = [summarise(resting(scene, inclined_bed(20.0, seed), speed=0.1), scene) for seed in range(2)]
    speed_by_depth({"surrogate": beds[0]}, beds, tmp_path / "depth.png")
    assert {"depth under the surface, d", "DEM, range of 2 replicas", "surrogate"} <= set(texts)
    speed_by_depth({}, replicas, tmp_path / "none.png")
    assert any("still changes" in text for text in texts)


def test_diagnostics_say_what_a_model_lacks(tmp_path, texts, replicas):
    spinless = replace(flowing(SCENE, 5), angular_velocity=None)
    diagnostics({"surrogate": summarise(spinless, SCENE)}, replicas, tmp_path / "diagnostics.png")
    assert is_png(tmp_path / "diagnostics.png")
    assert {"energy, J", "overlap, mm", "DEM, range of 3 replicas", "surrogate"} <= set(texts)


def test_nearest_cases_keep_a_failed_rollout(tmp_path, texts):
    failed = Measured.undefined("m/s", "diverged")
    nearest_cases(
        {30.0: {25.0: 0.07, 30.0: Measured(0.02, "m/s")}, 25.0: {25.0: failed, 30.0: failed}}, tmp_path / "n.png"
    )
    assert texts.count("failed") == 2
    assert {"0.070", "0.020", "case of the DEM, rpm"} <= set(texts)


def test_an_evaluation_is_drawn_for_both_packings(tmp_path, texts, replicas):
    names = {"20rpm": 20.0, "30rpm": 30.0, "30rpm_unseen": 30.0}
    runs = {name: flowing(SCENE, seed) for seed, name in enumerate(names)}
    truth = {rpm: runs[f"{rpm:g}rpm"] for rpm in (20.0, 30.0)}
    table = {}
    for rpm, run in truth.items():
        nearest, distances = nearest_case(run, truth)
        w1 = {f"{other:g}rpm": distance.value for other, distance in distances.items()}
        table[f"{rpm:g}rpm"] = {"own_rpm": rpm, "nearest_rpm": nearest, "is_own": nearest == rpm, "w1_m_s": w1}
    evaluation = SimpleNamespace(
        rollouts={name: SimpleNamespace(trajectory=run) for name, run in runs.items()},
        cases={name: SimpleNamespace(trajectory=run, scene=SCENE) for name, run in runs.items()},
        replicas={"shared": replicas, "unseen": replicas},
        candidates={"shared": replicas[0], "unseen": replicas[1]},
        summary={"nearest_case": table},
    )
    paths = draw_evaluation(evaluation, 30.0, tmp_path, model_name="contact")
    assert "contact" in texts
    of = default_title(SCENE)
    assert {f"{of}, {packing} packing" for packing in ("shared", "unseen")} < set(texts)
    assert f"{of}, shared packing: flow at 1.8 s, seen along the axis" in texts
    assert "drum, shared packing" in texts
    assert all(path.stat().st_size > 0 for path in paths)
    found = {path.name for path in paths}
    assert {"flow_pattern.png", "flow_pattern_unseen.png", "flow.gif", "nearest_case.png"} <= found
    assert found == {path.name for path in tmp_path.iterdir()}
    del evaluation.replicas["unseen"]
    assert "flow.gif" not in {path.name for path in draw_evaluation(evaluation, 30.0, tmp_path, gif=False)}


def test_loss_figure_marks_where_training_looks_further_ahead(tmp_path, texts):
    step = np.arange(1, 61)
    losses = pd.DataFrame(
        {
            "step": step,
            "loss": 1.0 / step,
            "learning_rate": 1e-3,
            "frames_ahead": np.where(step < 40, 3, 5),
            "term/spin": 0.1 / step,
            "validation_loss": 2.0 / step,
        }
    )
    with style.titled("drum, packing 0"):
        loss_curves(losses, tmp_path / "loss.png")
    assert {"5 frames ahead", "spin", "loss, validation", "drum, packing 0"} <= set(texts)
    loss_curves(losses.iloc[:0], tmp_path / "empty.png")
    assert "no losses were logged" in texts


def test_a_sweep_joins_no_seeds_and_draws_no_run_time_as_an_effect(tmp_path, monkeypatch):
    runs = pd.DataFrame({name: [1.0, 2.0, 3.0, 4.0] for name, _ in PANELS})
    runs = runs.assign(status="finished", seed=list("0101"), **{"model.radius": ["1", "1", "2", "2"]})
    panels, save = {}, Figure.savefig
    monkeypatch.setattr(
        Figure, "savefig", lambda figure, *a, **k: (panels.update(enumerate(figure.axes)), save(figure, *a, **k))
    )

    def joined(axis: str, frame: pd.DataFrame) -> list[bool]:
        sweep_axis(frame, axis, [], tmp_path / "sweep.png", "a sweep")
        return [
            any(len(line.get_xdata()) > 1 and line.get_linestyle() != "None" for line in panels[i].lines)
            for i in range(len(PANELS))
        ]

    timed = [name in RUN_TIMES for name, _ in PANELS]
    assert joined("model.radius", runs) == [not it for it in timed]
    assert not any(joined("seed", runs))
    texts = [[text.get_text() for text in panels[i].texts] for i in range(len(PANELS))]
    assert ["seed has no part in time for a frame"] in texts
    assert ["seed has no part in updates in the time given"] in texts


def test_case_card_of_an_empty_drum_says_that_there_is_nothing(tmp_path, texts):
    scene = replace(SCENE, filling=replace(SCENE.filling, count=0))
    full = flowing(SCENE, 1)
    names = ("position", "velocity", "angular_velocity")
    none = {name: np.zeros((full.frame_count, 0, 3)) for name in names if getattr(full, name) is not None}
    case_card(replace(full, radius=np.zeros(0), diagnostics={}, **none), scene, tmp_path / "card.png")
    assert {"no spheres", "undefined:\nthe scene has no spheres"} <= set(texts)


def test_case_card_shows_a_case_and_what_has_no_angle(tmp_path, texts):
    case_card(flowing(SCENE, 1), SCENE.at_speed(60.0), tmp_path / "card.png")
    assert is_png(tmp_path / "card.png")
    assert "drum, 60 rpm, 3000 spheres of 50 mm" in texts
    assert any("undefined" in text for text in texts)


def test_case_card_of_a_box_has_one_scale_that_holds_all_that_it_shows_and_no_angle(tmp_path, monkeypatch, texts):
    scene = shipped_scene("packing", {"filling.count": 20, "end_time": 0.12})
    bed = scene.fresh_filling(0).position
    position = np.stack([bed * [1.0, 1.0, 4.0 - 0.25 * k] for k in range(scene.frame_count)])  # a column that sinks
    still, time = np.zeros_like(position), 0.01 * np.arange(scene.frame_count)
    run = Trajectory(time, position, still, still, np.full(20, 0.025))
    drawn: list[Figure] = []
    save = Figure.savefig
    monkeypatch.setattr(Figure, "savefig", lambda figure, *a, **keys: drawn.append(figure) or save(figure, *a, **keys))
    case_card(run, scene, tmp_path / "card.png")
    panels = [axes for axes in drawn[0].axes if axes.get_xlabel() == "x, m"]
    assert "Angle of repose" not in texts
    assert {"Speeds of the spheres", "packing, 20 spheres of 50 mm"} <= set(texts)
    limits = {(axes.get_xlim(), axes.get_ylim()) for axes in panels}
    assert len(panels) == 3
    assert len(limits) == 1
    ((left, right), (bottom, top)) = limits.pop()
    assert left <= bed[:, 0].min() - 0.025
    assert right >= bed[:, 0].max() + 0.025
    assert bottom <= 0.0
    assert top >= position[1, :, 2].max() + 0.025
    assert all(len(axes.collections[0].get_offsets()) == 20 for axes in panels)


def test_a_failed_method_stays_in_the_picture_of_time_and_error(tmp_path, texts):
    contenders = [
        Contender("DEM", "dem", 0.5, 1.0),
        Contender("contact", "surrogate", 0.2, 4.0, 3.0, 5.0, fast=0.19, slow=0.25),
        Contender("ccnn", "surrogate", 30.0, None),
    ]
    time_against_error(contenders, "angle of repose", tmp_path / "time.png", accuracy=1.3)
    assert {"DEM", "contact", "ccnn (failed)", "nothing is faster and better"} <= set(texts)
    assert "the DEM's own accuracy" in texts
    texts.clear()
    time_against_error(contenders, "angle of repose", tmp_path / "unknown.png", accuracy=None)
    assert "the DEM's own accuracy" not in texts
    with pytest.raises(ValueError, match="choose one of dem, surrogate"):
        Contender("x", "magic", 1.0, 1.0)


def test_methods_without_a_time_are_named_under_the_picture_of_time_and_error(tmp_path, texts):
    lost = ["2 ms", "contact"]
    time_against_error([Contender("DEM", "dem", 0.5, 1.0)], "speeds", tmp_path / "some.png", untimed=lost)
    assert any("failed before the first frame: 2 ms; contact" in text for text in texts)
    time_against_error([], "speeds", tmp_path / "none.png", untimed=lost)
    assert "no method was timed and judged" in texts


def test_the_film_has_its_frames_in_real_time_and_shows_failures(tmp_path):
    path = flow_animation({"DEM": flowing(SCENE, 1), "surrogate": broken_run()}, SCENE, tmp_path / "flow.gif")
    with Image.open(path) as film:
        assert film.n_frames == SCENE.frame_count
        assert film.info["duration"] == 100
        film.seek(8)
        left, right = (np.asarray(film.convert("RGB").crop((x, 60, x + 300, 300))) for x in (0, 300))
    # Of the failed run only the drum's wall and a word are left, in grey.
    assert (right.max(axis=2) == right.min(axis=2)).all()
    assert (left.max(axis=2) != left.min(axis=2)).mean() > 0.05


def test_the_film_says_how_many_spheres_it_cannot_show(tmp_path):
    def top(escaped: int) -> np.ndarray:
        run = flowing(SCENE, 1)
        run.position[5:, :escaped] = 3.0  # m, far outside the picture
        run.position[5:, escaped // 2 : escaped] = np.nan
        with Image.open(flow_animation({"surrogate": run}, SCENE, tmp_path / f"flow{escaped}.gif")) as film:
            film.seek(8)
            return np.asarray(film.convert("L").crop((60, 51, 240, 67)))

    none, some, more = top(0), top(4), top(57)
    assert (some < 50).sum() > (none < 50).sum() + 50
    assert not np.array_equal(some, more)


def test_no_curve_is_left_out_when_colours_run_out():
    names = [f"term {k}" for k in range(9)]
    assert [name for name, _ in style.coloured(names)] == names


def test_a_figure_that_fails_leaves_the_old_file_as_it_was(tmp_path):
    path = tmp_path / "figure.png"
    path.write_text("old")

    def draw_and_fail():
        with style.drawing(path, 1.0, 1.0):
            raise RuntimeError("no")

    with pytest.raises(RuntimeError, match="no"):
        draw_and_fail()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_drawing_leaves_the_users_matplotlib_alone(tmp_path, replicas):
    before = dict(matplotlib.rcParams)
    speed_distribution({}, replicas, tmp_path / "speed.png")
    assert dict(matplotlib.rcParams) == before


@pytest.mark.parametrize("name", ["hopper", "packing_polydisperse", "collision", "free_flight", "drum_ramp"])
def test_any_scene_can_be_drawn_cut_open(tmp_path, texts, name):
    scene = shipped_scene(name)
    state = replace(scene.fresh_filling(0), time=scene.start_time)
    if name == "hopper":  # some have left
        state = replace(
            state, position=np.where(np.arange(state.count)[:, None] < 20, [0.0, 0.0, -0.07], state.position)
        )
    scene_state(tmp_path / "state.png", scene, state)
    assert {"x, m", "z, m", "speed, m/s"} <= set(texts)
    picture = np.asarray(Image.open(tmp_path / "state.png").convert("RGB"), int)
    coloured = np.ptp(picture, axis=2) > 60
    assert coloured[:, : int(0.7 * picture.shape[1])].any()  # spheres, beside the colour bar


def test_the_discharge_is_drawn_with_both_exponents(tmp_path, texts):
    opening = np.array([0.09, 0.12, 0.15, 0.18])
    result = HopperDischarge(opening + 0.028, 1e3 * opening**2.4, 10 * opening**2.5, 2.4, 0.03, 0.6, 0.02, 1450.0, 1.4)
    draw_discharge(tmp_path / "flow.png", result)
    assert any("exponent 2.5, C = 0.600" in text for text in texts)
    assert any("exponent 2.400 ± 0.030" in text for text in texts)
    assert "mass flow, kg/s" in texts


def test_the_drums_flow_is_drawn_packing_by_packing(tmp_path, texts):
    values = [np.array([34.8, 35.0, 35.3]), np.array([0.60, 0.61, 0.63])]
    samples = {("ours", 30.0): values, ("other", 30.0): values, ("ours", 20.0): values}
    labels = ["centre-of-mass angle, °", "mean speed, m/s"]
    draw_drum_flow(tmp_path / "flow.png", samples, {30.0: ((34.9, 0.5), (0.612, 0.015))}, labels)
    assert {"ours", "other", "drum, 20 rpm; a dot is a packing", *labels} <= set(texts)
    assert Image.open(tmp_path / "flow.png").size[0] > 100


def test_a_case_card_says_which_way_the_drum_turns_and_how_large_its_spheres_are():
    assert default_title(drum(-30.0)).endswith("drum, -30 rpm, 3000 spheres of 50 mm")
    assert default_title(shipped_scene("collision", {"filling.radii": [0.01, 0.025]})).endswith("2 spheres of 20–50 mm")


def test_speeds_of_a_wild_but_finite_model_are_drawn_beside_those_of_the_dem(tmp_path):
    scene = drum(end_time=2.6)
    calm, wild = flowing(scene, seed=1), flowing(scene, seed=2)
    wild.velocity[5:] = np.float32(1e25)
    runs = [summarise(run, scene) for run in (calm, wild)]
    assert speed_distribution({"model": runs[1]}, runs[:1], tmp_path / "speeds.png").stat().st_size > 5_000
