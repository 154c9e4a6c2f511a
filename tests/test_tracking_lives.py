"""One run through all its lives: how each ends, and what the next one adds, repeats and replaces."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import stored_runs
from mlflow import MlflowClient
from stored_runs import client, only_run, runs

from gran_bench.config import TrackingConfig
from gran_bench.tracking import Store, abandoned, end_child, open_run, ui, user_interface

# SQLAlchemy's word to MLflow, which a user never sees either.
pytestmark = pytest.mark.filterwarnings("ignore:The ``noload`` loader strategy")

STOPPED = "stopped: the same command goes on"
# Fixtures.
template, config = stored_runs.template, stored_runs.config


@pytest.mark.parametrize(("error", "status"), [(KeyboardInterrupt("SIGINT"), "KILLED"), (ValueError("no"), "FAILED")])
def test_the_status_says_how_a_run_ended(config: TrackingConfig, error: BaseException, status: str):
    def life() -> None:
        with open_run(config, "ends", "key", {}) as run:
            run.log_metrics({"loss": 1.0}, 7)
            raise error

    with pytest.raises(type(error)):
        life()
    found = only_run(config)
    assert found.info.status == status
    assert found.data.tags["ended_by"].startswith(type(error).__name__)
    assert found.data.tags["verdict"] == (STOPPED if status == "KILLED" else "failed: see ended_by")
    assert found.data.metrics["loss"] == 1.0


KILLED_BY_SIGNAL = """
import signal, sys, time
from gran_bench.config import TrackingConfig
from gran_bench.tracking import Store, abandoned, end_child, open_run, ui, user_interface
with open_run(TrackingConfig(experiment=sys.argv[2], root=sys.argv[1]), "killed", "key", {}) as run:
    run.log_metrics({"loss": 1.0}, 0)
    run.flush()
    print("open", flush=True)
    time.sleep(60)
