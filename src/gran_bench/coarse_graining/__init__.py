"""Coarse-grained DEMs held against the DEM of the fine spheres, and calibrated to it."""
