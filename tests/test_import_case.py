"""Trajectories of other codes become cases: completed and said, checked and named, trained on and judged."""

import gzip
import os
import pickle
from dataclasses import replace
from pathlib import Path
from shutil import copyfile

import numpy as np
import pytest
from omegaconf import OmegaConf

import gran_bench
from gran_bench.compose import checked_config, compose
from gran_bench.config import DatasetConfig, DemConfig, TrainConfig
from gran_bench.config.reading import read_config
from gran_bench.dataset import DatasetError, read_case, split_cases
from gran_bench.dataset.imported import imported_cases
from gran_bench.dem.simulate import settle, simulate
from gran_bench.import_case import import_arrays
from gran_bench.import_case.command import import_command, named_scene
from gran_bench.import_case.reading import read_trajectory
from gran_bench.run.experiment import run_experiment
from gran_bench.scene import Scene
from gran_bench.shipped import shipped_scene
from gran_bench.state import StateError, Trajectory
from gran_bench.sweep.task import REFUSED, complain

COUNT = 60
SCENE = shipped_scene("drum_small", {"filling.count": COUNT, "end_time": 1.62})
YAML = f"""
defaults: [drum_small, _self_]
name: of_lammps
filling: {{count: {COUNT}}}
end_time: 1.62
"""
COLUMNS = "id type x y z vx vy vz omegax omegay omegaz radius"


@pytest.fixture(scope="module")
def bed():
    return settle(SCENE, 0)


@pytest.fixture(scope="module")
def run(bed) -> Trajectory:
    """A run of the DEM that stands for another code's."""
    return simulate(SCENE.at_speed(40.0), bed, SCENE.end_time).trajectory


def dump(run: Trajectory, columns: str = COLUMNS, step: float | None = 2e-4, digits: int = 9, seed: int = 0) -> str:
    """The text that LAMMPS would have written of a run: spheres of each frame in an order of their own, ids from 1."""
    rng, count = np.random.default_rng(seed), len(run.radius)
    text = []
    for k, time in enumerate(run.time):
        when = f"TIMESTEP\n{round(time / step)}" if step else f"TIMESTEP\n{k}\nITEM: TIME\n{time:.9g}"
        text.append(f"ITEM: {when}\nITEM: NUMBER OF ATOMS\n{count}\nITEM: BOX BOUNDS ff ff ff\n" + "-1 1\n" * 3)
        text.append(f"ITEM: ATOMS {columns}\n")
        values = {"id": np.arange(1, count + 1), "type": np.ones(count, int), "radius": run.radius}
        for name, vector in (("", run.position), ("v", run.velocity), ("omega", run.angular_velocity)):
            values |= {f"{name}{axis}": vector[k, :, i] for i, axis in enumerate("xyz")}
        for i in rng.permutation(count):
            text.append(" ".join(f"{values[name][i]:.{digits}g}" for name in columns.split()) + "\n")
    return "".join(text)


def written(folder: Path, text: str, name: str = "run.dump") -> Path:
    path = folder / name
    path.write_bytes(gzip.compress(text.encode()) if name.endswith(".gz") else text.encode())
    return path


@pytest.fixture
def scene_file(tmp_path: Path) -> str:
    path = tmp_path / "scene.yaml"
    path.write_text(YAML)
    return str(path)


def imported(words: list[str], data: Path):
    assert import_command([*words, "--data", str(data)]) == 0
    return read_case(max((data / "imported").glob("*.h5"), key=os.path.getmtime))


