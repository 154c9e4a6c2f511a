"""An entry composes, checks, runs; what goes wrong takes one line and the right exit code, and leaves no folder."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

import gran_bench.conf
from gran_bench.compose import Source, changed_in, described_jobs, run_folder, swept_keys
from gran_bench.config import TrainConfig
from gran_bench.config.rules import ConfigError
from gran_bench.entry import run
from gran_bench.scene import SceneError
from gran_bench.state import StateError
from gran_bench.sweep.task import FAILED, REFUSED, complain

CONF = Path(gran_bench.conf.__path__[0])
RESULTS = Path(__file__).parents[1] / "results" / "sweeps"
PROBE = """
import gran_bench.conf
from gran_bench.config import TrainConfig
from gran_bench.entry import run
from gran_bench.provenance import command
from gran_bench.state import StateError

def task(config):
    if config.seed == 7:
        raise StateError("sphere 7 is nowhere; put it somewhere")
    if config.seed == 13:
        raise KeyError("a bug")
    if config.seed == 15:
        raise KeyboardInterrupt("SIGTERM")
    print(f"ran {config.tracking.folder} {config.model.name}")
    if config.seed >= 20:
        print(command())

if __name__ == "__main__":
    run(task, "train", TrainConfig)
"""


@pytest.fixture
def probe(tmp_path):
    """Runs a small entry in an empty folder: ``probe("seed=1") -> (exit code, stdout, stderr, files left)``."""
    script = tmp_path / "entry" / "probe.py"
    script.parent.mkdir()
    script.write_text(PROBE, "utf-8")
    folder = tmp_path / "empty"
    folder.mkdir()

    def command(*arguments: str) -> tuple[int, str, str, list[str]]:
        done = subprocess.run(
            [sys.executable, script, *arguments], cwd=folder, capture_output=True, text=True, timeout=120, check=False
        )
        left = sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())
        return done.returncode, done.stdout, done.stderr, left

    return command


@pytest.fixture
def refuse(monkeypatch, capsys, tmp_path):
    """Runs an entry in this process with a command line that it refuses: the one line that it says."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(os.environ, "HYDRA_FULL_ERROR", "1")

    def command(*arguments: str, config_name: str = "train") -> str:
        monkeypatch.setattr(sys, "argv", ["probe", *arguments])
        with pytest.raises(SystemExit) as ending:
            run(lambda config: pytest.fail("the task ran"), config_name, TrainConfig)
        assert ending.value.code == REFUSED
        said = capsys.readouterr()
        assert said.out == ""
        assert said.err.count("\n") == 1, said.err
        assert list(tmp_path.iterdir()) == []
        return said.err

    return command


# ---- before any work -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("+sede=1", ["sede=1", "did you mean seed?"]),
        ("model.widht=3", ["model.widht=3", "did you mean model.width?"]),
        ("model.width=3", ["model.width=3", "ccnn or radial"]),
        ("scene.material.restitution=1.2", ["scene.material.restitution=1.2", "(0, 1]"]),
        ("scene.wall_material.friction=1", ["scene.wall_material is null", "+scene.wall_material.friction=1"]),
        ("dem.time_step=0.01", ["dem.time_step=0.01", "largest safe step"]),
        ("scene.filling.count=9999", ["scene.filling.count=9999", "do not fit"]),
        ("scene.container.kind=none", ["no container"]),
        ("scene.container.lifters=4", ["the keys of scene.container are kind, diameter, length, periodic_axis\n"]),
        ("model=cnn", ["model=cnn", "did you mean ccnn?", "radial"]),
        ("optim=adam", ["optim=adam", "contact or emulator or", "or paper or radial or", "--config-dir=FOLDER"]),
        ("+experiment=holdout3", ["experiment=holdout3", "did you mean holdout30rpm?", "smoke"]),
        ("experiment=smoke", ["experiment", "+experiment=smoke"]),
        ("modle=ccnn", ["modle=ccnn", "did you mean model?"]),
        ("seed=1,2", ["seed=1,2", "-m"]),
        ("+seed=1", ["seed", "there already"]),
        ("seed", ["seed", "KEY=VALUE"]),
        ("seed=${nothing}", ["seed", "nothing"]),
        ("--config-name=trian", ["trian"]),
        ("-m seed=1,2 scene.material.restitution=0.5,1.2", ["scene.material.restitution=1.2"]),
        ("-m model=ccnn,radail", ["model=radail", "did you mean radial?"]),
        ("-m seed=interval(1,2)", ["does not support sweep type"]),
        ("+experiment=sweep_radius", ["sweep over", "add -m"]),
        ("tracking.sweep=mine", ["tracking.sweep=mine", "add -m"]),
        ("tracking.folder=../../evil", ["tracking.folder=../../evil is impossible", "never a path"]),
        ("-m seed=1,2 tracking.sweep=x/y", ["tracking.sweep=x/y is impossible", "never a path"]),
        ("--cfg job model=cnn", ["model=cnn", "did you mean ccnn?"]),
    ],
)
def test_a_command_that_cannot_be_ends_in_one_line_with_code_2_and_leaves_nothing(refuse, arguments, words):
    message = refuse(*arguments.split())
    assert message.startswith("error: ")
    assert [word for word in words if word not in message] == [], message


