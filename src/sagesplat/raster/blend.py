"""Blending kernels: Gaussians into pixels and gradients back, one thread per 16x16 tile.

A tile's pixels lie in two halves of 8 columns (index = 128 * half + 8 * row + column), so that a Gaussian's
rows in a half are one run of memory: the loops over a run are what LLVM vectorises. An intersection is one
Gaussian in one tile; `records` holds what the loops need of each Gaussian:
mean x, y [px], exponent factors A, B, C (log2 alpha = L + A dx^2 + B dx dy + C dy^2), L = log2 opacity,
colour r, g, b, and half width and height of the bounding box [px].
"""

import numpy as np
from llvmlite import ir
from numba import njit, prange, types
from numba.extending import intrinsic

from sagesplat.raster.render import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN

TILE = 16
HALF = 8
PIXELS = TILE * TILE
PLANE = PIXELS + 16  # keeps a tile's planes off each other's cache sets
RECORD = 11
SUMS = 9  # per intersection: colour r, g, b, then gq times 1, dx, dy, dx^2, dx dy, dy^2

_F = np.float32
_LOG2_ALPHA_MIN = _F(np.log2(ALPHA_MIN))
_ALPHA_MAX = _F(ALPHA_MAX)
_T_MIN = _F(TRANSMITTANCE_MIN)
_ONE, _ZERO, _FLOOR = _F(1), _F(0), _F(-24)
# 2^f on [-1, 0]: minimax in relative error (7.5e-8)
_P0, _P1, _P2 = _F(0.9999999250706731), _F(0.6931422526108741), _F(0.24017218887313774)
_P3, _P4, _P5 = _F(0.05527972090328897), _F(0.009188609386239987), _F(0.0009387872768787113)
_BIAS, _MANTISSA = np.int32(127), np.int32(23)

# Planes of a tile's buffer (unsigned: no check for negative indices stands in the way of vectorising)
_U = np.uint64
_Y, _S0, _S1, _S2, _S3, _S4, _S5 = (_U(PLANE * k) for k in range(1, 8))

# No NaN or Inf assumptions: sums may be reordered (that is what vectorises them), nothing else.
FAST = {"contract", "reassoc", "nsz", "arcp"}


@intrinsic
def _bits_to_float(typing_context, bits):  # type: ignore[no-untyped-def]
    def generate(context, builder, signature, arguments):
        return builder.bitcast(arguments[0], ir.FloatType())

    return types.float32(types.int32), generate


@njit(inline="always")
def _exp2(q):
    """2^q for q in [-24, 1)."""
    whole = np.int32(q)
    f = q - np.float32(whole)
    p = _P4 + f * _P5
    p = _P3 + f * p
    p = _P2 + f * p
    p = _P1 + f * p
    p = _P0 + f * p
    return p * _bits_to_float(np.int32((whole + _BIAS) << _MANTISSA))  # pyright: ignore[reportCallIssue]


@njit(fastmath=FAST, error_model="numpy", cache=True)
def _blend_run(lo, hi, s, mx, my, a, b, c, log_opacity, red, green, blue):
    """Blend one Gaussian into pixels lo..hi of a tile; state rows: T, r, g, b."""
    for p in range(lo, hi):
        dx = s[p] - mx
        dy = s[p + _Y] - my
        q = log_opacity + dx * (a * dx + b * dy) + c * dy * dy
        alpha = min(_exp2(max(q, _FLOOR)), _ALPHA_MAX)
        left = s[p + _S0]
        weight = alpha * left if (q >= _LOG2_ALPHA_MIN) & (left >= _T_MIN) else _ZERO
        s[p + _S0] = left - weight
        s[p + _S1] += weight * red
        s[p + _S2] += weight * green
        s[p + _S3] += weight * blue