# ---- what is read --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "step"), [("run.dump", 2e-4), ("run.dump.gz", None)])
def test_a_dump_becomes_the_case_that_the_dem_would_have_written(name, step, run, scene_file, tmp_path, capsys):
    path = written(tmp_path, dump(run, step=step), name)
    words = [str(path), "--scene", scene_file, "--speed", "40", *([f"--time-step={step}"] if step else [])]
    case = imported(words, tmp_path)
    np.testing.assert_allclose(case.trajectory.time, run.time, rtol=1e-9)
    for field in ("position", "velocity", "angular_velocity"):
        np.testing.assert_allclose(getattr(case.trajectory, field), getattr(run, field), rtol=1e-6, atol=1e-6)
    assert case.scene == replace(SCENE.at_speed(40.0), name="of_lammps")
    assert case.attributes["engine"] == "imported"
    assert case.attributes["derived"] == ""
    assert case.attributes["contact_history"].startswith("unknown")
    assert len(case.settled.history) == 0
    said = capsys.readouterr().out
    assert f"{COUNT} spheres, 13 frames every 0.01 s" in said
    hint = "dataset.training_speeds_rpm=[…] dataset.holdout_speeds_rpm=[…]"
    assert said.strip().endswith(f"dataset=imported dataset.files=[{tmp_path}/imported] {hint}")
    assert "taken for" not in said


def test_overlaps_and_energies_are_those_that_the_dem_computes(run, tmp_path):
    path = import_arrays(scene=SCENE.at_speed(40.0), root=tmp_path, **arrays(run))
    found = read_case(path).trajectory.diagnostics
    assert set(found) == {name for name in run.diagnostics if not name.endswith("peak")}
    for name, values in found.items():
        np.testing.assert_allclose(values, run.diagnostics[name], rtol=1e-9, atol=1e-15)
    assert found["wall_contact_count"].min() > 0


def arrays(run: Trajectory, **changes) -> dict:
    names = ("position", "time", "velocity", "angular_velocity", "radius")
    return {name: np.asarray(getattr(run, name), np.float64) for name in names} | changes


def test_files_of_one_frame_each_are_put_in_order(run, tmp_path):
    blocks = dump(run).split("ITEM: TIMESTEP")[1:]
    paths = [written(tmp_path, "ITEM: TIMESTEP" + block, f"dump{k}.liggghts") for k, block in enumerate(blocks)]
    frames = read_trajectory(sorted(paths, key=str), 2e-4)
    np.testing.assert_allclose(frames["time"], run.time)
    np.testing.assert_allclose(frames["position"], run.position, atol=1e-8)


def test_what_is_missing_is_derived_and_said(run, scene_file, tmp_path, capsys):
    path = written(tmp_path, dump(run, "id x y z"))
    case = imported([str(path), "--scene", scene_file, "--speed", "40", "--time-step", "2e-4"], tmp_path)
    said = capsys.readouterr().out
    for words in ("velocities are central differences", "spins are zero", "radii are half of scene.filling.diameter"):
        assert words in said
        assert words in case.attributes["derived"]
    inner = (run.position[2:] - run.position[:-2]) / 0.02
    np.testing.assert_allclose(case.trajectory.velocity[1:-1], inner, atol=2e-6)
    assert not case.trajectory.angular_velocity.any()
    np.testing.assert_array_equal(case.settled.radius, 0.025)


def test_a_span_gets_the_clock_of_the_scene(run, scene_file, tmp_path, capsys):
    late = replace(run, time=run.time + 3.0)
    path = written(tmp_path, dump(late))
    words = [str(path), "--scene", scene_file, "--speed", "40", "--time-step", "2e-4"]
    case = imported([*words, "--from", "4.52"], tmp_path)
    said = capsys.readouterr().out
    np.testing.assert_allclose(case.trajectory.time, 1.5 + 0.01 * np.arange(11))
    np.testing.assert_allclose(case.trajectory.position[0], run.position[2], atol=1e-6)
    assert "11 of 13 frames are from 4.52 s on" in said
    assert "4.52 s of the data is the scene's start_time=1.5 s" in said
    assert "scene.end_time=1.6" in said


def test_a_periodic_axis_is_wrapped_and_does_not_break_velocities(tmp_path):
    scene = shipped_scene("drum_slice")
    y = 0.09 + 0.2 * 0.01 * np.arange(20)
    position = np.stack([np.full(20, 0.3), y, np.zeros(20)], axis=1)[:, None]
    case = read_case(import_arrays(position, scene, frame_interval=0.01, root=tmp_path, tell=lambda line: None))
    assert (abs(case.trajectory.position[..., 1]) <= 0.1 + 1e-6).all()
    np.testing.assert_allclose(case.trajectory.velocity[..., 1], 0.2, rtol=1e-4)


