"""What it costs to show scenes to very many people: recorded visits and the caches of a CDN, in closed form.

    python -m benchmarks.scaling --out DIR [--write]

Visits are recorded by `node web/test/visitors.report.mjs BUNDLE OUT.json`. Each scene is a copy of a recorded
bundle. A cache holds what was asked for within its characteristic time (Che's approximation of LRU); of a
file that it lacks the first request of a visit fetches all. docs/scaling.md has the figures.
"""

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from matplotlib import rc_context
from matplotlib.figure import Figure
from scipy.optimize import brentq

from benchmarks.common import RESULTS, ROOT, finish
from sagesplat.io.files import read_json
from sagesplat.output.figures import INK, STYLE

DAY = 86_400.0  # s
KINDS = {"viewer": "#b9c2cf", "manifest": INK, "promises": "#3b6ea8", "pack": "#2f6f56", "chunk": "#d6a10b"}
MIX = (0.1, 0.4, 0.3, 0.2)  # of the recorded profiles
RETURNING = 0.2  # share of visits whose browser kept what an earlier one of the scene took
AGES = np.linspace(1, 2, 13) * DAY  # of the caches: the second day after they were empty
HEADER = 500  # bytes of an answer
PEAK = 1.6  # of the busiest minute over the mean
FRESH = 60.0  # s for which files without a hash may be handed out unasked
VIEWERS = (1_000, 10_000, 100_000, 1_000_000, 10_000_000)


@dataclass(frozen=True, eq=False)
class Bundle:
    """What is asked for in V recorded visits of a bundle of F files; an average visit weighs 1 / V."""

    name: str
    profiles: tuple[str, ...]
    profile: np.ndarray  # [V] index
    kinds: np.ndarray  # [F] index into KINDS
    sizes: np.ndarray  # [F] bytes over the network
    hashed: np.ndarray  # [F] its name changes with its content: kept without asking again
    requests: np.ndarray  # [V, F]
    sent: np.ndarray  # [V, F] bytes
    first: np.ndarray  # [V, F] of them those of the first request

    def weighted(self, table: np.ndarray) -> np.ndarray:
        """The mean [F] of what holds for each visit, by the shares of the profiles."""
        weights = np.array(MIX)[self.profile] / np.bincount(self.profile)[self.profile]
        return weights @ table / weights.sum()

    def asked(self) -> np.ndarray:
        """The share [V, F] of what a visit asks for that its browser did not keep."""
        came = self.sent / np.maximum(self.sizes, 1)
        kept = [came[self.profile == i].mean(0) for i in range(len(self.profiles))]
        return 1 - RETURNING * np.minimum(np.stack(kept), 1)[self.profile]


def read(path: Path) -> Bundle:
    """A recording. What is on its way where a browser stops a download counts: a round trip at its rate."""
    one = read_json(path)
    files, visits = one["files"], [(i, visit) for i, p in enumerate(one["profiles"]) for visit in p["visits"]]
    kinds = np.array([list(KINDS).index(file["kind"]) for file in files])
    page = np.array([file["uri"].startswith("assets/") for file in files])
    # not so: index.html, poster.jpg, manifest.json
    hashed = (kinds >= list(KINDS).index("promises")) | page
    sizes = np.array([file["bytes"] for file in files])
    requests, sent, first = np.zeros((3, len(visits), len(files)))
    for row, (i, visit) in enumerate(visits):
        on_the_way = int(one["profiles"][i]["mbit"] * 125 * one["profiles"][i]["latencyMs"])
        for _, file, *part in visit["requests"]:
            came, wanted = (*part, sizes[file], sizes[file])[:2]  # left out where they are all of the file
            body = min(came + on_the_way, wanted)
            first[row, file] += body if not requests[row, file] else 0
            sent[row, file] += body
            requests[row, file] += 1
    return Bundle(
        name=one["scene"],
        profiles=tuple(p["name"] for p in one["profiles"]),
        profile=np.array([i for i, _ in visits]),
        kinds=kinds,
        sizes=sizes,
        hashed=hashed,
        requests=requests,
        sent=sent,
        first=first,
    )


