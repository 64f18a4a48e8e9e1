"""The table of similarities: averaged images, rank correlations, and its last line, JSON."""

import json

import numpy as np
import pytest

from benchmarks import similarity
from benchmarks.similarity import agreement, averaged, lines, rank_correlation, summary


def test_images_are_averaged_to_the_largest_screen():
    image = np.arange(8 * 12 * 3, dtype=np.float32).reshape(8, 12, 3)
    assert averaged(image, 4, np.inf) is not None
    np.testing.assert_array_equal(averaged(image, 4, np.inf), image)
    np.testing.assert_array_equal(averaged(image, 0.5, 1), image)
    np.testing.assert_allclose(averaged(image, 2, 1)[0, 0], image[:2, :2].mean((0, 1)))
    assert averaged(image, 4, 2).shape == (4, 6, 3)
    assert averaged(image, 4, 1).shape == (2, 3, 3)


def test_rank_correlations_are_spearmans():
    assert rank_correlation(np.array([1, 5, 9]), np.array([0.1, 0.2, 7])) == pytest.approx(1)
    assert rank_correlation(np.array([1, 5, 9]), np.array([3, 2, 1])) == pytest.approx(-1)
    assert np.isnan(rank_correlation(np.ones(3), np.arange(3)))
    lpips = np.random.default_rng(0).random((4, 3, 5))
    assert agreement(np.exp(lpips), lpips) == pytest.approx((1, 1))
    by_level = np.broadcast_to(np.arange(5.0), (4, 3, 5))
    across = agreement(
        by_level + 1e-3 * np.arange(3)[None, ::-1, None], by_level + 1e-3 * np.arange(3)[:, None]
    )
    assert across == pytest.approx((1, -1))


def test_a_row_of_the_table():
    values = np.zeros((4, 2, 3)) + np.array([0.9, 0.8, 0.7, 0.5])[:, None, None] + [0.0, 0.02, 0.04]
    row = summary("SSIM", values, np.ones_like(values), 1 - values)
    assert row["mean"] == pytest.approx([0.92, 0.82, 0.72, 0.52])
    assert (row["to_2"], row["to_4"], row["to_4_levels"]) == pytest.approx((0.2, 0.4, 10))
    assert row["rank_levels"] == pytest.approx(1)
    assert summary("FLIP 67", values, np.ones_like(values), values)["rank_levels"] == pytest.approx(1)
    assert len(lines({"SSIM": row})) == 2


def test_a_run_is_measured(finished_run, monkeypatch, capsys):
    """With two definitions: weights of LPIPS and FLIP are not everywhere."""
    some = {"SSIM": lambda x, y, s: 1 - float(np.abs(x - y).mean())}
    monkeypatch.setattr(
        similarity,
        "similarities",
        lambda lpips: {**some, similarity.LPIPS: lambda x, y, s: 1 - some["SSIM"](x, y, s)},
    )
    similarity.main((finished_run,), views=3, levels=2)
    found = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert found["screens"] == [0.5, 1, 2, 4]
    row = found["runs"]["run"]["SSIM"]
    assert row["rank_levels"] == row["rank_views"] == 1
    assert found["all"]["SSIM"] == row
    assert all(0 < mean < 1 for mean in row["mean"])
