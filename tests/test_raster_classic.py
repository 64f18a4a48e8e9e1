"""Models for rasterisers that draw in another way."""

import math
from dataclasses import replace

import pytest
import torch
from conftest import pinhole, random_gaussians

from sagesplat.raster import rasterize
from sagesplat.raster.classic import for_classic, for_playcanvas


def test_one_camera_sees_the_same_picture() -> None:
    """The factor is exact where there is only one view."""
    g = random_gaussians(60, degree=1)
    g = replace(g, log_scales=g.log_scales - 1.5)  # small ones, that antialiasing makes faint
    camera = pinhole()
    wanted, as_they_are = (rasterize(g, camera, antialiased=a).rgb for a in (True, False))
    found = rasterize(for_classic(g, [camera]), camera).rgb
    torch.testing.assert_close(found, wanted, atol=2e-3, rtol=0)
    assert (as_they_are - wanted).abs().max() > 0.05


def test_several_cameras_give_the_mean_of_their_factors() -> None:
    g = replace(
        random_gaussians(1), log_scales=torch.full((1, 3), -3.0), means=torch.tensor([[0.0, 0.0, 0.3]])
    )
    cameras = [pinhole(), pinhole(angle=0.2), pinhole(angle=-0.3)]
    logits = [for_classic(g, [camera]).logit_opacities for camera in cameras]
    together = for_classic(g, cameras).logit_opacities
    assert torch.stack(logits).min() <= together <= torch.stack(logits).max()
    assert together < g.logit_opacities


@pytest.mark.parametrize("logit", [-800.0, 3.0, 800.0])
def test_what_no_camera_sees_stays_and_all_is_finite(logit: float) -> None:
    g = random_gaussians(20, logit=logit)
    g = replace(g, means=torch.cat([g.means[:10], g.means[10:] * 0 - 50]))
    found = for_classic(g, [pinhole()])
    assert torch.equal(found.logit_opacities[10:], g.logit_opacities[10:])
    assert torch.isfinite(found.logit_opacities).all()
    assert torch.equal(for_classic(g, []).logit_opacities, g.logit_opacities)


def test_the_low_pass_that_playcanvas_lacks_is_in_the_gaussians() -> None:
    """At twice the size, of which every second pixel is taken, ours is a quarter of its own, as theirs is."""
    camera = pinhole()
    g = random_gaussians(60, degree=1)
    g = replace(g, log_scales=g.log_scales - 1.5)
    twice = camera.resized(2 * camera.width, 2 * camera.height)
    twice.K[:2, 2] += 0.5  # so that every second pixel has the centre of one

    def theirs(g):
        return rasterize(g, twice).rgb[1::2, 1::2]

    found = for_playcanvas(g, [camera])
    found = replace(found, log_scales=found.log_scales - math.log(1.05))
    wanted = rasterize(g, camera).rgb
    error, before = ((theirs(some) - wanted).square().mean() for some in (found, g))
    assert error < before / 10
    unseen = for_playcanvas(g, [])
    torch.testing.assert_close(unseen.log_scales, g.log_scales + math.log(1.05))
    assert torch.equal(found.means, g.means)
    assert torch.equal(found.logit_opacities, g.logit_opacities)
