"""One bar for all cases that are being made: simulated time, files, who waits."""

import io
from dataclasses import dataclass

import pytest

from gran_bench.dataset.ensure import SimulatedTimeBar


class Terminal(io.StringIO):
    """A terminal that remembers what was written to it."""

    def isatty(self) -> bool:
        return True


@dataclass(eq=False)
class Simulation:
    """A job of the bar's."""

    simulated_seconds: float


def test_one_bar_counts_the_simulated_time_of_all_jobs(monkeypatch: pytest.MonkeyPatch):
    terminal = Terminal()
    monkeypatch.setattr("sys.stderr", terminal)
    bed, case = Simulation(1.5), Simulation(4.0)
    with SimulatedTimeBar([bed, case], show=True) as bar:
        bar.reached(bed, 1.0)
        bar.reached(bed, 2.5)  # longer than expected
        bar.finished(bed)
        bar.reached(case, 1.0)
        bar.waits(case)
        bar.finished(case)
    shown = terminal.getvalue().split("\r")
    assert "data 0/2 files:   0%" in shown[1]
    assert "6.5/6.5 s simulated" in shown[-1], "2.5 s of settling and 4 s of the case"
    assert "data 2/2 files: 100%" in shown[-1]
    assert any("waiting for another process" in line for line in shown)


def test_the_bar_is_silent_without_a_terminal(monkeypatch: pytest.MonkeyPatch):
    log = io.StringIO()
    monkeypatch.setattr("sys.stderr", log)
    with SimulatedTimeBar([job := Simulation(1.0)], show=True) as bar:
        bar.finished(job)
    assert log.getvalue() == ""
