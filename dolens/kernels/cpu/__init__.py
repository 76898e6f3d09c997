"""Kernels for the CPU, compiled by Numba: blocks of rays carried through all surfaces in cache."""
