"""A process that makes files of a data set: jobs in, progress out, one line of JSON each.

Started by :mod:`gran_bench.dataset.workers`, not by people.
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import Any

from gran_bench.dataset.case_spec import DatasetError
from gran_bench.dataset.generation import Job
from gran_bench.dataset.workers import spec_from_document


def main() -> None:
    """Serve jobs until the parent closes the pipe or is gone."""
    # Whatever a library prints must not get between the lines of JSON.
    channel = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)

    def tell(**message: Any) -> None:
        channel.write(json.dumps(message) + "\n")

    try:
        for line in sys.stdin:
            request = json.loads(line)
            job = Job(spec_from_document(request["spec"]), Path(request["root"]), request["settles"])
            try:
                if str(job.path) != request["path"]:
                    raise DatasetError("the solver's code changed since the command began; run it again")
                job.run(lambda seconds: tell(reached=float(seconds)), lambda: tell(waits=True))
            except DatasetError as error:
                tell(failed=str(error))
            else:
                tell(done=str(job.path))
    except BrokenPipeError:
        # The parent is gone: nobody wants the rest. _exit, or closing the channel would fail once more.
        os._exit(1)


if __name__ == "__main__":
    main()
