"""Kernels that blend weights instead of colours: sums by Gaussian and column, each pixel's column."""

import numpy as np
from numba import prange

from sagesplat.kernels.jit import njit
from sagesplat.kernels.simd import LANES, load, splat, spread, store, total
from sagesplat.raster.blend import (
    BAND,
    BANDS,
    BATCH,
    PIXELS,
    RECORD,
    SHARED,
    columns_from,
    first_row,
    gather_batch,
    new_batch,
    row_alpha,
    scratch,
    share_rows,
    transparent,
)
from sagesplat.raster.render import TILE

_F = np.float32
_ONE, _ZERO = _F(1), _F(0)


@njit(error_model="numpy", forceinline=True, cache=True)
def _cover(s, plane, batch, rows, j, x0, y0):
    """Blend a colour of 1 into the plane that begins at s[plane]; plane 0 of s is T."""
    share_rows(s, batch, j, y0)
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
                store(s, plane + p, load(s, plane + p) + weight)
            lo = end


@njit(forceinline=True, cache=True)
def _pixel(row, column):
    """Where a pixel of a tile lies in a plane."""
    return column // LANES * BAND + row * LANES + column % LANES


@njit(parallel=True, cache=True)
def weigh(records, starts, ids, slots, row_order, width, height, columns_of, reached, sums):
    """Sums of alpha T over each intersection's pixels, apart by column, into sums [I, columns].

    columns_of [H, W] tells each pixel's column; pixels of column -1 count nowhere. reached [I], zeros before,
    is 1 in the rows that are written.
    """
    tiles_x, num_columns = (width + TILE - 1) // TILE, sums.shape[1]
    for r in prange(len(row_order)):
        state, masks, (batch, rows) = scratch(6), np.zeros(num_columns * PIXELS, np.float32), new_batch()
        present = np.zeros(num_columns, np.bool_)
        for column in range(tiles_x):
            tile, row0, column0 = row_order[r] * tiles_x + column, row_order[r] * TILE, column * TILE
            x0, y0 = _F(column0), _F(row0)
            state[:PIXELS] = _ZERO
            masks[:] = _ZERO
            present[:] = False
            for y in range(row0, min(row0 + TILE, height)):
                for x in range(column0, min(column0 + TILE, width)):
                    p, of = _pixel(y - row0, x - column0), columns_of[y, x]
                    state[p] = _ONE
                    if of >= 0:
                        masks[of * PIXELS + p] = _ONE
                        present[of] = True
            end = starts[tile]
            while end < starts[tile + 1] and transparent(state):
                first, end = end, min(end + BATCH, starts[tile + 1])
                gather_batch(records, ids, first, end, x0, y0, batch, rows)
                for j in range(end - first):
                    state[PIXELS : 2 * PIXELS] = _ZERO  # so that each weight is left behind
                    _cover(state, PIXELS, batch, rows, j, x0, y0)
                    slot = slots[first + j]
                    reached[slot] = True
                    for of in range(num_columns):
                        sums[slot, of] = _masked(state, masks, of, rows, j) if present[of] else _ZERO


@njit(forceinline=True, cache=True)
def _masked(state, masks, of, rows, j):
    """Sum over a Gaussian's rows of plane 1 where the mask of a column is 1."""
    added = splat(_ZERO)
    for band in range(BANDS):
        for row in range(int(rows[band, 0, j]), int(rows[band, 1, j])):
            p = band * BAND + row * LANES
            added = added + load(state, PIXELS + p) * load(masks, of * PIXELS + p)
    return total(added)


@njit(parallel=True, cache=True)
def most(records, starts, ids, row_order, width, height, columns_of, num_columns, out):
    """The column of which most is painted in each pixel, into out [H, W]; columns_of [N]: of each Gaussian.

    What remains of the transmittance counts for column 0; of equals the first is taken.
    """
    tiles_x, planes = (width + TILE - 1) // TILE, 7 * PIXELS
    for r in prange(len(row_order)):
        state, (batch, rows) = scratch(6 + num_columns), new_batch()
        present, found = np.zeros(num_columns, np.bool_), np.empty(num_columns, np.int64)
        for column in range(tiles_x):
            tile, row0, column0 = row_order[r] * tiles_x + column, row_order[r] * TILE, column * TILE
            x0, y0 = _F(column0), _F(row0)
            state[:PIXELS] = _ONE
            state[planes : planes + PIXELS] = _ZERO
            present[:] = False
            end = starts[tile]
            while end < starts[tile + 1] and transparent(state):
                first, end = end, min(end + BATCH, starts[tile + 1])
                gather_batch(records, ids, first, end, x0, y0, batch, rows)
                for j in range(end - first):
                    of = columns_of[ids[first + j]]
                    plane = planes + of * PIXELS
                    if of and not present[of]:
                        present[of] = True
                        state[plane : plane + PIXELS] = _ZERO
                    _cover(state, plane, batch, rows, j, x0, y0)
            count = 0
            for of in range(1, num_columns):  # the others have no part in this tile
                found[count] = of
                count += present[of]
            for p in range(PIXELS):
                state[planes + p] += state[p]
            for y in range(row0, min(row0 + TILE, height)):
                for x in range(column0, min(column0 + TILE, width)):
                    at = planes + _pixel(y - row0, x - column0)
                    best = 0
                    for k in range(count):
                        if state[at + found[k] * PIXELS] > state[at + best * PIXELS]:
                            best = found[k]
                    out[y, x] = best
