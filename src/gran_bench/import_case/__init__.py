"""Trajectories of another code as cases: read, completed, checked, written."""

from gran_bench.import_case.arrays import import_arrays
from gran_bench.import_case.reading import read_trajectory

__all__ = ["import_arrays", "read_trajectory"]