def test_a_config_folder_of_ones_own_is_searched_and_held_to_the_same_rules(refuse, tmp_path_factory):
    mine = tmp_path_factory.mktemp("conf")
    (mine / "scene").mkdir()
    (mine / "scene" / "mine.yaml").write_text("defaults: [drum, _self_]\nname: mine\nfriction: 0.1\n")
    assert "scene.friction=0.1" in refuse(f"--config-dir={mine}", "scene=mine")
    assert "did you mean mine?" in refuse(f"--config-dir={mine}", "scene=mines")
    assert f"--config-dir={mine}s: no such folder" in refuse(f"--config-dir={mine}s", "scene=mine")


# ---- jobs ------------------------------------------------------------------------------------------------


def test_a_job_runs_with_the_checked_config_and_hydra_leaves_no_folder_of_its_own(probe):
    assert probe("+experiment=smoke", "model=ccnn") == (0, "ran smoke+model-ccnn ccnn\n", "", [])


def test_a_job_knows_its_own_command_quoted_for_a_shell(probe):
    _, out, _, _ = probe("seed=20", "tracking.root=a b")
    assert out.splitlines()[-1] == "python probe.py seed=20 'tracking.root=a b'"


def test_a_job_of_a_multirun_knows_the_command_that_would_run_it_alone(probe):
    _, out, said, _ = probe("-m", "seed=20,21", "hydra/launcher=local")
    told = sorted(line for line in out.splitlines() if line.startswith("python"))
    assert told == [f"python probe.py seed={seed}" for seed in (20, 21)], said


def test_a_failure_that_the_house_foresees_is_one_line_and_a_bug_shows_its_traceback(probe):
    assert probe("seed=7") == (FAILED, "", "error: sphere 7 is nowhere; put it somewhere\n", [])
    code, _, said, left = probe("seed=13")
    assert (code, left) == (FAILED, [])
    assert "Traceback" in said
    assert "KeyError: 'a bug'" in said


def test_a_stop_says_how_to_go_on(probe):
    assert probe("seed=15")[::2] == (128 + 15, "stopped by SIGTERM; the same command goes on from here\n")


@pytest.mark.slow
@pytest.mark.parametrize("launcher", ["basic", "local"])
def test_in_a_multirun_a_failed_job_is_seen_and_stops_no_other(probe, launcher):
    code, out, said, left = probe("-m", "+experiment=smoke", "seed=1,7,2", f"hydra/launcher={launcher}")
    assert code == FAILED
    assert "ran smoke+seed-1 contact" in out
    assert "ran smoke+seed-2 contact" in out
    assert "seed=7): sphere 7 is nowhere" in said
    assert said.rstrip().endswith("at least one job of the multirun failed; its message is above")
    assert left == ["results/multirun/multirun.yaml"]


