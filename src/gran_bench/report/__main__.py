"""Report what is there: sweeps, and the front page of the results. ``python -m gran_bench.report [FOLDER ...]``"""

import sys

from gran_bench.processes import quiet_without_reader
from gran_bench.report.command import report_command

if __name__ == "__main__":
    with quiet_without_reader():
        sys.exit(report_command())