@njit(cache=True, inline="always")
def _rows(records, i, half, x0, y0):
    """Runs of a Gaussian's bounding box in one half of a tile: first row, last row + 1 (equal = none)."""
    left = x0 + _F(half * HALF)
    if records[i, 0] + records[i, 9] < left or records[i, 0] - records[i, 9] > left + _F(HALF):
        return 0, 0
    lo = max(0, int(np.floor(records[i, 1] - records[i, 10] - y0)))
    hi = min(TILE, int(np.ceil(records[i, 1] + records[i, 10] - y0)))
    return lo, max(lo, hi)


@njit(cache=True, inline="always")
def _pixel_centres(buffer, x0, y0):
    for p in range(PIXELS):
        half, rest = divmod(p, TILE * HALF)
        row, column = divmod(rest, HALF)
        buffer[p] = x0 + _F(half * HALF + column) + _F(0.5)
        buffer[PLANE + p] = y0 + _F(row) + _F(0.5)


@njit(parallel=True, cache=True)
def forward(records, starts, ids, tiles_x, width, height, background, image, left, ends):
    """Blend all tiles into image [H, W, 3] and left [H, W] (what remains of the transmittance).

    starts [tiles + 1] and ids [I] list the intersections by tile and depth; ends [tiles] receives where
    each tile stopped, for the backward pass. Tiles without intersections show the background.
    """
    for tile in prange(len(starts) - 1):
        column0, row0 = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
        x0, y0 = _F(column0), _F(row0)
        buffer = np.zeros(6 * PLANE, np.float32)
        _pixel_centres(buffer, x0, y0)
        state = buffer[2 * PLANE :].reshape(4, PLANE)
        state[0] = _ONE
        end = starts[tile + 1]
        for k in range(starts[tile], starts[tile + 1]):
            i = ids[k]
            for half in range(2):
                lo, hi = _rows(records, i, half, x0, y0)
                if lo < hi:
                    base = half * TILE * HALF
                    _blend_run(
                        _U(base + lo * HALF), _U(base + hi * HALF), buffer,
                        records[i, 0], records[i, 1], records[i, 2], records[i, 3], records[i, 4],
                        records[i, 5], records[i, 6], records[i, 7], records[i, 8],
                    )  # fmt: skip
            if k % 16 == 15 and state[0, :PIXELS].max() < _T_MIN:
                end = k + 1
                break
        ends[tile] = end
        for row in range(min(TILE, height - row0)):
            for column in range(min(TILE, width - column0)):
                half, inner = divmod(column, HALF)
                p = half * TILE * HALF + row * HALF + inner
                left[row0 + row, column0 + column] = state[0, p]
                for channel in range(3):
                    image[row0 + row, column0 + column, channel] = (
                        state[1 + channel, p] + state[0, p] * background[channel]
                    )


@njit(fastmath=FAST, error_model="numpy", cache=True)
def _gradient_run(lo, hi, s, mx, my, a, b, c, log_opacity, red, green, blue, sums, slot):
    """Add one Gaussian's gradient sums over pixels lo..hi; walks front to back.

    state rows: T, what is still to come of (gradient . colour), dL/d(r, g, b), dL/dalpha.
    """
    s0 = s1 = s2 = s3 = s4 = s5 = s6 = s7 = s8 = _ZERO
    for p in range(lo, hi):
        dx = s[p] - mx
        dy = s[p + _Y] - my
        q = log_opacity + dx * (a * dx + b * dy) + c * dy * dy
        raw = _exp2(max(q, _FLOOR))
        alpha = min(raw, _ALPHA_MAX)
        left = s[p + _S0]
        seen = (q >= _LOG2_ALPHA_MIN) & (left >= _T_MIN)
        weight = alpha * left if seen else _ZERO
        g0, g1, g2 = s[p + _S2], s[p + _S3], s[p + _S4]
        value = g0 * red + g1 * green + g2 * blue + s[p + _S5]
        rest = s[p + _S1] - weight * value
        s[p + _S1] = rest
        s[p + _S0] = left - weight
        slope = left * value - rest / (_ONE - alpha)
        gq = slope * alpha if seen & (raw < _ALPHA_MAX) else _ZERO
        s0 += weight * g0
        s1 += weight * g1
        s2 += weight * g2
        gx = gq * dx
        gy = gq * dy
        s3 += gq
        s4 += gx
        s5 += gy
        s6 += gx * dx
        s7 += gx * dy
        s8 += gy * dy
    sums[slot, 0] += s0
    sums[slot, 1] += s1
    sums[slot, 2] += s2
    sums[slot, 3] += s3
    sums[slot, 4] += s4
    sums[slot, 5] += s5
    sums[slot, 6] += s6
    sums[slot, 7] += s7
    sums[slot, 8] += s8


