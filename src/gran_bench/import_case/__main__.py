"""Make a case of another code's trajectory: ``python -m gran_bench.import_case FILE --scene scene.yaml``."""

import sys

from gran_bench.import_case.command import import_command

if __name__ == "__main__":
    sys.exit(import_command())
