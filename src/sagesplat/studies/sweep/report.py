"""What the runs of a sweep measured, summed up as mean and spread."""

import math
import statistics
from collections.abc import Sequence
from pathlib import Path

from sagesplat.io.files import write_text
from sagesplat.output.table import Table

# columns of numbers, with their formats: SSIM and PSNR (dB) are of whole test views, "full" is the full model
# (the last level: of snapshots 3DGS itself), `error` the mean error of a category's prediction there; a
# training that resumed after a kill counts the seconds since then
MEASURES = {
    "Gaussians": ",.0f", "of full model": ".1%", "MB": ".2f", "SSIM": ".3f", "full SSIM": ".3f",
    "PSNR": ".2f", "full PSNR": ".2f", "promised": ".1f", "kept": ".1f", "share kept": ".1%",
    "error": ".3f", "training s": ".1f",
}  # fmt: skip
SHOWN = ("of full model", "SSIM", "share kept")  # what 80 characters have room for
Row = tuple[str | int | float, ...]


def summarise(rows: Sequence[Row]) -> Table:
    """Rows of cells.csv as mean and sample standard deviation over the seeds: NaN of nothing, and of one.

    `n` counts the runs that did not fail, `ok` those whose plan met the target.
    """
    groups: dict[Row, list[Row]] = {}
    for scene, variant, _, target, *measured in rows:
        groups.setdefault((scene, variant, target), []).append(tuple(measured))
    body = []
    for key, runs in groups.items():
        *columns, status = zip(*runs, strict=True)
        known = [[value for value in column if not math.isnan(value)] for column in columns]
        spreads = []
        for values in known:
            spreads.append(statistics.fmean(values) if values else math.nan)
            spreads.append(statistics.stdev(values) if len(values) > 1 else math.nan)
        body.append((*key, len(known[0]), status.count("ok"), *spreads))
    header = ("scene", "variant", "target", "n", "ok", *(f"{m}{sd}" for m in MEASURES for sd in ("", " sd")))
    formats = ("", "", "g", "d", "d", *(spec for spec in MEASURES.values() for _ in range(2)))
    return Table("Mean ± sample standard deviation over n seeds", header, formats, body)


def readable(summary: Table, measures: Sequence[str]) -> Table:
    """Some measures of a summary, each mean and spread in one cell."""
    first = summary.header.index("ok") + 1
    body: list[Row] = []
    for row in summary.cells():
        cells = dict(zip(summary.header, row, strict=True))
        spreads = ("±".join(v for v in (cells[m], cells[f"{m} sd"]) if v != "–") or "–" for m in measures)
        body.append((*row[:first], *spreads))
    header = (*summary.header[:first], *measures)
    return Table(summary.title, header, ("",) * len(header), body)


def write_results(out: Path, rows: list[Row]) -> None:
    """Write the runs, their summary and figures."""
    header = ("scene", "variant", "seed", "target", *MEASURES, "status")
    Table("Runs", header, ("", "", "d", "g", *MEASURES.values(), ""), rows).write_csv(out / "cells.csv")
    summary = summarise(rows)
    summary.write_csv(out / "summary.csv")
    write_text(out / "summary.md", f"{summary.title}\n\n{readable(summary, tuple(MEASURES)).markdown()}")
