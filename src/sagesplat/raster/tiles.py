"""Which Gaussian meets which tile, in depth order: counting placement by tile, then a sort in each tile.

Gaussians are read in the order in which they lie in memory, and a tile's list fits into a core's cache: one
sort of all by depth would fetch them from everywhere, which takes longer than the sort.
"""

from dataclasses import dataclass

import numpy as np
from numba import prange

from sagesplat.kernels.jit import njit
from sagesplat.kernels.workspace import Workspace
from sagesplat.raster.blend import TILE
from sagesplat.raster.project import tile_box
from sagesplat.raster.render import ALPHA_MIN

_CHUNKS = 16  # fixed, so that the result does not depend on the number of threads
_APART = 5  # each thread's stretch of chunks has some from all over
_DIGIT = 11  # most bits that a pass of the sort looks at; fewer where lists are shorter than its counters
_FEW = 32  # entries that are sorted by insertion alone


@dataclass(frozen=True, eq=False)
class Intersections:
    """Gaussians by tile and depth. An intersection's slot is its row when listed by Gaussian."""

    row_order: np.ndarray  # int64 [tile rows]
    starts: np.ndarray  # int64 [tiles + 1]
    ids: np.ndarray  # int32 [I], Gaussian of each intersection
    slots: np.ndarray  # int32 [I]
    offsets: np.ndarray  # int64 [N + 1], first slot of each Gaussian


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
def _count(records, radii, tiles_x, tiles_y, tile_mask, threshold, per_tile, offsets, boxes, met):
    """Counts, that of Gaussian i into offsets[i + 1]; for `_place` its box of tiles, and a bit for each of
    the first 64 that it meets.
    """
    offsets[0] = 0
    for place in prange(_CHUNKS):
        chunk = place * _APART % _CHUNKS
        for i in range(chunk * len(radii) // _CHUNKS, (chunk + 1) * len(radii) // _CHUNKS):
            bits, bit, total = np.uint64(0), np.uint64(1), 0
            if radii[i] > 0:
                x0, x1, y0, y1 = tile_box(
                    records[i, 0], records[i, 1], records[i, 9], records[i, 10], tiles_x, tiles_y
                )
                boxes[i, 0], boxes[i, 1], boxes[i, 2], boxes[i, 3] = x0, x1, y0, y1
                for y in range(y0, y1):
                    for x in range(x0, x1):
                        if tile_mask[y * tiles_x + x] and _touches(records, i, x, y, threshold):
                            per_tile[chunk, y * tiles_x + x] += 1
                            bits |= bit
                            total += 1
                        bit <<= np.uint64(1)
            met[i] = bits
            offsets[i + 1] = total


@njit(parallel=True, cache=True)
def _place(records, depths, tiles_x, tile_mask, threshold, boxes, met, cursor, offsets, ids, slots, keys):
    """Lists by tile, in the order of the Gaussians; `keys`: bits of their depths, which sort as these do."""
    bits_of = depths.view(np.uint32)  # of positive floats
    for place in prange(_CHUNKS):
        chunk = place * _APART % _CHUNKS
        for i in range(chunk * len(depths) // _CHUNKS, (chunk + 1) * len(depths) // _CHUNKS):
            slot, bits = offsets[i], met[i]
            if slot == offsets[i + 1]:
                continue
            x0, x1, y0, y1 = boxes[i, 0], boxes[i, 1], boxes[i, 2], boxes[i, 3]
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
                        ids[at], slots[at], keys[at] = i, slot, bits_of[i]
                        slot += 1


@njit(cache=True)
def stable_order(keys, order, other):
    """The places of keys [n] uint32, ascending, of equal ones in their order: low halves of order[:n] uint64.

    Two passes of an LSD radix sort over the highest bits in which keys differ leave little to an insertion.
    `order`, or `other`, both of n elements at least, is returned.
    """
    n, low, high = len(keys), np.uint32(0xFFFFFFFF), np.uint32(0)
    for key in keys:
        low, high = min(low, key), max(high, key)
    for i in range(n):
        order[i] = (np.uint64(keys[i] - low) << np.uint64(32)) | np.uint64(i)
    spread, width, digit = max(np.int64(high) - np.int64(low), 0), 0, 4  # of no keys none
    while spread >> width:
        width += 1
    while digit < _DIGIT and n >> digit + 1:
        digit += 1
    counters = np.empty((1 << _DIGIT) + 1, np.int64)
    skipped, passes = max(width - 2 * digit, 0), 2 if n > _FEW else 0
    for k in range(passes):
        first = skipped + (width - skipped) * k // passes
        last = skipped + (width - skipped) * (k + 1) // passes
        shift, mask = np.uint64(32 + first), np.uint64((1 << (last - first)) - 1)
        starts = counters[: (1 << (last - first)) + 1]
        starts[:] = 0
        for i in range(n):
            starts[np.int64((order[i] >> shift) & mask) + 1] += 1
        for at in range(1, len(starts)):
            starts[at] += starts[at - 1]
        for i in range(n):
            at = np.int64((order[i] >> shift) & mask)
            other[starts[at]] = order[i]
            starts[at] += 1
        order, other = other, order
    for i in range(1, n):  # entries differ by their places, so that none are equal
        entry, at = order[i], i
        while at > 0 and order[at - 1] > entry:
            order[at] = order[at - 1]
            at -= 1
        order[at] = entry
    return order


@njit(parallel=True, cache=True)
def _sort(starts, tiles_x, rows, keys, ids, slots):
    """Sort each tile's list by depth, front to back; of equal depths by Gaussian."""
    for r in prange(len(rows)):
        begin = rows[r] * tiles_x
        longest = 0
        for tile in range(begin, begin + tiles_x):
            longest = max(longest, starts[tile + 1] - starts[tile])
        order, other = np.empty(longest, np.uint64), np.empty(longest, np.uint64)
        of, by = np.empty(longest, np.int32), np.empty(longest, np.int32)
        for tile in range(begin, begin + tiles_x):
            first, last = starts[tile], starts[tile + 1]
            sorted_places = stable_order(keys[first:last], order, other)
            of[: last - first], by[: last - first] = ids[first:last], slots[first:last]
            for k in range(last - first):
                place = np.int64(sorted_places[k] & np.uint64(0xFFFFFFFF))
                ids[first + k], slots[first + k] = of[place], by[place]


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
    # a hair below the blending threshold, so that rounding never loses a pixel
    threshold, take, n = np.float32(np.log2(ALPHA_MIN) - 1e-3), workspace.take, len(depths)
    per_tile, offsets = np.zeros((_CHUNKS, tiles_x * tiles_y), np.int64), np.empty(n + 1, np.int64)
    boxes, met = take("boxes", n, 4, dtype=np.int32), take("met", n, dtype=np.uint64)
    _count(records, radii, tiles_x, tiles_y, tile_mask, threshold, per_tile, offsets, boxes, met)
    np.cumsum(offsets, out=offsets)
    ends = np.cumsum(per_tile.T.ravel())  # by tile, then by chunk
    cursor = np.ascontiguousarray((ends - per_tile.T.ravel()).reshape(-1, _CHUNKS).T)
    starts, rows = np.append(cursor[0], ends[-1:]), row_order(tiles_y)
    ids, slots = (take(name, offsets[-1], dtype=np.int32) for name in ("ids", "slots"))
    keys = take("keys", offsets[-1], dtype=np.uint32)
    _place(records, depths, tiles_x, tile_mask, threshold, boxes, met, cursor, offsets, ids, slots, keys)
    _sort(starts, tiles_x, rows, keys, ids, slots)
    return Intersections(rows, starts, ids, slots, offsets)
