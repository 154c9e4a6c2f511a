"""Coarse-graining: f³ spheres of d become one of f d, judged in the fine spheres' diameters against the fine DEM."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from beds import RADIUS, drum, flowing, inclined_bed, resting

from gran_bench.benchmark.contest import Contest
from gran_bench.coarse_graining.ladder import Ladder, run_ladder, shown
from gran_bench.compose import checked_config, compose
from gran_bench.config import (
    BenchmarkConfig,
    CoarseGrainingConfig,
    DatasetConfig,
    DemConfig,
    GenerateConfig,
    JudgeConfig,
    TrainConfig,
)
from gran_bench.config.rules import ConfigError
from gran_bench.dataset import CaseSpec, from_document, to_document
from gran_bench.evaluation.plan import Plan
from gran_bench.metrics import judge, summarise
from gran_bench.run.cost import flow_cost
from gran_bench.run.experiment import run_experiment
from gran_bench.scene import SceneError
from gran_bench.shipped import shipped_scene
from gran_bench.state import Trajectory

TINY = [
    *("scene=drum_small", "scene.container.diameter=0.4", "scene.container.length=0.2", "scene.filling.count=40"),
    *("scene.start_time=0.4", "scene.end_time=0.6", "scene.rotation.times=[0.4]", "dem.threads=1"),
    *("dataset.training_speeds_rpm=[30]", "dataset.holdout_speeds_rpm=[40]", "dataset.replicas=2"),
    "dataset.workers=1",
]


# ---- the scene -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("factor", "count"), [(1.26, 1500), (1.5, 889), (2.0, 375), (2.5, 192)])
def test_a_sphere_stands_for_f_cubed(factor, count):
    fine = shipped_scene("drum")
    coarse = shipped_scene("drum", {"coarse_graining": factor})
    assert (coarse.filling.count, coarse.filling.diameter) == (count, factor * 0.05)
    assert coarse.coarse_graining == pytest.approx(factor)
    assert (coarse.material, coarse.walls, coarse.name) == (fine.material, fine.walls, fine.name)
    assert coarse.fine == fine
    assert coarse.at_speed(20.0).at_rest().fine == fine.at_speed(20.0).at_rest()
    assert fine.coarse_grained(factor) == coarse == coarse.coarse_grained(factor)
    assert coarse.fresh_filling(0).count == count
    assert coarse.spheres == f"coarse-grained: {count} spheres of {50 * factor:g} mm for 3000 of 50 mm"
    assert coarse.spheres in flow_cost(coarse, DemConfig()).lines[0]


def test_a_distribution_of_sizes_keeps_its_shape_and_the_bed_its_volume():
    fine = shipped_scene("packing_polydisperse")
    beds = [scene.fresh_filling(0).radius for scene in (fine, fine.coarse_grained(1.5))]
    assert len(beds[1]) == round(len(beds[0]) / 1.5**3)
    volume = [float((radius**3).sum()) for radius in beds]
    assert volume[1] == pytest.approx(volume[0], rel=0.01)
    assert beds[1].mean() == pytest.approx(1.5 * beds[0].mean(), rel=0.01)
    assert fine.coarse_grained(1.5).filling.sizes == fine.filling.sizes


def test_friction_of_its_own_is_of_the_coarse_spheres_and_of_walls_of_their_material():
    own = {"coarse_graining": 2.0, "coarse_friction": 0.2, "coarse_rolling_friction": 0.05}
    coarse = shipped_scene("drum", own)
    for material in (coarse.material, coarse.wall_material):
        assert (material.friction, material.rolling_friction) == (0.2, 0.05)
    assert (coarse.fine.material.friction, coarse.fine.material.rolling_friction) == (0.3, 0.0)
    rough = shipped_scene("drum", own | {"wall_material": {"friction": 0.7}})
    assert rough.wall_material == rough.fine.wall_material
    assert rough.wall_material.friction == 0.7


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("scene.coarse_graining=0.5", "scene.coarse_graining=0.5 is impossible; choose a value ≥ 1"),
        ("scene.coarse_graining=7", "leaves 9 of scene.filling.count=3000 spheres, no bed; choose at most 6.69"),
        ("scene.coarse_graining=2 scene.filling.count=0", "scene.filling.count=0 gives too few; leave it at 1"),
        ("scene=collision scene.coarse_graining=1.5", "scene.filling.positions places them; leave it at 1"),
        ("scene.coarse_graining=1.5 dataset.files=[a.h5]", r"dataset.files=\['a.h5'\] are; leave it at 1"),
        ("scene.coarse_friction=0.2", "scene.coarse_graining=1 makes none; change scene.material.friction"),
        ("scene.filling.diameter=0.5 scene.filling.count=100 scene.coarse_graining=2.05",
         "0.5 times scene.coarse_graining=2.05 does not fit into scene.container.diameter=1"),
    ],
)  # fmt: skip
def test_coarse_graining_that_makes_no_sense_is_refused(override, words):
    with pytest.raises(ConfigError, match=words):
        checked_config(compose("generate", override.split()), GenerateConfig)


def test_coarse_spheres_start_on_a_narrower_lattice_where_the_scenes_own_has_too_few_sites():
    fine = shipped_scene("drum_small")
    assert fine.coarse_grained(1.26).filling.lattice_spacing < fine.filling.lattice_spacing
    assert fine.coarse_grained(1.26).fresh_filling(0).count == 150
    with pytest.raises(SceneError, match=r"scene.coarse_graining=2 leaves 38 spheres of 0.1 m, .* room for 27"):
        fine.coarse_grained(2.0)


def test_the_library_refuses_with_the_same_sentence():
    with pytest.raises(SceneError, match=r"scene.coarse_graining=0.5 is impossible; choose a value ≥ 1"):
        shipped_scene("drum").coarse_grained(0.5)
    with pytest.raises(SceneError, match=r"leaves 9 of scene.filling.count=3000 spheres"):
        shipped_scene("drum").coarse_grained(7.0)


# ---- the case --------------------------------------------------------------------------------------------


def test_the_hash_of_a_case_holds_it_and_a_case_without_keeps_its_own():
    fine = shipped_scene("drum")
    assert not {"fine_spheres", "coarse_graining"} & set(to_document(fine))
    coarse = fine.coarse_grained(1.5)
    assert from_document(to_document(coarse)) == coarse
    same = replace(fine, filling=coarse.filling)  # the same spheres, which stand for themselves
    specs = [CaseSpec(scene) for scene in (fine, coarse, same)]
    assert len({spec.path("data") for spec in specs}) == 3
    assert specs[1].label == "drum_coarse1.5_30rpm_seed0"
    assert specs[2].label == specs[0].label == "drum_30rpm_seed0"


# ---- judging ---------------------------------------------------------------------------------------------


def coarser(run: Trajectory, every: int) -> Trajectory:
    """One sphere in ``every``, that stands for the others."""
    arrays = {name: getattr(run, name)[:, ::every] for name in ("position", "velocity", "angular_velocity")}
    return replace(run, **arrays, radius=run.radius[::every] * np.float32(every ** (1.0 / 3.0)))


def test_a_coarse_run_is_seen_in_columns_and_layers_of_the_fine_diameter():
    fine = replace(drum(end_time=3.7), frame_interval=0.1)
    bed = 1.26 * inclined_bed(35.0)
    bed = bed[(np.hypot(bed[:, 0], bed[:, 2]) < 0.465) & (np.abs(bed[:, 1]) < 0.465)]
    seen = summarise(replace(resting(fine, bed), radius=np.full(len(bed), 1.26 * RADIUS)), fine)
    assert seen.diameter == 2 * RADIUS
    assert len(seen.layer_speed) == round(2 * fine.drum_radius / (2 * RADIUS))
    assert seen.series["surface_angle"].mean().number == pytest.approx(35.0, abs=3.0)
    assert seen.series["com_angle"].mean().number == pytest.approx(35.0, abs=1.0)


def test_other_spheres_of_one_bed_are_judged_and_those_of_another_refused():
    scene = replace(drum(end_time=3.7), frame_interval=0.04)
    runs = [flowing(scene, seed) for seed in range(3)]
    judgement = judge(coarser(runs[0], 8), runs[1:], scene)
    assert judgement.error("speed_w1").error.defined
    assert judgement.error("com_angle").multiple > 0
    assert judgement.error("position_10").error.note == "another number of spheres"
    assert judgement.failures.spheres == 25
    few = replace(coarser(runs[0], 8), radius=runs[0].radius[::8])
    with pytest.raises(ValueError, match="candidate has 25 spheres and replica 0 has 200"):
        judge(few, runs[1:], scene)


def test_a_surrogate_of_coarse_spheres_is_held_against_replicas_of_the_fine_ones():
    scene = shipped_scene("drum_small").coarse_grained(1.26)
    data = DatasetConfig(training_speeds_rpm=[30.0, 50.0], holdout_speeds_rpm=[40.0], replicas=2)
    plan = Plan(scene, DemConfig(), data, JudgeConfig(speeds_rpm=[30.0, 40.0]))
    assert plan.case(40.0).scene.filling.count == 150
    fine = [*plan.replicas(False), *plan.replicas(True), plan.finer, plan.coarser, plan.judged_case(True)]
    assert {spec.scene.filling.count for spec in fine} == {300}
    paths = {spec.path("data") for spec in plan.cases}
    assert {spec.path("data") for spec in [*fine, plan.case(40.0, True), plan.case(30.0)]} <= paths


def test_a_training_on_coarse_spheres_runs_and_is_judged(tmp_path):
    overrides = [*TINY, "+experiment=smoke", "scene.coarse_graining=1.26", "scene.end_time=0.8", "device=cpu"]
    overrides += ["threads=1", "trainer.steps=2", "optim.accumulate=1", "model.iterations=2", "judge=quick"]
    overrides += ["judge.speeds_rpm=[30]", "judge.gif=false", "judge.unseen_packing=false", "tracking.enabled=false"]
    overrides += [f"dataset.root={tmp_path}/data", f"tracking.root={tmp_path}/results"]
    summary = run_experiment(checked_config(compose("train", overrides), TrainConfig))
    judged = summary["judged"]["shared"]
    assert judged["failures"]["spheres"] == 20
    assert judged["errors"]["speed_w1"]["valid"]
    assert judged["errors"]["speed_w1"]["floor"] > 0
    own = summary["baselines"]["DEM, coarse-grained: 20 spheres of 63 mm for 40 of 50 mm"]
    assert own["speed_w1"]["valid"]


# ---- the ladder ------------------------------------------------------------------------------------------


def tiny_ladder(root: Path, *overrides: str) -> CoarseGrainingConfig:
    places = [f"dataset.root={root}/data", f"root={root}/results"]
    return checked_config(compose("coarse_graining", [*TINY, *places, *overrides]), CoarseGrainingConfig)


def test_the_ladder_judges_each_factor_at_two_steps(tmp_path, capsys):
    table = run_ladder(tiny_ladder(tmp_path, "factors=[1.26]"))
    assert table.method.tolist() == ["another packing", *["coarse-grained 1.26"] * 2,
                                     *["coarse-grained 1.26, largest step"] * 2]  # fmt: skip
    assert table.spheres.tolist() == [40, 20, 20, 20, 20]
    assert table.packing.tolist() == [1, 0, 1, 0, 1]
    automatic, largest = table.step_s[1], table.step_s[3]
    assert table.step_s[0] < automatic < largest
    assert (table.speed_w1_floors > 0).all()
    said = capsys.readouterr().out
    page = (tmp_path / "results" / "README.md").read_text("utf-8")
    kept = pd.read_csv(tmp_path / "results" / "drum_small.csv")
    assert "\n".join(shown(kept)) in page
    assert "| coarse-grained 1.26, largest step |" in said
    # The same cases, made once: the run at the largest step starts from the bed of the automatic one.
    assert len(list((tmp_path / "data").glob("*.h5"))) == 2 + 1 + 4
    assert len(list((tmp_path / "data" / "settled").glob("*.h5"))) == 2 + 2


def test_a_coarse_scene_is_a_ladder_of_its_own_and_a_dry_run_makes_nothing(tmp_path, capsys):
    given = ["scene.coarse_graining=1.26", "scene.coarse_friction=0.1", "dry_run=true"]
    config = tiny_ladder(tmp_path, *given)
    assert [rung.scene.filling.count for rung in Ladder(config).rungs] == [40, 20, 20]
    assert Ladder(config).rungs[1].scene.material.friction == 0.1
    assert Ladder(config).rungs[1].name == "coarse-grained 1.26, friction 0.1"
    assert Ladder(config).scene.material.friction == 0.3
    assert run_ladder(config).empty
    assert "coarse-grained: 20 spheres of 63 mm for 40 of 50 mm" in capsys.readouterr().out
    assert not any(tmp_path.iterdir())


# ---- the benchmark ---------------------------------------------------------------------------------------


def contest(*overrides: str) -> Contest:
    return Contest(checked_config(compose("benchmark", [*overrides, "models=[]"]), BenchmarkConfig), {})


def test_the_benchmark_has_each_factor_at_its_automatic_and_at_its_largest_step():
    found = contest()
    coarse = {method.name: method for method in found.methods if "coarse-grained" in method.name}
    assert {"DEM 0.25 ms, coarse-grained 1.26", "DEM 0.4 ms, coarse-grained 2"} <= set(coarse)
    assert len(coarse) == 8
    for method in coarse.values():
        scene = from_document(method.job["scene"])
        assert str(found.case.settled_path("data")) not in method.job["beds"]
        assert method.packings == len(set(method.job["beds"])) == 3
        assert scene.fine == found.scene
        assert not method.unfit_because
    beds = {bed for method in coarse.values() for bed in method.job["beds"]}
    assert beds <= {str(spec.settled_path("data")) for spec in found.beds}
    assert not beds & {str(spec.settled_path("data")) for spec in found.cases}


def test_a_factor_that_leaves_no_bed_does_not_fit_and_a_coarse_scene_is_refused():
    methods = contest("scene.filling.count=40", "profile.counts=[]").methods
    unfit = {method.name: method.unfit_because for method in methods if method.unfit_because}
    assert "leaves 5 of scene.filling.count=40 spheres" in unfit["DEM, coarse-grained 2"]
    with pytest.raises(ConfigError, match=r"scene.coarse_graining=2: methods are held against the fine spheres"):
        contest("scene.coarse_graining=2")


def test_the_shipped_table_is_that_of_its_record():
    folder = Path(__file__).parents[1] / "results" / "dem_speed"
    assert "\n".join(shown(pd.read_csv(folder / "coarse_graining.csv"))) in (folder / "README.md").read_text("utf-8")
