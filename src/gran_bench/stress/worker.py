"""A process that carries out stress cases: tasks in, outcomes out, one line of JSON each.

Started by :mod:`gran_bench.stress.crew`, not by people.
"""

from __future__ import annotations

import json
import os
import sys
from dataclasses import asdict

import torch

from gran_bench.stress.expectation import Observation
from gran_bench.stress.perform import Task, perform


def main() -> None:
    """Serve tasks until the parent closes the pipe."""
    # Whatever a library prints must not get between the lines of JSON.
    channel = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)
    torch.set_num_threads(1)
    try:
        for line in sys.stdin:
            outcome = perform(Task(**json.loads(line)))
            form = "observation" if isinstance(outcome, Observation) else "failure"
            channel.write(json.dumps({form: asdict(outcome)}) + "\n")
    except BrokenPipeError:
        os._exit(1)


if __name__ == "__main__":
    main()
