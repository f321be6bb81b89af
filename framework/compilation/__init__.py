"""Compilation and caching of numba kernels."""
