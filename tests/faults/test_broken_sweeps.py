"""A sweep without its store, without disk, or with records from elsewhere: nothing that is finished is lost."""

from __future__ import annotations

import shutil
import sqlite3
from dataclasses import replace
from pathlib import Path

import pytest
from omegaconf import DictConfig
from sweeps import statuses, stored, sweep_command

from gran_bench.compose import Source, changed_in, checked_config, described_jobs
from gran_bench.config import TrainConfig
from gran_bench.config.override_errors import explain
from gran_bench.run import experiment
from gran_bench.sweep.opening import open_sweep
from gran_bench.sweep.runs import SweepJob, read_runs
from gran_bench.sweep.task import Sweep, Task
from gran_bench.tracking import TrackingError


def described(place: Path, root: Path, *more: str) -> list[tuple[list[str], DictConfig]]:
    """The two jobs of a quick sweep, as its command line says them."""
    lines = [line for line in sweep_command(place / "data", jobs=2)[5:] if not line.startswith("hydra/")]
    lines += [f"tracking.root={root}", "trainer.steps=3", *more]
    return described_jobs(Source("train"), [*lines, "+experiment=smoke"], multirun=True).jobs


def planned(place: Path, root: Path, *more: str) -> list[SweepJob]:
    """The two jobs of a quick sweep."""
    jobs = []
    for overrides, composed in described(place, root, *more):
        config = checked_config(composed, TrainConfig)
        radius = next(line.partition("=")[2] for line in overrides if line.startswith("model.radius_m"))
        config.tracking.folder = f"R{radius}"
        choices = dict(line.partition("=")[::2] for line in changed_in(overrides))
        jobs.append(SweepJob(f"R{radius}", choices, config.seed, config=config))
    return jobs


