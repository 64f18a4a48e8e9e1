"""Ratios at equal SSIM, bars and survey rows on made-up curves; images and cameras from far away."""

import csv
import json
import math
from dataclasses import replace

import numpy as np
import pytest
from conftest import pinhole

from benchmarks import far
from benchmarks.size_tables import (
    AS_ONE,
    OUTSIDE,
    SURVEY,
    TRAINED,
    Measured,
    ratio,
    summary,
    table,
    write_survey,
)
from sagesplat.core.geometry import project
from sagesplat.studies.compare.report import MCMC, PLANNED, PRUNED, SAME_SHARE, SNAPSHOTS, Point


def point(method: str, name: str, encoded: int, ssim: float, psnr: float = 25.0) -> Point:
    nan = math.nan
    return Point(method, name, nan, nan, encoded // 20, encoded, 1, ssim, ssim, psnr, nan, 0.25)


OURS = [point(SAME_SHARE, f"level {k}", 1000 * 10**k, ssim, 20 + k) for k, ssim in enumerate((0.5, 0.7, 0.9))]
PLANS = [replace(p, method=PLANNED, encoded=p.encoded // 10 * 9) for p in OURS]
FIGURES = {
    "encoding_s_per_100k": 1.5,
    "trained_gaussians": 10_000,
    "resolutions": {n: {"psnr": 25.0, "ssim": 0.8 + n / 100} for n in (1, 2, 4, 8)},
    "bytes_from_far": {
        "resolution": {1: {0.8: 100.0, 0.9: 200.0}, 4: {0.8: 50.0, 0.9: 130.0}},
        "farther": {1: {0.8: 100.0}, 4: {0.8: 300.0}},
    },
}


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


def test_summary_and_bars():
    caps = [point(MCMC, "cap 10%", 9000, 0.7), point(MCMC, "cap 50%", 120_000, 0.9)]
    found = summary(measured(*caps, point(SNAPSHOTS, "step 9", 20_000, 0.7), point(PRUNED, "5%", 500, 0.95)))
    found = json.loads(json.dumps(found, allow_nan=False))
    assert found["worst_ratio"] == {SNAPSHOTS: 0.45, PRUNED: None, MCMC: pytest.approx(1.0)}
    same_share = found["bytes_ratio_same_share"][MCMC]
    assert [row["ratio"] for row in same_share.values()] == pytest.approx([10 / 9, 10 / 12])
    assert found["bytes_ratio"][PRUNED]["5%"] == {"ratio": None, "where": OUTSIDE, "ssim": 0.95}
    assert found["gap_db"] == pytest.approx(0.05)
    assert found["far_bytes_ratio"] == {"resolution": {"0.8": 0.5, "0.9": 0.65}, "farther": {"0.8": 3.0}}
    assert found["bytes_per_gaussian"] == {
        "all": 10.0,
        "all sent": 20.0,
        "level 1": 20.0,
        "levels 1 to 4": 20.0,
    }
    assert found["bars"] == {
        "top within 0.1 dB of as one": True,
        f"bytes at most those of {MCMC}": True,
        f"bytes at most those of {PRUNED}": False,
        f"0.6 of the bytes of {SNAPSHOTS}": True,
        "12 bytes a Gaussian": True,
        "100 k encoded in 20 s": True,
        "SSIM at 1/4 at least that at 1/1": True,
        "0.6 of the bytes at 1/4": False,
    }


def test_the_table_says_where_a_ratio_is_from():
    shown = table(measured(point(MCMC, "cap 10%", 2000, 0.6))).markdown()
    assert "between" in shown
    assert shown.count("\n") >= 7


def test_survey_rows(tmp_path):
    paths = write_survey(tmp_path, measured(point(MCMC, "cap 10%", 2000, 0.6)))
    ours = tmp_path / "sagesplat" / "MipNeRF360" / "yard.csv"
    assert ours in paths
    rows = list(csv.reader(ours.read_text().splitlines()))
    assert tuple(rows[0]) == SURVEY
    assert rows[1] == ["Baseline", "22.0000", "0.90000", "0.25000", "100000", "5000"]
    assert [row[0] for row in rows[1:]] == ["Baseline", "-Third", ""]
    assert {path.parts[-3] for path in paths} == {"sagesplat", "3dgs-mcmc", "3dgs", "3dgs-as-one"}


def test_images_and_cameras_of_lower_resolution():
    image = np.random.default_rng(0).random((10, 7, 3)).astype(np.float32)
    small = far.averaged(image, 3)
    assert small.shape == (3, 2, 3)
    assert np.allclose(small[1, 0], image[3:6, 0:3].mean((0, 1)))
    camera = pinhole(70, 50)
    x = np.array([[0.3, -0.2, 4.0], [-1.0, 0.5, 7.0]])
    there, depth = project(x, camera.w2c, camera.K)
    for n, other in ((4, far.smaller(camera, 4)), (0.25, far.larger(camera, 4))):
        assert (other.width, other.height) == (70 // n, 50 // n)
        assert np.allclose(project(x, other.w2c, other.K)[0], there / n, atol=1e-4)
    moved = far.farther(camera, 4, float(depth[0]))
    assert project(x, moved.w2c, moved.K)[1][0] == pytest.approx(4 * depth[0])


def test_bytes_of_the_levels_from_which_on_a_target_is_kept():
    cost = np.broadcast_to(np.array([[1, 2, 4], [10, 20, 40]]), (2, 2, 3))
    keeps = np.array([[[True, False, True], [True, True, True]], [[False, True, True], [False, False, True]]])
    assert far.least_cost(keeps, cost) == ((4 + 10) + (2 + 40)) / 2
