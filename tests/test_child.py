"""Processes that are started end with whoever started them; a program that is missing is said before any work."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
from pathlib import Path

import psutil
import pytest

from gran_bench.processes import MissingProgramError, start_module, start_program

ROOT = Path(__file__).parents[1]
PARENT = """
import subprocess, sys, time
from gran_bench.processes import start_module, start_program
sleep = [sys.executable, "-c", "import time; time.sleep(300)"]
children = [start_program(sleep), start_module("gran_bench.benchmark.jobs", stdin=subprocess.PIPE)]
print(*(child.pid for child in children), flush=True)
{ending}
"""


@pytest.mark.parametrize(("ending", "kill"), [("time.sleep(300)", True), ("raise SystemExit(3)", False)])
def test_a_child_and_what_it_has_started_end_with_a_parent_that_is_killed_or_just_ends(ending, kill):
    words = [sys.executable, "-c", PARENT.format(ending=ending)]
    parent = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    with parent:
        family = [psutil.Process(int(number)) for number in parent.stdout.readline().split()]
        assert len(family) == 2
        if kill:
            family += [grandchild for child in family for grandchild in child.children()]
            parent.send_signal(signal.SIGKILL)
        assert parent.wait(30) == (-signal.SIGKILL if kill else 3)
    _, left = psutil.wait_procs(family, timeout=30)
    assert left == []


def test_a_module_and_a_program_hand_on_their_exit_code_and_find_the_package_anywhere(tmp_path):
    code = "import gran_bench.state, sys; sys.exit(7)"
    assert start_program([sys.executable, "-c", code], cwd=tmp_path).wait(60) == 7
    killed = "import os; os.kill(os.getpid(), 9)"
    assert start_program([sys.executable, "-c", killed], cwd=tmp_path).wait(60) == 128 + signal.SIGKILL
    refused = start_module(
        "gran_bench.verify", "--case", "nothing", cwd=tmp_path, stderr=subprocess.PIPE, text=True
    )  # fmt: skip
    assert "--case nothing is unknown" in refused.communicate(timeout=60)[1]
    assert refused.returncode == 2


def test_a_program_that_is_missing_is_one_sentence():
    with pytest.raises(MissingProgramError, match=r"^no-such-program is not on this machine; "):
        start_program(["no-such-program"])


def test_a_comparison_with_lammps_without_mpiexec_is_refused_before_any_work(tmp_path):
    done = subprocess.run(
        [sys.executable, str(ROOT / "benchmarks" / "dem_vs_lammps.py")],
        env={"PATH": str(tmp_path)}, capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert done.returncode == 1
    assert re.fullmatch(r"error: mpiexec is not on this machine; .*apt-get install .*\n", done.stderr)


def test_every_process_of_the_package_is_started_in_one_place():
    """Beside it only what ends with its standard input, or in an instant, is started by `subprocess` itself."""
    allowed = {"processes.py", "provenance/origin.py", "dem/lammps.py", "sweep/slurm.py"}
    source = ROOT / "src" / "gran_bench"
    found = {
        path.relative_to(source).as_posix()
        for path in source.rglob("*.py")
        if re.search(r"subprocess\.(Popen|run|call|check_\w+)\(", path.read_text("utf-8"))
    }
    assert found == allowed
