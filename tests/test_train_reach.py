import math
from dataclasses import replace

import pytest
import torch
from conftest import pinhole, random_gaussians

from sagesplat.core.config import TrainConfig
from sagesplat.raster import rasterize
from sagesplat.train.reach import CLEAR, EVERY, LARGE, keep_clear


def sky(sigma):
    """A far Gaussian whose centre is just in front of the image plane, 90 units to the side."""
    one = random_gaussians(1, degree=0)
    return replace(
        one, means=torch.tensor([[90.0, 0.0, 1.5]]), quats=torch.tensor([[1.0, 0, 0, 0]]),
        log_scales=torch.full((1, 3), math.log(sigma)), logit_opacities=torch.tensor([5.0]),
    )  # fmt: skip


def test_a_far_gaussian_leaves_the_cameras_alone():
    g, camera = sky(60.0), pinhole(angle=0.0)
    before = rasterize(g, camera).alpha.mean()
    centre = torch.from_numpy(camera.position)[None]
    away = float((g.means - centre).norm())
    assert keep_clear(g, centre, 5.0, torch.ones(1, dtype=torch.bool)).tolist() == [0]
    assert float(g.log_scales.exp().max()) == pytest.approx(away / CLEAR, rel=1e-5)
    assert before > 0.45
    assert rasterize(g, camera).alpha.mean() < before / 7


def test_small_and_stopped_gaussians_keep_every_bit():
    g = random_gaussians(40, log_scale=-2.0)
    scales = g.log_scales.clone()
    everywhere = g.means[:5].clone()  # cameras inside of Gaussians
    assert not len(keep_clear(g, everywhere, 100.0, torch.ones(40, dtype=torch.bool)))
    torch.testing.assert_close(g.log_scales, scales, rtol=0, atol=0)
    big = sky(60.0)
    assert not len(keep_clear(big, torch.zeros(1, 3), 5.0, torch.zeros(1, dtype=torch.bool)))
    assert float(big.log_scales.exp().max()) == pytest.approx(60)


def test_nothing_large_becomes_smaller_than_what_counts_as_large():
    g = sky(2.0)
    keep_clear(g, g.means.clone(), 5.0, torch.ones(1, dtype=torch.bool))
    assert float(g.log_scales.exp().max()) == pytest.approx(LARGE * 5.0)


def test_the_fast_schedule_cannot_outgrow_it():
    assert 4 * TrainConfig().log_scales_lr * EVERY < 0.5
