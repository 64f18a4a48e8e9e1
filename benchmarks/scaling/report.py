"""Everything of docs/scaling.md in one go: visits, days, caches, new trainings, money; with figures."""

import csv
import shutil
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from benchmarks.scaling import figures, prices, training
from benchmarks.scaling.cdn import Outcome, Site, simulate
from benchmarks.scaling.theory import per_visit, pop_hits
from benchmarks.scaling.visits import KINDS, ROOT, Library, read, record
from sagesplat.io.files import atomic_path, read_json, write_json

RESULTS = ROOT / "benchmarks" / "results"
VIEWERS = (1_000, 10_000, 100_000, 1_000_000, 10_000_000)
# chunks of eight runs of two captures, over those of the bundles: docs/scaling.md
GROWTH = (1.142, 1.0, 1.176, 1.115, 1.145, 1.0, 1.178, 1.116)
# recorded visits: (name, scale of the increments' bytes, with a pack, visits of a profile)
SETS = (("1", 1, True, 24), ("10", 10, True, 24), ("files", 1, False, 12))
CACHES = (0.05e9, 0.2e9, 0.5e9, 1e9, 2e9, 5e9, 20e9, 50e9)
Say = Callable[[str], None]


def run(
    bundles: Sequence[Path],
    out: Path,
    viewers: Sequence[int] = VIEWERS,
    seed: int = 0,
    say: Say = lambda line: None,
) -> dict[str, Any]:
    """All figures into `out`; without bundles from the committed visits. DataError, RunError in one line."""
    out.mkdir(parents=True, exist_ok=True)
    paths = _visits(bundles, out, say)
    small, large, files = (read(paths[name]) for name, *_ in SETS)
    base = Site(growth=GROWTH, seed=seed)
    result: dict[str, Any] = {"site": asdict(base), "bundles": list(small.names)}
    result["visits"] = {
        "as recorded": _means(small),
        "nothing in flight": _means(read(paths["1"], flight=False)),
        "ten times": _means(large),
        "no pack": _means(files),
    }
    result["days"] = days(small, base, viewers, say)
    middle = replace(base, viewers=min(100_000, max(viewers)))
    result["caches"] = {
        "as recorded": sweep(small, middle, say),
        "ten times the bytes": sweep(large, middle, say),
    }
    result["variants"] = variants(small, files, middle, say)
    result["republish"] = {
        name: republish(lib, middle, say) for name, lib in (("pack", small), ("files", files))
    }
    result |= money(small, large, replace(base, viewers=1_000_000), viewers)
    result["captures"] = [_capture(path) for path in paths["1"]]
    write_json(out / "scaling.json", result)
    _write_csv(out / "scaling-days.csv", result["days"])
    _draw(result, {"as recorded (92 k Gaussians)": small, "ten times the bytes": large}, out)
    return result


def _visits(bundles: Sequence[Path], out: Path, say: Say) -> dict[str, list[Path]]:
    """Files of recorded visits by set; recorded now, or the committed ones where no bundle is given."""
    if not bundles:
        return {name: sorted(RESULTS.glob(f"scaling-visits-*-{name}.json")) for name, *_ in SETS}
    paths: dict[str, list[Path]] = {name: [] for name, *_ in SETS}
    for bundle in bundles:
        for name, scale, pack, count in SETS:
            path = out / f"scaling-visits-{bundle.resolve().name}-{name}.json"
            say(f"recording {path.name}")
            record(bundle, path, visits=count, scale=scale, pack=pack)
            paths[name].append(path)
    return paths


def _means(library: Library) -> dict[str, dict[str, float]]:
    """MB of a visit with an empty cache by profile and kind of file, means of the bundles; requests."""
    table = library.per_visit().mean(0) / 1e6
    counts = (library.start[1:] - library.start[:-1]).reshape(len(library.names), -1).mean(0)
    rows = {}
    for i, name in enumerate(library.profiles):
        mine = library.profile == i
        row = dict(zip(KINDS, table[mine].mean(0).tolist(), strict=True))
        rows[name] = row | {"all": float(table[mine].sum(1).mean()), "requests": float(counts[mine].mean())}
    return rows


def days(library: Library, base: Site, viewers: Sequence[int], say: Say) -> list[dict[str, Any]]:
    """A day by number of viewers, every request simulated, beside the closed form."""
    rows = []
    for count in viewers:
        site = replace(base, viewers=count)
        row = simulate(library, site).row()
        warm = min(site.warm_days, 1e6 / count)  # a million visits fill the caches
        fresh = simulate(library, replace(site, edge_ttl=60.0, warm_days=warm))
        row["che"], row["che_bytes"] = pop_hits(library, site)
        row["expected_mb_per_visit"] = per_visit(library, site)[1] / 1e6
        row["fresh_peak_origin_requests_per_s"] = fresh.row()["peak_origin_requests_per_s"]
        rows.append(row)
        say(_line(f"{count:>10,} viewers", row))
    return rows


def sweep(library: Library, site: Site, say: Say) -> list[dict[str, Any]]:
    """The same day with larger and larger caches at the points of presence."""
    rows = []
    for size in CACHES:
        here = replace(site, pop_bytes=size)
        row = simulate(library, here).row() | {"pop_bytes": size}
        row["che"], row["che_bytes"] = pop_hits(library, here)
        rows.append(row)
        say(_line(f"cache of {size / 1e9:g} GB", row))
    return rows


