"""A content delivery network, request by request: browsers, points of presence, a shield, the origin."""

import itertools
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numba import njit

from benchmarks.scaling.visits import Library
from sagesplat.core.errors import DataError

DAY = 86_400.0  # s
HIT, SHARED, VALIDATED, MISS = range(4)
_AT_ONCE = 20_000  # visits whose requests are in memory


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
def ask(caches: Caches, c, file, hashed, now, sizes, fill, ttl):  # type: ignore[no-untyped-def]
    """One request to cache `c`: HIT, SHARED, VALIDATED (held, asked for again) or MISS; keeps the file."""
    if caches.after[c, file] >= 0:
        _unlink(caches, c, file)
        _to_front(caches, c, file)
        age = now - caches.checked[c, file]
        if 0 <= age < fill:
            return SHARED
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
    at, pop, files, hashed, body, sizes, caches, timing, tables, origin, minutes
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
        near = ask(caches, pop[i], file, hashed[i], now, sizes, fill, ttl)
        if counts:
            tables[0, 0, near] += 1
            tables[0, 1, near] += body[i]
            minutes[0, minute] += 1
            minutes[2, minute] += body[i]
        if near < VALIDATED:
            continue
        fetched = sizes[file] if near == MISS else 0
        far = ask(caches, shield, file, hashed[i], now, sizes, fill, ttl)
        if counts:
            tables[1, 0, far] += 1
            tables[1, 1, far] += fetched
        if counts and far >= VALIDATED:
            origin[0] += 1
            origin[1] += sizes[file] if far == MISS else 0
            minutes[1, minute] += 1


@dataclass(frozen=True)
class Site:
    """What is simulated: one day of a site, after `warm_days` that fill the caches. Bytes, seconds."""

    viewers: int = 100_000  # visits a day, Poisson
    scenes: int = 1000
    zipf: float = 0.8  # a scene's popularity: rank ** -zipf
    pops: int = 30  # points of presence
    pop_skew: float = 0.5  # their shares of the visits: rank ** -pop_skew
    pop_bytes: float = 20e9  # of each one's cache that this site gets
    shield_bytes: float = 1e12  # 0: no shield
    fill_seconds: float = 0.3  # that a fetch takes
    edge_ttl: float = 0.0  # for which files without a hash are handed out unasked; 0: as served, `no-cache`
    returning: float = 0.2  # share of visits whose browser has what an earlier visit of the scene left
    mix: tuple[float, ...] = (0.1, 0.4, 0.3, 0.2)  # of the profiles
    diurnal: float = 0.6  # the rate is 1 + diurnal cos(t - 20 h)
    growth: tuple[float, ...] = (1.0,)  # bytes of chunks and packs, one factor drawn for each scene
    header_bytes: int = 500  # of an answer
    warm_days: float = 1.0
    seed: int = 0

    def check(self, library: Library) -> None:
        """DataError for what cannot be simulated."""
        fine = (
            min(self.viewers, self.scenes, self.pops) >= 1
            and all(0 <= share <= 1 for share in (self.returning, self.diurnal))
            and min(self.pop_bytes, self.shield_bytes, self.warm_days, self.edge_ttl, self.fill_seconds) >= 0
            and min(self.growth, default=0) > 0
        )
        if not fine:
            raise DataError("impossible site: counts start at 1, shares lie in 0..1, sizes and times at 0")
        if len(self.mix) != len(library.profiles) or min(self.mix) < 0 or not sum(self.mix):
            raise DataError(f"mix needs a share for each of the {len(library.profiles)} recorded profiles")


