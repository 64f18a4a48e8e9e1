"""Vectors of 16 and 8 for numba kernels, and the memory that their calls share."""