def test_the_commands_explain_themselves(probe):
    code, out, said, left = probe("--help")
    assert (code, said, left) == (0, "", [])
    models = "model: ccnn, ccnn_antisymmetric, contact, emulator, gns, gns_large, lu2021, radial, xu_shen2022"
    for word in ("+experiment=holdout30rpm", models, "scene: drum, drum_high,", "Exit code"):
        assert word in out
    code, out, said, left = probe("--cfg", "job", "+experiment=paper")
    assert (code, said, left) == (0, "", [])
    assert "learning_rate: 0.0001" in out


@pytest.mark.parametrize("entry", ["train", "generate"])
def test_the_help_names_every_choice_that_there_is(entry, tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", f"gran_bench.{entry}", "--help"],
        cwd=tmp_path, capture_output=True, text=True, timeout=60, check=True,
    )  # fmt: skip
    for group in {"train": ["model", "loss", "optim", "experiment"], "generate": ["scene", "dem", "dataset"]}[entry]:
        choices = sorted(path.stem for path in (CONF / group).glob("*.yaml"))
        assert f"{group}: {', '.join(choices)}" in done.stdout


def test_a_multirun_that_is_asked_for_by_hydras_mode_is_one(probe):
    code, out, said, _ = probe("hydra.mode=MULTIRUN", "seed=1,2")
    assert (code, said) == (0, "")
    assert "ran default+seed-1 contact" in out
    assert "ran default+seed-2 contact" in out


# ---- parts -----------------------------------------------------------------------------------------------


def jobs_of(*overrides: str, multirun: bool = True) -> list[list[str]]:
    return [job for job, _ in described_jobs(Source("train"), overrides, multirun).jobs]


def test_every_job_of_a_sweep_is_known_before_any_starts():
    assert jobs_of("seed=1,2", "model=ccnn,radial", "threads=1") == [
        ["seed=1", "model=ccnn", "threads=1"],
        ["seed=1", "model=radial", "threads=1"],
        ["seed=2", "model=ccnn", "threads=1"],
        ["seed=2", "model=radial", "threads=1"],
    ]
    assert jobs_of("seed=1", multirun=False) == [["seed=1"]]


def test_a_recipe_holds_its_axes_and_the_command_line_takes_their_place():
    jobs = jobs_of("+experiment=sweep_radius")
    assert len({job[0] for job in jobs}) == 6
    assert all("+experiment=sweep_radius" in job for job in jobs)
    assert jobs_of("+experiment=sweep_radius", "model.radius_diameters=1.8", "seed=4,5") == [
        ["model.radius_diameters=1.8", "seed=4", "+experiment=sweep_radius"],
        ["model.radius_diameters=1.8", "seed=5", "+experiment=sweep_radius"],
    ]
    with pytest.raises(ConfigError, match=r"sweep over model\.radius_diameters.*add -m"):
        jobs_of("+experiment=sweep_radius", multirun=False)


def test_what_a_command_changes_is_its_choices_without_places_and_the_recipes_name():
    lines = [
        "+experiment=smoke",
        "seed=1",
        "tracking.root=/else",
        "hydra/launcher=local",
        "+scene.wall_material.friction=1",
    ]
    assert changed_in(lines) == ["scene.wall_material.friction=1", "seed=1"]


@pytest.mark.parametrize(
    ("overrides", "folder"),
    [
        ([], "smoke"),
        (["+experiment=smoke"], "smoke"),
        (["seed=1", "model=ccnn"], "smoke+model-ccnn+seed-1"),
        (["model=ccnn", "seed=1"], "smoke+model-ccnn+seed-1"),
        (["tracking.root=/else", "dataset.root=x", "hydra/launcher=local", "trainer.minutes=3"], "smoke"),
        (["judge=quick", "judge.gif=false", "tracking.sweep=x", "dataset.unseen_packing_seed=2"], "smoke"),
        (["threads=1"], "smoke+threads-1"),
        (["++experimental=1"], "smoke+experimental-1"),
        (
            ["dataset=small", "+scene.wall_material.friction=0.1"],
            "smoke+dataset-small+scene.wall_material.friction-0.1",
        ),
        (["scene.name='../..'"], "smoke+scene.name-_.._.._"),
    ],
)
def test_a_run_folder_is_named_after_what_was_changed(overrides, folder):
    assert run_folder("smoke", overrides) == folder


