"""Money: list prices of others with source and date, a month's bill, and which input moves it most."""

from dataclasses import dataclass, replace

from benchmarks.scaling.cdn import Site
from benchmarks.scaling.theory import per_visit
from benchmarks.scaling.visits import Library

MONTH = 30  # days
GB = 1e9


@dataclass(frozen=True)
class Prices:
    """US dollars. `egress` holds (GB a month up to which, dollars a GB), the last one without end."""

    name: str
    egress: tuple[tuple[float, float], ...]
    requests: float  # per 10,000
    storage: float  # per GB and month
    gpu_hour: float
    source: str


_INF = float("inf")
_STORE = 0.015  # Cloudflare R2, developers.cloudflare.com/r2/pricing, 2026
_GPU = 1.5  # A100 80 GB: 0.80 to 3.00 in May 2026, mercatus-ai.com/blog/cloud-gpu-pricing
LOW = Prices(
    "bunny.net, volume tier",
    ((500e3, 0.005), (1000e3, 0.004), (_INF, 0.003)),
    0.0,
    _STORE,
    _GPU,
    "docs.bunny.net/cdn/pricing, read 2026-09-20; no charge for requests is listed",
)
MIDDLE = Prices(
    "bunny.net, standard tier, Europe and North America",
    ((_INF, 0.01),),
    0.0,
    _STORE,
    _GPU,
    "docs.bunny.net/cdn/pricing, read 2026-09-20",
)
# requests cost by region: those of Google's CDN stand in; above 500 TB a GB costs less than the last rate
HIGH = Prices(
    "CloudFront, first tiers of Europe and the US",
    ((10e3, 0.085), (50e3, 0.08), (150e3, 0.06), (_INF, 0.04)),
    0.0075,
    _STORE,
    _GPU,
    "smallestbusiness.com/compare/cloudfront-egress-cost, 2026-06-15;"
    " requests: cloud.google.com/cdn/pricing, 2026-09-20",
)
SHEETS = (LOW, MIDDLE, HIGH)


def tiered(gb: float, tiers: tuple[tuple[float, float], ...]) -> float:
    """Dollars for so many GB in a month."""
    total, below = 0.0, 0.0
    for until, price in tiers:
        total += max(min(gb, until) - below, 0.0) * price
        below = until
    return total


@dataclass(frozen=True)
class Storage:
    """Bytes of one scene at rest."""

    gaussians: float = 92e3
    chunk_bytes: float = 20.7  # per Gaussian: 1,899,917 of 91,972 in garden's bundle
    copies: int = 2  # the increments one by one, and all of them in the pack
    master_bytes: float = 83.3  # per Gaussian: nested/ladder.npz, 7,659,856 for the same
    documents: float = 315_000.0  # manifest and promises, unpacked
    viewer: float = 3_220_000.0  # page, licences, schema; 0 where one page shows all scenes

    @property
    def bundle(self) -> float:
        """Bytes of the folder that a web server has."""
        return self.gaussians * self.chunk_bytes * self.copies + self.documents + self.viewer

    @property
    def master(self) -> float:
        """Bytes of what bundles are made from."""
        return self.gaussians * self.master_bytes


@dataclass(frozen=True)
class Service:
    """A site over a month: its traffic, its scenes at rest, and how they were trained."""

    site: Site
    storage: Storage
    photos: int = 200  # of a scene
    hours_per_1000: float = 1.4  # GPU hours for 1000 photos
    trainings: float = 1.0  # of each scene in a month


def bill(library: Library, service: Service, prices: Prices) -> dict[str, float]:
    """Dollars a month by part; the origin's traffic is left out (section on hit rates: it is small)."""
    requests, sent = per_visit(library, service.site)
    visits = service.site.viewers * MONTH
    scenes, storage = service.site.scenes, service.storage
    hours = service.trainings * scenes * service.photos * service.hours_per_1000 / 1000
    return {
        "egress": tiered(visits * sent / GB, prices.egress),
        "requests": visits * requests / 10_000 * prices.requests,
        "storage": scenes * (storage.bundle + storage.master) / GB * prices.storage,
        "training": hours * prices.gpu_hour,
    }


def per_1000_visits(library: Library, service: Service, prices: Prices) -> float:
    """Dollars for a thousand visits, everything counted."""
    return sum(bill(library, service, prices).values()) / (service.site.viewers * MONTH / 1000)


def sensitivity(
    library: Library, larger: Library, service: Service, prices: Prices = MIDDLE
) -> list[tuple[str, str, float, str, float]]:
    """Dollars for a thousand visits when one input moves from low to high: what moves most comes first.

    Args:
        library: recorded visits.
        larger: the same with ten times the bytes of increments.
        service: everything else stays as it is here.
        prices: the same.
    """
    site = service.site

    def cost(s: Service = service, p: Prices = prices, visits: Library = library) -> float:
        return per_1000_visits(visits, s, p)

    def on(**changes: float | bool | tuple[float, ...]) -> float:
        return cost(replace(service, site=replace(site, **changes)))  # pyright: ignore[reportArgumentType]

    def priced(**changes: float | tuple[tuple[float, float], ...]) -> float:
        return cost(p=replace(prices, **changes))  # pyright: ignore[reportArgumentType]

    million = replace(service, storage=replace(service.storage, gaussians=10 * service.storage.gaussians))
    only = [tuple(float(i == j) for j in range(len(site.mix))) for i in range(len(site.mix))]
    by_mix = sorted((on(mix=mix), name) for mix, name in zip(only, library.profiles, strict=True))
    cheap, dear = (priced(egress=((_INF, price),)) for price in (0.003, 0.085))
    few, many = (on(scenes=scenes) for scenes in (max(site.viewers // 100_000, 1), site.viewers))
    quick = replace(service, hours_per_1000=0.05)
    weekly = replace(service, hours_per_1000=4.0, trainings=4.3)
    known = on(shared_viewer=True, elsewhere=0.3)
    moved = {
        "price of egress": ("$0.003/GB", cheap, "$0.085/GB", dear),
        "Gaussians of a scene": ("92 k", cost(), "920 k", cost(million, visits=larger)),
        "visits of a scene": ("100,000 a day", few, "1 a day", many),
        "GPU hours of a training": ("0.05 per 1000 photos", cost(quick), "4, every week", cost(weekly)),
        "price of requests": ("none", priced(requests=0.0), "$0.01 per 10,000", priced(requests=0.01)),
        "page shared by all scenes": ("yes, half know it", known, "no", cost()),
        "returning visitors": ("50 %", on(returning=0.5), "none", on(returning=0.0)),
        "what visitors ask for": (by_mix[0][1], by_mix[0][0], by_mix[-1][1], by_mix[-1][0]),
    }
    return sorted(((name, *row) for name, row in moved.items()), key=lambda row: -abs(row[4] - row[2]))
