"""The simulation of internet scale: days and caches, with the figures of docs/scaling.md.

    python -m benchmarks.scaling --out DIR [--viewers 1000 100000]

Visits are recorded by `node web/test/visitors.report.mjs BUNDLE OUT.json`.
"""

import csv
import shutil
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import tyro

from benchmarks.common import RESULTS, ROOT, finish, origin
from benchmarks.scaling import figures
from benchmarks.scaling.cdn import Site, simulate
from benchmarks.scaling.theory import per_visit, pop_hits
from benchmarks.scaling.visits import KINDS, Library, read
from sagesplat.core.errors import SageError
from sagesplat.io.files import write_json

VIEWERS = (1_000, 10_000, 100_000, 1_000_000, 10_000_000)
# chunks of eight runs of two captures, over those of the bundles: docs/scaling.md
GROWTH = (1.142, 1.0, 1.176, 1.115, 1.145, 1.0, 1.178, 1.116)
# recorded visits: as they are, with ten times the bytes of increments, without packs
SETS = ("1", "10", "files")
CACHES = (0.05e9, 0.2e9, 0.5e9, 1e9, 2e9, 5e9, 20e9, 50e9)


def main(
    out: Path, visits: Path = RESULTS, viewers: tuple[int, ...] = VIEWERS, seed: int = 0, write: bool = False
) -> None:
    """Internet scale by simulation: visits, caches of a CDN.

    Args:
        out: folder for JSON, CSV and figures.
        visits: folder with recorded visits, scaling-visits-SCENE-SET.json.
        viewers: visits a day.
        seed: of the simulated days.
        write: also copy the results to benchmarks/results and docs/images.
    """
    out.mkdir(parents=True, exist_ok=True)
    try:
        result = run(visits, out, viewers, seed)
    except SageError as error:
        raise SystemExit(str(error)) from None
    if write:
        for path in (*out.glob("scaling*.json"), *out.glob("scaling*.csv")):
            shutil.copy(path, RESULTS / path.name)
        for path in out.glob("scaling-*.png"):
            shutil.copy(path, ROOT / "docs" / "images" / path.name)
    kept = ("viewers", "mb_per_visit", "pop_hits_bytes", "origin_gb", "peak_origin_requests_per_s")
    finish("scaling", {"days": [{name: row[name] for name in kept} for row in result["days"]]}, False)


def run(visits: Path, out: Path, viewers: Sequence[int], seed: int) -> dict[str, Any]:
    """All figures into `out`. DataError, RunError in one line."""
    small, large, files = (read(sorted(visits.glob(f"scaling-visits-*-{name}.json"))) for name in SETS)
    base = Site(growth=GROWTH, seed=seed)
    middle = replace(base, viewers=min(100_000, max(viewers)))
    named = {"as recorded": small, "ten times": large, "no pack": files}
    result: dict[str, Any] = origin() | {"site": asdict(base), "bundles": list(small.names)}
    result["visits"] = {name: means(library) for name, library in named.items()}
    result["days"] = days(small, base, viewers)
    result["caches"] = {"as recorded": sweep(small, middle), "ten times the bytes": sweep(large, middle)}
    write_json(out / "scaling.json", result)
    with (out / "scaling-days.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(result["days"][0]))
        writer.writeheader()
        writer.writerows(result["days"])
    shown = {"as recorded (92 k Gaussians)": small, "ten times the bytes": large}
    drawn = {"visits": figures.visits(shown), "hits": figures.hits(result["days"], result["caches"])}
    for name, figure in drawn.items():
        figure.savefig(out / f"scaling-{name}.png", dpi=110)
    return result


def means(library: Library) -> dict[str, dict[str, float]]:
    """MB of a visit with an empty cache by profile and kind of file, means of the bundles; requests."""
    table = library.per_visit().mean(0) / 1e6
    counts = (library.start[1:] - library.start[:-1]).reshape(len(library.names), -1).mean(0)
    rows = {}
    for i, name in enumerate(library.profiles):
        mine = library.profile == i
        row = dict(zip(KINDS, table[mine].mean(0).tolist(), strict=True))
        rows[name] = row | {"all": float(table[mine].sum(1).mean()), "requests": float(counts[mine].mean())}
    return rows


def days(library: Library, base: Site, viewers: Sequence[int]) -> list[dict[str, Any]]:
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
        tell(f"{count:>10,} viewers", row)
    return rows


def sweep(library: Library, site: Site) -> list[dict[str, Any]]:
    """The same day with larger and larger caches at the points of presence."""
    rows = []
    for size in CACHES:
        here = replace(site, pop_bytes=size)
        row = simulate(library, here).row() | {"pop_bytes": size}
        row["che"], row["che_bytes"] = pop_hits(library, here)
        rows.append(row)
        tell(f"cache of {size / 1e9:g} GB", row)
    return rows


def tell(name: str, row: dict[str, Any]) -> None:
    """Print a day in a line."""
    print(
        f"{name:36} {row['mb_per_visit']:6.2f} MB {row['requests_per_visit']:5.1f} requests; answered by PoP"
        f" {row['pop_hits']:.1%} ({row['pop_hits_bytes']:.2%} of bytes); origin {row['origin_gb']:8.3f} GB,"
        f" {row['peak_origin_requests_per_s']:7.1f}/s of {row['peak_requests_per_s']:8.1f}/s;"
        f" {row['seconds_to_simulate']:.0f} s",
        flush=True,
    )


if __name__ == "__main__":
    tyro.cli(main, prog="python -m benchmarks.scaling")
