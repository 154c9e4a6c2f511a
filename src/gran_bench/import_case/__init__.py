"""Trajectories of another code as cases: read, completed, checked, written."""

from gran_bench.import_case.arrays import import_arrays
