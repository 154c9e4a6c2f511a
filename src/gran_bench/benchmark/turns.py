"""Methods take turns: round by round, in an order that is shuffled anew, one at a time on an otherwise idle machine.

A finished run is a JSON file, whole or not there, so that an interrupted benchmark goes on from where it was.
"""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gran_bench.benchmark.contest import Method
from gran_bench.files import write_text
from gran_bench.progress import Progress
from gran_bench.workers import Worker, crew

PREPARED_AT_A_TIME = 2
PATIENCE = 3600.0  # s that a method may prepare itself, or take for one run: the slowest take minutes
FAILURE = "failure.json"
FIRST_NUDGE = 1001  # seed of the nudge of the first round of seed 0; the replicas have the lower ones
ROUNDS_OF_A_SEED = 1000


@dataclass(frozen=True)
class Record:
    """All turns of one method, as its process told them (`jobs.prepare`), by round; why it failed, if it did."""

    turns: list[dict[str, Any]]
    failure: str = ""
    failed_seconds: float | None = None  # wall time of a simulated second before it failed; None without a frame


def trajectory_file(folder: Path, index: int) -> Path:
    """Where the frames of a round are kept until they are judged."""
    return folder / f"trajectory{index}.npz"


def nudge_seed(seed: int, index: int) -> int:
    """Seed of the nudge that a round of a benchmark starts from: no two rounds of two benchmarks have the same."""
    return FIRST_NUDGE + ROUNDS_OF_A_SEED * seed + index


def take_turns(
    methods: Sequence[Method], rounds: int, seed: int, folder: Path, conditions: Sequence[str], frame_interval: float,
    wants_frames: Callable[[Method, Path, int], bool] = lambda method, folder, index: False,
    after_round: Callable[[int, dict[str, Path]], None] = lambda index, folders: None,
    label: str = "timing",
) -> dict[str, Record]:  # fmt: skip
    """Run every method that fits the scene once a round, and keep what was measured; records by the method's name.

    Args:
        seed: of the order in each round, and of the nudges that the rounds start from.
        folder: of all measurements; ``conditions`` are what else decides one (`Method.key`).
        frame_interval: s.
        wants_frames: whether the frames of a method's round, in its folder, are still to be judged.
        after_round: called with the round and the folders of all methods, to judge what was kept.
    """
    fit = [method for method in methods if not method.unfit_because]
    folders = {method.name: folder / method.key(*conditions) for method in fit}

    def keeps(method: Method, index: int) -> bool:
        place = folders[method.name]
        return wants_frames(method, place, index) and not trajectory_file(place, index).exists()

    def wants(method: Method, index: int) -> bool:
        place = folders[method.name]
        return not (place / FAILURE).exists() and (keeps(method, index) or not round_file(place, index).exists())

    for failed in (place / FAILURE for place in folders.values()):
        # A run that diverged will diverge again; a process that died (of a lack of memory, say) gets another chance.
        if failed.exists() and json.loads(failed.read_text("utf-8"))["died"]:
            failed.unlink()
    orders = [np.random.default_rng([seed, index]).permutation(len(fit)) for index in range(rounds)]
    missing = [(fit[k], index) for index, order in enumerate(orders) for k in order if wants(fit[k], index)]
    workers = {method.name: Worker("gran_bench.benchmark.jobs") for method, _ in missing}
    bar = Progress(total=len(missing), desc=label, unit="run", leave=False)
    with bar, crew(list(workers.values()), PREPARED_AT_A_TIME) as threads:

        def prepare(method: Method) -> None:
            bar.set_postfix_str(f"preparing {method.name}", refresh=True)
            frames = round(method.seconds / frame_interval)
            request = {"job": method.job, "frames": frames, "nudge_seed": nudge_seed(seed, 0)}
            answer = workers[method.name].ask(request, PATIENCE)
            if "died" in answer:
                _note(method, answer, folders[method.name], 0, frame_interval)

        # All are compiled and warm before the first is timed; the first compiles what the others then load.
        needed = list({method.name: method for method, _ in missing}.values())
        for some in (needed[:1], needed[1:]):
            list(threads.map(prepare, some))
        for index in range(rounds):
            for method in [method for method, when in missing if when == index]:
                bar.set_postfix_str(method.name, refresh=True)
                bar.update()
                if wants(method, index):
                    place = folders[method.name]
                    keep = str(trajectory_file(place, index).resolve()) if keeps(method, index) else None
                    request = {"nudge_seed": nudge_seed(seed, index), "keep": keep}
                    _note(method, workers[method.name].ask(request, PATIENCE), place, index, frame_interval)
            after_round(index, folders)
    return {method.name: _read(folders[method.name], rounds) for method in fit}


def _note(method: Method, answer: dict[str, Any], folder: Path, index: int, frame_interval: float) -> None:
    """Write down what came of a run."""
    if "died" in answer or "failure" in answer:
        reached = answer.get("reached", 0) * frame_interval
        found = {"failure": answer.get("died") or answer["failure"], "died": "died" in answer}
        found["seconds"] = answer["wall_seconds"] / reached if reached else None
        write_text(folder / FAILURE, json.dumps(found) + "\n")
    else:
        turn = {"round": index, **answer, "method": method.name}
        write_text(round_file(folder, index), json.dumps(turn, indent=1) + "\n")


def round_file(folder: Path, index: int) -> Path:
    """What was measured of a method, whose folder it is, in a round."""
    return folder / f"round{index}.json"


def _read(folder: Path, rounds: int) -> Record:
    files = (round_file(folder, k) for k in range(rounds))
    turns = [json.loads(file.read_text("utf-8")) for file in files if file.exists()]
    failed = json.loads((folder / FAILURE).read_text("utf-8")) if (folder / FAILURE).exists() else {}
    return Record(turns, failed.get("failure", ""), failed.get("seconds"))