@dataclass(frozen=True)
class Site:
    """What is computed: a day of a site."""

    viewers: float  # visits a day
    scenes: int = 1000
    zipf: float = 0.8  # a scene's popularity: rank ** -zipf
    pops: int = 30  # points of presence
    pop_skew: float = 0.5  # their shares of the visits: rank ** -pop_skew
    pop_bytes: float = 20e9  # of each one's cache that this site gets


def shares(count: int, power: float) -> np.ndarray:
    """Shares of ranks 1 to `count`."""
    weights = np.arange(1, count + 1) ** -power
    return weights / weights.sum()


def day(bundles: Sequence[Bundle], site: Site) -> dict[str, float]:
    """A day of a site whose caches fill for a day before; every bundle is that of as many scenes."""
    rows = []
    for bundle in bundles:
        asked = bundle.asked()
        leaves = np.where(bundle.hashed, asked, 1.0)  # a file without a hash is asked for in any case
        each = {
            "requests": bundle.weighted(bundle.requests * leaves),
            "visits": bundle.weighted((bundle.requests > 0) * leaves),
            "sent": bundle.weighted(bundle.sent * asked),
            "first": bundle.weighted(bundle.first * asked),
        }
        rows.append(np.stack([*each.values(), bundle.sizes, bundle.hashed]))
    popularity = shares(site.scenes, site.zipf)
    # of the files of all scenes [N], a visit of the site
    parts = [rows[s % len(rows)] * np.array([[p]] * 4 + [[1]] * 2) for s, p in enumerate(popularity)]
    requests, visits, sent, first, sizes, hashed = np.concatenate(parts, 1)
    second = site.viewers / DAY
    missed = missed_first = 0.0  # by a point of presence: requests and bytes of a visit
    for share in shares(site.pops, site.pop_skew):
        there = absent(second * share * visits, sizes, site.pop_bytes)
        missed += share * float((visits * there * hashed).sum())
        missed_first += share * float((first * there).sum())
    new = absent(second * visits, sizes, np.inf)  # the shield has all that anybody asked for
    unhashed = second * requests[hashed == 0]
    total, egress = requests.sum(), sent.sum() + HEADER * requests.sum()
    return {
        "viewers": site.viewers,
        "mb_per_visit": egress / 1e6,
        "requests_per_visit": total,
        "pop_hits": 1 - (missed + requests[hashed == 0].sum()) / total,
        "pop_hits_bytes": 1 - missed_first / sent.sum(),
        "egress_gb": site.viewers * egress / 1e9,
        "origin_gb": site.viewers * float((visits * new * sizes).sum()) / 1e9,
        "peak_requests_per_s": PEAK * second * total,
        "peak_origin_requests_per_s": PEAK * (unhashed.sum() + second * float((visits * new * hashed).sum())),
        "fresh_peak_origin_requests_per_s": float((PEAK * unhashed / (1 + PEAK * FRESH * unhashed)).sum()),
        "peak_gbit_per_s": PEAK * second * egress * 8 / 1e9,
        **money(site.viewers, egress, total),
    }


def absent(rates: np.ndarray, sizes: np.ndarray, capacity: float) -> np.ndarray:
    """Chance that a file is not in a cache of so many bytes, which is asked for it so often a second."""
    ages = np.minimum(AGES, characteristic_time(rates, sizes, capacity))
    return np.exp(-rates[:, None] * ages).mean(1)


def characteristic_time(rates: np.ndarray, sizes: np.ndarray, capacity: float) -> float:
    """Seconds that a file stays unasked before it drops out of a cache; infinite where all fits (Che)."""
    if sizes[rates > 0].sum() <= capacity:
        return np.inf

    def too_much(log_time: float) -> float:
        return (sizes * -np.expm1(-rates * np.exp(log_time))).sum() - capacity

    return float(np.exp(brentq(too_much, -30, 60)))


