"""A process that makes one file of a data set; :mod:`gran_bench.dataset.ensure` starts it.

In comes a pickled job with the path that it must have. Out go lines of JSON: the simulated time covered, s; null once
it waits for another process; what went wrong.
"""

import json
import os
import pickle
import sys

from gran_bench.dataset.case_spec import DatasetError


def main() -> None:
    """Make the file, or say why not."""
    # Whatever a library prints must not get between the lines of JSON.
    channel = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)

    def tell(word: float | str | None) -> None:
        channel.write(json.dumps(word) + "\n")

    job, path = pickle.load(sys.stdin.buffer)
    try:
        if job.path != path:
            raise DatasetError("the solver's code changed since the command began; run it again")
        job.run(lambda seconds: tell(float(seconds)), lambda: tell(None))
    except DatasetError as error:
        tell(str(error))
    except BrokenPipeError:
        # The parent is gone: nobody wants the rest. _exit, or closing the channel would fail once more.
        os._exit(1)


if __name__ == "__main__":
    main()
