"""Which Gaussian meets which tile, in depth order: one radix sort and counting placement."""

from dataclasses import dataclass

import numpy as np
from numba import prange

from sagesplat.kernels.jit import njit
from sagesplat.kernels.simd import prefetch
from sagesplat.kernels.workspace import Workspace
from sagesplat.raster.blend import RECORD, TILE
from sagesplat.raster.project import tile_box
from sagesplat.raster.render import ALPHA_MIN

_AHEAD = 16  # Gaussians that are fetched before their turn: in order of depth they lie anywhere
_CHUNKS = 16  # fixed, so that the result does not depend on the number of threads


@dataclass(frozen=True, eq=False)
class Intersections:
    """Gaussians by tile and depth. An intersection's slot is its row when listed by Gaussian."""

    row_order: np.ndarray  # int64 [tile rows]
    starts: np.ndarray  # int64 [tiles + 1]
    ids: np.ndarray  # int32 [I], Gaussian of each intersection
    slots: np.ndarray  # int32 [I]
    offsets: np.ndarray  # int64 [N + 1], first slot of each Gaussian


@njit(cache=True)
def depth_order(depths, radii):
    """Indices of the drawn Gaussians (radius > 0), front to back; stable (LSD radix on the float's bits)."""
    n = 0
    for i in range(len(depths)):
        n += radii[i] > 0
    order, other = np.empty(n, np.int32), np.empty(n, np.int32)
    bits = depths.view(np.uint32)  # positive floats sort as their bits do
    n = 0
    for i in range(len(depths)):
        if radii[i] > 0:
            order[n] = i
            n += 1
    for shift in (0, 11, 22):
        starts = np.zeros(2049, np.int64)
        for i in order:
            starts[((bits[i] >> np.uint32(shift)) & np.uint32(2047)) + 1] += 1
        starts = np.cumsum(starts)
        for i in order:
            digit = (bits[i] >> np.uint32(shift)) & np.uint32(2047)
            other[starts[digit]] = i
            starts[digit] += 1
        order, other = other, order
    return order


@njit(error_model="numpy", forceinline=True, cache=True)
def _edge_maximum(along, across, cross, fixed, lo, hi):
    """Maximum over t in [lo, hi] of along t^2 + cross t fixed + across fixed^2 (along < 0)."""
    t = min(max(-0.5 * cross * fixed / along, lo), hi)
    return along * t * t + cross * t * fixed + across * fixed * fixed


@njit(error_model="numpy", forceinline=True, cache=True)
def _touches(records, i, tile_x, tile_y, threshold):
    """Whether alpha reaches its minimum anywhere between the centres of the tile's outer pixels (exact)."""
    x0, y0 = tile_x * TILE + 0.5 - records[i, 0], tile_y * TILE + 0.5 - records[i, 1]
    x1, y1 = x0 + TILE - 1, y0 + TILE - 1
    if x0 <= 0 <= x1 and y0 <= 0 <= y1:
        return True
    a, b, c = records[i, 2], records[i, 3], records[i, 4]
    best = -np.inf
    # the maximum lies on an edge that faces the centre
    if x0 > 0:
        best = max(best, _edge_maximum(c, a, b, x0, y0, y1))
    if x1 < 0:
        best = max(best, _edge_maximum(c, a, b, x1, y0, y1))
    if y0 > 0:
        best = max(best, _edge_maximum(a, c, b, y0, x0, x1))
    if y1 < 0:
        best = max(best, _edge_maximum(a, c, b, y1, x0, x1))
    return best + records[i, 5] >= threshold


