"""Blending kernels: Gaussians into pixels and gradients back, a row of 16x16 tiles per thread.

A tile's row of 16 pixels is one vector. An intersection is one Gaussian in one tile; `records` holds what
the loops need of each Gaussian:
mean x, y [px], exponent factors A, B, C (log2 alpha = L + A dx^2 + B dx dy + C dy^2), L = log2 opacity,
colour r, g, b, and half width and height of the bounding box [px].
"""

import numpy as np
from numba import prange

from sagesplat.kernels.jit import njit
from sagesplat.kernels.simd import (
    ceil,
    exp2,
    floor,
    gather,
    largest,
    load16,
    maximum,
    minimum,
    scatter,
    splat16,
    spread16,
    sqrt,
    store,
    store_totals,
    total,
    where,
)
from sagesplat.raster.render import ALPHA_MAX, ALPHA_MIN, TILE, TRANSMITTANCE_MIN

PIXELS = TILE * TILE
_BATCH = 16  # intersections between two looks whether a tile is opaque
_CHUNK = 256  # Gaussians that a thread takes at a time
RECORD = 11
BATCHED = RECORD + 1  # of a batch: rows of a stretch (see `_first_row`)
SUMS = 9  # per intersection: colour r, g, b, then gq times 1, dx, dy, dx^2, dx dy, dy^2

_F = np.float32
_LOG2_ALPHA_MIN = _F(np.log2(ALPHA_MIN))
_ALPHA_MIN, _ALPHA_MAX = _F(ALPHA_MIN), _F(ALPHA_MAX)
_T_MIN = _F(TRANSMITTANCE_MIN)
_ONE, _ZERO, _HALF = _F(1), _F(0), _F(0.5)
_TO_CONIC = _F(-2.0 / np.log2(np.e))  # of the exponent factors A, C, B / 2
_CENTRES = np.arange(TILE, dtype=np.float32) + _HALF
_FAR = _F(-100)  # log2 alpha from which no row of a stretch is seen
_STRETCH = _F(7.1)  # times 1 / sqrt(-C): so many rows raise log2 alpha from -100 to less than -8
_LONGEST = _F(8)  # rows of a stretch: more would add to the error
_SHARED = 6 * PIXELS  # where a Gaussian's values that depend on the row alone lie


@njit(error_model="numpy", forceinline=True, cache=True)
def gather_batch(records, ids, first, last, x0, y0, batch, rows):
    """Copy the records of a batch to where they are near; rows [2, 16]: first and last + 1 that each reaches.

    The highest point of an ellipse between two columns is its top, or lies on the column next to the top.
    """
    for j in range(last - first):
        for value in range(RECORD):
            batch[j, value] = records[ids[first + j], value]
    for j in range(0, _BATCH, 8):
        at, step = j * BATCHED, BATCHED
        mx, my = gather(batch, at, step), gather(batch, at + 1, step)
        a, b, c = gather(batch, at + 2, step), gather(batch, at + 3, step), gather(batch, at + 4, step)
        width, height = gather(batch, at + 9, step), gather(batch, at + 10, step)
        scatter(batch, at + RECORD, step, maximum(minimum(floor(_STRETCH / sqrt(-c)), _LONGEST), _ONE))
        left = x0 + _HALF - mx
        right = left + (TILE - 1)
        top = -b * height / (a + a)
        high, low = minimum(maximum(top, left), right), minimum(maximum(-top, left), right)
        steep = (gather(batch, at + 5, step) - _LOG2_ALPHA_MIN + 1e-3) / -c
        slack = 0.01 + 1e-3 * sqrt(steep)  # rounding, several times over
        high_part, low_part = high / width, low / width
        up = sqrt(maximum(steep * (_ONE - high_part * high_part), _ZERO)) + slack
        down = sqrt(maximum(steep * (_ONE - low_part * low_part), _ZERO)) + slack
        slope, centre = -b / (c + c), my - (y0 + _HALF)
        store(rows, j, maximum(ceil(centre + slope * low - down), _ZERO))
        store(rows, j + _BATCH, minimum(floor(centre + slope * high + up) + _ONE, _F(TILE)))


