"""Kernels from what blending found for each intersection to Gaussians."""

import numpy as np
from numba import prange

from sagesplat.kernels.jit import njit
from sagesplat.kernels.simd import double, load8, splat8, store
from sagesplat.kernels.threads import dealt
from sagesplat.raster.blend import SUMS, TO_CONIC

_CHUNK = 256  # Gaussians that a thread takes at a time
_ZERO, _HALF = np.float32(0), np.float32(0.5)


@njit(parallel=True, cache=True)
def add_by_gaussian(offsets, reached, sums, out):
    """Add the sums [I, columns] of each Gaussian's intersections to its row of out [N, columns]."""
    for i in prange(len(offsets) - 1):
        for slot in range(offsets[i], offsets[i + 1]):
            if reached[slot]:
                for column in range(sums.shape[1]):
                    out[i, column] += sums[slot, column]


@njit(parallel=True, cache=True)
def copy_means(records, radii, means2d):
    """The 2D means [N, 2] of what is drawn; zeros for the rest."""
    for i in prange(len(radii)):
        for axis in range(2):
            means2d[i, axis] = records[i, axis] if radii[i] > 0 else _ZERO


@njit(parallel=True, cache=True)
def reduce(records, radii, offsets, reached, sums, g_mean2d, g_conic, g_opacity, g_color):
    """Add the sums of each Gaussian's intersections and turn them into gradients of its 2D parameters.

    Gaussians of radius 0 are left out.
    """
    n = len(records)
    chunks = (n + _CHUNK - 1) // _CHUNK
    for place in prange(chunks):
        chunk = dealt(place, chunks)
        added = np.empty(8, np.float64)
        for i in range(chunk * _CHUNK, min((chunk + 1) * _CHUNK, n)):
            if offsets[i] == offsets[i + 1] or radii[i] <= 0:
                continue
            eight, dy_dy = double(splat8(_ZERO)), 0.0
            for slot in range(offsets[i], offsets[i + 1]):
                if reached[slot]:
                    eight = eight + double(load8(sums, slot * SUMS))
                    dy_dy += sums[slot, 8]
            store(added, 0, eight)
            a, b, c = TO_CONIC * records[i, 2], _HALF * TO_CONIC * records[i, 3], TO_CONIC * records[i, 4]
            g_mean2d[i, 0] += a * added[4] + b * added[5]
            g_mean2d[i, 1] += b * added[4] + c * added[5]
            g_conic[i, 0] -= 0.5 * added[6]
            g_conic[i, 1] -= added[7]
            g_conic[i, 2] -= 0.5 * dy_dy
            g_opacity[i] += added[3] / 2.0 ** records[i, 5]
            for channel in range(3):
                g_color[i, channel] = added[channel]
