"""Killed at any moment, the same command goes on and ends with the same numbers as if nothing had happened."""

import json
import os
import signal
import sqlite3
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
import victim
from overrides import override

# A short scene and few updates: what is tested is the way, not the result.
COMMAND = [
    sys.executable,
    "-m",
    "gran_bench.train",
    "+experiment=smoke",
    "scene.end_time=2.2",
    "trainer.steps=60",
    "trainer.checkpoint_steps=4",
    "judge.short_horizon_starts=3",
    "tracking.folder=resume",
]
ENVIRONMENT = os.environ | {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
PATIENCE = 240.0  # s, of a test that would otherwise wait for ever


def start(folder: Path, *changes: str) -> subprocess.Popen:
    folder.mkdir(exist_ok=True)
    return subprocess.Popen(
        [*COMMAND, *changes], cwd=folder, env=ENVIRONMENT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )


def finish(folder: Path, *changes: str) -> str:
    process = start(folder, *changes)
    output, _ = process.communicate(timeout=PATIENCE)
    assert process.returncode == 0, output
    return output


def stop_when(folder: Path, pattern: str, how: signal.Signals, *changes: str) -> int:
    """Start the command, send it a signal as soon as a file of that pattern is there; returns its exit code."""
    process, patience = start(folder, *changes), time.monotonic() + PATIENCE
    while not list(folder.glob(pattern)):
        assert process.poll() is None, f"ended before {pattern} was there: {process.communicate()[0]}"
        assert time.monotonic() < patience, f"{pattern} never came"
        time.sleep(0.005)
    process.send_signal(how)
    process.communicate(timeout=PATIENCE)
    return process.returncode


def run_of(folder: Path, name: str = "resume") -> Path:
    (summary,) = folder.glob(f"results/runs/{name}-*/summary.json")
    return summary.parent


# What the clock and the checkout decide.
ELSEWHERE = {"wall_seconds", "provenance", "command", "commit", "day", "model_sha256"}


def numbers(folder: Path) -> dict:
    """The summary without what depends on the clock and the checkout."""

    def kept(value):
        if not isinstance(value, dict):
            return value
        return {
            name: kept(entry)
            for name, entry in value.items()
            if name not in ELSEWHERE and "seconds" not in name and "ms_per_frame" not in name
        }

    return kept(json.loads((run_of(folder) / "summary.json").read_text()))


def weights(folder: Path, name: str = "resume") -> dict:
    return torch.load(run_of(folder, name) / "model.pt", weights_only=True)["weights"]


def statuses(folder: Path) -> list[str]:
    with sqlite3.connect(folder / "results" / "mlflow.db") as store:
        return [row[0] for row in store.execute("select status from runs")]


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("undisturbed")
    finish(folder)
    return folder


def test_kill_9_during_data_training_and_rollout_changes_no_number(undisturbed, tmp_path):
    folder = tmp_path / "killed"
    for pattern in (
        "data/settled/*.h5",  # the cases are being made
        "results/runs/*/checkpoint.pt",  # in training
        "results/runs/*/training.json",  # between training and judging
        "results/runs/*/rollouts/*.npz",  # one rollout is done, another is not
    ):
        assert stop_when(folder, pattern, signal.SIGKILL) == -signal.SIGKILL
    finish(folder)
    ours, theirs = weights(folder), weights(undisturbed)
    assert all(torch.equal(ours[name], theirs[name]) for name in theirs)
    assert numbers(folder) == numbers(undisturbed)
    assert statuses(folder) == ["FINISHED"]  # one run, reopened, not four


def test_kill_9_at_random_moments_of_a_training_changes_no_weight(tmp_path):
    calm, wild, hits, resumed = tmp_path / "calm", tmp_path / "wild", 0, 0
    began = time.monotonic()
    victim.finish(victim.start("training", root=str(tmp_path / "data"), folder=str(calm)))
    whole = time.monotonic() - began
    rng, saved = np.random.default_rng(0), wild / "checkpoint.pt"
    for kill in range(4):
        # Of the start too, so that an update, a save and the opening are all hit.
        process = victim.launch("training", root=str(tmp_path / "data"), folder=str(wild))
        while kill >= 2 and process.poll() is None and not saved.exists():
            time.sleep(0.01)
        hits += victim.kill_after(process, rng.uniform(0.02, 0.2) * whole)
        resumed += saved.exists()
    victim.finish(victim.start("training", root=str(tmp_path / "data"), folder=str(wild)))
    mine, theirs = (torch.load(folder / "final.pt", weights_only=True) for folder in (wild, calm))
    assert hits >= 3
    assert resumed > 0
    assert all(torch.equal(mine[name], theirs[name]) for name in theirs)


def test_sigterm_leaves_a_resumable_state_and_a_killed_run(undisturbed, tmp_path):
    folder = tmp_path / "stopped"
    code = stop_when(folder, "results/runs/*/checkpoint.pt", signal.SIGTERM)
    assert code == 128 + signal.SIGTERM
    assert statuses(folder) == ["KILLED"]
    finish(folder)
    assert statuses(folder) == ["FINISHED"]
    assert numbers(folder) == numbers(undisturbed)


def test_a_finished_command_prints_its_summary_again(undisturbed):
    before = (run_of(undisturbed) / "summary.json").stat().st_mtime_ns
    output = finish(undisturbed)
    assert "finished before" in output
    assert "held out" in output
    assert (run_of(undisturbed) / "summary.json").stat().st_mtime_ns == before


def test_kill_9_of_a_run_that_goes_on_and_of_one_that_starts_from_its_weights_changes_no_weight(tmp_path):
    steady = ["optim.schedule=constant", "rollout.final_frames=null", "judge.speeds_rpm=[40]"]
    steady.append(override("dataset.root", tmp_path / "data"))
    half, whole = (*steady, "trainer.steps=30", "tracking.folder=half"), (*steady, "tracking.folder=whole")
    tuned = (*steady, "trainer.steps=20", "dataset.training_speeds_rpm=[50]", "tracking.folder=tuned")
    there, calm = tmp_path / "there", tmp_path / "calm"
    finish(there, *half)
    parent = run_of(there, "half").name
    tuned = (*tuned, f"trainer.start_from={there / 'results' / 'runs' / parent}")
    assert stop_when(there, "results/runs/whole-*/checkpoint.pt", signal.SIGKILL, *whole) == -signal.SIGKILL
    assert stop_when(there, "results/runs/tuned-*/checkpoint.pt", signal.SIGKILL, *tuned) == -signal.SIGKILL
    for name, command in (("whole", whole), ("tuned", tuned)):
        finish(there, *command)
        finish(calm, *command)
        ours, theirs = weights(there, name), weights(calm, name)
        assert all(torch.equal(ours[key], theirs[key]) for key in theirs)
        assert run_of(there, name).name == run_of(calm, name).name
        training = json.loads((run_of(there, name) / "training.json").read_text())
        assert training["parent_run"] == parent
    assert "parent_run" not in json.loads((run_of(calm, "whole") / "training.json").read_text())