@dataclass(frozen=True, eq=False)
class Outcome:
    """What one day came to. Rows of the tables: HIT, SHARED (a fetch under way), VALIDATED (304), MISS."""

    site: Site
    visits: int
    asked: int  # requests of pages, those that the browser's own cache answers included
    asked_bytes: int  # without answers' headers, like all bytes but `egress`
    browser: int  # requests that never left the browser
    browser_bytes: int
    pop: np.ndarray  # [4] requests
    pop_bytes: np.ndarray  # [4] delivered
    unsent_bytes: int  # that a 304 to a browser saved
    shield: np.ndarray  # [4] requests
    shield_bytes: np.ndarray  # [4] delivered to points of presence
    origin: int  # requests
    origin_bytes: int
    minutes: np.ndarray  # [3, 1441] requests at the points of presence, at the origin, bytes out; last: later
    used: np.ndarray  # [P + 1] bytes in the caches at the end, the shield's last
    wall: float  # s that the simulation took

    @property
    def egress(self) -> float:
        """Bytes to viewers, headers included."""
        return float(self.pop_bytes.sum() + self.site.header_bytes * self.pop.sum())

    def row(self) -> dict[str, Any]:
        """The figures of docs/scaling.md."""
        sent = max(int(self.pop.sum()), 1)
        near = int(self.pop[HIT] + self.pop[SHARED])
        bytes_sent = max(int(self.pop_bytes.sum()), 1)
        near_bytes = int(self.pop_bytes[[HIT, SHARED, VALIDATED]].sum())
        asked_shield = max(int(self.shield.sum()), 1)
        peaks = self.minutes[:, :-1].max(1)
        return {
            "viewers": self.site.viewers,
            "visits": self.visits,
            "mb_per_visit": self.egress / max(self.visits, 1) / 1e6,
            "requests_per_visit": self.pop.sum() / max(self.visits, 1),
            "browser_hits": self.browser / max(self.asked, 1),
            "browser_hits_bytes": (self.browser_bytes + self.unsent_bytes) / max(self.asked_bytes, 1),
            "pop_hits": near / sent,
            "pop_hits_bytes": near_bytes / bytes_sent,
            "pop_shared": int(self.pop[SHARED]) / sent,
            "pop_validated": int(self.pop[VALIDATED]) / sent,
            "shield_hits": int(self.shield[HIT] + self.shield[SHARED]) / asked_shield,
            "shield_hits_bytes": 1 - self.origin_bytes / max(int(self.shield_bytes.sum()), 1),
            "egress_gb": self.egress / 1e9,
            "origin_gb": self.origin_bytes / 1e9,
            "origin_requests": self.origin,
            "peak_requests_per_s": float(peaks[0] / 60),
            "peak_origin_requests_per_s": float(peaks[1] / 60),
            "peak_gbit_per_s": float(peaks[2] * 8 / 60 / 1e9),
            "pop_cache_gb": float(self.used[:-1].max() / 1e9),
            "seconds_to_simulate": self.wall,
        }


@dataclass(frozen=True, eq=False)
class Objects:
    """Files of all scenes: scene s has ids s F to s F + F - 1."""

    bundle: np.ndarray  # [S] recorded bundle that a scene is a copy of
    size: np.ndarray  # [N] bytes
    factor: np.ndarray  # [S]
    popularity: np.ndarray  # [S] cumulative


def simulate(library: Library, site: Site) -> Outcome:
    """One day, every request of it; the same seed gives the same day. DataError for an impossible site."""
    site.check(library)
    begin = time.perf_counter()
    objects = lay_out(library, site)
    caches = new_caches(site.pops, len(objects.size), site.pop_bytes, site.shield_bytes)
    tally = np.zeros(7, np.int64)
    tables = np.zeros((2, 2, 4), np.int64)  # pop or shield, requests or bytes, by outcome
    origin = np.zeros(2, np.int64)
    minutes = np.zeros((3, 1441), np.int64)
    first = site.warm_days * DAY
    timing = np.array([first, site.fill_seconds, site.edge_ttl])
    for batch in _batches(library, site, objects, tally):
        at, pop, files, hashed, body = batch
        serve(at, pop, files, hashed, body, objects.size, caches, timing, tables, origin, minutes)
    return Outcome(
        site=site,
        visits=int(tally[0]),
        asked=int(tally[1]),
        asked_bytes=int(tally[2]),
        browser=int(tally[3]),
        browser_bytes=int(tally[4]),
        unsent_bytes=int(tally[5]),
        pop=tables[0, 0],
        pop_bytes=tables[0, 1],
        shield=tables[1, 0],
        shield_bytes=tables[1, 1],
        origin=int(origin[0]),
        origin_bytes=int(origin[1]),
        minutes=minutes,
        used=caches.used.copy(),
        wall=time.perf_counter() - begin,
    )


