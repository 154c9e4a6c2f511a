"""Compare runs: ``python -m gran_bench.compare RUN RUN ... [--speed RPM] [--out FILE] [--root FOLDER]``."""

import sys

from gran_bench.compare.command import compare_command

if __name__ == "__main__":
    sys.exit(compare_command())
