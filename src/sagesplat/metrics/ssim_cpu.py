"""SSIM fused with its gradient: 11x11 Gaussian window, sigma 1.5, zero padding, RGB in [0, 1], as in 3DGS.

Images and maps are planes [3, H, W'] (`kernels/planes.py`) that hold zeros beyond column W. Tiles are copied
near in groups, blurred down the columns, then along the rows. Where both images are zero all around, as they
are beside an object, the result is known without.
"""

import numpy as np
from numba import prange

from sagesplat.kernels.jit import njit
from sagesplat.kernels.simd import LANES, load, load8, maximum, splat, splat8, store, total, where

WINDOW = 11
TILE = 16  # columns and rows of what a mask of tiles takes together
RADIUS = WINDOW // 2
_CHUNK = 64  # columns that are blurred at a time: what is needed of them fits into the nearest cache
_MARGIN = 8  # columns on either side
_ROWS, _LINE = TILE + 2 * RADIUS, _CHUNK + 2 * _MARGIN
_PATCH = _ROWS * _LINE  # floats of a plane that the blurs of a chunk take
_F = np.float32
_C1, _C2, _ONE, _TWO, _ZERO = _F(0.01**2), _F(0.03**2), _F(1), _F(2), _F(0)
_taps = np.exp(-((np.arange(WINDOW) - RADIUS) ** 2) / (2 * 1.5**2))
TAPS = _taps / _taps.sum()  # weights of the window, along a line
_K0, _K1, _K2, _K3, _K4, _K5 = (_F(t) for t in TAPS[: RADIUS + 1])
_COLUMNS = np.arange(LANES, dtype=np.float32)


