"""Verify the DEM against theory.

python -m gran_bench.verify            # the whole suite: analytic cases, published tests, the drum
python -m gran_bench.verify --quick    # a subset; --help for the rest
"""

from __future__ import annotations

from gran_bench.plots.verification import draw_verification
from gran_bench.processes import quiet_without_reader
from gran_bench.verification.command import run


def main() -> None:
    """Run the suite and end with its exit code."""
    with quiet_without_reader():
        raise SystemExit(run(draw_verification))


if __name__ == "__main__":
    main()
