"""Outlier masks: what is found, what is not, and that training leaves it out."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from conftest import random_gaussians, write_capture
from hypothesis import given
from hypothesis import strategies as st

from sagesplat.core.config import BlocksConfig, TrainConfig
from sagesplat.core.errors import RunError
from sagesplat.core.gaussians import Gaussians
from sagesplat.metrics.image import psnr
from sagesplat.raster import rasterize
from sagesplat.scene.images import Photos
from sagesplat.scene.scene import Scene
from sagesplat.stages import blocks
from sagesplat.train import outliers
from sagesplat.train.events import Step, Trained
from sagesplat.train.nested import capped_config
from sagesplat.train.outliers import SMALLEST, OutlierSchedule, inliers
from sagesplat.train.trainer import train

HEIGHT, WIDTH = 240, 320  # two pixels a cell
FIGURE = slice(80, 160), slice(200, 240)


def images(seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """A rendering, and a photo with details that it lacks: of both signs, and strong."""
    rng = np.random.default_rng(seed)
    photo = rng.random((HEIGHT, WIDTH, 3), np.float32)
    rendering = photo + rng.normal(0, 0.2, photo.shape).astype(np.float32)
    return torch.from_numpy(rendering), torch.from_numpy(photo)


def with_figure(rendering: torch.Tensor, where=FIGURE, colour: float = 0.3) -> torch.Tensor:
    photo = rendering.clone()
    photo[where] += colour
    return photo


def test_a_figure_is_found_and_details_are_not():
    rendering, photo = images()
    assert inliers(rendering, photo) is None
    photo[FIGURE] += 0.3
    left = inliers(rendering, photo)
    assert left is not None
    assert not left[FIGURE].any()
    assert float((~left).sum()) < 2 * 80 * 40  # its edges are blurred
    valid = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    assert inliers(rendering, images()[1], valid) is valid


def test_neither_small_things_nor_whole_photos_are_outliers():
    rendering, _ = images()
    small = 2 * (SMALLEST - 5)
    assert inliers(rendering, with_figure(rendering, (slice(50, 50 + small), slice(50, 300)))) is None
    assert inliers(rendering, rendering + 0.3) is None
    assert inliers(rendering, with_figure(rendering, (slice(0, HEIGHT), slice(0, WIDTH // 2)))) is None
    assert inliers(rendering, torch.full_like(rendering, torch.nan)) is None


def test_bytes_and_sizes():
    rendering = images()[0].clamp(0, 0.7).mul(255).round().div(255)
    photo = with_figure(rendering, colour=0.2)
    as_bytes = photo.mul(255).round().to(torch.uint8)
    a, b = inliers(rendering, photo), inliers(rendering, as_bytes)
    assert a is not None
    assert b is not None
    assert torch.equal(a, b)
    large = [x.repeat_interleave(3, 0).repeat_interleave(3, 1) for x in (rendering, photo)]
    of_large = inliers(*large)
    assert of_large is not None
    assert torch.equal(of_large[1::3, 1::3], a)


def test_pixels_that_do_not_count_are_not_looked_at():
    rendering, _ = images()
    valid = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    valid[FIGURE] = False
    assert inliers(rendering, with_figure(rendering), valid) is valid
    assert inliers(rendering, with_figure(rendering), torch.zeros_like(valid)) is not None
    tiles = np.ones((15, 20), bool)
    tiles[5:10, 12:15] = False  # nothing is drawn there, and it is no outlier
    assert inliers(rendering, with_figure(rendering), None, tiles) is None
    valid[:, :100] = False
    both = inliers(rendering, with_figure(rendering, (slice(20, 60), slice(90, 190))), valid)
    assert both is not None
    assert not (both & ~valid).any()
    assert not both[20:60, 100:190].any()


@given(st.integers(1, 70), st.integers(1, 400), st.integers(0, 2**32 - 1))
def test_any_size_and_content(height, width, seed):
    rng = np.random.default_rng(seed)
    rendering, photo = (torch.from_numpy(rng.random((height, width, 3), np.float32)) for _ in range(2))
    photo[: height // 2, : width // 4] = rng.random()
    valid = torch.from_numpy(rng.random((height, width)) < rng.random())
    left = inliers(rendering, photo, valid)
    assert left is not None
    assert left.shape == valid.shape
    assert not (left & ~valid).any()


class Figures(Photos):
    """Photos with a bright square, at another place in each."""

    def __getitem__(self, index: int) -> np.ndarray:
        photo = super().__getitem__(index).copy()
        at = 3 + 4 * (3 * index % 8)  # neighbours show it elsewhere
        photo[9:22, at : at + 12] = 255 - photo[9:22, at : at + 12] // 4
        return photo


CONFIG = TrainConfig(max_steps=150, sh_degree=0, exposure="off")
LABELS = np.full(60, -1, np.int16)


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Scene:
    truth = random_gaussians(60, seed=12, degree=0, log_scale=-1.2, logit=2.0)
    return write_capture(tmp_path_factory.mktemp("capture") / "cloud", truth)  # 48 x 32


def trained(scene: Scene, photos: Photos, config: TrainConfig) -> tuple[Gaussians, list[float]]:
    events = list(train(scene, photos, LABELS, config))
    assert isinstance(events[-1], Trained)
    return events[-1].gaussians, [event.loss for event in events if isinstance(event, Step)]


def quality(g: Gaussians, scene: Scene, photos: Photos) -> float:
    """PSNR of the training views against other photos than they were trained on."""
    errors = []
    for row in scene.train_ids.tolist():
        image = rasterize(g, scene.views[row].camera).rgb.clamp(0, 1).numpy()
        errors.append(float(np.square(image - photos[row] / 255).mean()))
    return float(psnr(float(np.mean(errors))))


def test_training_leaves_figures_out(scene, monkeypatch):
    """Until the masks begin every bit is the same; what is trained afterwards is nearer to the scene."""
    monkeypatch.setattr(outliers, "SMALLEST", 5)  # these photos have 48 cells along a side, not 160
    clean, figures = Photos(scene.views), Figures(scene.views)
    plain, losses = trained(scene, figures, CONFIG)
    robust, robust_losses = trained(scene, figures, replace(CONFIG, outliers=True))
    schedule = OutlierSchedule.of(CONFIG.max_steps, 1, len(scene.train_ids))
    assert robust_losses[: schedule.first] == losses[: schedule.first]
    steps = [step for step in range(CONFIG.max_steps) if schedule(step)][-20:]
    after, before = (np.array(found)[steps].mean() for found in (robust_losses, losses))
    assert after < 0.7 * before  # less is compared
    assert quality(robust, scene, clean) > quality(plain, scene, clean) + 0.5


def test_views_are_seen_before_they_are_judged():
    of = OutlierSchedule.of
    assert of(30_000, 1, 150).first == 9000
    assert of(2000, 1, 46).first == 600
    assert of(7000, 1, 300).first == 3000  # ten visits
    assert of(7000, 2, 300).first == 2100
    assert of(1000, 1, 162).first == 600  # there is no time for ten
    schedule = of(2000, 1, 46)
    assert not any(map(schedule, range(600)))
    rounds = [{schedule(step) for step in range(46 * i, 46 * (i + 1))} for i in range(14, 20)]
    assert rounds == [{True}, {False}, {True}, {True}, {False}, {True}]


def test_a_resized_training_has_none():
    # It is fitted to what the run's training left.
    assert not capped_config(TrainConfig(outliers=True), 10, 10).outliers


@pytest.mark.parametrize(
    ("option", "config"),
    [
        ("outliers", TrainConfig(outliers=True)),
        ("poses", TrainConfig(poses=True)),
        ("exposure affine", TrainConfig(exposure="affine")),
    ],
)
def test_blocks_refuse_what_is_of_the_whole_scene(option, config):
    with pytest.raises(RunError, match=rf"--train\.{option} does not go with --blocks\.count; leave out one"):
        blocks.check(BlocksConfig(count=2), config)
    blocks.check(BlocksConfig(), config)


@pytest.mark.slow
@pytest.mark.parametrize("more", [{"exposure": "affine"}, {"poses": True}, {"batch": 2}])
def test_it_goes_with_what_is_refined(scene, more):
    _, losses = trained(scene, Figures(scene.views), replace(CONFIG, max_steps=20, outliers=True, **more))
    assert np.isfinite(losses).all()