"""


def killed_by(number: signal.Signals, config: TrackingConfig) -> None:
    """A process that has opened a run and is ended by a signal."""
    sources = str(Path(__file__).parents[1] / "src")
    process = subprocess.Popen(
        [sys.executable, "-c", KILLED_BY_SIGNAL, config.root, config.experiment],
        env=os.environ | {"PYTHONPATH": sources},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout.readline() == "open\n", "MLflow must not chatter"
    process.send_signal(number)
    _, complaints = process.communicate(timeout=60)
    assert "INFO" not in complaints


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_killed_run_is_marked_and_reopened(config: TrackingConfig, number: signal.Signals):
    killed_by(number, config)
    before = only_run(config)
    assert (before.info.status, before.data.tags["verdict"]) == ("KILLED", STOPPED)
    with open_run(config, "killed", "key", {}) as run:
        assert run.run_id == before.info.run_id
        assert only_run(config).info.status == "RUNNING"
    after = only_run(config)
    assert after.info.status == "FINISHED"
    assert not {"ended_by", "verdict"} & set(after.data.tags)


# ---- runs whose process is gone ------------------------------------------------------------------------------


def another_command(config: TrackingConfig) -> None:
    with open_run(config, "another", "another key", {}):
        pass


def the_ui(config: TrackingConfig) -> None:
    with pytest.MonkeyPatch.context() as patch:
        for name, value in os.environ.items():
            patch.setenv(name, value)  # so that what the UI sets is undone
        patch.setattr(user_interface, "_serve", lambda *given: None)
        ui(config.root, port=50124, experiment=config.experiment)


@pytest.mark.parametrize("opens", [another_command, the_ui])
def test_a_run_that_was_killed_outright_is_marked_by_whoever_opens_the_store_next(
    config: TrackingConfig, opens: Callable[[TrackingConfig], None], capsys: pytest.CaptureFixture
):
    killed_by(signal.SIGKILL, config)
    assert only_run(config).info.status == "RUNNING"
    opens(config)
    killed = next(run for run in runs(config) if run.info.run_name == "killed")
    assert killed.info.status == "KILLED"
    assert "its process is gone" in killed.data.tags["ended_by"]
    assert killed.data.tags["verdict"] == STOPPED
    assert "marked as KILLED, because its process is gone (killed, or the machine stopped): killed\n" in (
        capsys.readouterr().err
    )
    # The same command goes on with it as ever.
    with open_run(config, "killed", "key", {}) as run:
        assert run.run_id == killed.info.run_id
    assert client(config).get_run(run.run_id).info.status == "FINISHED"


def test_a_run_that_goes_on_is_left_alone(config: TrackingConfig, capsys: pytest.CaptureFixture):
    with open_run(config, "goes on", "key", {}) as run:
        another_command(config)
        the_ui(config)
        assert client(config).get_run(run.run_id).info.status == "RUNNING"
    assert "KILLED" not in capsys.readouterr().err


@pytest.mark.parametrize(
    ("changed", "status"),
    [
        ({"start": "1"}, "KILLED"),  # its number is another process's by now
        ({"boot": "an earlier start"}, "KILLED"),
        ({"machine": "another machine", "host": "node7", "pid": 1}, "RUNNING"),
    ],
)
def test_a_process_is_known_by_its_machine_and_its_start(
    config: TrackingConfig, changed: dict[str, object], status: str, capsys: pytest.CaptureFixture
):
    store = Store(config)
    process = json.loads(abandoned.this_process()) | changed
    run_id = store.create_run("early", "early", None, tags={abandoned.PROCESS_TAG: json.dumps(process)})
    the_ui(config)
    assert client(config).get_run(run_id).info.status == status
    told = "left as RUNNING, for only their own machines know: early (node7)" in capsys.readouterr().err
    assert told == (status == "RUNNING")


def test_a_run_that_ends_while_it_is_looked_at_stays_as_it_ended(
    config: TrackingConfig, monkeypatch: pytest.MonkeyPatch
):
    store = Store(config)
    process = json.loads(abandoned.this_process()) | {"start": "1"}
    run_id = store.create_run("quick", "quick", None, tags={abandoned.PROCESS_TAG: json.dumps(process)})
    seen = store.running()
    monkeypatch.setattr(Store, "running", lambda self: seen)
    store.client.set_terminated(run_id, "FINISHED")
    the_ui(config)
    assert store.status_of(run_id) == "FINISHED"


def test_of_a_killed_job_its_sweep_still_says_why(config: TrackingConfig):
    killed_by(signal.SIGKILL, config)
    another_command(config)
    end_child(config, "key", "its process was ended by signal 9")
    killed = next(run for run in runs(config) if run.info.run_name == "killed")
    assert (killed.info.status, killed.data.tags["ended_by"]) == ("FAILED", "its process was ended by signal 9")


def test_a_resumed_run_logs_a_repeated_step_once_and_a_changed_param_as_a_tag(config: TrackingConfig):
    def first_life() -> None:
        with open_run(config, "resumed", "key", {"minutes": 1, "seed": 0}) as run:
            for step in range(4):
                run.log_metrics({"loss": 1.0 / (step + 1)}, step)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        first_life()
    # The last checkpoint was at step 2: steps 2 and 3 are computed again, to the same values.
    with open_run(config, "resumed", "key", {"minutes": 2, "seed": 0, "new": "x"}) as run:
        for step in range(2, 6):
            run.log_metrics({"loss": 1.0 / (step + 1)}, step)
    found = only_run(config)
    assert [m.step for m in client(config).get_metric_history(found.info.run_id, "loss")] == list(range(6))
    assert found.data.params == {"minutes": "1", "seed": "0", "new": "x"}
    assert found.data.tags["resumed_with.minutes"] == "2"


def test_a_replayed_step_stays_as_it_is_and_a_lost_one_is_filled_in(
    config: TrackingConfig, monkeypatch: pytest.MonkeyPatch
):
    def rows(steps: range, pace: float) -> list[tuple[int, dict[str, float]]]:
        return [(step, {"training/loss": 1.0 / (1 + step), "training/seconds": pace * step}) for step in steps]

    with open_run(config, "killed", "key", {}) as run:
        # Steps 3 to 5 were never sent: the process was killed between two flushes.
        for step, metrics in (*rows(range(3), 1.0), *rows(range(6, 8), 1.0)):
            run.log_metrics(metrics, step)
    asked = []
    original = MlflowClient.get_metric_history

    def counted(self: MlflowClient, run_id: str, name: str, *arguments: object) -> list:
        asked.append(name)
        return original(self, run_id, name, *arguments)

    monkeypatch.setattr(MlflowClient, "get_metric_history", counted)
    with open_run(config, "killed", "key", {}) as run:
        # All rows that survived on disk, then the steps after the checkpoint anew, at another pace.
        for step, metrics in (*rows(range(5), 1.0), *rows(range(5, 10), 2.0)):
            run.log_metrics(metrics, step)
            if step % 3 == 0:
                run.flush()
        run.log_metrics({"training/loss": 0.0}, 9)  # within one life, too, a step is logged once
    assert sorted(asked) == ["training/loss", "training/seconds"]
    store, run_id = client(config), only_run(config).info.run_id
    loss, seconds = (
        {m.step: m.value for m in original(store, run_id, f"training/{name}")} for name in ("loss", "seconds")
    )
    assert len(original(store, run_id, "training/seconds")) == len(original(store, run_id, "training/loss")) == 10
    assert loss == pytest.approx({step: 1.0 / (1 + step) for step in range(10)})
    assert seconds == {step: (1.0 if step in (0, 1, 2, 3, 4, 6, 7) else 2.0) * step for step in range(10)}


def test_figures_found_anew_take_the_place_of_the_old(config: TrackingConfig):
    for angle in (30.0, 31.0, 31.0, 30.0):
        with open_run(config, "judged anew", "key", {}) as run:
            run.log_metrics({"angle": angle, "nan": float("nan")}, 100, supersede=True)
        assert only_run(config).data.metrics["angle"] == angle
    store, run_id = client(config), only_run(config).info.run_id
    assert len(store.get_metric_history(run_id, "angle")) == 3
    assert len(store.get_metric_history(run_id, "nan")) == 1


def test_another_key_is_another_run(config: TrackingConfig):
    for key in ("one", "two", "one"):
        with open_run(config, key, key, {}):
            pass
    assert sorted(run.info.run_name for run in runs(config)) == ["one", "two"]


def test_a_status_that_does_not_exist_is_refused(config: TrackingConfig):
    with open_run(config, "status", "key", {}) as run, pytest.raises(ValueError, match="status='DONE'"):
        run.finish("DONE")