def test_archives_of_gns_and_of_the_export(run, tmp_path):
    kinds = np.where(np.arange(COUNT + 2) < COUNT, 6, 3)  # two boundary particles
    position = np.concatenate([run.position, np.zeros((13, 2, 3))], axis=1)
    pairs = np.empty(2, object)
    pairs[:] = [(position[:4], kinds), (position, kinds)]
    np.savez(tmp_path / "gns.npz", gns_data=pairs)
    with pytest.raises(DatasetError, match="has 2 trajectories; choose one with --trajectory"):
        read_trajectory([tmp_path / "gns.npz"])
    frames = read_trajectory([tmp_path / "gns.npz"], trajectory=1, types=[6])
    np.testing.assert_array_equal(frames["position"], run.position)
    assert "time" not in frames
    np.savez(tmp_path / "old.npz", simulation_trajectory_0=np.array([position[:, :COUNT], np.array(6)], object))
    np.testing.assert_array_equal(read_trajectory([tmp_path / "old.npz"])["type"], 6)
    np.savez(tmp_path / "plain.npz", material=np.zeros(COUNT), **arrays(run))
    found = read_trajectory([tmp_path / "plain.npz"])
    np.testing.assert_array_equal(found["angular_velocity"], run.angular_velocity)


def test_an_archive_runs_nothing(tmp_path):
    class Evil:
        def __reduce__(self):
            return os.system, (f"touch {tmp_path / 'ran'}",)

    np.savez(tmp_path / "evil.npz", gns_data=np.array([Evil()], object), allow_pickle=True)
    with pytest.raises(DatasetError, match=r"names posix\.system, which is no array"):
        read_trajectory([tmp_path / "evil.npz"])
    assert not (tmp_path / "ran").exists()
    assert pickle.loads  # what would have run it


def test_scenes_are_named_by_yaml_or_by_the_name_of_a_shipped_one(scene_file):
    assert named_scene(scene_file) == replace(SCENE, name="of_lammps")
    assert named_scene("drum") == shipped_scene("drum")
    folder = Path(scene_file).parent
    (folder / "steep.yaml").write_text("defaults: [scene, _self_]\nname: steep\nmaterial: {friction: 0.5}\n")
    assert named_scene(str(folder / "steep.yaml")).material.friction == 0.5
    assert named_scene(str(Path(__file__).parents[1] / "conf/scene/hopper.yaml")) == shipped_scene("hopper")


# ---- what is refused -----------------------------------------------------------------------------------------


def spoiled(run: Trajectory, **changes) -> dict:
    """The arrays of a run with changed entries, each given as (place, value)."""
    found = arrays(run)
    for name, (place, value) in changes.items():
        found[name] = np.array(np.broadcast_to(found[name], (13, COUNT))) if name == "radius" else found[name].copy()
        found[name][place] = value
    return found


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"position": ((4, 7), np.nan)}, r"frame 4 \(1.54 s\): id 107 has a position that is not finite"),
        ({"velocity": ((4, [7, 8]), np.inf)}, r"frame 4 \(1.54 s\): id 107 and 1 more has a velocity that is not"),
        ({"position": ((12, 3), (0.3, 0.0, 0.0))}, r"frame 12 \(1.62 s\): id 103 has its centre outside the walls"),
        ({"radius": ((9, 2), 0.026)}, r"frame 9 \(1.59 s\): id 102 has a radius that is not in the scene's"),
        (
            {"radius": ((..., 2), 0.04)},
            r"frame 0 \(1.5 s\): id 102 has a radius that is not in the scene's 0.025 to 0.025 m",
        ),
        ({"radius": ((..., 2), 0.0)}, "id 102 has a radius that is not in the scene"),
        ({"time": (5, 1.3)}, r"out of order or not equally spaced: frame 5 at 1.3 s comes -0.24 s after the last"),
        ({"time": (5, 1.5501)}, "not equally spaced: frame 5 at 1.5501 s"),
    ],
)
def test_what_is_inconsistent_is_named_with_frame_and_id(changes, said, run, tmp_path):
    with pytest.raises(DatasetError, match=said):
        import_arrays(scene=SCENE, id=100 + np.arange(COUNT), root=tmp_path, **spoiled(run, **changes))
    assert not list(tmp_path.rglob("*.h5"))


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"position": np.zeros((5, 3, 2))}, r"position has shape \(5, 3, 2\); expected \(5, 3, 3\)"),
        ({"position": np.zeros((5, 3))}, r"position has shape \(5, 3\); expected \(F, N, 3\)"),
        ({"position": np.zeros((2, 3, 3))}, "position has 2 frames; give three or more"),
        ({"time": None}, "no times; give --frame-interval"),
        ({"type": [1] * 30 + [2] * 30}, "types 1, 2 and a scene with 1 material; choose the spheres with --type"),
    ],
)
def test_arrays_that_are_no_trajectory_are_refused(changes, said, run, tmp_path):
    with pytest.raises((DatasetError, StateError), match=said):
        import_arrays(scene=SCENE, root=tmp_path, **arrays(run, **changes))


