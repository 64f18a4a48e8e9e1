"""What `benchmarks.size` prints: ratios of bytes at equal SSIM."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sagesplat.output.table import Table
from sagesplat.output.tables import MB
from sagesplat.studies.compare.report import MCMC, PLANNED, PRUNED, SAME_SHARE, SNAPSHOTS, Point, least

AS_ONE, TRAINED = "3DGS, as one", "3DGS"  # methods beside those of `sagesplat compare`
BASELINES = (SNAPSHOTS, PRUNED, MCMC)
OUTSIDE = "above our top"  # a baseline whose SSIM none of our levels reaches
_LOW = 4  # levels that count as the lowest


@dataclass(frozen=True)
class Measured:
    """A capture's sets on the test views, as decoded, and what else was measured of the run."""

    scene: str
    points: list[Point]
    figures: dict[str, Any]


def ratio(ours: Sequence[Point], baseline: Point) -> tuple[float, str]:
    """Our encoded bytes over a baseline's at its SSIM, both as decoded, and where on our curve that is.

    Between two of our levels SSIM is linear in the logarithm of the bytes. "smallest": our smallest level is
    better already, the ratio is at most this. `OUTSIDE` (NaN): none of our levels is as good.
    """
    found = least(ours, baseline.ssim_sent, "encoded")
    return found.nbytes / max(baseline.encoded, 1), OUTSIDE if math.isnan(found.nbytes) else found.how


def summary(measured: Measured) -> dict[str, Any]:
    """Figures of one capture, as JSON has them."""
    points, figures = measured.points, measured.figures
    ours = sorted(_of(points, SAME_SHARE), key=lambda p: p.encoded)
    full, as_one = ours[-1], _of(points, AS_ONE)[0]
    planned = sorted(_of(points, PLANNED), key=lambda p: p.encoded)
    ratios = {name: _ratios(planned, _of(points, name)) for name in BASELINES}
    same_share = {name: _ratios(ours, _of(points, name)) for name in BASELINES}
    return {
        **figures,
        "gaussians": full.count,
        "full": _quality(full),
        "as_one": _quality(as_one),
        "gap_db": as_one.psnr - full.psnr,
        "gap_ssim": as_one.ssim - full.ssim,
        "bytes_per_gaussian": {
            "all": full.encoded / figures["trained_gaussians"],  # as it was trained: encoders leave some out
            "all sent": _each(full),
            "level 1": _each(ours[0]),
            f"levels 1 to {_LOW}": _each(ours[min(_LOW, len(ours)) - 1]),
        },
        "bytes_ratio": ratios,  # of plans within a budget
        "bytes_ratio_same_share": same_share,
        "worst_ratio": {name: _worst(rows) for name, rows in ratios.items() if rows},
    }


def _ratios(ours: Sequence[Point], baselines: Sequence[Point]) -> dict[str, dict[str, Any]]:
    found = {}
    for point in baselines:
        value, how = ratio(ours, point)
        found[point.name] = {"ratio": None if math.isnan(value) else value, "where": how, "ssim": point.ssim}
    return found


def _worst(rows: Mapping[str, Mapping[str, Any]]) -> float | None:
    """The largest ratio; None where one of them is outside of our curve."""
    values = [row["ratio"] for row in rows.values()]
    return None if None in values else max(values)


def _quality(point: Point) -> dict[str, float | None]:
    values = {"psnr": point.psnr, "ssim": point.ssim, "lpips_alex": point.lpips_alex}
    values |= {"lpips_vgg": point.lpips_vgg, "bytes": point.encoded}
    return {name: None if math.isnan(value) else value for name, value in values.items()}


def _each(point: Point) -> float:
    return point.encoded / max(point.count, 1)


def table(measured: Measured) -> Table:
    """All sets of a capture; ours / theirs at their SSIM, planned and with the same share of everything."""
    points = measured.points
    planned, same, body, marks = _of(points, PLANNED), _of(points, SAME_SHARE), [], {}
    for point in points:
        values = []
        for column, ours in ((9, planned), (10, same)):
            value, how = ratio(ours, point) if point.method in BASELINES else (math.nan, "")
            values.append(value)
            if how:
                marks[len(body), column] = how
        lpips = point.lpips_alex, point.lpips_vgg
        size = point.count, point.encoded / MB, _each(point)
        body.append((point.method, point.name, *size, point.psnr, point.ssim, *lpips, *values))
    header = ("method", "which", "Gaussians", "MB", "bytes each", "PSNR", "SSIM", "LPIPS alex", "LPIPS vgg")
    formats = ("", "", ",d", ".3f", ".1f", ".2f", ".4f", ".4f", ".4f", ".2f", ".2f")
    return Table(
        f"{measured.scene}: test views, as decoded",
        (*header, "planned : it", "same share : it"),
        formats,
        body,
        marks=marks,
    )


def _of(points: Sequence[Point], method: str) -> list[Point]:
    return [point for point in points if point.method == method]
