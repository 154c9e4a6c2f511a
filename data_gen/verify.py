"""Verify the DEM against theory: ``python -m data_gen.verify``, the same as ``python -m gran_bench.verify``."""

from gran_bench.verify import main

if __name__ == "__main__":
    main()
