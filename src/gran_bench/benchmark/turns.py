"""Methods take turns: round by round, in an order that is shuffled anew, one at a time on an otherwise idle machine.

Each method lives in a process of its own that waits between its turns. Each finished run is a JSON file, whole or not
there, so that an interrupted benchmark goes on from where it was.
"""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from gran_bench.benchmark.crew import ask, crew
from gran_bench.benchmark.method import Method
from gran_bench.files import write_text

PREPARED_AT_A_TIME = 2
FAILURE = "failure.json"
FIRST_NUDGE = 1001  # seed of the nudge of the first round of seed 0; the replicas have the lower ones
ROUNDS_OF_A_SEED = 1000


@dataclass(frozen=True)
class Turn:
    """One timed run.

    Attributes:
        round: index.
        wall_seconds, cpu_seconds: of the run; where they differ, the process waited for the processor.
        peak_bytes: largest resident memory of the method's process during the run, Python and libraries included.
        own_bytes: of these, what came on top of what was resident before the run.
    """

    round: int
    wall_seconds: float
    cpu_seconds: float
    peak_bytes: int
    own_bytes: int


@dataclass(frozen=True)
class Record:
    """All turns of one method.

    Attributes:
        folder: of its files.
        turns: by round; empty for a method that failed in its first run.
        failure: why it failed; empty where it did not.
        failed_seconds: wall time of a simulated second before it failed, s; None where it never got to a frame.
    """

    folder: Path
    turns: list[Turn]
    failure: str
    failed_seconds: float | None = None


def trajectory_file(folder: Path, index: int) -> Path:
    """Where the frames of a round are kept until they are judged."""
    return folder / f"trajectory{index}.npz"


def nudge_seed(seed: int, index: int) -> int:
    """Seed of the nudge that a round starts from: no two rounds of two benchmarks have the same.

    Args:
        seed: of the benchmark.
        index: of the round.
    """
    return FIRST_NUDGE + ROUNDS_OF_A_SEED * seed + index


def take_turns(
    methods: Sequence[Method],
    rounds: int,
    seed: int,
    folder: Path,
    conditions: Sequence[str],
    frame_interval: float,
    wants_frames: Callable[[Method, Path, int], bool] = lambda method, folder, index: False,
    after_round: Callable[[int, dict[str, Path]], None] = lambda index, folders: None,
    label: str = "timing",
) -> dict[str, Record]:
    """Run every method once a round, and keep what was measured.

    Args:
        methods: that fit the scene; others are passed over.
        rounds: how often.
        seed: of the order in each round, and of the nudges that the rounds start from.
        folder: of all measurements.
        conditions: what else decides a measurement (`Method.key`).
        frame_interval: s.
        wants_frames: whether the frames of a method's round, in its folder, are still to be judged.
        after_round: called with the round and the folders of all methods, to judge what was kept.
        label: of the bar.

    Returns:
        Records by the method's name.
    """
    fit = [method for method in methods if not method.unfit_because]
    folders = {method.name: folder / method.key(*conditions) for method in fit}

    def wants(method: Method, index: int) -> tuple[bool, bool]:
        """Whether a turn is missing, and whether its frames are wanted."""
        place = folders[method.name]
        frames_wanted = wants_frames(method, place, index) and not trajectory_file(place, index).exists()
        if (place / FAILURE).exists():
            return False, False
        return frames_wanted or not _path(place, index).exists(), frames_wanted

    for place in folders.values():
        _forget_death(place)
    missing = [(m, index) for index in range(rounds) for m in _order(fit, seed, index) if wants(m, index)[0]]
    with crew() as hire, tqdm(total=len(missing), desc=label, unit="run", disable=None, leave=False) as bar:
        # All are compiled and warm before the first is timed.
        workers: dict[str, subprocess.Popen] = {}

        def prepare(method: Method) -> None:
            bar.set_postfix_str(f"preparing {method.name}", refresh=True)
            workers[method.name] = hire()
            frames = round(method.seconds / frame_interval)
            answer = ask(workers[method.name], {"job": method.job, "frames": frames, "nudge_seed": nudge_seed(seed, 0)})
            if "died" in answer:
                _fail(folders[method.name], answer["died"], died=True)

        needed = list({method.name: method for method, _ in missing}.values())
        for method in needed[:1]:  # it compiles what the others then load
            prepare(method)
        lanes = ThreadPoolExecutor(PREPARED_AT_A_TIME)
        try:
            list(lanes.map(prepare, needed[1:]))
        except BaseException:
            # The lanes end once nothing waits and those that they wait for are gone.
            lanes.shutdown(wait=False, cancel_futures=True)
            for worker in list(workers.values()):
                worker.kill()
            raise
        finally:
            lanes.shutdown()
        for index in range(rounds):
            for method in [method for method, when in missing if when == index]:
                wanted, keeps = wants(method, index)
                bar.set_postfix_str(method.name, refresh=True)
                bar.update()
                if wanted:
                    place = folders[method.name]
                    keep = str(trajectory_file(place, index).resolve()) if keeps else None
                    request = {"nudge_seed": nudge_seed(seed, index), "keep": keep}
                    _take_turn(method, workers[method.name], place, index, request, frame_interval)
            after_round(index, folders)
    return {method.name: _read(folders[method.name], rounds) for method in fit}


def _take_turn(
    method: Method, worker: subprocess.Popen, folder: Path, index: int, request: dict[str, Any], frame_interval: float
) -> None:
    """Let a worker run once, and write down what came of it."""
    answer = ask(worker, request)
    if "died" in answer:
        _fail(folder, answer["died"], died=True)
    elif "failure" in answer:
        reached = answer["reached"] * frame_interval
        seconds = answer["wall_seconds"] / reached if reached else None
        _fail(folder, answer["failure"], died=False, seconds=seconds)
    else:
        turn = asdict(Turn(index, **answer)) | {"method": method.name}
        write_text(_path(folder, index), json.dumps(turn, indent=1) + "\n")


def _order(methods: Sequence[Method], seed: int, index: int) -> list[Method]:
    return [methods[i] for i in np.random.default_rng([seed, index]).permutation(len(methods))]


def _path(folder: Path, index: int) -> Path:
    return folder / f"round{index}.json"


def _fail(folder: Path, message: str, died: bool, seconds: float | None = None) -> None:
    write_text(folder / FAILURE, json.dumps({"failure": message, "died": died, "seconds": seconds}) + "\n")


def _forget_death(folder: Path) -> None:
    """A run that diverged will diverge again; a process that died (of a lack of memory, say) gets another chance."""
    path = folder / FAILURE
    if path.exists() and json.loads(path.read_text("utf-8"))["died"]:
        path.unlink()


def _read(folder: Path, rounds: int) -> Record:
    found = [json.loads(_path(folder, k).read_text("utf-8")) for k in range(rounds) if _path(folder, k).exists()]
    turns = [Turn(**{name: value for name, value in turn.items() if name != "method"}) for turn in found]
    if not (folder / FAILURE).exists():
        return Record(folder, turns, "")
    failed = json.loads((folder / FAILURE).read_text("utf-8"))
    return Record(folder, turns, failed["failure"], failed["seconds"])
