"""Compare runs: ``python -m gran_bench.compare RUN RUN ... [--speed RPM] [--out FILE] [--root FOLDER]``."""

from __future__ import annotations

import sys

from gran_bench.compare.command import compare_command
from gran_bench.processes import quiet_without_reader

if __name__ == "__main__":
    with quiet_without_reader():
        sys.exit(compare_command())
