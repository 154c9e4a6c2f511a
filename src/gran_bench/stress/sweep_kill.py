"""A sweep killed again and again must end like one that was left alone: ``python -m gran_bench.stress.sweep_kill``.

Two at a time, on the smallest scene; ``kill -9`` of the whole process group at seeded random moments, spread over the
sweep; the same command each time again.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sqlite3
import subprocess
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gran_bench.compose import override
from gran_bench.processes import group, kill_group, stop_on_signals
from gran_bench.run.record import MODEL
from gran_bench.run.summary import SUMMARY
from gran_bench.stress.finished_files import Written, done_again, finished_files, records_of
from gran_bench.surrogate.checkpoint import load_card
from gran_bench.sweep.sweep_file import SWEEPS
from gran_bench.tracking.address import DATABASE, SERVER
from gran_bench.tracking.store import KEY_TAG, PARENT_TAG

SWEEP = "kills"  # name of the sweep
RADII = (0.06, 0.065)  # m
PATIENCE = 900.0  # s, of a sweep that would otherwise be waited for for ever
JUDGED = ("judged_rpm", "judged", "nearest_case", "position_error", "data_digest")  # of a summary; no times
# Runs are looked for in the sweeps' own databases, whatever server the user records on.
ENVIRONMENT = {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1", SERVER: ""}


class SweepStalled(RuntimeError):
    """A sweep did not end, or not well; the message has the end of what it said."""


@dataclass(frozen=True)
class SweepKills:
    """How a sweep under kills ended.

    Attributes:
        jobs: of the sweep.
        kills: how many times it was killed.
        finished: runs in the store that are finished, but for the parent.
        doubled: keys that the store has more than once.
        other_runs: runs in the store that are neither the parent, finished nor doubled: open, failed or without parent.
        parents: runs that have children.
        differing: what differs from the undisturbed sweep, a line each.
        repeated: files of finished runs that did not stay as they were, a line each.
        seconds: of the undisturbed sweep and of the killed one.
    """

    jobs: int
    kills: int
    finished: int
    doubled: int
    other_runs: int
    parents: int
    differing: list[str]
    repeated: list[str]
    seconds: tuple[float, float]

    @property
    def passed(self) -> bool:
        """Whether nothing was lost, doubled or changed."""
        whole = self.finished == self.jobs and self.parents == 1
        return whole and not (self.doubled or self.other_runs or self.differing or self.repeated)

    def lines(self) -> list[str]:
        """The result as a short table."""
        rows = [
            ("kills -9 of the whole sweep", f"{self.kills}", ""),
            ("runs finished in the store", f"{self.finished} of {self.jobs}", self.finished == self.jobs),
            ("runs that are there twice", f"{self.doubled}", not self.doubled),
            ("runs that are open, failed or without the parent", f"{self.other_runs}", not self.other_runs),
            ("parents", f"{self.parents}", self.parents == 1),
            ("weights and figures that differ", f"{len(self.differing)}", not self.differing),
            ("files of finished runs that were written again", f"{len(self.repeated)}", not self.repeated),
            ("undisturbed, killed", f"{self.seconds[0]:.0f} s, {self.seconds[1]:.0f} s", ""),
        ]
        verdicts = {True: "pass", False: "fail", "": ""}
        table = [f"{name:<52}{found:>12}  {verdicts[good]}".rstrip() for name, found, good in rows]
        return [*table, *(f"  {line}" for line in (*self.differing, *self.repeated))]


def sweep_under_kills(folder: Path, jobs: int = 12, kills: int = 10, seed: int = 0) -> SweepKills:
    """Run a sweep undisturbed, the same one under kills, and compare.

    Args:
        folder: gets the data, and the results of both.
        jobs: of the sweep, two at a time.
        kills: how many.
        seed: of the moments.

    Raises:
        SweepStalled: a sweep that was left alone did not end well.
    """
    rng = np.random.default_rng(seed)
    calm, hunted = folder / "undisturbed", folder / "killed"
    command = sweep_command(folder / "data", jobs)
    began = time.monotonic()
    finish(command, calm)
    undisturbed = time.monotonic() - began
    # A life between two kills: the start, and a job beside another one.
    life = undisturbed / (1.0 + 0.5 * jobs) * 2.0
    began, finished = time.monotonic(), {}
    for done in sorted(rng.integers(0, max(jobs - 2, 1), kills)):
        kill_at(command, hunted, int(done), float(rng.random()) * life)
        finished = finished_files(hunted / "results") | finished  # as each was when it was first seen
    finish(command, hunted)
    return _compared(calm, hunted, jobs, kills, finished, (undisturbed, time.monotonic() - began))


def sweep_command(data: Path, jobs: int) -> list[str]:
    """The command line of a sweep of ``jobs`` quick jobs, two at a time."""
    radii = RADII if jobs % len(RADII) == 0 else RADII[:1]
    seeds = ",".join(str(seed) for seed in range(jobs // len(radii)))
    return [
        *(sys.executable, "-m", "gran_bench.train", "-m", "+experiment=smoke", "hydra/launcher=local"),
        *("scene.end_time=1.7", "trainer.steps=12", "trainer.checkpoint_steps=2", "threads=1"),
        *("judge.speeds_rpm=[]", "judge.short_horizon_starts=2", override("dataset.root", data.resolve())),
        *(f"model.radius={','.join(map(str, radii))}", f"seed={seeds}", f"tracking.sweep={SWEEP}"),
    ]


def finish(command: list[str], folder: Path) -> None:
    """Run a command to its end.

    Raises:
        SweepStalled: it did not end well, or not at all.
    """
    with group(command, folder, ENVIRONMENT) as process:
        try:
            code = process.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            code = f"none after {PATIENCE:.0f} s"
    if code != 0:
        last = (folder / "said.txt").read_text("utf-8", errors="replace").splitlines()[-12:]
        raise SweepStalled(f"the sweep in {folder} ended with code {code}: " + "\n".join(last))


def kill_at(command: list[str], folder: Path, done: int, after: float) -> None:
    """Start a command, and kill its process group when ``done`` runs are finished and ``after`` seconds have passed.

    Where one more run finishes first, that is the moment.

    Raises:
        SweepStalled: it ended by itself, or never came that far.
    """
    with group(command, folder, ENVIRONMENT) as process:
        began = time.monotonic()
        while True:
            elapsed, finished = time.monotonic() - began, len(list(folder.glob(f"results/runs/*/{SUMMARY}")))
            if (finished >= done and elapsed >= after) or finished > done:
                break
            if process.poll() is not None or elapsed > PATIENCE:
                raise SweepStalled(f"the sweep in {folder} came to {finished} runs, not to {done}; see said.txt there")
            time.sleep(0.01)
        kill_group(process)


def results_of(folder: Path) -> dict[str, dict[str, Any]]:
    """What each run of a sweep found, by its folder's name: hash of its weights, and every figure but times."""
    found = {}
    for path in sorted(folder.glob(f"results/runs/*/{SUMMARY}")):
        _, weights = load_card(path.parent / MODEL)
        digest = hashlib.sha256()
        for name, value in sorted(weights.items()):
            digest.update(name.encode() + value.contiguous().numpy().tobytes())
        summary = json.loads(path.read_text("utf-8"))
        found[path.parent.name] = {"weights": digest.hexdigest(), **{name: summary[name] for name in JUDGED}}
    return found


