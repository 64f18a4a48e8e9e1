"""Caches that drop what was not asked for longest, and the way of requests through them."""

from typing import NamedTuple

import numpy as np
from numba import njit

HIT, SHARED, VALIDATED, MISS = range(4)


class Caches(NamedTuple):
    """C caches over N files; each is a ring of what it holds, the latest used first, around node N."""

    after: np.ndarray  # [C, N + 1] next node, towards what is older; -1: not held
    before: np.ndarray  # [C, N + 1]
    checked: np.ndarray  # [C, N] s at which a file was fetched or found unchanged
    used: np.ndarray  # [C] bytes
    capacity: np.ndarray  # [C] bytes


def new_caches(pops: int, files: int, pop_bytes: float, shield_bytes: float) -> Caches:
    """Empty caches of the points of presence, and the shield's as the last one."""
    after = np.full((pops + 1, files + 1), -1, np.int32)
    before = after.copy()
    after[:, files] = before[:, files] = files
    capacity = np.full(pops + 1, pop_bytes)
    capacity[-1] = shield_bytes
    return Caches(after, before, np.zeros((pops + 1, files)), np.zeros(pops + 1), capacity)


@njit(cache=True)
def _unlink(caches, c, file):  # type: ignore[no-untyped-def]
    newer, older = caches.before[c, file], caches.after[c, file]
    caches.after[c, newer] = older
    caches.before[c, older] = newer
    caches.after[c, file] = -1


@njit(cache=True)
def _to_front(caches, c, file):  # type: ignore[no-untyped-def]
    ring = caches.after.shape[1] - 1
    first = caches.after[c, ring]
    caches.after[c, ring] = file
    caches.before[c, file] = ring
    caches.after[c, file] = first
    caches.before[c, first] = file


@njit(cache=True)
def ask(caches: Caches, c, file, hashed, now, sizes, fill, ttl, coalesce):  # type: ignore[no-untyped-def]
    """One request to cache `c`: HIT, SHARED, VALIDATED (held, asked for again) or MISS; keeps the file."""
    if caches.after[c, file] >= 0:
        _unlink(caches, c, file)
        _to_front(caches, c, file)
        age = now - caches.checked[c, file]
        if 0 <= age < fill:
            return SHARED if coalesce else MISS
        if hashed or age <= ttl:
            return HIT
        caches.checked[c, file] = now
        return VALIDATED
    if sizes[file] > caches.capacity[c]:
        return MISS
    ring = caches.after.shape[1] - 1
    caches.used[c] += sizes[file]
    while caches.used[c] > caches.capacity[c]:
        oldest = caches.before[c, ring]
        _unlink(caches, c, oldest)
        caches.used[c] -= sizes[oldest]
    _to_front(caches, c, file)
    caches.checked[c, file] = now
    return MISS


@njit(cache=True)
def serve(  # type: ignore[no-untyped-def]
    at, pop, files, hashed, body, sizes, caches, timing, coalesce, tables, origin, minutes
):
    """Requests in the order of time through a point of presence and the shield to the origin.

    Args:
        timing: s from which requests count, that a fetch takes, for which unhashed files are fresh.
        tables: [2, 2, 4] pop or shield; requests or bytes delivered; by outcome. Added to.
        origin: [2] requests and bytes. Added to.
        minutes: [3, 1441] requests at points of presence, at the origin; bytes out; the last column is what
            comes after a day. Added to.
    """
    begin, fill, ttl = timing
    shield = len(caches.used) - 1
    for i in range(len(at)):
        file, now = files[i], at[i]
        counts = now >= begin
        minute = min(int((now - begin) / 60), 1440) if counts else 0
        near = ask(caches, pop[i], file, hashed[i], now, sizes, fill, ttl, coalesce)
        if counts:
            tables[0, 0, near] += 1
            tables[0, 1, near] += body[i]
            minutes[0, minute] += 1
            minutes[2, minute] += body[i]
        if near < VALIDATED:
            continue
        fetched = sizes[file] if near == MISS else 0
        far = ask(caches, shield, file, hashed[i], now, sizes, fill, ttl, coalesce)
        if counts:
            tables[1, 0, far] += 1
            tables[1, 1, far] += fetched
        if counts and far >= VALIDATED:
            origin[0] += 1
            origin[1] += sizes[file] if far == MISS else 0
            minutes[1, minute] += 1