def variants(library: Library, files: Library, site: Site, say: Say) -> dict[str, dict[str, Any]]:
    """A day with one thing changed at a time; `files`: the same bundles without their packs."""
    changes: dict[str, dict[str, Any]] = {
        "as served": {},
        "60 s fresh at the edge": {"edge_ttl": 60.0},
        "no shield": {"shield_bytes": 0.0},
        "no coalescing": {"coalesce": False},
        "one page for all scenes": {"shared_viewer": True},
        "50 % return": {"returning": 0.5},
        "10,000 scenes": {"scenes": 10_000, "pops": 10},
        "1000 scenes, 10 points of presence": {"pops": 10},
        "one scene, empty caches": {"scenes": 1, "warm_days": 0.0},
    }
    rows = {name: simulate(library, replace(site, **change)).row() for name, change in changes.items()}
    rows["no packs"] = simulate(files, site).row()
    for name, row in rows.items():
        say(_line(name, row))
    return rows


def republish(library: Library, site: Site, say: Say) -> dict[str, dict[str, float]]:
    """What a new training of every scene at noon adds to the same day: GB to viewers, GB from the origin."""
    before = simulate(library, site)
    rows = {}
    for what in ("all", "one"):
        after = simulate(library, replace(site, republish=what))
        rows[what] = _more(before, after)
        say(f"{what} republished: {rows[what]}")
    return rows


def _more(before: Outcome, after: Outcome) -> dict[str, float]:
    return {
        "viewers_gb": (after.egress - before.egress) / 1e9,
        "viewers_share": after.egress / before.egress - 1,
        "upstream_gb": float(after.shield_bytes.sum() - before.shield_bytes.sum()) / 1e9,
        "origin_gb": (after.origin_bytes - before.origin_bytes) / 1e9,
    }


def money(library: Library, larger: Library, base: Site, viewers: Sequence[int]) -> dict[str, Any]:
    """Bills of a month by viewers and price list, trainings, storage, and what moves the bill."""
    service = prices.Service(base, training.Storage())
    million = training.Storage(gaussians=1e6)
    bills = []
    for count in viewers:
        for sheet in prices.SHEETS:
            here = replace(service, site=replace(base, viewers=count))
            bill = prices.bill(library, here, sheet)
            total = sum(bill.values())
            bills.append({"viewers": count, "prices": sheet.name, **bill, "total": total}
                         | {"per_1000_visits": prices.per_1000_visits(library, here, sheet)})  # fmt: skip
    moved = prices.sensitivity(library, larger, service)
    return {
        "bills": bills,
        "sources": {sheet.name: sheet.source for sheet in prices.SHEETS},
        "sensitivity": prices.as_rows(moved),
        "base_per_1000_visits": prices.per_1000_visits(library, service, prices.MIDDLE),
        "even_visits_per_scene": prices.even_visits(library, service, prices.MIDDLE),
        "per_visit_mb": {
            "as recorded": per_visit(library, base)[1] / 1e6,
            "ten times": per_visit(larger, base)[1] / 1e6,
        },
        "trainings": [asdict(one) | {"hours_per_1000": one.hours_per_1000} for one in training.TRAININGS],
        "hectares": _hectares(),
        "storage": {
            name: {"bundle_mb": s.bundle / 1e6, "master_mb": s.master / 1e6}
            for name, s in (("92 k", service.storage), ("1 M", million))
        },
    }


def _hectares() -> list[dict[str, float]]:
    """Device hours a hectare by photos a hectare, at each published number of hours for 1000 photos."""
    published = [one.hours_per_1000 for one in training.TRAININGS if not one.ours]
    return [
        {"photos": photos, **{f"hours_{h:.2g}": training.per_hectare(photos, h) for h in sorted(published)}}
        for photos in (500, 2000, 10_000)
    ]


def _capture(path: Path) -> dict[str, Any]:
    """Photos and ground of a recorded bundle's capture."""
    one = read_json(path)
    frame = one["frame"]
    area = training.hull_hectares(one["cameras"], frame["up"], frame["metersPerUnit"])
    return {
        "scene": one["scene"],
        "photos": one["photos"],
        "square_meters": area * 1e4,
        "scale": frame["scale"],
    }


def _write_csv(path: Path, rows: Sequence[dict[str, Any]]) -> None:
    with atomic_path(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def _draw(result: dict[str, Any], libraries: dict[str, Library], out: Path) -> None:
    drawn = {
        "visits": figures.visits(libraries),
        "hits": figures.hits(result["days"], result["caches"]),
        "cost": figures.sensitivity(result["sensitivity"], result["base_per_1000_visits"]),
    }
    for name, figure in drawn.items():
        figure.savefig(out / f"scaling-{name}.png", dpi=110)


def commit(out: Path) -> None:
    """Copy a run's results and figures to where the repository keeps them."""
    for path in (*out.glob("scaling*.json"), *out.glob("scaling*.csv")):
        shutil.copy(path, RESULTS / path.name)
    for path in out.glob("scaling-*.png"):
        shutil.copy(path, ROOT / "docs" / "images" / path.name)


def _line(name: str, row: dict[str, Any]) -> str:
    return (
        f"{name:36} {row['mb_per_visit']:6.2f} MB {row['requests_per_visit']:5.1f} requests; answered by PoP"
        f" {row['pop_hits']:.1%} ({row['pop_hits_bytes']:.2%} of bytes); origin {row['origin_gb']:8.3f} GB,"
        f" {row['peak_origin_requests_per_s']:7.1f}/s of {row['peak_requests_per_s']:8.1f}/s;"
        f" {row['seconds_to_simulate']:.0f} s"
    )