def do(sweep: Sweep, jobs: list[SweepJob], number: int) -> None:
    """What a job of the sweep does, but for its log."""
    if number not in sweep.done:
        jobs[number].config.tracking.parent = sweep.parent
        sweep.log(number).parent.mkdir(parents=True, exist_ok=True)
        try:
            experiment.run_experiment(jobs[number].config)
        except Exception as error:
            sweep.log(number).write_text(f"error: {explain(error, TrainConfig)}\n")
            raise


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the figures of a run."""
    monkeypatch.setattr(experiment, "draw_evaluation", lambda *arguments: [])


@pytest.mark.usefixtures("quick")
def test_a_store_that_vanishes_is_told_and_the_same_command_records_all_again(place: Path, tmp_path: Path):
    root = tmp_path / "results"
    jobs = planned(place, root)

    def first_life() -> None:
        with open_sweep(jobs, "kills") as sweep:
            assert statuses(root) == ["SCHEDULED", "SCHEDULED"]
            do(sweep, jobs, 0)
            assert statuses(root) == ["FINISHED", "SCHEDULED"]
            (root / "mlflow.db").unlink()
            do(sweep, jobs, 1)

    with pytest.raises(TrackingError, match=r"mlflow\.db does not answer: the file is gone or was replaced"):
        first_life()
    summaries = sorted(root.glob("runs/*/summary.json"))
    times = [path.stat().st_mtime_ns for path in summaries]
    assert len(times) == 2
    jobs = planned(place, root)
    with open_sweep(jobs, "kills") as sweep:
        assert len(sweep.done) == 2
    assert statuses(root) == ["FINISHED", "FINISHED"]
    assert stored(root)["kills"] == ("FINISHED", None)
    assert [path.stat().st_mtime_ns for path in summaries] == times
    with sqlite3.connect(root / "mlflow.db") as store:
        keys = {row[0] for row in store.execute("select distinct key from latest_metrics")}
    assert {"training/loss", "shared/error/speed_w1", "sweep/runs finished"} <= keys


def test_a_run_is_finished_in_the_table_though_the_store_failed_at_its_end(place: Path, tmp_path: Path, monkeypatch):
    root = tmp_path / "results"
    # Among the last things that a run does.
    monkeypatch.setattr(experiment, "draw_evaluation", lambda *arguments: (root / "mlflow.db").unlink() or [])
    overrides, _ = described(place, root)[0]

    def first_life() -> None:
        with open_sweep(planned(place, root), "kills") as sweep:
            task = Task(experiment.run_experiment, Source("train"), TrainConfig, ["python"], sweep)
            assert not task.apart(overrides, 0)  # the exit code says that something went wrong

    with pytest.raises(TrackingError):
        first_life()
    assert [(run.run, run.status) for run in read_runs(root / "sweeps" / "kills")] == [("R0.06", "finished")]
    with open_sweep(planned(place, root), "kills") as sweep:
        assert list(sweep.done) == [0]
    assert statuses(root) == ["FINISHED", "SCHEDULED"]


@pytest.mark.usefixtures("quick")
def test_a_job_of_another_machine_leaves_files_that_its_sweep_records_and_refuses_other_source(
    place: Path, tmp_path: Path, capsys: pytest.CaptureFixture
):
    root = tmp_path / "results"
    (first, _), (second, _) = described(place, root)
    with open_sweep(planned(place, root), "kills", elsewhere=True) as sweep:
        task = Task(experiment.run_experiment, Source("train"), TrainConfig, ["python"], sweep)
        assert task.apart(first, 0)
        assert statuses(root) == ["SCHEDULED", "SCHEDULED"]
        assert task.recorded(0)
        assert statuses(root) == ["FINISHED", "SCHEDULED"]
        edited = tuple(replace(job, key=f"{job.key}-edited") for job in sweep.jobs)
        assert not replace(task, sweep=replace(sweep, jobs=edited)).apart(second, 1)
        assert "source or data of this machine are not what the sweep began with" in capsys.readouterr().err
        assert len(list(root.glob("runs/*"))) == 1
    with sqlite3.connect(root / "mlflow.db") as store:
        keys = {row[0] for row in store.execute("select distinct key from metrics")}
    assert {"training/loss", "shared/error/speed_w1"} <= keys


@pytest.mark.usefixtures("quick")
def test_a_run_that_a_single_command_finished_is_found_under_its_other_name(place: Path, tmp_path: Path):
    root = tmp_path / "results"
    alone = planned(place, root)[0].config
    alone.tracking.folder = "alone"
    experiment.run_experiment(alone)
    with open_sweep(planned(place, root), "kills") as sweep:
        assert list(sweep.done) == [0]
        assert "runs/alone-" in sweep.done[0]
    assert [path.name[:6] for path in (root / "runs").iterdir()] == ["alone-"]
    # It hangs under the sweep by now, finished.
    found = {name.partition("-")[0]: status for name, (status, parent) in stored(root).items() if parent == "kills"}
    assert found == {"alone": "FINISHED", "R0.065": "SCHEDULED"}


@pytest.mark.usefixtures("quick")
def test_a_full_disk_is_one_clear_line_and_what_was_finished_stays(full_at, place: Path, tmp_path: Path):
    root = tmp_path / "results"
    jobs = planned(place, root, "tracking.enabled=false")
    with open_sweep(jobs, "full") as sweep:
        do(sweep, jobs, 0)
        # From here on no file may be larger than a model, as where a disk has little left: a rollout is.
        with full_at(150_000), pytest.raises(OSError, match="File too large") as full:
            do(sweep, jobs, 1)
        message = explain(full.value, TrainConfig)
        assert message.startswith("the disk takes no more")
        assert "free space, and the same command goes on" in message
    trained = next(root.glob("runs/R0.065-*/training.json"))
    before = trained.stat().st_mtime_ns
    assert not list(root.rglob("*.tmp"))
    page = (root / "sweeps" / "kills" / "README.md").read_text("utf-8")
    assert "1 runs finished, 1 failed" in page
    assert "the disk takes no more" in page
    jobs = planned(place, root, "tracking.enabled=false")
    with open_sweep(jobs, "full") as sweep:
        assert list(sweep.done) == [0]
        do(sweep, jobs, 1)
    assert trained.stat().st_mtime_ns == before
    assert "2 runs finished, 0 failed" in (root / "sweeps" / "kills" / "README.md").read_text("utf-8")


@pytest.mark.usefixtures("quick")
def test_a_run_that_any_sweep_has_recorded_is_not_done_again_and_the_store_learns_it(place: Path, tmp_path: Path):
    here, there = tmp_path / "here", tmp_path / "there"
    jobs = planned(place, here, "tracking.enabled=false")
    with open_sweep(jobs, "mine") as sweep:
        do(sweep, jobs, 0)
    # Another machine has the committed table, and nothing else.
    (there / "sweeps" / "committed").mkdir(parents=True)
    shutil.copy(here / "sweeps" / "kills" / "runs.csv", there / "sweeps" / "committed")
    jobs = planned(place, there)
    with open_sweep(jobs, "mine") as sweep:
        assert list(sweep.done) == [0]
        assert "its row is in" in sweep.done[0]
    assert not list(there.glob("runs/R0.06-*"))
    assert statuses(there) == ["FINISHED", "SCHEDULED"]
    assert [run.run for run in read_runs(there / "sweeps" / "kills")] == ["R0.06"]
    with sqlite3.connect(there / "mlflow.db") as store:
        keys = {row[0] for row in store.execute("select key from latest_metrics")}
        tags = dict(store.execute("select key, value from tags where key in ('commit', 'folder', 'recorded_again_by')"))
    assert "headline/speed W1 m per s" in keys
    # Where the run was made, not where it was recorded again.
    (kept,) = read_runs(there / "sweeps" / "kills")
    assert kept.facts["copied_from"] == "committed, R0.06"
    assert tags["commit"] == kept.facts["commit"]
    assert "made elsewhere" in tags["folder"]


@pytest.mark.usefixtures("quick")
def test_a_job_whose_data_cannot_be_made_stops_no_other(place: Path, tmp_path: Path):
    (tmp_path / "no folder").write_text("a file where data should go")
    jobs = planned(place, tmp_path / "results", "tracking.enabled=false")
    jobs[1].config.dataset.root = str(tmp_path / "no folder")
    with open_sweep(jobs, "mine") as sweep:
        assert sweep.jobs[1].key == ""
        do(sweep, jobs, 0)
        with pytest.raises(Exception, match=r"cannot be made|could not be made"):
            do(sweep, jobs, 1)
    runs = read_runs(tmp_path / "results" / "sweeps" / "kills")
    assert [(run.run, run.status) for run in runs] == [("R0.06", "finished"), ("R0.065", "failed")]
