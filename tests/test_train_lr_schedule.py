"""The pace of training: published rates, larger ones that come down to them, and resolutions by frequency."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import pinhole

from sagesplat.core.config import TrainConfig
from sagesplat.core.gaussians import PARAMETERS
from sagesplat.scene.scene import Camera
from sagesplat.train import densify
from sagesplat.train.lr_schedule import PUBLISHED_RATES, detail, lr_schedule, smaller
from sagesplat.train.strategy import schedule_of


def noise(height: int, width: int, cells: int = 1) -> np.ndarray:
    """Grey noise in blocks of `cells` pixels."""
    blocks = np.random.default_rng(0).integers(0, 256, (-(-height // cells), -(-width // cells)))
    photo = np.kron(blocks, np.ones((cells, cells)))[:height, :width]
    return np.repeat(photo[..., None], 3, 2).astype(np.uint8)


def test_the_published_pace_is_3dgs_and_full_size():
    config = TrainConfig(lr_schedule="published", max_steps=1000)
    published = lr_schedule(config, 2.0, [])
    first, last = published.learning_rates(0), published.learning_rates(1000)
    assert first["means"] == pytest.approx(2 * 1.6e-4)
    assert last["means"] == pytest.approx(2 * 1.6e-6)
    for name in PARAMETERS[1:]:
        assert first[name] == last[name] == PUBLISHED_RATES[name]
    assert {published.factor(step) for step in range(1, 1001)} == {1}


@pytest.mark.parametrize(
    ("steps", "shrinks", "means_shrink"),
    [(200, 0.5, 0.1), (1000, 0.5, 0.1), (2000, 0.25, 0.05), (20_000, 0.1, 0.01)],
)
def test_the_fast_pace_begins_with_larger_steps_and_ends_with_smaller_ones(
    steps: int, shrinks: float, means_shrink: float
):
    config = TrainConfig(lr_schedule="fast", max_steps=steps)
    fast = lr_schedule(config, 2.0, [noise(64, 64)])
    for name in PARAMETERS:
        rates = [fast.learning_rates(step)[name] for step in np.linspace(0, steps, 21).astype(int).tolist()]
        published = PUBLISHED_RATES[name] * (2.0 if name == "means" else 1.0)
        assert rates[0] == pytest.approx(4 * published)
        assert (np.diff(rates) <= 0).all()
        assert rates[-1] == pytest.approx(rates[0] * (means_shrink if name == "means" else shrinks))


def test_detail_is_what_a_smaller_photo_keeps():
    assert detail(noise(96, 128), 1) == pytest.approx(1)
    white = [detail(noise(96, 128), factor) for factor in (2, 4)]
    assert white == pytest.approx([1 / 4, 1 / 16], rel=0.1)
    smooth = [detail(noise(96, 128, cells=16), factor) for factor in (2, 4)]
    assert 1 > smooth[0] > smooth[1] > white[1]
    assert smooth[0] > 2 * white[0]
    assert detail(np.full((20, 30, 3), 7, np.uint8), 2) == 0


def test_smooth_photos_stay_small_for_longer():
    config = TrainConfig(lr_schedule="fast", max_steps=1000)
    rough, smooth = (lr_schedule(config, 1.0, [noise(900, 1000, cells)]) for cells in (1, 16))
    for run in (rough, smooth):
        factors = [run.factor(step) for step in range(1, 1001)]
        assert factors[0] == 4
        assert sorted(factors, reverse=True) == factors
        assert factors[500:] == [1] * 500
    assert sum(smooth.factor(s) > 1 for s in range(1000)) > sum(rough.factor(s) > 1 for s in range(1000))


@pytest.mark.parametrize("size", [(256, 256), (399, 700)])
def test_small_photos_are_not_made_smaller(size):
    assert lr_schedule(TrainConfig(lr_schedule="fast"), 1.0, [noise(*size, cells=8)]).coarse == ()


def test_a_smaller_photo_has_a_smaller_camera():
    photo, camera = noise(51, 70), pinhole(70, 51)
    assert smaller(photo, camera, 1) == (photo, camera) or smaller(photo, camera, 1)[0] is photo
    small, seen = smaller(photo, camera, 2)
    assert isinstance(seen, Camera)
    assert small.shape == (seen.height, seen.width, 3) == (26, 35, 3)
    np.testing.assert_allclose(seen.K[0], camera.K[0] / 2, rtol=1e-6)
    np.testing.assert_allclose(seen.K[1], camera.K[1] * 26 / 51, rtol=1e-6)
    np.testing.assert_allclose(small.mean(), photo.mean(), atol=1)


def test_small_photos_ask_for_few_gaussians():
    config = TrainConfig(max_steps=30_000)
    plan = schedule_of(config)
    full = densify.budget(config, plan, plan.refine_stop, 100_000, 100_000, 1000)
    assert full == 150_000
    assert densify.budget(config, plan, plan.refine_stop, 100_000, 25_000, 1000) == 37_500
    assert densify.budget(config, plan, plan.refine_stop, 100_000, 25_000, 40_000) == 80_000
    assert densify.budget(config, plan, plan.refine_start, 100_000, 25_000, 1000) == 1000
    many = replace(config, max_gaussians=1_000_000)
    assert densify.budget(many, plan, plan.refine_stop, 100_000, 100_000, 1000) == 1_000_000
    assert densify.budget(many, plan, plan.refine_stop, 100_000, 25_000, 1000) == 250_000
