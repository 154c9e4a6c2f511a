"""Exports open in the programs that they are for, with the positions, radii, velocities and times of the case."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gran_bench.config import ContainerConfig, FillingConfig, SceneConfig
from gran_bench.dataset import CaseSpec, ensure_case, read_case
from gran_bench.export import Exported, exported_case
from gran_bench.export.command import FORMATS, export_command
from gran_bench.export.walls import wall_mesh
from gran_bench.scene import Vibration, build_scene
from gran_bench.shipped import shipped_scene
from gran_bench.state import Trajectory

CONFIG = SceneConfig(
    name="drum_tiny",
    container=ContainerConfig(diameter=0.4, length=0.2),
    filling=FillingConfig(count=40),
    start_time=0.4,
    end_time=0.6,
)
SPEC = CaseSpec(build_scene(CONFIG).at_speed(30.0))


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("data")
    ensure_case(SPEC, root)
    return root


@pytest.fixture(scope="module")
def case(data: Path):
    return read_case(SPEC.path(data))


def still(name: str, *times: float, **changes) -> Exported:
    """A shipped scene with two spheres that rest in its middle."""
    scene = replace(shipped_scene(name), **changes)
    place = np.broadcast_to([[0.0, 0.0, 0.3], [0.1, 0.0, 0.3]], (len(times), 2, 3)).astype(np.float32)
    motion = Trajectory(np.array(times), place, np.zeros_like(place), None, np.array([0.02, 0.03]))
    return Exported(name, scene, motion, np.zeros(2, np.uint8))


def written(exported: Exported, path: Path, tell=print) -> Path:
    FORMATS[path.suffix[1:]](exported, path, tell)
    return path


# ---- walls ---------------------------------------------------------------------------------------------------


def test_walls_of_a_drum_lie_on_it_and_turn_with_it(case):
    drum = exported_case(case.path)
    mesh = wall_mesh(case.scene, *drum.bounds)
    (before, velocity, there), (after, _, _) = mesh.at(0.4), mesh.at(0.5)
    mantle = mesh.wall == 0
    np.testing.assert_allclose(np.hypot(before[mantle, 0], before[mantle, 2]), 0.2)
    assert np.ptp(before[mantle, 1]) == pytest.approx(0.2)
    assert set(mesh.wall) == {0, 1, 2}
    assert there.all()
    omega = np.pi  # 30 rpm
    np.testing.assert_allclose(
        velocity, omega * np.stack([before[:, 2], 0 * before[:, 1], -before[:, 0]], 1), atol=1e-12
    )
    turned = np.arctan2(after[mantle, 0], after[mantle, 2]) - np.arctan2(before[mantle, 0], before[mantle, 2])
    np.testing.assert_allclose(np.mod(turned, 2 * np.pi), 0.1 * omega)


def test_a_wall_that_opens_is_gone_and_one_that_shakes_has_moved():
    hopper = still("hopper", 0.0, 1.0)
    lid = next(i for i, wall in enumerate(hopper.scene.walls) if wall.opens is not None)
    mesh = wall_mesh(hopper.scene, *hopper.bounds)
    shut, opened = (mesh.at(t)[2] for t in (0.0, hopper.scene.start_time))
    of_lid = mesh.wall[mesh.triangle[:, 0]] == lid
    assert shut.all()
    np.testing.assert_array_equal(opened, ~of_lid)
    box = still("packing", 0.0)
    floor = replace(box.scene.walls[4], motion=Vibration(0.01, 1.0, (0.0, 0.0, 1.0)))
    shaken = replace(box.scene, walls=(floor,))
    mesh = wall_mesh(shaken, *box.bounds)
    np.testing.assert_allclose(mesh.at(0.25)[0] - mesh.point, [[0.0, 0.0, 0.01]] * 4, atol=1e-12)


def test_a_box_is_six_rectangles_as_large_as_the_box():
    box = still("packing", 0.0)
    lower, upper = box.bounds
    mesh = wall_mesh(box.scene, lower, upper)
    np.testing.assert_allclose(mesh.point.min(axis=0), lower, atol=1e-12)
    np.testing.assert_allclose(mesh.point.max(axis=0), upper, atol=1e-12)
    assert len(mesh.triangle) == 12


def test_what_cannot_be_drawn_is_said():
    class Mesh:
        turns, motion, opens = False, None, None

    box = still("packing", 0.0)
    said: list[str] = []
    wall_mesh(replace(box.scene, walls=()), *box.bounds)
    object.__setattr__(box.scene, "walls", (Mesh(),))
    assert not len(wall_mesh(box.scene, *box.bounds, said.append).triangle)
    assert said == ["wall 0 is a Mesh, which is not drawn"]


# ---- the other programs --------------------------------------------------------------------------------------


def needs(reader: str):
    """The programs are large; `make test-slow` installs them."""
    return pytest.importorskip(reader, reason=f"{reader} is not installed; make test-slow installs it")


def vtk_frames(path: Path):
    """Times of a file, and of each: arrays by name, positions, numbers of vertices and polygons."""
    vtk = needs("vtk")
    from vtk.util.numpy_support import vtk_to_numpy

    reader = vtk.vtkHDFReader()
    reader.SetFileName(str(path))
    assert reader.CanReadFile(str(path))
    reader.UpdateInformation()
    times = reader.GetOutputInformation(0).Get(vtk.vtkStreamingDemandDrivenPipeline.TIME_STEPS())
    frames = []
    for time in times:
        reader.UpdateTimeStep(time)
        found = reader.GetOutput()
        points = found.GetPointData()
        arrays = {
            points.GetArrayName(i): vtk_to_numpy(points.GetArray(i)).copy() for i in range(points.GetNumberOfArrays())
        }
        place = vtk_to_numpy(found.GetPoints().GetData()).copy()
        frames.append((place, arrays, found.GetNumberOfVerts(), found.GetNumberOfPolys()))
    return times, frames


def test_vtk_reads_a_case_back_frame_by_frame(case, tmp_path):
    times, frames = vtk_frames(written(exported_case(case.path), tmp_path / "case.vtkhdf"))
    motion = case.trajectory
    np.testing.assert_array_equal(times, motion.time)
    for k, (place, arrays, vertices, polygons) in enumerate(frames):
        spheres = arrays["wall"] == 0
        assert vertices == spheres.sum() == 40
        assert polygons == 4 * 72
        np.testing.assert_array_equal(place[spheres], motion.position[k])
        for name in ("velocity", "angular_velocity"):
            np.testing.assert_array_equal(arrays[name][spheres], getattr(motion, name)[k])
        np.testing.assert_allclose(arrays["speed"], np.linalg.norm(arrays["velocity"], axis=1), rtol=1e-6)
        np.testing.assert_array_equal(arrays["radius"][spheres], motion.radius)
        np.testing.assert_array_equal(arrays["id"][spheres], np.arange(40))
        assert (arrays["type"][spheres] == 0).all()
        assert (arrays["radius"][~spheres] == 0).all()
        np.testing.assert_allclose(np.hypot(*place[arrays["wall"] == 1][:, [0, 2]].T), 0.2, rtol=1e-6)


def test_vtk_sees_a_lid_go_and_a_rollout_without_spin(tmp_path):
    hopper = still("hopper", 0.0, 0.1, shipped_scene("hopper").start_time, 9.0)
    _, frames = vtk_frames(written(hopper, tmp_path / "hopper.vtkhdf"))
    assert [polygons for *_, polygons in frames] == [5 * 72, 5 * 72, 4 * 72, 4 * 72]
    for place, arrays, *_ in frames:
        np.testing.assert_allclose(place[:2], hopper.trajectory.position[0])
        assert "angular_velocity" not in arrays


def test_ovito_reads_a_case_and_its_walls_back(case, tmp_path, monkeypatch):
    monkeypatch.setenv("QT_QPA_PLATFORM", "offscreen")
    needs("ovito")
    from ovito.io import import_file

    said: list[str] = []
    path = written(exported_case(case.path), tmp_path / "case.xyz", said.append)
    pipeline, motion = import_file(str(path)), case.trajectory
    assert pipeline.source.num_frames == motion.frame_count
    for k in (0, 7, 20):
        frame = pipeline.compute(k)
        seen = frame.particles
        assert frame.attributes["Time"] == pytest.approx(motion.time[k], abs=1e-12)
        np.testing.assert_allclose(seen.positions, motion.position[k], rtol=1e-7, atol=1e-12)
        np.testing.assert_allclose(seen["Velocity"], motion.velocity[k], rtol=1e-7, atol=1e-12)
        np.testing.assert_allclose(seen["Angular Velocity"], motion.angular_velocity[k], rtol=1e-7, atol=1e-12)
        np.testing.assert_allclose(seen["speed"], np.linalg.norm(motion.velocity[k], axis=1), rtol=1e-6)
        np.testing.assert_allclose(seen["Radius"], motion.radius, rtol=1e-7)
        np.testing.assert_array_equal(seen.identifiers, np.arange(40))
    np.testing.assert_allclose(np.array(frame.cell)[:, :3], np.diag([0.4, 0.2, 0.4]))
    np.testing.assert_allclose(np.array(frame.cell)[:, 3], [-0.2, -0.1, -0.2])
    walls = tmp_path / "case.walls.obj"
    assert said == [f"walls as they stand at the first frame: {walls}"]
    (mesh,) = import_file(str(walls)).compute().triangle_meshes.values()
    assert mesh.face_count == 4 * 72


def test_numpy_reads_arrays_in_si_units(case, tmp_path):
    with np.load(written(exported_case(case.path), tmp_path / "case.npz")) as found:
        for name in ("time", "position", "velocity", "angular_velocity", "radius"):
            np.testing.assert_array_equal(found[name], getattr(case.trajectory, name))
        assert found["wall_point"].shape == (21, len(found["wall_velocity"][0]), 3)
        assert "drum_radius: 0.2" in str(found["scene"])


# ---- the command ---------------------------------------------------------------------------------------------


def test_the_command_finds_a_case_by_its_name(data, case, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert export_command(["drum_tiny_30rpm", "--to", "npz", "--data", str(data)]) == 0
    assert "40 spheres, 21 frames, 0.4 to 0.6 s" in capsys.readouterr().out
    with np.load(f"{case.path.stem}.npz") as found:
        np.testing.assert_array_equal(found["time"], case.trajectory.time)


def test_the_command_finds_the_judged_rollout_of_a_run_by_folder_name_key_and_id(
    data, case, tmp_path, monkeypatch, capsys
):
    run = tmp_path / "results" / "runs" / "smoke-1a2b3c4d"
    (run / "rollouts").mkdir(parents=True)
    (run / "summary.json").write_text('{"judged_rpm": 30.0}')
    position = case.trajectory.position[:4] + 1.0
    for name in ("30rpm", "40rpm"):
        made_of = f"{case.digest} 0123"
        np.savez(
            run / "rollouts" / f"{name}.npz", position=position, velocity=position, made_of=made_of, failed_frame=-1
        )
    monkeypatch.chdir(tmp_path)
    ids = {"0" * 32: str(run)}
    for named in (str(run), "smoke-1a2b3c4d", "1a2b3c4d", "0" * 32):
        words = [named, "--to", "npz", "--data", str(data), "--out", "out.npz"]
        assert export_command(words, lambda run_id, root: ids.get(run_id)) == 0
        with np.load("out.npz") as found:
            np.testing.assert_array_equal(found["position"], position)
            np.testing.assert_allclose(found["time"], [0.4, 0.41, 0.42, 0.43])
            np.testing.assert_array_equal(found["radius"], case.trajectory.radius)
            assert "angular_velocity" not in found
    assert export_command([str(run), "--to", "npz", "--data", str(data), "--rollout", "50rpm"]) == 2
    assert "--rollout 50rpm" in capsys.readouterr().err
    assert export_command([str(run), "--to", "npz", "--data", str(tmp_path)]) == 2
    assert "name the cache with --data" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["nothing", "--to", "npz"], "nothing is no file, no case in data, no run in results"),
        (["{case}", "--to", "npz", "--rollout", "30rpm"], "is a case; a run has rollouts"),
        (["conf.txt", "--to", "npz"], "conf.txt is cut short or damaged"),
    ],
)
def test_the_command_refuses_in_one_line(words, said, case, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("conf.txt").write_text("no case")
    assert export_command([word.format(case=case.path) for word in words]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert len(error.splitlines()) == 1


def test_the_program_refuses_an_unknown_format(case):
    words = [sys.executable, "-m", "gran_bench.export", str(case.path), "--to", "vtu"]
    done = subprocess.run(words, capture_output=True, text=True, env=os.environ | {"COLUMNS": "200"})
    assert done.returncode == 2
    assert "invalid choice: 'vtu' (choose from 'vtkhdf', 'xyz', 'npz')" in done.stderr