@njit(parallel=True, cache=True)
def _count(records, order, tiles_x, tiles_y, tile_mask, threshold, per_tile, per_gaussian, boxes, met):
    """Counts; for `_place` each Gaussian's box of tiles, and a bit for each of its first 64 that it meets."""
    for chunk in prange(_CHUNKS):
        for k in range(chunk * len(order) // _CHUNKS, (chunk + 1) * len(order) // _CHUNKS):
            i, ahead = order[k], np.int64(order[min(k + _AHEAD, len(order) - 1)])
            prefetch(records, ahead * RECORD)
            prefetch(records, ahead * RECORD + RECORD - 1)
            x0, x1, y0, y1 = tile_box(
                records[i, 0], records[i, 1], records[i, 9], records[i, 10], tiles_x, tiles_y
            )
            boxes[k, 0], boxes[k, 1], boxes[k, 2], boxes[k, 3] = x0, x1, y0, y1
            bits, bit, total = np.uint64(0), np.uint64(1), 0
            for y in range(y0, y1):
                for x in range(x0, x1):
                    if tile_mask[y * tiles_x + x] and _touches(records, i, x, y, threshold):
                        per_tile[chunk, y * tiles_x + x] += 1
                        bits |= bit
                        total += 1
                    bit <<= np.uint64(1)
            met[k] = bits
            per_gaussian[i] = total


@njit(parallel=True, cache=True)
def _place(records, order, tiles_x, tile_mask, threshold, boxes, met, cursor, offsets, ids, slots):
    for chunk in prange(_CHUNKS):
        for k in range(chunk * len(order) // _CHUNKS, (chunk + 1) * len(order) // _CHUNKS):
            i = order[k]
            prefetch(offsets, np.int64(order[min(k + _AHEAD, len(order) - 1)]))
            slot, bits = offsets[i], met[k]
            x0, x1, y0, y1 = boxes[k, 0], boxes[k, 1], boxes[k, 2], boxes[k, 3]
            small = (x1 - x0) * (y1 - y0) <= 64
            for y in range(y0, y1):
                for x in range(x0, x1):
                    tile = y * tiles_x + x
                    if small:
                        meets = bits & np.uint64(1) != 0
                        bits >>= np.uint64(1)
                    else:
                        meets = tile_mask[tile] and _touches(records, i, x, y, threshold)
                    if meets:
                        at = cursor[chunk, tile]
                        cursor[chunk, tile] = at + 1
                        ids[at] = i
                        slots[at] = slot
                        slot += 1


def row_order(tiles_y: int) -> np.ndarray:
    """Rows of tiles by their reversed bits: each thread's stretch has rows from all over the image."""
    bits = max(1, (tiles_y - 1).bit_length())
    return np.argsort([int(f"{row:0{bits}b}"[::-1], 2) for row in range(tiles_y)])


def intersect(
    records: np.ndarray,
    depths: np.ndarray,
    radii: np.ndarray,
    width: int,
    height: int,
    tile_mask: np.ndarray,
    workspace: Workspace,
) -> Intersections:
    """List every (tile, Gaussian) pair in which the Gaussian is visible, by tile, front to back."""
    tiles_x, tiles_y = -(-width // TILE), -(-height // TILE)
    order = depth_order(depths, radii)
    # a hair below the blending threshold, so that rounding never loses a pixel
    threshold = np.float32(np.log2(ALPHA_MIN) - 1e-3)
    per_tile = np.zeros((_CHUNKS, tiles_x * tiles_y), np.int64)
    per_gaussian = np.zeros(len(depths), np.int64)
    boxes = workspace.take("boxes", len(order), 4, dtype=np.int32)
    met = workspace.take("met", len(order), dtype=np.uint64)
    _count(records, order, tiles_x, tiles_y, tile_mask, threshold, per_tile, per_gaussian, boxes, met)
    offsets = np.concatenate([[0], np.cumsum(per_gaussian)])
    ends = np.cumsum(per_tile.T.ravel())  # by tile, then by chunk
    cursor = np.ascontiguousarray((ends - per_tile.T.ravel()).reshape(-1, _CHUNKS).T)
    starts = np.append(cursor[0], ends[-1:])
    ids, slots = (workspace.take(name, offsets[-1], dtype=np.int32) for name in ("ids", "slots"))
    _place(records, order, tiles_x, tile_mask, threshold, boxes, met, cursor, offsets, ids, slots)
    return Intersections(row_order(tiles_y), starts, ids, slots, offsets)
