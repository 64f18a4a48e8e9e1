"""Tables, curves and files of what was measured of levels."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, LogLocator, NullFormatter

from sagesplat.adapt.observe import TOTAL
from sagesplat.core.text_table import aligned
from sagesplat.io.files import write_json
from sagesplat.metrics.flip import PIXELS_PER_DEGREE
from sagesplat.output.figures import ACCENT, FAINT, STYLE, save_figure, shortened
from sagesplat.output.table import Table
from sagesplat.output.tables import MB, mean
from sagesplat.studies.measure.score import COVERED, FLIP, Row

JSON, PICTURE = "measure.json", "measure"
SIDE = 192  # px, of the crops
FLIP_NOTE = f"FLIP: 0 is no difference to be seen at {PIXELS_PER_DEGREE:g} pixels per degree"
_COLOURS = (ACCENT, "#1d4ed8", "#047857", "#7c3aed", "#b45309", "#be185d")
_WIDTH = 12.0  # inches


@dataclass(frozen=True)
class Measured:
    """Levels and what was measured of them."""

    reference: str
    reference_count: int
    names: Sequence[str]  # of the levels
    series: Sequence[str]  # what each is a level of
    counts: Sequence[int]  # Gaussians
    nbytes: Sequence[int]
    views: Sequence[str]  # names of the viewpoints
    categories: Mapping[int, str]
    others: Sequence[str]  # columns of MS-SSIM, FLIP and LPIPS, as far as they were measured
    rows: Sequence[Row]

    def __repr__(self) -> str:
        return f"<measured: {', '.join(self.names)} at {len(self.views)} viewpoints>"

    def __str__(self) -> str:
        table = levels_table(self).only("level", "Gaussians", "MB", "SSIM", "PSNR", "worst SSIM")
        return f"{table.title}\n{aligned(table.header, table.cells(), right=(1, 2, 3, 4, 5))}"

    def of(self, level: int, label_id: int) -> list[Row]:
        """The rows of a level and a region."""
        return [row for row in self.rows if row.level == level and row.label_id == label_id]

    def labels(self) -> list[int]:
        """Categories that were seen, the one with the most pixels first."""
        pixels: dict[int, int] = {}
        for row in self.rows:
            if row.label_id >= 0:
                pixels[row.label_id] = pixels.get(row.label_id, 0) + row.pixels
        return sorted(pixels, key=lambda label: (-pixels[label], label))

    def region(self, label_id: int) -> str:
        """The name of a region."""
        special = {TOTAL: "whole image", COVERED: "covered by the reference"}
        return special.get(label_id) or self.categories.get(label_id, f"category {label_id}")


def levels_table(measured: Measured) -> Table:
    """A row for each level: its size, and means over the viewpoints."""
    body = []
    for level, name in enumerate(measured.names):
        whole, covered = measured.of(level, TOTAL), measured.of(level, COVERED)
        worst = min(whole, key=lambda row: row.ssim)
        cells = [name, measured.counts[level], measured.counts[level] / max(1, measured.reference_count)]
        cells += [measured.nbytes[level] / MB]
        cells += [_of_field(whole, field) for field in ("ssim", "psnr", *measured.others)]
        cells += [_mean(covered, "ssim"), _mean(covered, "psnr"), worst.ssim, measured.views[worst.view]]
        body.append(tuple(cells))
    header = ("level", "Gaussians", "share", "MB", "SSIM", "PSNR", *measured.others)
    header += ("SSIM covered", "PSNR covered", "worst SSIM", "at")
    formats = ("", ",d", ".1%", ".2f", ".4f", ".2f", *[".4f"] * len(measured.others), ".4f", ".2f", ".4f", "")
    title = f"Levels against {measured.reference}, means over {len(measured.views)} viewpoints"
    note = "covered: pixels that the reference covers; an empty background agrees with itself"
    notes = (note, *([FLIP_NOTE] if FLIP in measured.others else []))
    return Table(title, header, formats, body, notes=notes)


def categories_table(measured: Measured) -> Table:
    """SSIM of each category at each level."""
    labels = measured.labels()
    body = [
        (name, *(_mean(measured.of(level, label), "ssim") for label in labels))
        for level, name in enumerate(measured.names)
    ]
    header = ("level", *map(measured.region, labels))
    return Table("SSIM by category", header, ("", *[".4f"] * len(labels)), body)


def regions_table(measured: Measured) -> Table:
    """A row for each level and region, for a CSV."""
    body = []
    for level, name in enumerate(measured.names):
        for label in (TOTAL, COVERED, *measured.labels()):
            if rows := measured.of(level, label):
                cells: list[Any] = [name, measured.counts[level], measured.nbytes[level]]
                cells += [measured.region(label), len(rows)]
                cells += [_of_field(rows, field) for field in ("ssim", "psnr", *measured.others)]
                body.append((*cells, min(row.ssim for row in rows)))
    header = ("level", "Gaussians", "bytes", "region", "viewpoints", "SSIM", "PSNR", *measured.others)
    header += ("worst SSIM",)
    formats = ("", "d", "d", "", "d", *[".4f"] * (len(measured.others) + 3))
    return Table("Levels by region", header, formats, body)


def views_table(measured: Measured) -> Table:
    """Every measurement, for a CSV."""
    body = [
        (
            measured.names[row.level], measured.views[row.view], measured.region(row.label_id), row.pixels,
            row.ssim, row.psnr, *(row.others.get(name, np.nan) for name in measured.others),
        )
        for row in measured.rows
    ]  # fmt: skip
    header = ("level", "viewpoint", "region", "pixels", "SSIM", "PSNR", *measured.others)
    return Table(
        "Levels by viewpoint", header, ("", "", "", "d", *[".4f"] * (2 + len(measured.others))), body
    )


def write_report(folder: Path, measured: Measured, how: Mapping[str, Any], strip: "Strip") -> None:
    """levels.csv, views.csv, measure.json and measure.png and .svg in a folder."""
    regions = regions_table(measured)
    regions.write_csv(folder / "levels.csv")
    views_table(measured).write_csv(folder / "views.csv")
    values = (
        [None if isinstance(v, float) and not np.isfinite(v) else v for v in row] for row in regions.rows
    )
    levels = [dict(zip(regions.header, row, strict=True)) for row in values]
    reference = {"name": measured.reference, "Gaussians": measured.reference_count}
    write_json(
        folder / JSON,
        {"format": "sagesplat-measure", "version": 1, **how, "reference": reference, "levels": levels},
    )
    save_figure(_figure(measured, strip), folder / PICTURE)


def _mean(rows: Sequence[Row], field: str) -> float:
    return mean(np.array([getattr(row, field) for row in rows]))


@dataclass(frozen=True, eq=False)
class Strip:
    """The same part of one viewpoint, of the reference and of each level."""

    view: str
    reference: UInt8[np.ndarray, "h w 3"]
    levels: Sequence[UInt8[np.ndarray, "h w 3"]]


def worst_view(measured: Measured) -> int:
    """The viewpoint with the lowest SSIM, as a mean over the levels."""
    sums = np.zeros(len(measured.views))
    for row in measured.rows:
        if row.label_id == TOTAL:
            sums[row.view] += row.ssim
    return int(sums.argmin())


@rc_context(STYLE)
def _figure(measured: Measured, strip: Strip) -> Figure:
    per_row = 8
    pictures = [("reference", strip.reference), *zip(measured.names, strip.levels, strict=True)]
    rows = -(-len(pictures) // per_row)
    fields = ["ssim", "psnr", *(name for name in measured.others if name.startswith("lpips"))]
    cell = _WIDTH / per_row
    height = 6.2 + rows * (cell + 0.25) + 0.4
    figure = Figure(figsize=(_WIDTH, height))
    panels: Any = figure.subfigures(2, 1, height_ratios=[6.2, height - 6.2])
    top, bottom = panels
    grid = top.subplots(2, len(fields), squeeze=False)
    top.subplots_adjust(left=0.07, right=0.98, top=0.93, bottom=0.09, wspace=0.28, hspace=0.35)
    sizes = (measured.counts, "Gaussians"), (np.array(measured.nbytes) / MB, "MB")
    for axes, (values, unit) in zip(grid, sizes, strict=True):
        for one, field in zip(axes, fields, strict=True):
            _curves(one, measured, np.asarray(values, float), field)
            one.set_xscale("log")
            one.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            one.xaxis.set_major_formatter(EngFormatter(sep="") if unit != "MB" else lambda x, _: f"{x:g}")
            one.xaxis.set_minor_formatter(NullFormatter())
            one.set(xlabel=unit, ylabel=field.upper().replace("_", " "))
    grid[0, 0].legend(loc="lower right")
    bottom.text(0.01, 0.99, f"where the levels differ most: {shortened(strip.view)}", va="top", color=FAINT)
    for i, (name, picture) in enumerate(pictures):
        row, column = divmod(i, per_row)
        share = cell / (height - 6.2)
        place = 1 - 0.4 / (height - 6.2) - (row + 1) * (share + 0.25 / (height - 6.2))
        axes = bottom.add_axes((column / per_row + 0.003, place, 1 / per_row - 0.006, share * 0.95))
        axes.imshow(picture, aspect="auto", interpolation="nearest")
        axes.set_title(shortened(name), loc="left", pad=2, fontsize=7)
        axes.set_axis_off()
    return figure


def _curves(axes: Axes, measured: Measured, sizes: np.ndarray, field: str) -> None:
    """A field over the sizes: a curve for each series, that of what is covered fainter."""
    for number, series in enumerate(dict.fromkeys(measured.series)):
        levels = [level for level, own in enumerate(measured.series) if own == series]
        levels.sort(key=lambda level: sizes[level])
        colour = _COLOURS[number % len(_COLOURS)]
        regions = (TOTAL, COVERED) if field in ("ssim", "psnr") else (TOTAL,)
        for region in regions:
            found = [_of_field(measured.of(level, region), field) for level in levels]
            whole = region == TOTAL
            axes.plot(
                sizes[levels], found, ls="-" if whole else ":", marker="o" if whole else ".", ms=4,
                alpha=1.0 if whole else 0.7, color=colour,
                label=shortened(series) if whole else "covered pixels only",
            )  # fmt: skip


def _of_field(rows: Sequence[Row], field: str) -> float:
    """Mean of SSIM, PSNR or another column; NaN without any."""
    if field in ("ssim", "psnr"):
        return _mean(rows, field)
    return mean(np.array([row.others.get(field, np.nan) for row in rows]))
