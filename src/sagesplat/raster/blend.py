"""Blending kernels: Gaussians into pixels and gradients back, a row of 16x16 tiles per thread.

A tile is walked in bands of as many columns as a vector has lanes: one band of 16 where the machine has such
registers, else two of 8, so that what the loops keep fits into registers and bands that an ellipse does not
reach cost nothing. An intersection is one Gaussian in one tile; `records` holds what the loops need of each
Gaussian:
mean x, y [px], exponent factors A, B, C (log2 alpha = L + A dx^2 + B dx dy + C dy^2), L = log2 opacity,
colour r, g, b, and half width and height of the bounding box [px].
Images are in planes (`kernels/planes.py`); what stands beyond column W means nothing.
"""

import numpy as np
from numba import prange

from sagesplat.kernels.jit import njit
from sagesplat.kernels.simd import (
    LANES,
    ceil,
    exp2,
    floor,
    fma,
    largest,
    load,
    load8,
    maximum,
    minimum,
    prefetch,
    splat,
    spread,
    sqrt,
    store,
    store_totals,
    total,
    where,
)
from sagesplat.raster.render import ALPHA_MAX, ALPHA_MIN, TILE, TRANSMITTANCE_MIN

BANDS = TILE // LANES
PIXELS = TILE * TILE
BAND = TILE * LANES  # pixels; a plane of a tile is [bands, rows, lanes]
BATCH = 16  # intersections between two looks whether a tile is opaque
RECORD = 11
BATCHED = RECORD + 1  # of a batch: rows of a stretch (see `first_row`)
SUMS = 9  # per intersection: colour r, g, b, then gq times 1, dx, dy, dx^2, dx dy, dy^2
SHARED = 6 * PIXELS  # where a Gaussian's values that depend on the row alone lie

_F = np.float32
_LOG2_ALPHA_MIN = _F(np.log2(ALPHA_MIN))
_ALPHA_MIN, _ALPHA_MAX = _F(ALPHA_MIN), _F(ALPHA_MAX)
_T_MIN = _F(TRANSMITTANCE_MIN)
_ONE, _ZERO, _HALF = _F(1), _F(0), _F(0.5)
TO_CONIC = _F(-2.0 / np.log2(np.e))  # of the exponent factors A, C, B / 2
_CENTRES = np.arange(TILE, dtype=np.float32) + _HALF
_FAR = _F(-100)  # log2 alpha from which no row of a stretch is seen
_STRETCH = _F(7.1)  # times 1 / sqrt(-C): so many rows raise log2 alpha from -100 to less than -8
_LONGEST = _F(8)  # rows of a stretch: more would add to the error


@njit(error_model="numpy", forceinline=True, cache=True)
def gather_batch(records, ids, first, last, x0, y0, batch, rows):
    """Copy a batch's records to batch [12, 16]; rows [bands, 2, 16]: first and last + 1 that each reaches.

    The highest point of an ellipse between two columns is its top, or lies on the column next to the top.
    """
    for k in range(last, min(last + BATCH, len(ids))):
        prefetch(records, np.int64(ids[k]) * RECORD)
        prefetch(records, np.int64(ids[k]) * RECORD + RECORD - 1)
    for j in range(np.uint64(last - first)):
        i = np.uint64(ids[np.uint64(first) + j])
        for value in range(np.uint64(RECORD)):
            batch[value, j] = records[i, value]
    for j in range(0, BATCH, 8):
        mx, my = load8(batch, j), load8(batch, BATCH + j)
        a, b, c = load8(batch, 2 * BATCH + j), load8(batch, 3 * BATCH + j), load8(batch, 4 * BATCH + j)
        width, height = load8(batch, 9 * BATCH + j), load8(batch, 10 * BATCH + j)
        stretch = maximum(minimum(floor(_STRETCH / sqrt(-c)), _LONGEST), _ONE)
        store(batch, RECORD * BATCH + j, stretch)
        top = -b * height / (a + a)
        steep = (load8(batch, 5 * BATCH + j) - _LOG2_ALPHA_MIN + 1e-3) / -c
        slack = 0.01 + 1e-3 * sqrt(steep)  # rounding, several times over
        slope, centre, inverse = -b / (c + c), my - (y0 + _HALF), _ONE / width
        for band in range(BANDS):
            left = x0 + (_F(band * LANES) + _HALF) - mx
            right = left + _F(LANES - 1)
            high, low = minimum(maximum(top, left), right), minimum(maximum(-top, left), right)
            high_part, low_part = high * inverse, low * inverse
            up = sqrt(maximum(steep * (_ONE - high_part * high_part), _ZERO)) + slack
            down = sqrt(maximum(steep * (_ONE - low_part * low_part), _ZERO)) + slack
            at = 2 * BATCH * band + j
            store(rows, at, maximum(ceil(centre + slope * low - down), _ZERO))
            store(rows, at + BATCH, minimum(floor(centre + slope * high + up) + _ONE, _F(TILE)))