def lay_out(library: Library, site: Site) -> Objects:
    """The files of so many scenes, copies of the recorded bundles with bytes that vary."""
    rng = np.random.default_rng([site.seed, 1])
    bundle = np.arange(site.scenes) % len(library.names)
    factor = rng.choice(np.array(site.growth), site.scenes)
    sizes = np.where(library.grows[bundle], library.sizes[bundle] * factor[:, None], library.sizes[bundle])
    size = np.ceil(sizes).astype(np.int64).ravel()
    weights = np.arange(1, site.scenes + 1) ** -site.zipf
    return Objects(bundle=bundle, size=size, factor=factor, popularity=np.cumsum(weights / weights.sum()))


def _batches(
    library: Library, site: Site, objects: Objects, tally: np.ndarray
) -> Iterator[tuple[np.ndarray, ...]]:
    """Requests that leave browsers, in the order of time: when, where, what, hashed, bytes to send."""
    rng = np.random.default_rng([site.seed, 2])
    days = site.warm_days + 1
    slices = max(24, int(np.ceil(site.viewers * days / _AT_ONCE)))
    edges = np.linspace(0, days * DAY, slices + 1)
    late: list[np.ndarray] = []
    for begin, end in itertools.pairwise(edges):
        fresh = _requests(library, site, objects, rng, (begin, end), tally)
        rows = [np.concatenate(parts) for parts in zip(late, fresh, strict=True)] if late else fresh
        order = np.argsort(rows[0], kind="stable")
        rows = [row[order] for row in rows]
        here = np.searchsorted(rows[0], end)
        late = [row[here:] for row in rows]
        yield tuple(row[:here] for row in rows)
    yield tuple(late)  # of visitors who came before the end


def _requests(
    library: Library,
    site: Site,
    objects: Objects,
    rng: np.random.Generator,
    span: tuple[float, float],
    tally: np.ndarray,
) -> list[np.ndarray]:
    """Requests of those who come in a time span; what browsers answer themselves goes to the tally only."""
    come = np.sort(rng.uniform(*span, rng.poisson(_expected(site, span))))
    count = len(come)
    scene = np.searchsorted(objects.popularity, rng.random(count) * objects.popularity[-1])
    scene = np.minimum(scene, site.scenes - 1)
    pop = rng.choice(site.pops, count, p=_shares(np.arange(1, site.pops + 1) ** -site.pop_skew))
    profile = rng.choice(len(site.mix), count, p=_shares(np.array(site.mix)))
    before, now = (_pick(library, profile, rng) for _ in range(2))
    known = rng.random(count)
    bundle = objects.bundle[scene]
    row = bundle * library.visits + now

    each = library.start[row + 1] - library.start[row]
    of = np.repeat(np.arange(count), each)  # the visit of each request
    request = (
        np.arange(len(of)) - np.repeat(np.cumsum(each) - each, each) + np.repeat(library.start[row], each)
    )
    at = come[of] + library.at[request]
    file, b = library.file[request], bundle[of]
    factor = np.where(library.grows[b, file], objects.factor[scene[of]], 1.0)
    body = np.ceil(library.body[request] * factor).astype(np.int64)
    hashed = library.hashed[b, file]

    has = (known[of] < site.returning) & library.kept[b * library.visits + before[of], file]
    inside = has & hashed  # never leaves the browser
    unsent = has & ~hashed  # a 304
    counts = at >= site.warm_days * DAY
    tally[0] += int((come >= site.warm_days * DAY).sum())
    tally[1] += int(counts.sum())
    tally[2] += int(body[counts].sum())
    tally[3] += int((counts & inside).sum())
    tally[4] += int(body[counts & inside].sum())
    tally[5] += int(body[counts & unsent].sum())

    thing = scene[of] * library.kinds.shape[1] + file
    out = ~inside
    body = np.where(unsent, 0, body)
    return [at[out], pop[of][out], thing[out], hashed[out], body[out]]


def _expected(site: Site, span: tuple[float, float]) -> float:
    """Visits in a time span."""
    turn = 2 * np.pi / DAY
    swing = np.sin(turn * (span[1] - DAY * 20 / 24)) - np.sin(turn * (span[0] - DAY * 20 / 24))
    return float(site.viewers * (span[1] - span[0] + site.diurnal * swing / turn) / DAY)


def _shares(weights: np.ndarray) -> np.ndarray:
    return weights / weights.sum()


def _pick(library: Library, profile: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A recorded visit of each profile, all with the same chance."""
    first = np.searchsorted(library.profile, np.arange(len(library.profiles)))
    each = np.bincount(library.profile)
    return first[profile] + (rng.random(len(profile)) * each[profile]).astype(np.int64)