def _compared(
    calm: Path, hunted: Path, jobs: int, kills: int, finished: dict[Path, Written], seconds: tuple[float, float]
) -> SweepKills:
    differing = _differing(results_of(hunted), results_of(calm), "")
    sweep = Path("results") / SWEEPS / SWEEP
    differing += _differing(records_of(hunted / sweep), records_of(calm / sweep), "the sweep's record, ")
    rows = _stored_runs(hunted / "results" / DATABASE)
    parents = {parent for _, _, _, parent in rows if parent is not None}
    children = [row for row in rows if row[0] not in parents]
    good = [row for row in children if row[2] == "FINISHED" and row[3] in parents]
    ended = [row for row in rows if row[0] in parents and row[2] == "FINISHED"]
    keys = Counter(row[1] for row in rows)
    return SweepKills(
        jobs,
        kills,
        finished=len(good),
        doubled=sum(count - 1 for count in keys.values()),
        other_runs=len(rows) - len(good) - len(ended),
        parents=len(parents),
        differing=differing,
        repeated=done_again(finished, finished_files(hunted / "results")),
        seconds=seconds,
    )


def _differing(ours: dict[str, dict[str, Any]], theirs: dict[str, dict[str, Any]], of: str) -> list[str]:
    """What two sweeps do not share of their runs, a line each."""
    told = [f"{name}: {of}in one sweep alone" for name in sorted(ours.keys() ^ theirs.keys())]
    for name in sorted(ours.keys() & theirs.keys()):
        parts = [part for part in theirs[name] if ours[name].get(part) != theirs[name][part]]
        told += [f"{name}: {of}{part}" for part in parts]
    return told


def _stored_runs(database: Path) -> list[tuple[str, str, str, str | None]]:
    """Id, key, status and parent of every run in a store."""
    tag = "(select value from tags where run_uuid = runs.run_uuid and key = ?)"
    with sqlite3.connect(database) as store:
        return store.execute(f"select run_uuid, {tag}, status, {tag} from runs", (KEY_TAG, PARENT_TAG)).fetchall()


def main() -> int:
    """The command: print the table; exit code 1 where the two sweeps are not equal."""
    parser = argparse.ArgumentParser("python -m gran_bench.stress.sweep_kill", description=__doc__)
    parser.add_argument("--jobs", type=int, default=12, help="of the sweep (default: 12)")
    parser.add_argument("--kills", type=int, default=10, help="of the whole process group (default: 10)")
    parser.add_argument("--seed", type=int, default=0, help="of the moments (default: 0)")
    chosen = parser.parse_args()
    # Asked to stop, it ends its sweep and leaves no files.
    with stop_on_signals(), tempfile.TemporaryDirectory() as folder:
        try:
            result = sweep_under_kills(Path(folder), chosen.jobs, chosen.kills, chosen.seed)
        except SweepStalled as error:
            print(f"error: {error}", file=sys.stderr)
            return 1
    print("\n".join(result.lines()))
    return 0 if result.passed else 1


if __name__ == "__main__":
    sys.exit(main())
