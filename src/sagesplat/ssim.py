"""SSIM fused with its gradient: 11x11 Gaussian window, sigma 1.5, zero padding, RGB in [0, 1], as in 3DGS."""

import numpy as np
from numba import njit, prange

WINDOW = 11
_RADIUS = WINDOW // 2
_STRIP = 32  # rows a thread works on at a time
_C1, _C2 = np.float32(0.01**2), np.float32(0.03**2)
_taps = np.exp(-((np.arange(WINDOW) - _RADIUS) ** 2) / (2 * 1.5**2))
_K0, _K1, _K2, _K3, _K4, _K5 = (np.float32(t) for t in (_taps / _taps.sum())[: _RADIUS + 1])
_U = np.uint64
_0, _1, _2, _3, _4, _5, _6, _7, _8, _9, _10 = (_U(i) for i in range(WINDOW))
_TWO, _ONE = np.float32(2), np.float32(1)
_FAST = {"contract", "nsz", "arcp", "reassoc"}


@njit(fastmath=_FAST, cache=True)
def _blur_row(row, out):
    """Window along a row that is padded by 5 on either side."""
    for w in range(_U(len(out))):
        out[w] = (
            _K0 * (row[w] + row[w + _10])
            + _K1 * (row[w + _1] + row[w + _9])
            + _K2 * (row[w + _2] + row[w + _8])
            + _K3 * (row[w + _3] + row[w + _7])
            + _K4 * (row[w + _4] + row[w + _6])
            + _K5 * row[w + _5]
        )


@njit(fastmath=_FAST, cache=True)
def _blur_column(rows, r, out):
    """Window down the columns of rows r..r+10."""
    for w in range(_U(len(out))):
        out[w] = (
            _K0 * (rows[r, w] + rows[r + _10, w])
            + _K1 * (rows[r + _1, w] + rows[r + _9, w])
            + _K2 * (rows[r + _2, w] + rows[r + _8, w])
            + _K3 * (rows[r + _3, w] + rows[r + _7, w])
            + _K4 * (rows[r + _4, w] + rows[r + _6, w])
            + _K5 * rows[r + _5, w]
        )


@njit(fastmath=_FAST, cache=True)
def _products(x, y, xx, yy, xy):
    for w in range(_U(len(x))):
        xx[w] = x[w] * x[w]
        yy[w] = y[w] * y[w]
        xy[w] = x[w] * y[w]


@njit(fastmath=_FAST, error_model="numpy", cache=True)
def _quality(mx, my, xx, yy, xy, ssim, d_mean, d_variance, d_covariance):
    """A row of the SSIM map and its derivatives by the first image's mean, variance and the covariance."""
    for w in range(_U(len(mx))):
        a1, b1 = _TWO * mx[w] * my[w] + _C1, mx[w] * mx[w] + my[w] * my[w] + _C1
        a2 = _TWO * (xy[w] - mx[w] * my[w]) + _C2
        b2 = xx[w] - mx[w] * mx[w] + yy[w] - my[w] * my[w] + _C2
        inverse = _ONE / (b1 * b2)
        value = a1 * a2 * inverse
        by_covariance = _TWO * a1 * inverse
        by_variance = -value / b2
        ssim[w] = value
        d_covariance[w] = by_covariance
        d_variance[w] = by_variance
        d_mean[w] = (
            _TWO * my[w] * a2 * inverse
            - _TWO * mx[w] * value / b1
            - my[w] * by_covariance
            - _TWO * mx[w] * by_variance
        )


@njit(parallel=True, cache=True)
def compare(x, y, ssim, derivatives):
    """SSIM maps of images x, y [H, W, C] into ssim [C, H, W], derivatives into [3, C, H, W]."""
    height, width, channels = x.shape
    strips = -(-height // _STRIP)
    for job in prange(strips * channels):
        channel, top = job // strips, (job % strips) * _STRIP
        bottom = min(top + _STRIP, height)
        padded = np.zeros((5, width + 2 * _RADIUS), np.float32)
        blurred = np.zeros((5, bottom - top + 2 * _RADIUS, width), np.float32)
        for r in range(max(top - _RADIUS, 0), min(bottom + _RADIUS, height)):
            for w in range(width):
                padded[0, w + _RADIUS] = x[r, w, channel]
                padded[1, w + _RADIUS] = y[r, w, channel]
            _products(padded[0], padded[1], padded[2], padded[3], padded[4])
            for k in range(5):
                _blur_row(padded[k], blurred[k, r - top + _RADIUS])
        rows = np.empty((5, width), np.float32)
        for r in range(top, bottom):
            for k in range(5):
                _blur_column(blurred[k], _U(r - top), rows[k])
            _quality(
                rows[0], rows[1], rows[2], rows[3], rows[4], ssim[channel, r],
                derivatives[0, channel, r], derivatives[1, channel, r], derivatives[2, channel, r],
            )  # fmt: skip


@njit(parallel=True, cache=True)
def gradient(x, y, derivatives, scale, l1_scale, out):
    """Add scale * d(sum of SSIM)/dx + l1_scale * sign(x - y) into out [H, W, C]."""
    height, width, channels = x.shape
    strips = -(-height // _STRIP)
    for job in prange(strips * channels):
        channel, top = job // strips, (job % strips) * _STRIP
        bottom = min(top + _STRIP, height)
        padded = np.zeros(width + 2 * _RADIUS, np.float32)
        blurred = np.zeros((3, bottom - top + 2 * _RADIUS, width), np.float32)
        for r in range(max(top - _RADIUS, 0), min(bottom + _RADIUS, height)):
            for k in range(3):
                padded[_RADIUS : _RADIUS + width] = derivatives[k, channel, r]
                _blur_row(padded, blurred[k, r - top + _RADIUS])
        rows = np.empty((3, width), np.float32)
        for r in range(top, bottom):
            for k in range(3):
                _blur_column(blurred[k], _U(r - top), rows[k])
            for w in range(width):
                a, b = x[r, w, channel], y[r, w, channel]
                by_ssim = rows[0, w] + _TWO * a * rows[1, w] + b * rows[2, w]
                out[r, w, channel] += scale * by_ssim + l1_scale * np.sign(a - b)