@njit(cache=True)
def _scratch():
    """Zeros for a tile's six planes and what its rows share, on a boundary of 64 bytes."""
    memory = np.zeros(7 * PIXELS + 16, np.float32)
    skip = (-memory.ctypes.data // 4) % 16
    return memory[skip : skip + 7 * PIXELS]


@njit(cache=True)
def _most(s):
    """Largest transmittance of a tile."""
    most = load16(s, 0)
    for row in range(1, TILE):
        most = maximum(most, load16(s, row * TILE))
    return largest(most)


@njit(forceinline=True, cache=True)
def _share_rows(s, lines, my, c):
    """What all columns have in common: 2^(C k^2) of the k-th row of a stretch, and dy of each row."""
    k = load16(_CENTRES, 0) - _HALF
    store(s, _SHARED, exp2(k * k * c))
    store(s, _SHARED + TILE, lines - my)


@njit(forceinline=True, cache=True)
def _first_row(s, row, dx, a, b, c, log_opacity):
    """Alpha in the first row of a stretch, and the power p with which it goes on.

    k rows below, alpha is that times p^k 2^(C k^2): no exponential for each row. Columns in which no row of
    the stretch is seen have 0, so that nothing overflows.
    """
    dy = s[_SHARED + TILE + row]
    q = dx * (dx * a + dy * b) + (dy * dy * c + log_opacity)
    slope = dx * b + (c + c) * dy
    lowest = where(slope > _ZERO, splat16(_FAR), splat16(_LOG2_ALPHA_MIN))
    return where(q >= lowest, exp2(q), _ZERO), exp2(slope)


@njit(error_model="numpy", cache=True)
def _blend(s, lo, hi, columns, lines, mx, my, a, b, c, log_opacity, red, green, blue, stretch):
    """Blend one Gaussian into rows lo..hi of a tile; planes of s: T, r, g, b, what rows share."""
    dx = columns - mx
    _share_rows(s, lines, my, c)
    while lo < hi:
        power, ratio = _first_row(s, lo, dx, a, b, c, log_opacity)
        end = min(lo + int(stretch), hi)
        for row in range(lo, end):
            p = row * TILE
            left = load16(s, p)
            raw = power * spread16(s, _SHARED + row - lo)
            seen = (raw >= _ALPHA_MIN) & (left >= _T_MIN)
            weight = where(seen, minimum(raw, _ALPHA_MAX) * left, _ZERO)
            power = power * ratio
            store(s, p, left - weight)
            store(s, p + PIXELS, load16(s, p + PIXELS) + weight * red)
            store(s, p + 2 * PIXELS, load16(s, p + 2 * PIXELS) + weight * green)
            store(s, p + 3 * PIXELS, load16(s, p + 3 * PIXELS) + weight * blue)
        lo = end


@njit(parallel=True, cache=True)
def forward(records, starts, ids, row_order, width, height, background, image, left, ends):
    """Blend all tiles into image [H, W, 3] and left [H, W] (what remains of the transmittance).

    starts [tiles + 1] and ids [I] list the intersections by tile and depth; ends [tiles] receives where
    each tile stopped, for the backward pass. Tiles without intersections show the background.
    """
    tiles_x = (width + TILE - 1) // TILE
    for r in prange(len(row_order)):
        state = _scratch()
        batch, rows = np.zeros((_BATCH, BATCHED), np.float32), np.empty((2, _BATCH), np.float32)
        for column in range(tiles_x):
            tile, row0, column0 = row_order[r] * tiles_x + column, row_order[r] * TILE, column * TILE
            x0, y0 = _F(column0), _F(row0)
            columns, lines = load16(_CENTRES, 0) + x0, load16(_CENTRES, 0) + y0
            state[:PIXELS] = _ONE
            state[PIXELS : 4 * PIXELS] = _ZERO
            end = starts[tile]
            while end < starts[tile + 1] and _most(state) >= _T_MIN:
                first, end = end, min(end + _BATCH, starts[tile + 1])
                gather_batch(records, ids, first, end, x0, y0, batch, rows)
                for j in range(end - first):
                    lo, hi = int(rows[0, j]), int(rows[1, j])
                    if lo < hi:
                        _blend(
                            state, lo, hi, columns, lines, batch[j, 0], batch[j, 1], batch[j, 2],
                            batch[j, 3], batch[j, 4], batch[j, 5], batch[j, 6], batch[j, 7], batch[j, 8],
                            batch[j, RECORD],
                        )  # fmt: skip
            ends[tile] = end
            for y in range(row0, min(row0 + TILE, height)):
                for x in range(column0, min(column0 + TILE, width)):
                    p = (y - row0) * TILE + x - column0
                    left[y, x] = state[p]
                    for channel in range(3):
                        painted = state[PIXELS * (1 + channel) + p]
                        image[y, x, channel] = painted + state[p] * background[channel]


@njit(error_model="numpy", cache=True)
def _pass(s, lo, hi, columns, lines, mx, my, a, b, c, log_opacity, red, green, blue, stretch):
    """What `_gradient` does to the planes, for a Gaussian whose own gradient nobody asks for."""
    dx = columns - mx
    _share_rows(s, lines, my, c)
    while lo < hi:
        power, ratio = _first_row(s, lo, dx, a, b, c, log_opacity)
        end = min(lo + int(stretch), hi)
        for row in range(lo, end):
            p = row * TILE
            left = load16(s, p)
            raw = power * spread16(s, _SHARED + row - lo)
            seen = (raw >= _ALPHA_MIN) & (left >= _T_MIN)
            weight = where(seen, minimum(raw, _ALPHA_MAX) * left, _ZERO)
            power = power * ratio
            g0, g1, g2 = load16(s, p + 2 * PIXELS), load16(s, p + 3 * PIXELS), load16(s, p + 4 * PIXELS)
            value = g0 * red + g1 * green + g2 * blue + load16(s, p + 5 * PIXELS)
            store(s, p + PIXELS, load16(s, p + PIXELS) - weight * value)
            store(s, p, left - weight)
        lo = end


@njit(error_model="numpy", cache=True)
def _gradient(
    s, lo, hi, columns, lines, mx, my, a, b, c, log_opacity, red, green, blue, stretch, sums, absolute, slot
):
    """One Gaussian's gradient sums over rows lo..hi; walks front to back.

    Planes of s: T, what is still to come of (gradient . colour), dL/d(r, g, b), dL/dalpha. `absolute` [I, 2]
    (or None) receives the sums of |dL/d mean|.
    """
    dx = columns - mx
    _share_rows(s, lines, my, c)
    s0 = s1 = s2 = r0 = r1 = r2 = across = up = splat16(_ZERO)
    while lo < hi:
        power, ratio = _first_row(s, lo, dx, a, b, c, log_opacity)
        end = min(lo + int(stretch), hi)
        for row in range(lo, end):
            p = row * TILE
            left = load16(s, p)
            raw = power * spread16(s, _SHARED + row - lo)
            # lanes that are not seen may hold any value, also ones that are slow to compute with
            alpha = where((raw >= _ALPHA_MIN) & (left >= _T_MIN), minimum(raw, _ALPHA_MAX), _ZERO)
            power = power * ratio
            weight = alpha * left
            g0, g1, g2 = load16(s, p + 2 * PIXELS), load16(s, p + 3 * PIXELS), load16(s, p + 4 * PIXELS)
            value = g0 * red + g1 * green + g2 * blue + load16(s, p + 5 * PIXELS)
            rest = load16(s, p + PIXELS) - weight * value
            store(s, p + PIXELS, rest)
            store(s, p, left - weight)
            gq = where(raw < _ALPHA_MAX, alpha * (left * value - rest / (_ONE - alpha)), _ZERO)
            s0 = s0 + weight * g0
            s1 = s1 + weight * g1
            s2 = s2 + weight * g2
            r0 = r0 + gq
            down = spread16(s, _SHARED + TILE + row)
            along = gq * down
            r1 = r1 + along
            r2 = r2 + along * down
            if absolute is not None:
                by_x, by_y = (dx * a + down * (b * _HALF)) * gq, (dx * (b * _HALF) + down * c) * gq
                across = across + maximum(by_x, -by_x)
                up = up + maximum(by_y, -by_y)
        lo = end
    if absolute is not None:
        absolute[slot, 0], absolute[slot, 1] = total(across) * -_TO_CONIC, total(up) * -_TO_CONIC
    rdx = r0 * dx
    store_totals(sums, slot * SUMS, s0, s1, s2, r0, rdx, r1, rdx * dx, r1 * dx)
    sums[slot, 8] = total(r2)


@njit(parallel=True, cache=True)
def backward(
    records, radii, starts, ends, ids, slots, row_order, width, height, image, left, grad_image, grad_left,
    sums, absolute,
):  # fmt: skip
    """Gradient sums of every intersection into sums [I, 9], at the row that `slots` gives it.

    image [H, W, 3] is what `forward` made; grad_left [H, W] is dL/d(remaining transmittance). Gaussians of
    radius 0 take no gradient: their sums are not written. `absolute` [I, 2] or None: see `_gradient`.
    """
    tiles_x = (width + TILE - 1) // TILE
    for r in prange(len(row_order)):
        state = _scratch()
        batch, rows = np.zeros((_BATCH, BATCHED), np.float32), np.empty((2, _BATCH), np.float32)
        for column in range(tiles_x):
            tile, row0, column0 = row_order[r] * tiles_x + column, row_order[r] * TILE, column * TILE
            for k in range(ends[tile], starts[tile + 1]):
                sums[slots[k]] = _ZERO
                if absolute is not None:
                    absolute[slots[k]] = _ZERO
            if starts[tile] == ends[tile]:
                continue
            x0, y0 = _F(column0), _F(row0)
            columns, lines = load16(_CENTRES, 0) + x0, load16(_CENTRES, 0) + y0
            state[: 6 * PIXELS] = _ZERO
            for y in range(row0, min(row0 + TILE, height)):
                for x in range(column0, min(column0 + TILE, width)):
                    p = (y - row0) * TILE + x - column0
                    rest = grad_left[y, x] * (left[y, x] - _ONE)
                    for channel in range(3):
                        state[PIXELS * (2 + channel) + p] = grad_image[y, x, channel]
                        rest += grad_image[y, x, channel] * image[y, x, channel]
                    state[p] = _ONE
                    state[PIXELS + p] = rest
                    # alpha = 1 - left is one more channel in which every Gaussian has the value 1
                    state[5 * PIXELS + p] = -grad_left[y, x]
            for first in range(starts[tile], ends[tile], _BATCH):
                last = min(first + _BATCH, ends[tile])
                gather_batch(records, ids, first, last, x0, y0, batch, rows)
                for j in range(last - first):
                    lo, hi, slot = int(rows[0, j]), int(rows[1, j]), slots[first + j]
                    if lo < hi and radii[ids[first + j]] > 0:
                        _gradient(
                            state, lo, hi, columns, lines, batch[j, 0], batch[j, 1], batch[j, 2],
                            batch[j, 3], batch[j, 4], batch[j, 5], batch[j, 6], batch[j, 7], batch[j, 8],
                            batch[j, RECORD], sums, absolute, slot,
                        )  # fmt: skip
                    elif lo < hi:
                        _pass(
                            state, lo, hi, columns, lines, batch[j, 0], batch[j, 1], batch[j, 2],
                            batch[j, 3], batch[j, 4], batch[j, 5], batch[j, 6], batch[j, 7], batch[j, 8],
                            batch[j, RECORD],
                        )  # fmt: skip
                    else:
                        sums[slot] = _ZERO
                        if absolute is not None:
                            absolute[slot] = _ZERO


@njit(parallel=True, cache=True)
def weigh(records, starts, ids, slots, row_order, width, height, columns_of, sums):
    """Sums of alpha T over each intersection's pixels, apart by column, into sums [I, columns].

    columns_of [H, W] tells each pixel's column; pixels of column -1 count nowhere.
    """
    tiles_x, num_columns = (width + TILE - 1) // TILE, sums.shape[1]
    for r in prange(len(row_order)):
        state, masks = _scratch(), np.zeros(num_columns * PIXELS, np.float32)
        batch, rows = np.zeros((_BATCH, BATCHED), np.float32), np.empty((2, _BATCH), np.float32)
        present = np.zeros(num_columns, np.bool_)
        for column in range(tiles_x):
            tile, row0, column0 = row_order[r] * tiles_x + column, row_order[r] * TILE, column * TILE
            x0, y0 = _F(column0), _F(row0)
            columns, lines = load16(_CENTRES, 0) + x0, load16(_CENTRES, 0) + y0
            state[:PIXELS] = _ZERO
            masks[:] = _ZERO
            present[:] = False
            for y in range(row0, min(row0 + TILE, height)):
                for x in range(column0, min(column0 + TILE, width)):
                    p, of = (y - row0) * TILE + x - column0, columns_of[y, x]
                    state[p] = _ONE
                    if of >= 0:
                        masks[of * PIXELS + p] = _ONE
                        present[of] = True
            end = starts[tile]
            while end < starts[tile + 1] and _most(state) >= _T_MIN:
                first, end = end, min(end + _BATCH, starts[tile + 1])
                gather_batch(records, ids, first, end, x0, y0, batch, rows)
                for j in range(end - first):
                    lo, hi, slot = int(rows[0, j]), int(rows[1, j]), slots[first + j]
                    # as a colour of 1 over a plane of zeros, each weight is left behind
                    state[PIXELS + lo * TILE : PIXELS + max(lo, hi) * TILE] = _ZERO
                    if lo < hi:
                        _blend(
                            state, lo, hi, columns, lines, batch[j, 0], batch[j, 1], batch[j, 2],
                            batch[j, 3], batch[j, 4], batch[j, 5], _ONE, _ZERO, _ZERO, batch[j, RECORD],
                        )  # fmt: skip
                    for of in range(num_columns):
                        added = splat16(_ZERO)
                        if present[of]:
                            for row in range(lo, hi):
                                weight = load16(state, PIXELS + row * TILE)
                                added = added + weight * load16(masks, of * PIXELS + row * TILE)
                        sums[slot, of] = total(added)
            for k in range(end, starts[tile + 1]):
                sums[slots[k]] = _ZERO


@njit(error_model="numpy", cache=True)
def _cover(s, plane, lo, hi, columns, lines, mx, my, a, b, c, log_opacity, stretch):
    """What `_blend` does, with one channel of 1 that lies at `plane`."""
    dx = columns - mx
    _share_rows(s, lines, my, c)
    while lo < hi:
        power, ratio = _first_row(s, lo, dx, a, b, c, log_opacity)
        end = min(lo + int(stretch), hi)
        for row in range(lo, end):
            p = row * TILE
            left = load16(s, p)
            raw = power * spread16(s, _SHARED + row - lo)
            seen = (raw >= _ALPHA_MIN) & (left >= _T_MIN)
            weight = where(seen, minimum(raw, _ALPHA_MAX) * left, _ZERO)
            power = power * ratio
            store(s, p, left - weight)
            store(s, plane + p, load16(s, plane + p) + weight)
        lo = end


@njit(parallel=True, cache=True)
def most(records, starts, ids, row_order, width, height, columns_of, num_columns, out):
    """The column of which most is painted in each pixel, into out [H, W]; columns_of [N]: of each Gaussian.

    What remains of the transmittance counts for column 0; of equals the first is taken.
    """
    tiles_x, planes = (width + TILE - 1) // TILE, 7 * PIXELS
    for r in prange(len(row_order)):
        state = np.zeros(planes + num_columns * PIXELS, np.float32)
        batch, rows = np.zeros((_BATCH, BATCHED), np.float32), np.empty((2, _BATCH), np.float32)
        for column in range(tiles_x):
            tile, row0, column0 = row_order[r] * tiles_x + column, row_order[r] * TILE, column * TILE
            x0, y0 = _F(column0), _F(row0)
            columns, lines = load16(_CENTRES, 0) + x0, load16(_CENTRES, 0) + y0
            state[:PIXELS] = _ONE
            state[planes:] = _ZERO
            end = starts[tile]
            while end < starts[tile + 1] and _most(state) >= _T_MIN:
                first, end = end, min(end + _BATCH, starts[tile + 1])
                gather_batch(records, ids, first, end, x0, y0, batch, rows)
                for j in range(end - first):
                    lo, hi = int(rows[0, j]), int(rows[1, j])
                    if lo < hi:
                        _cover(
                            state, planes + columns_of[ids[first + j]] * PIXELS, lo, hi, columns, lines,
                            batch[j, 0], batch[j, 1], batch[j, 2], batch[j, 3], batch[j, 4], batch[j, 5],
                            batch[j, RECORD],
                        )  # fmt: skip
            for p in range(PIXELS):
                state[planes + p] += state[p]
            for y in range(row0, min(row0 + TILE, height)):
                for x in range(column0, min(column0 + TILE, width)):
                    at = planes + (y - row0) * TILE + x - column0
                    best = 0
                    for of in range(1, num_columns):
                        if state[at + of * PIXELS] > state[at + best * PIXELS]:
                            best = of
                    out[y, x] = best


@njit(parallel=True, cache=True)
def add_by_gaussian(offsets, sums, out):
    """Add the sums [I, columns] of each Gaussian's intersections to its row of out [N, columns]."""
    for i in prange(len(offsets) - 1):
        for slot in range(offsets[i], offsets[i + 1]):
            for column in range(sums.shape[1]):
                out[i, column] += sums[slot, column]


@njit(parallel=True, cache=True)
def copy_means(records, radii, means2d):
    """The 2D means [N, 2] of what is drawn; zeros for the rest."""
    for i in prange(len(radii)):
        for axis in range(2):
            means2d[i, axis] = records[i, axis] if radii[i] > 0 else _ZERO


@njit(parallel=True, cache=True)
def reduce(records, radii, offsets, sums, g_mean2d, g_conic, g_opacity, g_color):
    """Add the sums of each Gaussian's intersections and turn them into gradients of its 2D parameters.

    Gaussians of radius 0 are left out.
    """
    n = len(records)
    for chunk in prange((n + _CHUNK - 1) // _CHUNK):
        added = np.empty(SUMS, np.float64)
        for i in range(chunk * _CHUNK, min((chunk + 1) * _CHUNK, n)):
            if offsets[i] == offsets[i + 1] or radii[i] <= 0:
                continue
            added[:] = 0.0
            for slot in range(offsets[i], offsets[i + 1]):
                for column in range(SUMS):
                    added[column] += sums[slot, column]
            a, b, c = _TO_CONIC * records[i, 2], _HALF * _TO_CONIC * records[i, 3], _TO_CONIC * records[i, 4]
            g_mean2d[i, 0] += a * added[4] + b * added[5]
            g_mean2d[i, 1] += b * added[4] + c * added[5]
            g_conic[i, 0] -= 0.5 * added[6]
            g_conic[i, 1] -= added[7]
            g_conic[i, 2] -= 0.5 * added[8]
            g_opacity[i] += added[3] / 2.0 ** records[i, 5]
            for channel in range(3):
                g_color[i, channel] = added[channel]