@pytest.mark.parametrize(
    ("edit", "words", "said"),
    [
        (lambda text: text, [], "counts steps and has no ITEM: TIME; give --time-step"),
        (
            lambda text: text.replace(" y z", " u w"),
            ["--time-step=1"],
            "lacks the column y, z (it has id, type, x, u, w",
        ),
        (lambda text: text.replace(" vz", " c"), ["--time-step=1"], "lacks the column vz"),
        (lambda text: text[: len(text) // 2], ["--time-step=1"], "is cut short in frame 6: 2"),
        (lambda text: text.replace("\n17 1 ", "\n99 1 ", 1), ["--time-step=1"], "frame 0 has id 17 0 times"),
        (
            lambda text: text[::-1].replace(" 1 71\n", " 1 61\n", 1)[::-1],
            ["--time-step=1"],
            "frame 12 has id 16 2 times",
        ),
        (lambda text: text.replace("\n17 1 ", "\n17 1 x", 1), ["--time-step=1"], "frame 0 has words in column x"),
        (lambda text: "ITEM: UNITS\ncgs\n" + text, [], "is in units cgs; write it in units si"),
        (lambda text: "Step Temp\n", [], "is no dump of spheres: frame 0 has the line 'Step Temp'"),
        (lambda text: "", [], "has no frame"),
        (lambda text: text, ["--time-step=2e-4", "--type=7"], "has no sphere to import; choose another --type"),
        (lambda text: text, ["--time-step=2e-4", "--from=9"], "position has 0 frames; give three or more"),
        (lambda text: text, ["--time-step=2e-4", "--scene=hopper", "--speed=3"], "'hopper' keeps its own motion"),
        (lambda text: text, ["--time-step=2e-4", "--scene=drun"], "scene=drun"),
        (lambda text: text, ["--time-step=2e-4", "--scene=none.yaml"], "--scene none.yaml cannot be read"),
        (lambda text: text, ["--time-step=2e-4", "--scene=drum_small", "--name=a/b"], "name=a/b"),
        (lambda text: text, ["--time-step=2e-4", "--packing=-1"], "packing_seed=-1"),
    ],
)
def test_the_command_refuses_in_one_line(edit, words, said, run, scene_file, tmp_path, capsys):
    path = written(tmp_path, edit(dump(run)))
    assert import_command([str(path), "--scene", scene_file, "--data", str(tmp_path), *words]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert len(error.splitlines()) == 1
    assert not list(tmp_path.rglob("*.h5"))


def test_a_file_that_is_not_there_and_a_command_without_a_scene(tmp_path, capsys):
    assert import_command([str(tmp_path / "no.dump"), "--scene", "drum"]) == 2
    assert "no.dump is no file" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        import_command(["no.dump"])
    assert "the following arguments are required: --scene" in capsys.readouterr().err


def test_an_import_without_a_speed_says_which_one_it_is_taken_for(run, scene_file, tmp_path, capsys):
    imported([str(written(tmp_path, dump(run))), "--scene", scene_file, "--time-step", "2e-4"], tmp_path)
    assert "taken for a run at 30 rpm, the speed of scene 'of_lammps'; where it had another" in capsys.readouterr().out


def test_files_that_are_no_text_are_answered_with_what_an_import_takes(tmp_path, capsys):
    case, noise = tmp_path / "case.h5", tmp_path / "noise.dump"
    for path, said in ((case, "is an HDF5 file; give a text dump"), (noise, "is no text; give a text dump of LAMMPS")):
        path.write_bytes(b"\x89HDF\r\n\xff\xfe")
        assert import_command([str(path), "--scene", "drum"]) == 2
        assert f"{path} {said}" in capsys.readouterr().err


@pytest.mark.parametrize(("factor", "ratio"), [(10.0, "0.1"), (0.5, "2"), (1.4, None)])
def test_times_that_contradict_the_velocities_are_refused(factor, ratio, run, tmp_path):
    given = arrays(run, time=1.5 + factor * (run.time - 1.5))
    if ratio is None:
        assert import_arrays(scene=SCENE, root=tmp_path, tell=lambda line: None, **given).exists()
        return
    words = (
        rf"positions move {ratio}\d* times as fast as the velocities say .* frames 0\.0[01]\d* s apart .* --time-step"
    )
    with pytest.raises(DatasetError, match=words):
        import_arrays(scene=SCENE, root=tmp_path, **given)
    assert not list(tmp_path.rglob("*.h5"))


def test_impacts_and_spheres_at_rest_say_nothing_of_the_times(tmp_path):
    scene, frames = shipped_scene("drum_small"), np.arange(12)
    position = np.zeros((12, 2, 3))
    position[:, 0, 0] = 0.01 * (frames % 2)  # to and fro, with an impact in every frame
    position[:, 1, 1] = 0.1 + 1e-6 * (frames % 3)  # the rounding of a dump
    velocity = np.zeros_like(position)
    velocity[:, 0, 0] = 5.0 * (-1.0) ** frames
    options = {"frame_interval": 0.01, "root": tmp_path, "tell": lambda line: None}
    assert import_arrays(position, scene, velocity=velocity, **options).exists()
    still = np.zeros_like(position)
    still[..., 1] = 0.1
    still[:, 0, 0] = 0.01 * frames
    with pytest.raises(DatasetError, match="inf times as fast as the velocities say"):
        import_arrays(still, scene, velocity=np.zeros_like(position), **options)


def test_deep_overlaps_are_a_warning(run, tmp_path):
    said: list[str] = []
    pressed = arrays(run)
    pressed["position"][3, 0] = pressed["position"][3, 1] + [0.02, 0.0, 0.0]
    path = import_arrays(scene=SCENE, root=tmp_path, tell=said.append, **pressed)
    assert said[-1].startswith("warning: spheres overlap by 60% of the diameter in frame 3")
    assert read_case(path).attributes["warnings"] in said[-1]


# ---- training and judging on them ----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def cases(bed, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data cache with dumps of runs at three speeds, imported; the judged one twice more, nudged."""
    folder = tmp_path_factory.mktemp("cases")
    (folder / "scene.yaml").write_text(YAML)
    starts = [(30.0, 0), (50.0, 0), (40.0, 0), (40.0, 1), (40.0, 2)]
    for rpm, replica in starts:
        nudge = 1e-9 * np.random.default_rng(replica).standard_normal((COUNT, 3)) * (replica > 0)
        start = replace(bed, position=bed.position + nudge)
        trajectory = simulate(SCENE.at_speed(rpm), start, SCENE.end_time).trajectory
        path = written(folder, dump(trajectory), f"{rpm:g}_{replica}.dump.gz")
        words = [str(path), "--scene", str(folder / "scene.yaml"), "--speed", str(rpm), "--time-step", "2e-4"]
        assert import_command([*words, "--replica", str(replica), "--data", str(folder)]) == 0
    return folder


def train_config(cases: Path, *overrides: str) -> TrainConfig:
    words = ["+experiment=smoke", "dataset=imported", f"dataset.files=[{cases}/imported]", "scene.name=of_lammps"]
    words += ["dataset.training_speeds_rpm=[30,50]", "dataset.holdout_speeds_rpm=[40]", "judge.speeds_rpm=[40]"]
    words += [f"scene.filling.count={COUNT}", "scene.end_time=1.62", "tracking=off", f"tracking.root={cases}/results"]
    composed = compose("train", [*words, "trainer.steps=4", "model=radial", *overrides])
    return read_config(TrainConfig, OmegaConf.to_container(composed, resolve=True))


def test_imported_cases_are_split_by_the_speed_of_their_walls(cases, tmp_path):
    config = train_config(cases)
    scene = replace(SCENE, name="of_lammps")
    split = split_cases(scene, config.dem, config.dataset)
    assert [spec.path("nowhere").name.split("_")[2] for spec in split.all] == ["30rpm", "40rpm", "50rpm"]
    assert len(imported_cases([cases / "imported"])) == 5
    with pytest.raises(DatasetError, match=r"has no 20rpm of packing 0; it has of_lammps_30rpm") as missing:
        split_cases(scene, DemConfig(), replace(config.dataset, training_speeds_rpm=[20.0]))
    assert complain(missing.value, TrainConfig) == REFUSED
    one, two = (tmp_path / f"{name}.h5" for name in "ab")
    for path in (one, two):
        copyfile(split.training[0].path("nowhere"), path)
    with pytest.raises(DatasetError, match=rf"has 30rpm of packing 0 2 times; delete one of: {one}, {two}$") as twice:
        split_cases(scene, DemConfig(), replace(config.dataset, files=[str(tmp_path)], training_speeds_rpm=[30.0]))
    assert complain(twice.value, TrainConfig) == REFUSED
    with pytest.raises(DatasetError, match=r"scene\.frame_interval is 0.02 and .* was imported with 0.01"):
        split_cases(replace(scene, frame_interval=0.02), DemConfig(), config.dataset)
    with pytest.raises(DatasetError, match=r"scene\.filling\.count is 70"):
        split_cases(replace(scene, filling=replace(scene.filling, count=70)), DemConfig(), config.dataset)
    with pytest.raises(DatasetError, match="is a folder without a case"):
        split_cases(scene, DemConfig(), DatasetConfig(files=[str(Path(__file__).parent)]))


def test_a_model_is_trained_on_dumps_and_judged_by_them(cases, capsys):
    summary = run_experiment(train_config(cases))
    assert summary["training"]["steps"] == 4
    shared = summary["judged"]["shared"]
    assert shared["replicas"] == 2
    assert shared["errors"]["speed_w1"]["floor"] > 0
    assert "floor_half_step" not in shared["errors"]["speed_w1"]
    assert summary["rollouts"]["40rpm"]["dem_ms_per_frame"] is None
    assert set(summary["judged"]) == {"shared"}
    assert "this DEM undefined" in capsys.readouterr().out


@pytest.mark.slow
def test_without_replicas_there_is_no_noise_floor(cases):
    alone = sorted(str(path) for path in (cases / "imported").glob("*.h5") if "replica" not in path.name)
    summary = run_experiment(train_config(cases, f"dataset.files=[{','.join(alone)}]"))
    errors = summary["judged"]["shared"]["errors"]["speed_w1"]
    assert errors["value"] > 0
    assert errors["floor"] is None
    assert errors["multiple_of_floor"] is None


def test_the_commands_of_the_page_are_understood(capsys):
    page = (Path(__file__).parents[1] / "docs" / "extending.md").read_text("utf-8")
    section = page.partition("## Data of another code")[2].partition("\n## ")[0]
    commands = [line.split()[3:] for line in section.splitlines() if line.startswith("python -m")]
    for words in commands[:3]:
        assert import_command(words) == 2
        assert f"{words[0]} is no file" in capsys.readouterr().err
    config = checked_config(compose("train", commands[3]), TrainConfig)
    assert config.dataset.files == ["data/imported"]


def test_the_public_face_has_the_library_door():
    assert gran_bench.import_arrays is import_arrays
    assert isinstance(SCENE, Scene)
