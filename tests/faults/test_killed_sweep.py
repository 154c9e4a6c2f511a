"""``kill -9`` of a sweep, as a whole and in one job: the same command ends as if nothing had happened."""

from __future__ import annotations

import os
import re
import signal
import time
from pathlib import Path

import numpy as np
from sweeps import (
    PATIENCE,
    SWEEP,
    finish,
    finished_work,
    group,
    kill_at,
    records_of,
    results_of,
    statuses,
    stored,
    sweep_command,
)

from gran_bench.sweep.runs import read_runs

JOBS = 4


def test_a_sweep_killed_again_and_again_ends_as_an_undisturbed_one(place: Path, tmp_path: Path):
    calm, hunted = tmp_path / "undisturbed", tmp_path / "killed"
    command = sweep_command(place / "data", JOBS)
    began = time.monotonic()
    finish(command, calm)
    # A life between two kills: the start, and a job beside another one.
    life = (time.monotonic() - began) / (1.0 + 0.5 * JOBS) * 2.0
    rng, seen = np.random.default_rng(0), {}
    for done in (0, 1, 2):
        kill_at(command, hunted, done, float(rng.random()) * life)
        seen = finished_work(hunted) | seen  # as each was when it was first seen
    finish(command, hunted)
    now = finished_work(hunted)
    assert seen
    assert {name: now.get(name) for name in seen} == seen, "what was finished was done again"
    assert len(results_of(hunted)) == JOBS
    assert results_of(hunted) == results_of(calm)
    assert records_of(hunted) == records_of(calm)
    children = {name: found for name, found in stored(hunted / "results").items() if name != SWEEP}
    assert stored(hunted / "results")[SWEEP] == ("FINISHED", None)
    assert list(children.values()) == [("FINISHED", SWEEP)] * JOBS


def test_a_job_that_the_system_kills_fails_alone_and_the_same_command_finishes_it(place: Path, tmp_path: Path):
    folder = tmp_path / "one job"
    command = [*sweep_command(place / "data", jobs=2), "trainer.steps=25"]
    with group(command, folder) as process:
        patience = time.monotonic() + PATIENCE
        while not (found := _process_of_first_job(folder)):
            assert process.poll() is None, (folder / "said.txt").read_text()
            assert time.monotonic() < patience
            time.sleep(0.005)
        os.kill(found, signal.SIGKILL)
        assert process.wait(PATIENCE) == 1
    assert statuses(folder / "results") == ["FAILED", "FINISHED"]
    assert stored(folder / "results")["kills"] == ("FAILED", None)
    killed, other = read_runs(folder / "results" / "sweeps" / "kills")
    assert (killed.status, other.status) == ("failed", "finished")
    assert "signal 9" in killed.reason
    assert f"{killed.reason} (log: `{killed.facts['log']}`)" in (folder / "said.txt").read_text()
    finish(command, folder)
    assert statuses(folder / "results") == ["FINISHED", "FINISHED"]
    assert stored(folder / "results")["kills"] == ("FINISHED", None)


def _process_of_first_job(folder: Path) -> int | None:
    """Id of the first job's process, once it has its log."""
    for log in folder.glob("results/sweeps/kills/logs/*radius_m-0.06+*.log"):
        if found := re.search(r"^---- \S+  process (\d+)  ", log.read_text("utf-8")):
            return int(found[1])
    return None