@njit(parallel=True, cache=True)
def backward(
    records, starts, ends, ids, slots, tiles_x, width, height, image, left, grad_image, grad_left, sums
):
    """Gradient sums of every intersection into sums [I, 9], at the row that `slots` gives it.

    image [H, W, 3] is what `forward` made; grad_left [H, W] is dL/d(remaining transmittance).
    """
    for tile in prange(len(starts) - 1):
        for k in range(starts[tile], starts[tile + 1]):
            for column in range(SUMS):
                sums[slots[k], column] = _ZERO
        if starts[tile] == ends[tile]:
            continue
        column0, row0 = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
        x0, y0 = _F(column0), _F(row0)
        buffer = np.zeros(8 * PLANE, np.float32)
        _pixel_centres(buffer, x0, y0)
        state = buffer[2 * PLANE :].reshape(6, PLANE)
        for row in range(min(TILE, height - row0)):
            for column in range(min(TILE, width - column0)):
                half, inner = divmod(column, HALF)
                p = half * TILE * HALF + row * HALF + inner
                y, x = row0 + row, column0 + column
                state[0, p] = _ONE
                total = _ZERO
                for channel in range(3):
                    state[2 + channel, p] = grad_image[y, x, channel]
                    total += grad_image[y, x, channel] * image[y, x, channel]
                # alpha = 1 - left is one more channel in which every Gaussian has the value 1
                state[5, p] = -grad_left[y, x]
                state[1, p] = total - grad_left[y, x] * (_ONE - left[y, x])
        for k in range(starts[tile], ends[tile]):
            i = ids[k]
            slot = slots[k]
            for half in range(2):
                lo, hi = _rows(records, i, half, x0, y0)
                if lo < hi:
                    base = half * TILE * HALF
                    _gradient_run(
                        _U(base + lo * HALF), _U(base + hi * HALF), buffer,
                        records[i, 0], records[i, 1], records[i, 2], records[i, 3], records[i, 4],
                        records[i, 5], records[i, 6], records[i, 7], records[i, 8], sums, slot,
                    )  # fmt: skip


@njit(parallel=True, cache=True)
def reduce(records, offsets, sums, g_mean2d, g_conic, g_opacity, g_color):
    """Add the sums of each Gaussian's intersections and turn them into gradients of its 2D parameters."""
    to_conic = _F(-2.0 / np.log2(np.e))
    for i in prange(len(records)):
        if offsets[i] == offsets[i + 1]:
            continue
        total = np.zeros(SUMS, np.float64)
        for slot in range(offsets[i], offsets[i + 1]):
            for column in range(SUMS):
                total[column] += sums[slot, column]
        a, b, c = to_conic * records[i, 2], _F(0.5) * to_conic * records[i, 3], to_conic * records[i, 4]
        g_mean2d[i, 0] += a * total[4] + b * total[5]
        g_mean2d[i, 1] += b * total[4] + c * total[5]
        g_conic[i, 0] -= 0.5 * total[6]
        g_conic[i, 1] -= total[7]
        g_conic[i, 2] -= 0.5 * total[8]
        g_opacity[i] += total[3] / 2.0 ** records[i, 5]
        for channel in range(3):
            g_color[i, channel] = total[channel]