@njit(cache=True)
def new_batch():
    """Memory for `gather_batch`."""
    return np.zeros((BATCHED, BATCH), np.float32), np.zeros((BANDS, 2, BATCH), np.float32)


@njit(cache=True)
def scratch(size):
    """Zeros for `size` planes of a tile and one for what its rows share, on a boundary of 64 bytes."""
    memory = np.zeros((size + 1) * PIXELS + 16, np.float32)
    skip = (-memory.ctypes.data // 4) % 16
    return memory[skip : skip + (size + 1) * PIXELS]


@njit(cache=True)
def transparent(s):
    """Whether any pixel of a tile takes more."""
    most = load(s, 0)
    for at in range(LANES, PIXELS, LANES):
        most = maximum(most, load(s, at))
    return largest(most) >= _T_MIN


@njit(forceinline=True, cache=True)
def share_rows(s, batch, j, y0):
    """What all columns have in common: 2^(C k^2) of the k-th row of a stretch, dy and dy^2 of each row."""
    c, my = spread(batch, 4 * BATCH + j), spread(batch, BATCH + j)
    k = load(_CENTRES, 0) - _HALF
    store(s, SHARED, exp2(k * k * c))
    for row in range(0, TILE, LANES):
        dy = load(_CENTRES, row) + y0 - my
        store(s, SHARED + TILE + row, dy)
        store(s, SHARED + 2 * TILE + row, dy * dy)


@njit(forceinline=True, cache=True)
def columns_from(batch, j, band, x0):
    """dx of a band's columns."""
    return load(_CENTRES, band * LANES) + x0 - spread(batch, j)


@njit(forceinline=True, cache=True)
def first_row(s, row, dx, batch, j):
    """Alpha in the first row of a stretch, and the power p with which it goes on.

    k rows below, alpha is that times p^k 2^(C k^2): no exponential for each row. Columns in which no row of
    the stretch is seen have 0, so that nothing overflows.
    """
    a, b, c = spread(batch, 2 * BATCH + j), spread(batch, 3 * BATCH + j), spread(batch, 4 * BATCH + j)
    dy = spread(s, SHARED + TILE + row)
    q = dx * (dx * a + dy * b) + (dy * dy * c + spread(batch, 5 * BATCH + j))
    slope = dx * b + (c + c) * dy
    lowest = where(slope > _ZERO, splat(_FAR), splat(_LOG2_ALPHA_MIN))
    return where(q >= lowest, exp2(q), _ZERO), exp2(slope)


@njit(forceinline=True, cache=True)
def row_alpha(raw, left):
    """Alpha of a row, 0 in lanes that are not seen: these may hold any value, also slow ones."""
    return where((raw >= _ALPHA_MIN) & (left >= _T_MIN), minimum(raw, _ALPHA_MAX), _ZERO)


@njit(forceinline=True, cache=True)
def _colour(batch, j):
    return spread(batch, 6 * BATCH + j), spread(batch, 7 * BATCH + j), spread(batch, 8 * BATCH + j)


@njit(error_model="numpy", forceinline=True, cache=True)
def _blend(s, batch, rows, j, x0, y0):
    """Blend one Gaussian into a tile; planes of s: T, r, g, b."""
    share_rows(s, batch, j, y0)
    red, green, blue = _colour(batch, j)
    stretch = int(batch[RECORD, j])
    for band in range(BANDS):
        lo, hi = int(rows[band, 0, j]), int(rows[band, 1, j])
        dx = columns_from(batch, j, band, x0)
        while lo < hi:
            power, ratio = first_row(s, lo, dx, batch, j)
            end = min(lo + stretch, hi)
            for row in range(lo, end):
                p = band * BAND + row * LANES
                left = load(s, p)
                weight = row_alpha(power * spread(s, SHARED + row - lo), left) * left
                power = power * ratio
                store(s, p, left - weight)
                store(s, p + PIXELS, load(s, p + PIXELS) + weight * red)
                store(s, p + 2 * PIXELS, load(s, p + 2 * PIXELS) + weight * green)
                store(s, p + 3 * PIXELS, load(s, p + 3 * PIXELS) + weight * blue)
            lo = end


@njit(parallel=True, cache=True)
def forward(records, starts, ids, row_order, width, height, background, image, left, ends):
    """Blend all tiles into image [3, H, W'] and left [H, W'] (what remains of the transmittance).

    starts [tiles + 1] and ids [I] list the intersections by tile and depth; ends [tiles] receives where
    each tile stopped, for the backward pass. Tiles without intersections show the background.
    """
    tiles_x = (width + TILE - 1) // TILE
    wide, plane = left.shape[1], left.size
    for r in prange(len(row_order)):
        state, (batch, rows) = scratch(6), new_batch()
        for column in range(tiles_x):
            tile, row0, column0 = row_order[r] * tiles_x + column, row_order[r] * TILE, column * TILE
            x0, y0 = _F(column0), _F(row0)
            state[:PIXELS] = _ONE
            state[PIXELS : 4 * PIXELS] = _ZERO
            end = starts[tile]
            while end < starts[tile + 1] and transparent(state):
                first, end = end, min(end + BATCH, starts[tile + 1])
                gather_batch(records, ids, first, end, x0, y0, batch, rows)
                for j in range(end - first):
                    _blend(state, batch, rows, j, x0, y0)
            ends[tile] = end
            for y in range(row0, min(row0 + TILE, height)):
                for band in range(BANDS):
                    p, at = band * BAND + (y - row0) * LANES, y * wide + column0 + band * LANES
                    remains = load(state, p)
                    store(left, at, remains)
                    for channel in range(3):
                        painted = load(state, PIXELS * (1 + channel) + p)
                        store(image, channel * plane + at, painted + remains * background[channel])


@njit(error_model="numpy", forceinline=True, cache=True)
def _pass(s, batch, rows, j, x0, y0):
    """What `_gradient` does to the planes, for a Gaussian whose own gradient nobody asks for."""
    share_rows(s, batch, j, y0)
    red, green, blue = _colour(batch, j)
    stretch = int(batch[RECORD, j])
    for band in range(BANDS):
        lo, hi = int(rows[band, 0, j]), int(rows[band, 1, j])
        dx = columns_from(batch, j, band, x0)
        while lo < hi:
            power, ratio = first_row(s, lo, dx, batch, j)
            end = min(lo + stretch, hi)
            for row in range(lo, end):
                p = band * BAND + row * LANES
                left = load(s, p)
                weight = row_alpha(power * spread(s, SHARED + row - lo), left) * left
                power = power * ratio
                g0, g1, g2 = load(s, p + 2 * PIXELS), load(s, p + 3 * PIXELS), load(s, p + 4 * PIXELS)
                value = g0 * red + g1 * green + g2 * blue + load(s, p + 5 * PIXELS)
                store(s, p + PIXELS, fma(-weight, value, load(s, p + PIXELS)))  # the same bits
                store(s, p, left - weight)
            lo = end


@njit(error_model="numpy", forceinline=True, cache=True)
def _gradient(s, batch, rows, j, x0, y0, sums, slot):
    """One Gaussian's gradient sums over its rows of a tile; walks front to back.

    Planes of s: T, what is still to come of (gradient . colour), dL/d(r, g, b), dL/dalpha.
    """
    share_rows(s, batch, j, y0)
    red, green, blue = _colour(batch, j)
    stretch = int(batch[RECORD, j])
    s0 = s1 = s2 = t0 = tx = ty = txx = txy = tyy = splat(_ZERO)
    for band in range(BANDS):
        lo, hi = int(rows[band, 0, j]), int(rows[band, 1, j])
        if lo >= hi:
            continue
        dx = columns_from(batch, j, band, x0)
        r0 = r1 = splat(_ZERO)
        while lo < hi:
            power, ratio = first_row(s, lo, dx, batch, j)
            end = min(lo + stretch, hi)
            for row in range(lo, end):
                p = band * BAND + row * LANES
                left = load(s, p)
                raw = power * spread(s, SHARED + row - lo)
                power = power * ratio
                alpha = row_alpha(raw, left)
                odds = alpha / maximum(_ONE - raw, _ONE - _ALPHA_MAX)
                weight = alpha * left
                g0, g1, g2 = load(s, p + 2 * PIXELS), load(s, p + 3 * PIXELS), load(s, p + 4 * PIXELS)
                value = g0 * red + g1 * green + g2 * blue + load(s, p + 5 * PIXELS)
                rest = fma(-weight, value, load(s, p + PIXELS))
                store(s, p + PIXELS, rest)
                store(s, p, left - weight)
                gq = where(raw < _ALPHA_MAX, weight * value - odds * rest, _ZERO)
                s0 = s0 + weight * g0
                s1 = s1 + weight * g1
                s2 = s2 + weight * g2
                r0 = r0 + gq
                r1 = r1 + gq * spread(s, SHARED + TILE + row)
                tyy = tyy + gq * spread(s, SHARED + 2 * TILE + row)
            lo = end
        rdx = r0 * dx
        t0, tx, ty, txx, txy = t0 + r0, tx + rdx, ty + r1, txx + rdx * dx, txy + r1 * dx
    store_totals(sums, slot * SUMS, s0, s1, s2, t0, tx, ty, txx, txy)
    sums[slot, 8] = total(tyy)


@njit(forceinline=True, cache=True)
def _receive(s, row0, column0, image, left, grad_image, grad_left):
    """A tile's planes before its first Gaussian (see `_gradient`), from gradients of the image."""
    height, wide = left.shape
    plane = left.size
    s[: 6 * PIXELS] = _ZERO
    for y in range(row0, min(row0 + TILE, height)):
        for band in range(BANDS):
            p, at = band * BAND + (y - row0) * LANES, y * wide + column0 + band * LANES
            rest = splat(_ZERO)
            for channel in range(3):
                by = load(grad_image, channel * plane + at)
                store(s, PIXELS * (2 + channel) + p, by)
                rest = rest + by * load(image, channel * plane + at)
            if grad_left.size > 0:
                # alpha = 1 - left is one more channel in which every Gaussian has the value 1
                by = load(grad_left, at)
                rest = rest + by * (load(left, at) - _ONE)
                store(s, 5 * PIXELS + p, -by)
            store(s, p, splat(_ONE))
            store(s, PIXELS + p, rest)


@njit(parallel=True, cache=True)
def backward(
    records, radii, starts, ends, ids, slots, row_order, width, image, left, grad_image, grad_left, reached,
    sums,
):  # fmt: skip
    """Gradient sums of every intersection into sums [I, 9], at the row that `slots` gives it.

    image [3, H, W'] is what `forward` made; grad_image, and grad_left [H, W'] of the remaining transmittance
    (or of no rows), have zeros beyond column W. reached [I], zeros before, is 1 in the rows that are
    written: not those of Gaussians of radius 0, which take no gradient, nor those behind opaque ones.
    `radii` [N] may have no rows: all take one.
    """
    tiles_x = (width + TILE - 1) // TILE
    for r in prange(len(row_order)):
        state, (batch, rows) = scratch(6), new_batch()
        for column in range(tiles_x):
            tile, row0, column0 = row_order[r] * tiles_x + column, row_order[r] * TILE, column * TILE
            if starts[tile] == ends[tile]:
                continue
            x0, y0 = _F(column0), _F(row0)
            _receive(state, row0, column0, image, left, grad_image, grad_left)
            for first in range(starts[tile], ends[tile], BATCH):
                last = min(first + BATCH, ends[tile])
                gather_batch(records, ids, first, last, x0, y0, batch, rows)
                for k in range(first, last):
                    prefetch(sums, np.int64(slots[k]) * SUMS)
                for j in range(last - first):
                    if len(radii) == 0 or radii[ids[first + j]] > 0:
                        slot = slots[first + j]
                        _gradient(state, batch, rows, j, x0, y0, sums, slot)
                        reached[slot] = True
                    else:
                        _pass(state, batch, rows, j, x0, y0)
