"""What `benchmarks.size` prints: ratios at equal SSIM, the bars of it, and rows of the compression survey."""

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sagesplat.io.files import atomic_path
from sagesplat.output.table import Table
from sagesplat.output.tables import MB
from sagesplat.studies.compare.report import MCMC, PLANNED, PRUNED, SAME_SHARE, SNAPSHOTS, Point, least

AS_ONE, TRAINED = "3DGS, as one", "3DGS"  # methods beside those of `sagesplat compare`
BASELINES = (SNAPSHOTS, PRUNED, MCMC)
OUTSIDE = "above our top"  # a baseline whose SSIM none of our levels reaches
SURVEY = ("Submethod", "PSNR", "SSIM", "LPIPS", "Size [Bytes]", "#Gaussians")  # w-m/3dgs-compression-survey
_LOW = 4  # levels that count as the lowest
# folder of a method's rows in the survey's layout
_FOLDERS = {
    SAME_SHARE: "sagesplat", MCMC: "3dgs-mcmc", PRUNED: "3dgs-pruned", TRAINED: "3dgs", AS_ONE: "3dgs-as-one",
}  # fmt: skip


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
        "bars": bars(full, as_one, ratios, figures),
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


def bars(
    full: Point, as_one: Point, ratios: Mapping[str, Mapping[str, Any]], figures: Mapping[str, Any]
) -> dict[str, bool]:
    """Whether each bar is met."""
    worst = {name: _worst(rows) for name, rows in ratios.items() if rows}
    return {
        "top within 0.1 dB of as one": full.psnr >= as_one.psnr - 0.1,
        **{f"bytes at most those of {n}": _most(worst[n], 1.0) for n in (MCMC, PRUNED) if n in worst},
        **{f"0.6 of the bytes of {n}": _most(worst[n], 0.6) for n in (SNAPSHOTS,) if n in worst},
        "12 bytes a Gaussian": full.encoded / figures["trained_gaussians"] <= 12,
        "100 k encoded in 20 s": figures["encoding_s_per_100k"] <= 20,
    }


def _most(value: float | None, bar: float) -> bool:
    return value is not None and value <= bar


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


def write_survey(folder: Path, measured: Measured, dataset: str = "MipNeRF360") -> list[Path]:
    """FOLDER/METHOD/DATASET/SCENE.csv: rows as authors hand them in to the public compression survey.

    LPIPS is VGG's as 3DGS computes it; empty where its weights are missing. Our full model and the level
    next to a third of its bytes have names, which the survey's table shows; the others are in its plots.
    """
    written = []
    for method, name in _FOLDERS.items():
        points = sorted(_of(measured.points, method), key=lambda p: -p.encoded)
        if not points:
            continue
        away = {abs(math.log(3 * p.encoded / points[0].encoded)): p.name for p in points[1:]}
        names = {points[0].name: "Baseline"} | ({away[min(away)]: "-Third"} if away else {})
        rows = [(names.get(p.name, ""), *survey_row(p)) for p in points]
        path = folder / name / dataset / f"{measured.scene}.csv"
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_path(path) as temporary, temporary.open("w", newline="") as file:
            csv.writer(file, lineterminator="\n").writerows([SURVEY, *rows])
        written.append(path)
    return written


def survey_row(point: Point) -> tuple[str, str, str, int, int]:
    """PSNR, SSIM, LPIPS, bytes and Gaussians of a set, with the survey's digits and more."""
    lpips = "" if math.isnan(point.lpips_vgg) else f"{point.lpips_vgg:.5f}"
    return f"{point.psnr:.4f}", f"{point.ssim:.5f}", lpips, point.encoded, point.count


def _of(points: Sequence[Point], method: str) -> list[Point]:
    return [point for point in points if point.method == method]
