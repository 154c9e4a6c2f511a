"""A sweep in the store: its runs wait under one parent, stay there, and are closed by it where they could not."""

from __future__ import annotations

from pathlib import Path

import pytest
import stored_runs
from stored_runs import client, runs

from gran_bench.config import TrackingConfig
from gran_bench.tracking import Child, end_child, open_run, reopen_ended, schedule_children

# SQLAlchemy's word to MLflow, which a user never sees either.
pytestmark = pytest.mark.filterwarnings("ignore:The ``noload`` loader strategy")

# Fixtures.
template, config = stored_runs.template, stored_runs.config


def sweep_parent(config: TrackingConfig) -> str:
    axes, tags = {"sweep": {"model.radius": "1,2"}}, {"sweep": "sweep_radius"}
    with open_run(config, "sweep_radius", "sweep", axes, tags) as run:
        return run.run_id


def test_a_sweeps_runs_wait_under_its_parent_before_their_jobs_start(config: TrackingConfig):
    parent = sweep_parent(config)
    children = [Child("R1", "one"), Child("R2", "two"), Child("R3", "three", finished=True)]
    # The third was done before, by a store that is gone.
    assert schedule_children(config, parent, children) == {"three"}
    waiting = {run.info.run_name: run for run in runs(config) if run.info.run_id != parent}
    assert {run.info.status for run in waiting.values()} == {"SCHEDULED"}
    assert {run.data.tags["mlflow.parentRunId"] for run in waiting.values()} == {parent}
    assert {run.data.tags["sweep"] for run in waiting.values()} == {"sweep_radius"}
    with open_run(config, "R1", "one", {}, parent=parent) as run:
        assert run.run_id == waiting["R1"].info.run_id
        assert client(config).get_run(run.run_id).info.status == "RUNNING"
    # The same command again: nothing is made twice, what is finished stays so, what was killed waits again.
    client(config).update_run(waiting["R2"].info.run_id, status="RUNNING")
    assert sweep_parent(config) == parent
    assert schedule_children(config, parent, [Child("R1", "one", finished=True), *children[1:]]) == {"three"}
    statuses = {run.info.run_name: run.info.status for run in runs(config) if run.info.run_id != parent}
    assert statuses == {"R1": "FINISHED", "R2": "SCHEDULED", "R3": "SCHEDULED"}


def test_a_run_that_another_sweep_made_stays_there_and_an_orphan_is_taken_in(config: TrackingConfig):
    with open_run(config, "single", "one", {}):
        pass
    parent = sweep_parent(config)
    schedule_children(config, parent, [Child("single", "one", finished=True)])
    with open_run(config, "another sweep", "second", {}, {"sweep": "another"}) as other:
        pass
    schedule_children(config, other.run_id, [Child("single", "one", finished=True)])
    tags = {run.info.run_name: run.data.tags for run in runs(config)}
    assert (tags["single"]["mlflow.parentRunId"], tags["single"]["sweep"]) == (parent, "sweep_radius")
    client(config).delete_run(parent)
    schedule_children(config, other.run_id, [Child("single", "one", finished=True)])
    tags = {run.info.run_name: run.data.tags for run in runs(config)}
    assert (tags["single"]["mlflow.parentRunId"], tags["single"]["sweep"]) == (other.run_id, "another")


def test_a_child_that_could_not_close_itself_is_closed_with_the_reason_and_no_other(config: TrackingConfig):
    parent = sweep_parent(config)
    schedule_children(config, parent, [Child("killed", "one"), Child("done", "two")])
    with open_run(config, "done", "two", {}):
        pass
    for key in ("one", "two", "no such key"):
        end_child(config, key, "signal 9")
    found = {run.info.run_name: run for run in runs(config)}
    assert found["killed"].info.status == "FAILED"
    assert found["killed"].data.tags["ended_by"] == "signal 9"
    assert found["done"].info.status == "FINISHED"
    with open_run(config, "killed", "one", {}):
        pass
    killed = next(run for run in runs(config) if run.info.run_name == "killed")
    assert killed.info.status == "FINISHED"
    assert "ended_by" not in killed.data.tags


def test_a_run_that_has_ended_takes_a_later_report_and_keeps_its_status(config: TrackingConfig, tmp_path: Path):
    parent = sweep_parent(config)
    with reopen_ended(config, "sweep") as run:
        run.log_metrics({"best/angle": 1.5}, supersede=True)
    with reopen_ended(config, "no such key") as run:
        assert run is None
    found = client(config).get_run(parent)
    assert found.info.status == "FINISHED"
    assert found.data.metrics["best/angle"] == 1.5