def money(viewers: float, egress: float, requests: float) -> dict[str, float]:
    """Dollars of 30 such days: egress at 0.005 and 0.01 a GB; CloudFront's tiers, and its requests."""
    gb, count = 30 * viewers * egress / 1e9, 30 * viewers * requests
    tiers = ((10_240, 0.085), (40_960, 0.08), (102_400, 0.06), (np.inf, 0.04))
    left, tiered = gb, 0.0
    for size, price in tiers:
        tiered += min(left, size) * price
        left = max(left - size, 0.0)
    paid = 0.0075 * count / 10_000
    return {"low": 0.005 * gb, "middle": 0.01 * gb, "high": tiered + paid, "high_requests": paid}


def means(bundles: Sequence[Bundle]) -> dict[str, dict[str, float]]:
    """MB of a visit with an empty cache by profile and kind of file, means of the bundles; requests."""
    found = {}
    for i, name in enumerate(bundles[0].profiles):
        mine = [(one, one.profile == i) for one in bundles]
        by_kind = {
            kind: np.mean([one.sent[rows][:, one.kinds == k].sum(1).mean() for one, rows in mine]) / 1e6
            for k, kind in enumerate(KINDS)
        }
        count = np.mean([one.requests[rows].sum(1).mean() for one, rows in mine])
        found[name] = by_kind | {"all": sum(by_kind.values()), "requests": count}
    return found


@rc_context(STYLE)
def drawn(visits: Mapping[str, Mapping[str, float]], days: Sequence[Mapping[str, float]]) -> Figure:
    """Bytes of a visit by kind of file; hits and requests by viewers a day."""
    figure = Figure(figsize=(11, 3.2), layout="constrained")
    size, hits, load = figure.subplots(1, 3)
    left = np.zeros(len(visits))
    for kind, color in KINDS.items():
        width = np.array([row[kind] for row in visits.values()])
        size.barh(list(visits), width, left=left, height=0.62, color=color, label=kind)
        left += width
    size.set(xlabel="MB of a visit", xlim=(0, None))
    size.invert_yaxis()
    size.legend(loc="lower center", bbox_to_anchor=(0.3, 1), ncols=3)
    viewers = [row["viewers"] for row in days]
    for name, label in (("pop_hits_bytes", "bytes"), ("pop_hits", "requests")):
        hits.semilogx(viewers, [100 * row[name] for row in days], "o-", ms=4, label=label)
    hits.set(xlabel="viewers a day", ylabel="answered by points of presence (%)", ylim=(0, 102))
    hits.legend()
    for name, label in (
        ("peak_requests_per_s", "CDN"),
        ("peak_origin_requests_per_s", "origin, as served (no-cache)"),
        ("fresh_peak_origin_requests_per_s", f"origin, {FRESH:.0f} s fresh at the edge"),
    ):
        load.loglog(viewers, [row[name] for row in days], "o-", ms=4, label=label)
    load.set(xlabel="viewers a day", ylabel="requests/s in the busiest minute")
    load.legend(loc="lower right")
    return figure


def main(out: Path, visits: Path = RESULTS, write: bool = False) -> None:
    """Internet scale in closed form: visits, caches of a CDN, money.

    Args:
        out: folder for the figure.
        visits: folder with recorded visits, scaling-visits-SCENE-SCALE.json.
        write: also keep the results in benchmarks/results and docs/images.
    """
    bundles, large = (
        [read(path) for path in sorted(visits.glob(f"scaling-visits-*-{s}.json"))] for s in (1, 10)
    )
    if not bundles or not large:
        raise SystemExit(f"{visits}: no recorded visits; node web/test/visitors.report.mjs BUNDLE OUT.json")
    out.mkdir(parents=True, exist_ok=True)
    days = [day(bundles, Site(viewers)) for viewers in VIEWERS]
    caches = [day(bundles, replace(Site(1e5), pop_bytes=size)) | {"bytes": size} for size in (5e7, 2e8, 1e9)]
    result: dict[str, Any] = {
        "visits": means(bundles),
        "ten times the bytes": means(large),
        "days": days,
        "caches": caches,
    }
    path = out / "scaling.png"
    drawn(result["visits"], days).savefig(path, dpi=110)
    if write:
        shutil.copy(path, ROOT / "docs" / "images" / path.name)
    finish("scaling", result, write)


if __name__ == "__main__":
    tyro.cli(main, prog="python -m benchmarks.scaling")
