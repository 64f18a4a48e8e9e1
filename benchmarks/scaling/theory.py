"""Hit rates in closed form: Che's approximation of LRU, for caches that have been filling for a while."""

import numpy as np

from benchmarks.scaling.cdn import DAY, Site, lay_out
from benchmarks.scaling.visits import Library


def characteristic_time(rates: np.ndarray, sizes: np.ndarray, capacity: float) -> float:
    """Seconds that a file stays unasked before it drops out (Che): sum of s (1 - exp(-r T)) is the capacity.

    Args:
        rates: requests a second of each file.
        sizes: bytes of each file.
        capacity: bytes of the cache; infinity is returned where everything fits.
    """
    asked = rates > 0
    if sizes[asked].sum() <= capacity:
        return float("inf")
    low, high = 0.0, 1.0 / rates[asked].min()
    while (sizes * -np.expm1(-rates * high)).sum() < capacity:
        high *= 2
    for _ in range(100):
        middle = (low + high) / 2
        held = (sizes * -np.expm1(-rates * middle)).sum()
        low, high = (middle, high) if held < capacity else (low, middle)
    return (low + high) / 2


def held(rates: np.ndarray, time: float, since: float, until: float) -> np.ndarray:
    """Chance that a file is in the cache, on average from `since` to `until` seconds after it was empty."""
    ages = np.minimum(np.linspace(since, until, 49), time)
    return -np.expm1(-rates[:, None] * ages).mean(1)


def expected(library: Library, site: Site) -> tuple[np.ndarray, np.ndarray]:
    """Requests a visit that leave the browser, and bytes that they bring: by file [B, F] of each bundle."""
    bundles, files = library.kinds.shape
    share = np.array(site.mix)[library.profile] / sum(site.mix)
    share = share / np.bincount(library.profile)[library.profile]  # chance of each recorded visit
    kept = library.kept.reshape(bundles, library.visits, files)
    # whose browser has a file: an earlier visit of the same profile kept it
    has = np.stack([kept[:, library.profile == p].mean(1) for p in range(len(library.profiles))], 1)
    row = np.repeat(np.arange(len(library.start) - 1), np.diff(library.start))
    bundle, visit = np.divmod(row, library.visits)
    file = library.file
    left = share[visit] * (1 - site.returning * has[bundle, library.profile[visit], file])
    asked, sent = np.zeros((bundles, files)), np.zeros((bundles, files))
    # a file without a hash is asked for in any case
    np.add.at(asked, (bundle, file), np.where(library.hashed[bundle, file], left, share[visit]))
    np.add.at(sent, (bundle, file), left * library.body)
    return asked, sent


def file_rates(library: Library, site: Site) -> tuple[np.ndarray, np.ndarray]:
    """The same for the hashed files of all scenes [N], by how often each scene is visited."""
    objects = lay_out(library, site)
    asked, sent = (table * library.hashed for table in expected(library, site))
    popularity = np.diff(objects.popularity, prepend=0.0)[:, None]
    factor = np.where(library.grows[objects.bundle], objects.factor[:, None], 1.0)
    return (popularity * asked[objects.bundle]).ravel(), (popularity * factor * sent[objects.bundle]).ravel()


def per_visit(library: Library, site: Site) -> tuple[float, float]:
    """Requests and bytes to the viewer of a visit, headers included."""
    asked, sent = expected(library, site)
    requests = float(asked.sum(1).mean())
    bodies = np.where(library.grows, sent * np.mean(site.growth), sent)
    return requests, float(bodies.sum(1).mean()) + site.header_bytes * requests


def pop_hits(library: Library, site: Site) -> tuple[float, float]:
    """Predicted share of requests, and of bytes, of hashed files that points of presence answer."""
    asked, sent = file_rates(library, site)
    sizes = lay_out(library, site).size
    weights = np.arange(1, site.pops + 1) ** -site.pop_skew
    hits, bytes_hit = 0.0, 0.0
    for share in weights / weights.sum():
        rates = asked * share * site.viewers / DAY
        time = characteristic_time(rates, sizes, site.pop_bytes)
        there = held(rates, time, site.warm_days * DAY, (site.warm_days + 1) * DAY)
        hits += share * float((asked * there).sum())
        bytes_hit += share * float((sent * there).sum())
    return hits / float(asked.sum()), bytes_hit / float(sent.sum())
