"""Make a case of another code's trajectory: ``python -m gran_bench.import_case FILE --scene scene.yaml``."""

from __future__ import annotations

import sys

from gran_bench.import_case.command import import_command
from gran_bench.processes import quiet_without_reader

if __name__ == "__main__":
    with quiet_without_reader():
        sys.exit(import_command(sys.argv[1:]))
