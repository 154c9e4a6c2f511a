"""Open a case or a run elsewhere: ``python -m gran_bench.export CASE|RUN --to vtkhdf|xyz|npz``."""

import sys

from gran_bench.export.command import export_command

if __name__ == "__main__":
    sys.exit(export_command())
