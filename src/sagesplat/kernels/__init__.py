"""What numba kernels share: their cache, vectors of 16 and 8 lanes, and reusable memory."""
