"""The experiments that kill: they see a run that is done twice, and nothing that they started outlives them."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import pytest

import gran_bench
from gran_bench.processes import group
from gran_bench.stress import kills, sweep_kill
from gran_bench.stress.experiment import Bench
from gran_bench.stress.finished_files import done_again, finished_files, records_of
from gran_bench.sweep.runs import SweepRun

PATIENCE = 20.0  # s


def finish_run(results: Path, name: str, **said) -> Path:
    """Leave what a finished run leaves, as small files; its folder."""
    folder = results / "runs" / name
    folder.mkdir(parents=True)
    (folder / "summary.json").write_text("{}")
    (folder / "model.pt").write_bytes(b"weights")
    SweepRun(name, "0123456789", "judge", "finished", {"seed": "0"}, 0, **said).write(results / "sweeps" / "kills")
    return folder


# ---- runs that are done twice --------------------------------------------------------------------------------


def test_finished_files_that_stay_as_they_were_are_not_told(tmp_path):
    finish_run(tmp_path, "radius-0.06")
    before = finished_files(tmp_path)
    assert {path.name for path in before} == {"summary.json", "model.pt"}
    finish_run(tmp_path, "radius-0.07")  # finished later: nothing was done again
    assert done_again(before, finished_files(tmp_path)) == []


def test_a_run_that_is_done_again_is_named_though_it_ends_with_the_same_bytes(tmp_path):
    folder = finish_run(tmp_path, "radius-0.06")
    finish_run(tmp_path, "radius-0.07")
    before = finished_files(tmp_path)
    weights = folder / "model.pt"
    os.utime(weights, ns=(0, weights.stat().st_mtime_ns + 1))
    told = "radius-0.06: model.pt was finished and is written again, with the same content"
    assert done_again(before, finished_files(tmp_path)) == [told]
    weights.write_bytes(b"others")
    assert done_again(before, finished_files(tmp_path)) == ["radius-0.06: model.pt was finished and has changed"]
    weights.unlink()
    (folder / "summary.json").unlink()
    assert done_again(before, finished_files(tmp_path)) == [
        "radius-0.06: summary.json was finished and is gone",
        "radius-0.06: model.pt was finished and is gone",
    ]


def test_what_a_run_that_is_not_finished_has_left_may_change(tmp_path):
    folder = finish_run(tmp_path, "radius-0.06")
    (folder / "summary.json").unlink()
    failed = SweepRun("radius-0.06", "0123456789", "judge", "failed", {}, 0, reason="killed")
    failed.write(tmp_path / "sweeps" / "kills")
    assert finished_files(tmp_path) == {}


def test_records_of_sweeps_are_compared_without_their_times(tmp_path):
    figures = {"headline/angle error deg": 1.0, "headline/rollout ms per frame": 3.0, "wall_seconds/training": 1.0}
    finish_run(tmp_path / "calm", "radius-0.06", figures=figures, facts={"hardware": "a fast one"})
    finish_run(tmp_path / "wild", "radius-0.06", figures=figures | {"wall_seconds/training": 4.0}, ended_at="later")
    calm, wild = (records_of(tmp_path / name / "sweeps" / "kills") for name in ("calm", "wild"))
    assert calm == wild
    assert calm["radius-0.06"]["figures"] == {"headline/angle error deg": 1.0}


# A sweep of four jobs that are done in no time; with a word behind it, it does finished ones again.
QUICK_SWEEP = """
    import sys, time
    from pathlib import Path
    for number in range(4):
        folder = Path("results/runs") / f"job-{number}"
        folder.mkdir(parents=True, exist_ok=True)
        if sys.argv[1:] or not (folder / "summary.json").exists():
            (folder / "model.pt").write_bytes(b"weights")
            (folder / "summary.json").write_text("{}")
        time.sleep(0.3)
