"""Numba compiles the CPU kernels, which carry blocks of rays through all surfaces in cache."""
