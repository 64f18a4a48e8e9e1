"""Ratios at equal SSIM, summaries on made-up curves; all of it on a small capture."""

import json
import math
from dataclasses import replace

import pytest

from benchmarks import size
from benchmarks.size import Asked, measure
from benchmarks.size_tables import AS_ONE, OUTSIDE, TRAINED, Measured, ratio, summary
from sagesplat.demo.capture import make_capture
from sagesplat.studies.compare.report import MCMC, PLANNED, PRUNED, SAME_SHARE, SNAPSHOTS, Point


def point(method: str, name: str, encoded: int, ssim: float, psnr: float = 25.0) -> Point:
    nan = math.nan
    return Point(method, name, nan, nan, encoded // 20, encoded, 1, ssim, ssim, psnr, nan, 0.25)


OURS = [point(SAME_SHARE, f"level {k}", 1000 * 10**k, ssim, 20 + k) for k, ssim in enumerate((0.5, 0.7, 0.9))]
PLANS = [replace(p, method=PLANNED, encoded=p.encoded // 10 * 9) for p in OURS]
FIGURES = {"encoding_s_per_100k": 1.5, "trained_gaussians": 10_000}


def measured(*more: Point) -> Measured:
    as_one = point(AS_ONE, "500 steps more", 90_000, 0.91, 22.05)
    points = [*OURS, *PLANS, as_one, point(TRAINED, "trained", 95_000, 0.88), *more]
    return Measured("yard", points, FIGURES)


def test_bytes_at_equal_ssim():
    # halfway between SSIM 0.5 and 0.7 is halfway between the logarithms of 1000 and 10,000 bytes
    found = ratio(OURS, point(MCMC, "cap 5%", 2000, 0.6))
    assert found == (pytest.approx(math.sqrt(10) / 2), "between")
    assert ratio(OURS, point(MCMC, "cap 5%", 5000, 0.7)) == (2.0, "")
    assert ratio(OURS, point(MCMC, "cap 5%", 500, 0.4)) == (2.0, "smallest")
    value, where = ratio(OURS, point(MCMC, "cap 100%", 500_000, 0.91))
    assert (math.isnan(value), where) == (True, OUTSIDE)
    # as decoded, whatever it was before
    assert ratio(OURS, replace(point(MCMC, "cap 5%", 5000, 0.9), ssim_sent=0.7))[0] == 2.0


def test_summary():
    caps = [point(MCMC, "cap 10%", 9000, 0.7), point(MCMC, "cap 50%", 120_000, 0.9)]
    found = summary(measured(*caps, point(SNAPSHOTS, "step 9", 20_000, 0.7), point(PRUNED, "5%", 500, 0.95)))
    found = json.loads(json.dumps(found, allow_nan=False))
    assert found["worst_ratio"] == {SNAPSHOTS: 0.45, PRUNED: None, MCMC: pytest.approx(1.0)}
    same_share = found["bytes_ratio_same_share"][MCMC]
    assert [row["ratio"] for row in same_share.values()] == pytest.approx([10 / 9, 10 / 12])
    assert found["bytes_ratio"][PRUNED]["5%"] == {"ratio": None, "where": OUTSIDE, "ssim": 0.95}
    assert found["gap_db"] == pytest.approx(0.05)
    assert found["bytes_per_gaussian"] == {
        "all": 10.0,
        "all sent": 20.0,
        "level 1": 20.0,
        "levels 1 to 4": 20.0,
    }


@pytest.mark.slow
def test_every_kind_of_set_is_measured(tmp_path, monkeypatch):
    monkeypatch.setattr(size, "_TIMED", 10)  # steps that say how many the model tuned as one gets
    make_capture(tmp_path / "yard", views=16, width=64, height=48)
    asked = Asked(
        steps=40, nest_steps=10, base_steps=10, tune_steps=2, snapshots=2, shares=(0.5,),
        caps=(0.5,), plan_views=4,
    )  # fmt: skip
    found = measure(tmp_path / "runs", str(tmp_path / "yard"), asked, print)
    kinds = {point.method for point in found.points}
    assert kinds >= {AS_ONE, TRAINED, MCMC, PRUNED, SAME_SHARE, SNAPSHOTS, PLANNED}
