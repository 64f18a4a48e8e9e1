"""SSIM fused with its gradient: 11x11 Gaussian window, sigma 1.5, zero padding, RGB in [0, 1], as in 3DGS.

Maps are [3, H, W'] with W' = `padded(W)`, so that their rows are whole vectors.
"""

from typing import Any

import numba
import numpy as np
from numba import prange

from sagesplat.kernels.jit import njit
from sagesplat.kernels.simd import load16, load_blue, load_green, load_red, store, total, where

WINDOW = 11
LANES = 16
get_thread_id: Any = getattr(numba, "get_thread_id")  # noqa: B009 - not in numba's stubs
_RADIUS = WINDOW // 2
_STRIP = 32  # rows a thread works on at a time
_F = np.float32
_C1, _C2, _ONE, _TWO, _ZERO = _F(0.01**2), _F(0.03**2), _F(1), _F(2), _F(0)
_taps = np.exp(-((np.arange(WINDOW) - _RADIUS) ** 2) / (2 * 1.5**2))
_K0, _K1, _K2, _K3, _K4, _K5 = (_F(t) for t in (_taps / _taps.sum())[: _RADIUS + 1])
_COLUMNS = np.arange(LANES, dtype=np.float32)


def padded(width: int) -> int:
    """A width as a number of whole vectors."""
    return -(-width // LANES) * LANES


def scratch_size(width: int) -> int:
    """Floats that a thread works in."""
    return 4 * (_STRIP + 2 * _RADIUS + 1) * (padded(width) + LANES)


def strips(height: int) -> int:
    """How many strips of rows an image has."""
    return -(-height // _STRIP)


def all_tiles(height: int, width: int) -> np.ndarray:
    """A mask of tiles in which every tile counts."""
    return np.ones((-(-height // LANES), padded(width) // LANES), np.bool_)


def covered(tiles: np.ndarray, height: int, width: int) -> float:
    """Share of the pixels that lie in tiles that count."""
    rows = np.minimum(height - LANES * np.arange(tiles.shape[0]), LANES)
    columns = np.minimum(width - LANES * np.arange(tiles.shape[1]), LANES)
    return float(rows @ tiles @ columns) / (height * width)


@njit(forceinline=True, cache=True)
def _blur(values, at, step):
    """Window over 16 neighbours at a time, from values[at] on; `step` from one tap to the next."""
    return (
        (load16(values, at) + load16(values, at + 10 * step)) * _K0
        + (load16(values, at + step) + load16(values, at + 9 * step)) * _K1
        + (load16(values, at + 2 * step) + load16(values, at + 8 * step)) * _K2
        + (load16(values, at + 3 * step) + load16(values, at + 7 * step)) * _K3
        + (load16(values, at + 4 * step) + load16(values, at + 6 * step)) * _K4
        + load16(values, at + 5 * step) * _K5
    )


@njit(forceinline=True, cache=True)
def _quality(mx, my, squares, product):
    """SSIM and its derivatives by the first image's mean, by a variance and by the covariance."""
    a1, b1 = mx * my * _TWO + _C1, mx * mx + my * my + _C1
    a2, b2 = (product - mx * my) * _TWO + _C2, squares - mx * mx - my * my + _C2
    inverse = _ONE / (b1 * b2)
    value = a1 * a2 * inverse
    by_covariance = a1 * inverse * _TWO
    by_variance = -value * b1 * inverse
    by_mean = (my * a2 * inverse - mx * value * b2 * inverse - mx * by_variance) * _TWO - my * by_covariance
    return value, by_mean, by_variance, by_covariance


@njit(cache=True)
def _blocks(tiles, top, bottom, needed, near):
    """Which blocks of 16 columns hold a tile of the strip that counts, and which lie next to one."""
    needed[:] = False
    for row in range(top // LANES, (bottom + LANES - 1) // LANES):
        needed |= tiles[row]
    near[:] = needed
    near[:-1] |= needed[1:]
    near[1:] |= needed[:-1]


@njit(parallel=True, cache=True)
def compare(x, y, tiles, scratch, ssim, derivatives, sums):
    """SSIM of x, y [H, W, 3] into ssim [3, H, W'], its derivatives [3, 3, H, W'], sums [3, strips].

    tiles [ceil(H/16), W'/16]: those that are false count nowhere, and windows see y in x's place there;
    what stands in ssim and derivatives there means nothing.
    """
    height, width, channels = x.shape
    wide = ssim.shape[2]
    strips = sums.shape[1]
    plane = channels * height * wide
    line = wide + LANES  # rows a power of two apart would fall into the same few sets of the cache
    area = (_STRIP + 2 * _RADIUS) * line
    for job in prange(strips * channels):
        channel, top = job // strips, (job % strips) * _STRIP
        bottom = min(top + _STRIP, height)
        needed, near = np.empty(wide // LANES, np.bool_), np.empty(wide // LANES, np.bool_)
        _blocks(tiles, top, bottom, needed, near)
        sums[channel, job % strips] = 0.0
        if not needed.any():
            continue
        rows, blurred = scratch[get_thread_id(), area * 4 :], scratch[get_thread_id()]
        scratch[get_thread_id()] = _ZERO
        for r in range(max(top - _RADIUS, 0), min(bottom + _RADIUS, height)):
            whole = width // LANES * LANES
            for w in range(0, whole, LANES):
                if not near[w // LANES]:
                    continue
                at = (r * width + w) * 3
                if channel == 0:
                    a, b = load_red(x, at), load_red(y, at)
                elif channel == 1:
                    a, b = load_green(x, at), load_green(y, at)
                else:
                    a, b = load_blue(x, at), load_blue(y, at)
                if not tiles[r // LANES, w // LANES]:
                    a = b
                store(rows, w + _RADIUS, a)
                store(rows, line + w + _RADIUS, b)
                store(rows, 2 * line + w + _RADIUS, a * a + b * b)
                store(rows, 3 * line + w + _RADIUS, a * b)
            for w in range(whole, width):
                b = y[r, w, channel]
                a = x[r, w, channel] if tiles[r // LANES, w // LANES] else b
                rows[w + _RADIUS] = a
                rows[line + w + _RADIUS] = b
                rows[2 * line + w + _RADIUS] = a * a + b * b
                rows[3 * line + w + _RADIUS] = a * b
            for w in range(0, wide, LANES):
                if needed[w // LANES]:
                    for k in range(4):
                        at = k * area + (r - top + _RADIUS) * line + w
                        store(blurred, at, _blur(rows, k * line + w, 1))
        added = 0.0
        for r in range(top, bottom):
            for w in range(0, wide, LANES):
                if not tiles[r // LANES, w // LANES]:
                    continue
                at = (r - top) * line + w
                value, by_mean, by_variance, by_covariance = _quality(
                    _blur(blurred, at, line), _blur(blurred, area + at, line),
                    _blur(blurred, 2 * area + at, line), _blur(blurred, 3 * area + at, line),
                )  # fmt: skip
                at = (channel * height + r) * wide + w
                store(ssim, at, value)
                store(derivatives, at, by_mean)
                store(derivatives, plane + at, by_variance)
                store(derivatives, 2 * plane + at, by_covariance)
                added += total(where(load16(_COLUMNS, 0) + _F(w) < _F(width), value, _ZERO))
        sums[channel, job % strips] = added


@njit(cache=True)
def _run(tiles, w, width):
    """The next columns from w on, as first and last + 1, whose tiles count (a row of `tiles`)."""
    while w < width and not tiles[w // LANES]:
        w += LANES
    end = w
    while end < width and tiles[end // LANES]:
        end += LANES
    return w, min(end, width)


@njit(parallel=True, cache=True)
def gradient(x, y, tiles, scratch, derivatives, scale, l1_scale, out, sums):
    """scale * d(sum of SSIM)/dx + l1_scale * sign(x - y) into out [H, W, 3]; sums [3, strips] of |x - y|.

    `tiles` as in `compare`: nothing is added, and the gradient is zero, where they are false.
    """
    height, width, channels = x.shape
    wide = derivatives.shape[3]
    strips = sums.shape[1]
    line, area = wide + LANES, (_STRIP + 2 * _RADIUS) * (wide + LANES)
    for job in prange(strips * channels):
        channel, top = job // strips, (job % strips) * _STRIP
        bottom = min(top + _STRIP, height)
        needed, near = np.empty(wide // LANES, np.bool_), np.empty(wide // LANES, np.bool_)
        _blocks(tiles, top, bottom, needed, near)
        row, blurred = scratch[get_thread_id(), area * 4 :], scratch[get_thread_id()]
        smooth = row[line:]
        scratch[get_thread_id()] = _ZERO
        if needed.any():
            for r in range(max(top - _RADIUS, 0), min(bottom + _RADIUS, height)):
                for k in range(3):
                    row[_RADIUS : _RADIUS + width] = _ZERO
                    first, last = _run(tiles[r // LANES], 0, width)
                    while first < last:
                        row[_RADIUS + first : _RADIUS + last] = derivatives[k, channel, r, first:last]
                        first, last = _run(tiles[r // LANES], last, width)
                    for w in range(0, wide, LANES):
                        if needed[w // LANES]:
                            store(blurred, k * area + (r - top + _RADIUS) * line + w, _blur(row, w, 1))
        added = 0.0
        for r in range(top, bottom):
            first, last = _run(tiles[r // LANES], 0, width)
            out[r, :first, channel] = _ZERO
            error = _ZERO
            while first < last:
                for w in range(first, last, LANES):
                    for k in range(3):
                        store(smooth, k * wide + w, _blur(blurred, k * area + (r - top) * line + w, line))
                for w in range(first, last):
                    a, b = x[r, w, channel], y[r, w, channel]
                    error += abs(a - b)
                    by_ssim = smooth[w] + _TWO * a * smooth[wide + w] + b * smooth[2 * wide + w]
                    out[r, w, channel] = scale * by_ssim + l1_scale * (_F(a > b) - _F(a < b))
                begin = last
                first, last = _run(tiles[r // LANES], last, width)
                out[r, begin:first, channel] = _ZERO
            added += error
        sums[channel, job % strips] = added