"""


@pytest.mark.parametrize(("words", "passed"), [([], True), (["again"], False)])
def test_a_sweep_that_does_finished_runs_again_fails_and_says_which(tmp_path, monkeypatch, words, passed):
    (tmp_path / "quick_sweep.py").write_text(textwrap.dedent(QUICK_SWEEP), "utf-8")
    command = [sys.executable, str(tmp_path / "quick_sweep.py"), *words]
    monkeypatch.setattr(sweep_kill, "sweep_command", lambda data, jobs: command)
    monkeypatch.setattr(sweep_kill, "results_of", lambda folder: {})
    rows = [("parent", "sweep", "FINISHED", None), *((f"{n}", f"key-{n}", "FINISHED", "parent") for n in range(4))]
    monkeypatch.setattr(sweep_kill, "_stored_runs", lambda database: rows)
    # Killed once, when a job is finished: that is what this seed gives.
    result = sweep_kill.sweep_under_kills(tmp_path, jobs=4, kills=1, seed=0)
    assert (result.passed, bool(result.repeated)) == (passed, not passed)
    if not passed:
        assert "job-0: summary.json was finished and is written again, with the same content" in result.repeated
        assert result.lines()[-1].strip() == result.repeated[-1]


# ---- orphans -------------------------------------------------------------------------------------------------

# Starts, in its own group, a process that starts another; both would live for a minute.
PARENT = """
    import sys
    from pathlib import Path
    from gran_bench.processes import group
    inner = "import time; time.sleep(60)"
    outer = f"import os, subprocess, sys; p = subprocess.Popen([sys.executable, '-c', '{inner}']);" \\
        " print(os.getpid(), p.pid, flush=True); p.wait()"
    with group([sys.executable, "-c", outer], Path(sys.argv[1]), {}) as process:
        process.wait()
"""


def alive(number: int) -> bool:
    """Whether a process is there and not merely waiting to be reaped."""
    try:
        state = Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state not in "ZX"


def wait_until(true) -> None:
    began = time.monotonic()
    while not true():
        assert time.monotonic() - began < PATIENCE
        time.sleep(0.02)


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="no /proc to look for processes in")
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_a_group_ends_with_whoever_started_it(tmp_path, how):
    sources = str(Path(gran_bench.__file__).parent.parent)
    parent = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(PARENT), str(tmp_path)],
        env=os.environ | {"PYTHONPATH": sources},
        stderr=subprocess.DEVNULL,
    )
    said = tmp_path / "said.txt"
    wait_until(lambda: said.exists() and said.read_text().endswith("\n"))
    started = [int(number) for number in said.read_text().split()]
    assert all(map(alive, started))
    parent.send_signal(how)
    parent.wait(PATIENCE)
    wait_until(lambda: not any(map(alive, started)))


def test_a_command_in_a_group_gives_its_exit_code(tmp_path):
    for script, code in (("raise SystemExit(3)", 3), ("import os; os.kill(os.getpid(), 9)", 128 + 9)):
        with group([sys.executable, "-c", script], tmp_path, {"ONE": "1"}) as process:
            assert process.wait(PATIENCE) == code


def test_a_killed_sweep_that_takes_too_long_is_asked_to_end_what_it_started(tmp_path, monkeypatch):
    script = """
        import signal, sys, time
        from pathlib import Path
        def stop(*_):
            Path("asked").touch()
            sys.exit(1)
        signal.signal(signal.SIGTERM, stop)
        Path("ready").touch()
        time.sleep(60)
    """

    class Started(subprocess.Popen):
        def communicate(self, *values, **named):
            wait_until((tmp_path / "ready").exists)
            return super().communicate(*values, **named)

    (tmp_path / "slow_sweep.py").write_text(textwrap.dedent(script), "utf-8")
    monkeypatch.setattr(kills, "SWEEP", "slow_sweep")
    monkeypatch.setattr(kills.subprocess, "Popen", Started)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    with pytest.raises(subprocess.TimeoutExpired):
        kills.killed_sweep(Bench(tmp_path, tmp_path), longest=0.01)
    assert (tmp_path / "asked").exists()
