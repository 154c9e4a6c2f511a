"""What Numba compiles: the fast engine and its lists."""
