"""Value noise for the garden's textures."""

from math import floor

import numpy as np
from jaxtyping import Float64

from sagesplat.kernels.jit import njit

jit = njit(cache=True, fastmath=True, error_model="numpy")


def dice(i, j):
    """A pseudorandom number in [0, 1) for a pair of integers, or for arrays of them."""
    h = (i * 374761393 + j * 668265263) & 0xFFFFFFFF
    h = ((h ^ (h >> 13)) * 1274126177) & 0xFFFFFFFF
    return ((h ^ (h >> 16)) & 0xFFFFFF) / 16777216.0


dice_at = jit(dice)


@jit
def noise(x, y):
    """Value noise in [0, 1], cells of size 1."""
    fx, fy = floor(x), floor(y)
    i, j = int(fx), int(fy)
    x, y = x - fx, y - fy
    x, y = x * x * (3 - 2 * x), y * y * (3 - 2 * y)
    low = dice_at(i, j) * (1 - x) + dice_at(i + 1, j) * x
    high = dice_at(i, j + 1) * (1 - x) + dice_at(i + 1, j + 1) * x
    return low * (1 - y) + high * y


@jit
def fbm_at(x, y, scale, octaves, footprint):
    """Sum of noise octaves, about -0.5 to 0.5; octaves finer than `footprint` fade out."""
    total, weight = 0.0, 0.5
    for k in range(octaves):
        keep = min(scale / footprint - 0.8, 1.0)
        if keep <= 0:
            break
        total += weight * keep * (noise(x / scale + 17 * k, y / scale - 9 * k) - 0.5)
        x, y = 0.8 * x - 0.6 * y, 0.6 * x + 0.8 * y
        scale, weight = 0.5 * scale, 0.62 * weight
    return total


@jit
def _fill(x, y, scale, octaves, footprint, out):
    for i in range(len(out)):
        out[i] = fbm_at(x[i], y[i], scale, octaves, footprint[i])


def fbm(
    x: Float64[np.ndarray, " n"],
    y: Float64[np.ndarray, " n"],
    scale: float,
    octaves: int,
    footprint: Float64[np.ndarray, " n"],
) -> Float64[np.ndarray, " n"]:
    """`fbm_at` over arrays: cells of `scale` metres halved octave by octave, about -0.5 to 0.5."""
    out = np.empty(len(footprint))
    _fill(np.ascontiguousarray(x), np.ascontiguousarray(y), scale, octaves, footprint, out)
    return out