def strips(height: int) -> int:
    """How many strips of rows an image has: its rows of tiles."""
    return -(-height // TILE)


def all_tiles(height: int, width: int) -> np.ndarray:
    """A mask of tiles in which every tile counts."""
    return np.ones((-(-height // TILE), -(-width // TILE)), np.bool_)


def covered(tiles: np.ndarray, height: int, width: int) -> float:
    """Share of the pixels that lie in tiles that count."""
    rows = np.minimum(height - TILE * np.arange(tiles.shape[0]), TILE)
    columns = np.minimum(width - TILE * np.arange(tiles.shape[1]), TILE)
    return float(rows @ tiles @ columns) / (height * width)


@njit(forceinline=True, cache=True)
def _blur(values, at, step=1):
    """Window over neighbours of `step`, of the vector at values[at]."""
    first = at - RADIUS * step
    return (
        (load(values, first) + load(values, first + 10 * step)) * _K0
        + (load(values, first + step) + load(values, first + 9 * step)) * _K1
        + (load(values, first + 2 * step) + load(values, first + 8 * step)) * _K2
        + (load(values, first + 3 * step) + load(values, first + 7 * step)) * _K3
        + (load(values, first + 4 * step) + load(values, first + 6 * step)) * _K4
        + load(values, at) * _K5
    )


@njit(forceinline=True, cache=True)
def _four_blurs(patches, at):
    """Blurs of x, y, x^2 + y^2 and x y down the columns of two patches."""
    a, b = load(patches, at), load(patches, _PATCH + at)
    mx, my, squares, product = a * _K5, b * _K5, (a * a + b * b) * _K5, a * b * _K5
    for distance, k in ((1, _K4), (2, _K3), (3, _K2), (4, _K1), (5, _K0)):
        up, down = at - distance * _LINE, at + distance * _LINE
        a, b = load(patches, up), load(patches, _PATCH + up)
        c, d = load(patches, down), load(patches, _PATCH + down)
        mx, my = mx + (a + c) * k, my + (b + d) * k
        squares, product = squares + (a * a + b * b + c * c + d * d) * k, product + (a * b + c * d) * k
    return mx, my, squares, product


@njit(forceinline=True, cache=True)
def _quality(mx, my, squares, product, inside):
    """SSIM and its derivatives by the first image's mean, by a variance and by the covariance; 0 outside."""
    a1, b1 = mx * my * _TWO + _C1, mx * mx + my * my + _C1
    a2, b2 = (product - mx * my) * _TWO + _C2, squares - mx * mx - my * my + _C2
    inverse = _ONE / (b1 * b2)
    value = a1 * a2 * inverse
    by_covariance = a1 * inverse * _TWO
    by_variance = -value * b1 * inverse
    by_mean = (my * a2 * inverse - mx * value * b2 * inverse - mx * by_variance) * _TWO - my * by_covariance
    value, by_mean = where(inside, value, _ZERO), where(inside, by_mean, _ZERO)
    return value, by_mean, where(inside, by_variance, _ZERO), where(inside, by_covariance, _ZERO)


@njit(forceinline=True, cache=True)
def _take(values, hidden, tiles, start, strip, left, height, wide, patch, to):
    """Copy a plane's part around TILE rows and _CHUNK columns to patch[to], with zeros outside of the plane.

    Tiles that do not count are taken from the plane `hidden`.
    """
    for r in range(_ROWS):
        row = strip * TILE - RADIUS + r
        for c in range(0, _LINE, _MARGIN):
            w, piece = left - _MARGIN + c, splat8(_ZERO)
            if 0 <= row < height and 0 <= w < wide:
                at = start + row * wide + w
                piece = load8(values, at) if tiles[row // TILE, w // TILE] else load8(hidden, at)
            store(patch, to + r * _LINE + c, piece)


@njit(cache=True)
def _blank(bits, first, end):
    """Whether all these floats, as their bits, are zero."""
    any_bit = np.uint32(0)
    for at in range(first, end):
        any_bit |= bits[at]
    return any_bit == 0


@njit(parallel=True, cache=True)
def compare(x, y, tiles, width, ssim, derivatives, sums):
    """SSIM of x, y [3, H, W'] into ssim, its derivatives [3, 3, H, W'], sums [3, strips].

    tiles [ceil(H/16), ceil(W/16)]: those that are false count nowhere, and windows see y in x's place there;
    what is written there is zero. ssim and derivatives may have no elements.
    """
    channels, height, wide = x.shape
    strips = sums.shape[1]
    for job in prange(strips * channels):
        channel, strip = job // strips, job % strips
        start, area = channel * height * wide, np.empty(2 * _PATCH + 4 * _LINE, np.float32)
        rows, bits, added = area[2 * _PATCH :], area.view(np.uint32), 0.0
        for left in range(0, wide, _CHUNK):
            counts = tiles[strip, left // TILE : (left + _CHUNK) // TILE]
            some, zero = counts.any(), splat(_ZERO)
            if some:
                _take(x, y, tiles, start, strip, left, height, wide, area, 0)
                _take(y, y, tiles, start, strip, left, height, wide, area, _PATCH)
                some = not _blank(bits, 0, 2 * _PATCH)
            for r in range(min(TILE, height - strip * TILE)):
                for c in range(0, _LINE if some else 0, LANES):
                    mx, my, squares, product = _four_blurs(area, (r + RADIUS) * _LINE + c)
                    store(rows, c, mx)
                    store(rows, _LINE + c, my)
                    store(rows, 2 * _LINE + c, squares)
                    store(rows, 3 * _LINE + c, product)
                sum_of_row, first = splat(_ZERO), start + (strip * TILE + r) * wide + left
                for c in range(0, min(_CHUNK, wide - left), LANES):
                    value = by_mean = by_variance = by_covariance = splat(_ZERO)
                    inside = load(_COLUMNS, 0) + _F(left + c) < _F(width)
                    if counts[c // TILE] and not some:
                        value, by_mean, by_variance, by_covariance = _quality(zero, zero, zero, zero, inside)
                    elif counts[c // TILE]:
                        value, by_mean, by_variance, by_covariance = _quality(
                            _blur(rows, c + _MARGIN), _blur(rows, _LINE + c + _MARGIN),
                            _blur(rows, 2 * _LINE + c + _MARGIN), _blur(rows, 3 * _LINE + c + _MARGIN),
                            inside,
                        )  # fmt: skip
                    sum_of_row = sum_of_row + value
                    if ssim.size > 0:
                        store(ssim, first + c, value)
                    if derivatives.size > 0:
                        store(derivatives, first + c, by_mean)
                        store(derivatives, x.size + first + c, by_variance)
                        store(derivatives, 2 * x.size + first + c, by_covariance)
                added += total(sum_of_row)
        sums[channel, strip] = added


@njit(parallel=True, cache=True)
def gradient(x, y, tiles, derivatives, scale, l1_scale, out, sums):
    """scale * d(sum of SSIM)/dx + l1_scale * sign(x - y) into out [3, H, W']; sums [3, strips] of |x - y|.

    `tiles` as in `compare`: nothing is added, and the gradient is zero, where they are false.
    """
    channels, height, wide = x.shape
    strips, bits_x, bits_y = sums.shape[1], x.view(np.uint32).ravel(), y.view(np.uint32).ravel()
    for job in prange(strips * channels):
        channel, strip = job // strips, job % strips
        start, area = channel * height * wide, np.empty(3 * _PATCH + 3 * _LINE, np.float32)
        rows, bits, added = area[3 * _PATCH :], area.view(np.uint32), 0.0
        for left in range(0, wide, _CHUNK):
            counts = tiles[strip, left // TILE : (left + _CHUNK) // TILE]
            some = counts.any()
            if some:  # where both images are zero all around, so is the derivative by the mean
                _take(derivatives, derivatives, tiles, start, strip, left, height, wide, area, 0)
                some = not _blank(bits, 0, _PATCH)
                for row in range(strip * TILE, min(strip * TILE + TILE, height)):
                    first = start + row * wide + left
                    end = first + min(_CHUNK, wide - left)
                    some = some or not (_blank(bits_x, first, end) and _blank(bits_y, first, end))
            for k in range(1, 3 if some else 0):
                of = k * x.size + start
                _take(derivatives, derivatives, tiles, of, strip, left, height, wide, area, k * _PATCH)
            for r in range(min(TILE, height - strip * TILE)):
                for k in range(3 if some else 0):
                    for c in range(0, _LINE, LANES):
                        down = _blur(area, k * _PATCH + (r + RADIUS) * _LINE + c, _LINE)
                        store(rows, k * _LINE + c, down)
                error, first = splat(_ZERO), start + (strip * TILE + r) * wide + left
                for c in range(0, min(_CHUNK, wide - left), LANES):
                    slope = splat(_ZERO)
                    if some and counts[c // TILE]:
                        a, b, at = load(x, first + c), load(y, first + c), c + _MARGIN
                        by_ssim = _blur(rows, at) + b * _blur(rows, 2 * _LINE + at)
                        by_ssim = by_ssim + a * _blur(rows, _LINE + at) * _TWO
                        sign = where(a > b, splat(l1_scale), where(a < b, splat(-l1_scale), _ZERO))
                        slope, error = by_ssim * scale + sign, error + maximum(a - b, b - a)
                    store(out, first + c, slope)
                added += total(error)
        sums[channel, strip] = added
