"""Several processes at once: two on one data set, eight on one tracking store."""

from __future__ import annotations

import sqlite3
import time
from pathlib import Path

import victim
from tiny import tiny_specs

from gran_bench.dataset import read_case


def test_two_processes_that_want_the_same_cases_make_each_once(tmp_path):
    root, specs, made = tmp_path / "data", tiny_specs(seconds=1.0), {}

    def look() -> None:
        """Note which file carries which final name: one that is made twice is another file."""
        for path in root.rglob("[!.]*.h5"):
            made.setdefault(path, set()).add(path.stat().st_mtime_ns)

    crew = [victim.launch("data", root=str(root), workers=1, seconds=1.0) for _ in range(2)]
    deadline = time.monotonic() + victim.PATIENCE
    while any(process.poll() is None for process in crew) and time.monotonic() < deadline:
        look()
        time.sleep(0.005)
    look()
    for process in crew:
        victim.finish(process)
    assert {path: len(versions) for path, versions in made.items()} == dict.fromkeys(made, 1)
    assert {spec.path(root) for spec in specs} <= set(made)
    assert len({read_case(spec.path(root)).digest for spec in specs}) == 3


def test_eight_jobs_that_open_one_new_store_at_the_same_moment_all_record(tmp_path):
    jobs, steps, root, gate = 8, 10, tmp_path / "results", tmp_path / "gate"
    root.mkdir()
    crew = [victim.start("tracking", root=str(root), number=n, steps=steps, gate=str(gate)) for n in range(jobs)]
    gate.touch()
    said = "\n".join(map(victim.finish, crew))
    assert [line for line in said.splitlines() if "locked" in line or line.startswith("warning:")] == []
    with sqlite3.connect(root / "mlflow.db") as store:
        assert store.execute("select count(*) from runs where status = 'FINISHED'").fetchone() == (jobs,)
        assert store.execute("select count(*) from metrics").fetchone() == (jobs * steps * 2,)
    assert len(list(Path(root).rglob("artifacts/report-*.txt"))) == jobs
