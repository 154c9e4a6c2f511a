"""Cases on disk: the layout keeps every bit, the name follows from the contents, damage is told."""

import io
import resource
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from gran_bench.config import (
    ContainerConfig,
    DatasetConfig,
    DemConfig,
    FillingConfig,
    MaterialConfig,
    SceneConfig,
    SizesConfig,
)
from gran_bench.dataset import (
    CaseSpec,
    DatasetError,
    case_spec,
    ensure_case,
    ensure_cases,
    from_document,
    generation,
    half_step,
    read_attributes,
    read_case,
    read_settled,
    replicas,
    split_cases,
    to_document,
)
from gran_bench.dataset.ensure import SimulatedTimeBar
from gran_bench.dem.simulate import SimulationResult, choose_time_step, settle, simulate
from gran_bench.provenance.source_digest import bare_code
from gran_bench.scene import Rotation, SceneError, build_scene

CONFIG = SceneConfig(
    name="drum_tiny",
    container=ContainerConfig(diameter=0.4, length=0.2),
    filling=FillingConfig(count=40),
    start_time=0.4,
    end_time=0.6,
)
SCENE = build_scene(CONFIG)
SPEC = CaseSpec(SCENE.at_speed(30.0))


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The file of one case, made once for this module."""
    return ensure_case(SPEC, tmp_path_factory.mktemp("data"))


@pytest.fixture
def copy(made: Path, tmp_path: Path) -> Path:
    """A copy of the file that a test may damage."""
    path = tmp_path / made.name
    path.write_bytes(made.read_bytes())
    return path


# ---- what a file keeps ---------------------------------------------------------------------------------------


def test_a_case_holds_what_the_solver_gave(made: Path):
    bed = settle(SPEC.settling_scene, 0)
    result = simulate(SPEC.scene, bed, SPEC.scene.end_time)
    case = read_case(made)
    assert case.scene == SPEC.scene
    assert case.trajectory.frame_count == SCENE.frame_count == 21
    for name in ("position", "velocity", "angular_velocity"):
        stored = getattr(case.trajectory, name)
        assert stored.dtype == np.float32
        np.testing.assert_array_equal(stored, getattr(result.trajectory, name).astype(np.float32))
    assert set(case.trajectory.diagnostics) == set(result.trajectory.diagnostics)
    for name, values in result.trajectory.diagnostics.items():
        assert case.trajectory.diagnostics[name].dtype == np.float64
        np.testing.assert_array_equal(case.trajectory.diagnostics[name], values)
    assert case.attributes["time_step"] == result.time_step
    assert case.attributes["steps"] == result.steps
    assert case.attributes["wall_seconds"] > 0


def test_the_settled_state_restarts_the_run_bit_for_bit(made: Path):
    case = read_case(made)
    assert len(case.settled.history) > 0
    again = simulate(case.scene, case.settled, case.scene.end_time)
    np.testing.assert_array_equal(again.trajectory.position.astype(np.float32), case.trajectory.position)


def test_the_layout_is_the_published_one(made: Path):
    with h5py.File(made) as file:
        for name in ("position", "velocity", "angular_velocity"):
            assert file[name].shape == (21, 40, 3)
            assert file[name].dtype == np.float32
            assert file[name].chunks == (1, 40, 3)
            assert file[name].fletcher32
        assert file["time"].shape == (21,)
        assert file["settled/position"].dtype == np.float64
        assert file["settled/history/force"].shape[1] == 3
        assert file.attrs["material.friction"] == CONFIG.material.friction
        assert file.attrs["engine"] == "numba"


def test_some_frames_can_be_read_alone(made: Path):
    whole, some = read_case(made), read_case(made, slice(3, 6))
    np.testing.assert_array_equal(some.trajectory.position, whole.trajectory.position[3:6])
    np.testing.assert_array_equal(some.trajectory.time, whole.trajectory.time[3:6])


def test_an_empty_drum_is_a_case_too(tmp_path: Path):
    scene = build_scene(replace(CONFIG, filling=FillingConfig(count=0)))
    case = read_case(ensure_case(CaseSpec(scene), tmp_path))
    assert case.trajectory.position.shape == (21, 0, 3)


# ---- what a name says ----------------------------------------------------------------------------------------


def changed(**values: object) -> CaseSpec:
    return CaseSpec(build_scene(replace(CONFIG, **values)).at_speed(30.0))


DIFFERENT = {
    "speed": CaseSpec(SCENE.at_speed(31.0)),
    "friction": changed(material=MaterialConfig(friction=0.31)),
    "wall friction": changed(wall_material=MaterialConfig(friction=0.31)),
    "gravity": changed(gravity=[0.0, 0.0, -9.8]),
    "filling": changed(filling=FillingConfig(count=41)),
    "settled speed": changed(filling=FillingConfig(count=40, settled_speed=1e-4)),
    "drum": changed(container=ContainerConfig(diameter=0.4, length=0.2, periodic_axis=True)),
    "start": changed(start_time=0.5),
    "end": changed(end_time=0.7),
    "frame interval": changed(frame_interval=0.02),
    "schedule": CaseSpec(replace(SCENE, rotation=Rotation((0.4, 0.5), (30.0, 40.0)))),
    "engine": replace(SPEC, dem=DemConfig(engine="numpy")),
    "time step": replace(SPEC, dem=DemConfig(time_step=1e-4)),
    "precision": replace(SPEC, dem=DemConfig(precision="float32")),
    "packing": replace(SPEC, packing_seed=1),
    "replica 1": replicas(SPEC, 2)[0],
    "replica 2": replicas(SPEC, 2)[1],
    "half step": half_step(SPEC),
}


@pytest.mark.parametrize("what", DIFFERENT)
def test_whatever_changes_the_result_changes_the_name(what: str):
    others = [SPEC.path("."), *(spec.path(".") for name, spec in DIFFERENT.items() if name != what)]
    assert DIFFERENT[what].path(".") not in others


def test_what_does_not_change_the_result_keeps_the_name():
    same = [
        replace(SPEC, dem=DemConfig(allow_unsafe_step=True)),
        replace(SPEC, dem=DemConfig(time_step=2e-4)),  # what the automatic choice takes
        CaseSpec(SCENE.at_speed(30)),
        replace(SPEC, nudge_seed=5),  # of no nudge
    ]
    assert {spec.path(".") for spec in same} == {SPEC.path(".")}


def test_new_solver_code_makes_new_names_and_new_comments_do_not(monkeypatch: pytest.MonkeyPatch):
    old = SPEC.path(".")
    monkeypatch.setattr(case_spec, "dem_source_hash", lambda: "other")
    assert SPEC.path(".") != old
    assert bare_code('"""Doc."""\nx = 1  # why\n') == bare_code('"""Other."""\n\nx = 1\n')
    assert bare_code("x = 1") != bare_code("x = 2")


def test_cases_that_differ_after_settling_share_the_bed():
    specs = [SPEC, CaseSpec(SCENE.at_speed(50.0)), *replicas(SPEC, 2), half_step(SPEC), changed(end_time=0.7)]
    assert len({spec.settled_path(".") for spec in specs}) == 1
    assert replace(SPEC, packing_seed=1).settled_path(".") != SPEC.settled_path(".")
    assert changed(material=MaterialConfig(friction=0.31)).settled_path(".") != SPEC.settled_path(".")


def test_a_scene_survives_its_document():
    for spec in DIFFERENT.values():
        assert from_document(to_document(spec.scene)) == spec.scene
    with pytest.raises(SceneError, match="lacks gravity"):
        from_document({name: value for name, value in to_document(SCENE).items() if name != "gravity"})


# ---- replicas ------------------------------------------------------------------------------------------------


def test_replicas_start_a_nanometre_apart_with_the_same_history(tmp_path: Path):
    paths = ensure_cases([SPEC, *replicas(SPEC, 2)], tmp_path, workers=1, progress=False)
    plain, *nudged = [read_case(path) for path in paths]
    for case in nudged:
        moved = np.linalg.norm(case.settled.position - plain.settled.position, axis=1)
        np.testing.assert_allclose(moved, 1e-9, rtol=1e-5)
        np.testing.assert_array_equal(case.settled.history.force, plain.settled.history.force)
        assert not np.array_equal(case.trajectory.position[-1], plain.trajectory.position[-1])
    assert nudged[0].digest != nudged[1].digest


def test_half_the_step_runs_from_the_same_bed(tmp_path: Path):
    coarse, fine = (read_case(path) for path in ensure_cases([SPEC, half_step(SPEC)], tmp_path, workers=1))
    np.testing.assert_array_equal(coarse.settled.position, fine.settled.position)
    assert fine.attributes["time_step"] == 0.5 * coarse.attributes["time_step"]
    assert fine.attributes["steps"] == 2 * coarse.attributes["steps"]


# ---- damage --------------------------------------------------------------------------------------------------


def test_a_file_cut_short_is_told_by_reading_and_by_making(copy: Path):
    whole = copy.read_bytes()
    for size in (0, 100, len(whole) // 2, len(whole) - 1):
        copy.write_bytes(whole[:size])
        for attempt in (lambda: read_case(copy), lambda: read_attributes(copy), lambda: ensure_case(SPEC, copy.parent)):
            with pytest.raises(DatasetError, match=rf"{copy.name} is cut short or damaged.*delete it and run"):
                attempt()
        assert copy.stat().st_size == size, "a damaged file is never remade silently"


def test_a_damaged_bed_is_told_and_no_case_starts_from_it(tmp_path: Path, made: Path):
    bed = SPEC.settled_path(tmp_path)
    bed.parent.mkdir()
    whole = bytearray(SPEC.settled_path(made.parent).read_bytes())
    whole[len(whole) // 2] ^= 1
    bed.write_bytes(whole)
    with pytest.raises(DatasetError, match=rf"{bed.name} is cut short or damaged"):
        ensure_case(SPEC, tmp_path)
    assert not SPEC.path(tmp_path).exists()


def test_a_flipped_bit_is_told_or_harmless(copy: Path):
    whole, sound = copy.read_bytes(), read_case(copy)
    rng = np.random.default_rng(0)
    told = 0
    for bit in rng.integers(8 * len(whole), size=150):
        damaged = bytearray(whole)
        damaged[bit // 8] ^= 1 << (bit % 8)
        copy.write_bytes(damaged)
        try:
            case = read_case(copy)
        except DatasetError as error:
            told += copy.name in str(error)
            continue
        # The bit was in a gap between HDF5's blocks: everything that is read must be as before.
        assert case.digest == sound.digest
        assert case.attributes == sound.attributes
        np.testing.assert_array_equal(case.trajectory.position, sound.trajectory.position)
        np.testing.assert_array_equal(case.settled.velocity, sound.settled.velocity)
    assert told > 75


def test_a_changed_attribute_is_told(copy: Path):
    with h5py.File(copy, "r+") as file:
        file.attrs["wall_seconds"] = 1.0
    with pytest.raises(DatasetError, match="attributes do not match their seal"):
        read_attributes(copy)


def test_a_missing_file_says_how_to_make_it(tmp_path: Path):
    with pytest.raises(DatasetError, match=r"none\.h5 does not exist; make it with python -m gran_bench\.generate"):
        read_case(tmp_path / "none.h5")


def test_a_folder_that_cannot_be_written_is_told(tmp_path: Path):
    (tmp_path / "data").write_text("a file where the folder should be")
    with pytest.raises(DatasetError, match=r"cannot be made.*dataset\.root"):
        ensure_case(SPEC, tmp_path / "data")


def test_a_full_disk_is_told_and_leaves_nothing_behind(tmp_path: Path, made: Path):
    SPEC.settled_path(tmp_path).parent.mkdir()
    SPEC.settled_path(tmp_path).write_bytes(SPEC.settled_path(made.parent).read_bytes())
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, hard))  # bytes a file may have
    try:
        with pytest.raises(DatasetError, match=r"cannot be made: File too large; free space"):
            ensure_case(SPEC, tmp_path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert [path.name for path in tmp_path.iterdir() if path.is_file()] == []
    assert ensure_case(SPEC, tmp_path).exists()


# ---- making --------------------------------------------------------------------------------------------------


def test_what_is_there_is_used_and_not_made_again(made: Path):
    before = made.stat().st_mtime_ns
    assert ensure_case(SPEC, made.parent) == made
    assert made.stat().st_mtime_ns == before


def test_worker_processes_make_the_same_data_as_this_process(made: Path, tmp_path: Path):
    specs = [SPEC, CaseSpec(SCENE.at_speed(20.0)), CaseSpec(SCENE.at_speed(25.0))]
    paths = ensure_cases(specs, tmp_path, workers=2, progress=False)
    assert [path.name for path in paths] == [spec.path(tmp_path).name for spec in specs]
    assert read_case(paths[0]).digest == read_case(made).digest
    assert not list(tmp_path.rglob("*.tmp"))


def test_two_that_want_the_same_case_make_it_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    calls, together = [], threading.Barrier(2)

    def counted(*arguments: object, **options: object) -> SimulationResult:
        calls.append(threading.get_ident())
        return simulate(*arguments, **options)

    def want_it() -> Path:
        together.wait(timeout=60)
        return ensure_case(SPEC, tmp_path)

    monkeypatch.setattr(generation, "simulate", counted)
    # The lock belongs to an open file, so two threads stand in for two processes.
    with ThreadPoolExecutor(2) as pool:
        first, second = pool.submit(want_it), pool.submit(want_it)
    assert first.result() == second.result()
    assert len(calls) == 1


def test_a_case_that_fails_names_itself_and_the_others_are_made(tmp_path: Path):
    # A bed that may not take longer than it needs to fall cannot come to rest.
    hopeless = changed(filling=FillingConfig(count=40, settled_speed=1e-12, longest_settling=0.05))
    ensure_case(SPEC, tmp_path)
    with pytest.raises(DatasetError, match=r"drum_tiny_30rpm_seed0.*longest_settling"):
        ensure_cases([SPEC, hopeless], tmp_path, progress=False)
    assert SPEC.path(tmp_path).exists()


def test_spheres_of_many_sizes_make_the_case_that_the_name_says(tmp_path: Path):
    # Forty quantiles leave out the tails, so that the smallest sphere is larger than the sizes allow.
    filling = FillingConfig(count=40, diameter=0.04, sizes=SizesConfig(kind="lognormal", spread=0.2))
    spec = changed(filling=filling)
    case = read_case(ensure_case(spec, tmp_path))
    radius = case.trajectory.radius.min()
    assert radius > 1.001 * spec.scene.filling.smallest_radius
    assert case.attributes["time_step"] == spec.key["dem"]["time_step"]
    assert case.attributes["time_step"] < choose_time_step(spec.scene, radius=radius)[0]


def test_a_case_records_the_bed_it_started_from(tmp_path: Path):
    ensure_case(SPEC, tmp_path)
    bed, attributes = read_settled(SPEC.settled_path(tmp_path))
    assert bed.time == SCENE.start_time
    assert attributes["digest"] == read_case(SPEC.path(tmp_path)).attributes["settled_digest"]


# ---- splits --------------------------------------------------------------------------------------------------


def test_the_papers_speeds_are_split_as_the_paper_did():
    split = split_cases(SCENE, DemConfig(), DatasetConfig())
    speeds = [[spec.scene.rotation.speeds_rpm[0] for spec in side] for side in (split.training, split.holdout)]
    assert speeds == [[20.0, 25.0, 35.0, 40.0, 50.0, 60.0], [30.0]]
    assert len(split.all) == 7


@pytest.mark.parametrize(
    ("speeds", "message"),
    [
        ({"training_speeds_rpm": [20.0, 30.0]}, "holdout_speeds_rpm has 30 rpm, which is also in dataset.training"),
        ({"validation_speeds_rpm": [35.0]}, "validation_speeds_rpm has 35 rpm, which is also in dataset.training"),
        ({"training_speeds_rpm": []}, "training_speeds_rpm is empty"),
    ],
)
def test_a_speed_is_on_one_side_only(speeds: dict, message: str):
    with pytest.raises(DatasetError, match=message):
        split_cases(SCENE, DemConfig(), DatasetConfig(**speeds))


# ---- progress ------------------------------------------------------------------------------------------------


class Terminal(io.StringIO):
    """A terminal that remembers what was written to it."""

    def isatty(self) -> bool:
        return True


@dataclass(eq=False)
class Simulation:
    """A job of the bar's."""

    simulated_seconds: float


def test_one_bar_counts_the_simulated_time_of_all_jobs(monkeypatch: pytest.MonkeyPatch):
    terminal = Terminal()
    monkeypatch.setattr("sys.stderr", terminal)
    bed, case = Simulation(1.5), Simulation(4.0)
    with SimulatedTimeBar([bed, case], show=True) as bar:
        bar.reached(bed, 1.0)
        bar.reached(bed, 2.5)  # longer than expected
        bar.finished(bed)
        bar.reached(case, 1.0)
        bar.waits(case)
        bar.finished(case)
    shown = terminal.getvalue().split("\r")
    assert "data 0/2 files:   0%" in shown[1]
    assert "6.5/6.5 s simulated" in shown[-1], "2.5 s of settling and 4 s of the case"
    assert "data 2/2 files: 100%" in shown[-1]
    assert any("waiting for another process" in line for line in shown)


def test_the_bar_is_silent_without_a_terminal(monkeypatch: pytest.MonkeyPatch):
    log = io.StringIO()
    monkeypatch.setattr("sys.stderr", log)
    with SimulatedTimeBar([job := Simulation(1.0)], show=True) as bar:
        bar.finished(job)
    assert log.getvalue() == ""