def test_every_key_that_is_swept_is_a_choice_and_in_the_name_and_what_is_fixed_is_named_as_ever():
    jobs = jobs_of("+experiment=smoke", "trainer.budget=time", "trainer.minutes=1,4", "dataset.root=x", "seed=0")
    swept = swept_keys(jobs)
    assert swept == {"trainer.minutes"}
    names = [run_folder("smoke", job, swept) for job in jobs]
    assert names == [f"smoke+seed-0+trainer.budget-time+trainer.minutes-{minutes}" for minutes in (1, 4)]
    assert changed_in(jobs[1], swept) == ["seed=0", "trainer.budget=time", "trainer.minutes=4"]
    recipes = swept_keys(jobs_of("+experiment=smoke,holdout30rpm"))
    assert changed_in(["+experiment=smoke"], recipes) == ["experiment=smoke"]
    assert run_folder("smoke", ["+experiment=smoke"], recipes) == "smoke"


@pytest.mark.parametrize("name", ["sweep_loss", "sweep_rollout"])
def test_runs_of_the_shipped_sweeps_keep_their_names(name):
    jobs = jobs_of(f"+experiment={name}")
    names = {run_folder(name, job, swept_keys(jobs)) for job in jobs}
    committed = [job["run"] for job in json.loads((RESULTS / name / "sweep.json").read_text("utf-8"))["jobs"]]
    assert set(committed) <= names
    assert len(names) == len(jobs)


@pytest.mark.parametrize(
    ("swept", "told"),
    [
        ("trainer.minutes=1,4", "trainer.minutes=1 and trainer.minutes=4: two jobs"),
        ("judge.speeds_rpm=[30],[30,40]", "gran_bench.evaluate judges a model again"),
        ("seed=3,3", "give each value once"),
    ],
)
def test_two_jobs_that_would_train_the_same_weights_are_refused_before_any_work(
    monkeypatch, capsys, tmp_path, swept, told
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(os.environ, "HYDRA_FULL_ERROR", "1")
    monkeypatch.setattr(sys, "argv", ["probe", "-m", "+experiment=smoke", swept])
    with pytest.raises(SystemExit) as ending:
        run(
            lambda config: pytest.fail("the task ran"),
            "train",
            TrainConfig,
            sweep="gran_bench.sweep.opening:open_sweep",
        )
    assert ending.value.code == REFUSED
    assert told in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_recipes_that_are_sweeps_are_not_swept_over():
    with pytest.raises(
        ConfigError, match=r"experiment=sweep_\w+ is itself a sweep over .*; give each a command of its own"
    ):
        described_jobs(Source("train"), ["+experiment=smoke,sweep_radius"], multirun=True)


def test_long_commands_keep_a_folder_of_their_own():
    speeds = ",".join(str(speed) for speed in range(100))
    first, second = (run_folder("x", [f"dataset.training_speeds_rpm=[{speeds}]", f"seed={i}"]) for i in range(2))
    assert first != second
    assert max(len(first), len(second)) <= 150


@pytest.mark.parametrize(
    ("error", "code"),
    [(ConfigError("a"), REFUSED), (SceneError("a"), REFUSED), (StateError("a"), FAILED), (KeyError("a"), FAILED)],
)
def test_the_exit_code_tells_a_refused_config_from_a_failed_run(error, code):
    assert complain(error, TrainConfig) == code


@pytest.mark.parametrize(
    ("entry", "typed", "meant"), [("train", "sede", "seed"), ("generate", "scen", "scene"), ("ui", "prot", "port")]
)
def test_the_entries_refuse_before_they_load_anything_heavy(entry, typed, meant, tmp_path: Path):
    done = subprocess.run(
        [sys.executable, "-X", "importtime", "-m", f"gran_bench.{entry}", f"+{typed}=1"],
        cwd=tmp_path, capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    lines = [line for line in done.stderr.splitlines() if not line.startswith("import time:")]
    assert (done.returncode, lines) == (REFUSED, [f"error: {typed}=1: no such key; did you mean {meant}?"])
    assert not {"torch", "numba", "mlflow"} & {line.rpartition("|")[2].strip() for line in done.stderr.splitlines()}
    assert list(tmp_path.iterdir()) == []
