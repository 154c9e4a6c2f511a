"""A sweep in the store: its runs wait under one parent, stay there, and are closed by it where they could not."""

from __future__ import annotations

from pathlib import Path

import pytest
import stored_runs
from mlflow.entities import Run as StoredRun
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


def under(config: TrackingConfig, parent: str) -> dict[str, StoredRun]:
    """The children of a parent, by name."""
    return {run.info.run_name: run for run in runs(config) if run.data.tags.get("mlflow.parentRunId") == parent}


def test_a_run_that_two_sweeps_share_stays_with_the_first_and_its_tag_names_both(config: TrackingConfig):
    first = sweep_parent(config)
    schedule_children(config, first, [Child("R1", "one"), Child("R2", "two")])
    with open_run(config, "boundary", "second", {}, {"sweep": "boundary"}) as second:
        pass
    for parent in (second.run_id, second.run_id, first):  # the same commands again change nothing
        schedule_children(config, parent, [Child("R1", "one")])
    schedule_children(config, second.run_id, [Child("R3", "three")])
    assert set(under(config, first)) == {"R1", "R2"}
    assert set(under(config, second.run_id)) == {"R3"}
    # As README says it.
    experiment, both = runs(config)[0].info.experiment_id, "tags.sweep LIKE '%boundary%'"
    found = {run.info.run_name: run.data.tags["sweep"] for run in client(config).search_runs([experiment], both)}
    assert found == {"R1": "sweep_radius, boundary", "R3": "boundary", "boundary": "boundary"}


def test_an_orphan_is_taken_in(config: TrackingConfig):
    with open_run(config, "single", "one", {}):
        pass
    first, child = sweep_parent(config), Child("single", "one", finished=True)
    schedule_children(config, first, [child])
    assert set(under(config, first)) == {"single"}
    with open_run(config, "another sweep", "second", {}, {"sweep": "another"}) as other:
        pass
    client(config).delete_run(first)
    schedule_children(config, other.run_id, [child])
    (name, run), *more = under(config, other.run_id).items()
    assert (name, run.data.tags["sweep"], more) == ("single", "sweep_radius, another", [])
    assert run.data.tags["gran_bench.key"] == "one"


def test_a_sweeps_own_row_keeps_the_name_of_its_recipe(config: TrackingConfig):
    for name in ("sweep_radius+trainer-quick", "sweep_loss+trainer-quick"):
        with open_run(config, name, name, {}, {"sweep": name}):
            pass
    assert {run.info.run_name for run in runs(config)} == {"sweep_radius+trainer-quick", "sweep_loss+trainer-quick"}


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
