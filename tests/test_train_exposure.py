"""Colour transforms of training photos: learned, with the identity as their mean; fits of held-out photos."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from conftest import random_gaussians, write_capture

from sagesplat.core.config import TrainConfig
from sagesplat.scene.images import Photos
from sagesplat.train.events import Found, Trained
from sagesplat.train.exposure import ExposureUpdate, exposure_update, fit_exposure, transforms
from sagesplat.train.trainer import begin, train
from sagesplat.train.view_parameters import ViewParameters

GAIN = np.array([1.3, 0.75], np.float32)  # of stored values, by turns
CONFIG = TrainConfig(max_steps=160, level_every=160, lr_schedule="published", sh_degree=0)


class Exposed(Photos):
    """Photos of which every other one is brighter."""

    def __getitem__(self, index):
        photo = super().__getitem__(index).astype(np.float32) * GAIN[index % 2]
        return photo.clip(0, 255).round().astype(np.uint8)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    truth = random_gaussians(60, degree=0, logit=1.0)
    return write_capture(tmp_path_factory.mktemp("capture") / "capture", truth, views=9, noise=0.0)


def trained(scene, photos, config, **options) -> tuple[Trained, list[str]]:
    labels = np.full(len(scene.points.xyz), -1, np.int16)
    events = list(train(scene, photos, labels, config, **options))
    assert isinstance(events[-1], Trained)
    return events[-1], [event.text for event in events if isinstance(event, Found)]


def test_gains_are_learned_and_their_mean_is_the_identity(scene):
    done, found = trained(scene, Exposed(scene.views), replace(CONFIG, exposure="affine"))
    assert len(found) == 1
    exposure = transforms(done.per_view["exposure"])
    np.testing.assert_allclose(exposure[scene.train_ids].mean(0), np.eye(3, 4), atol=1e-5)
    np.testing.assert_array_equal(
        exposure[scene.test_ids], np.tile(np.eye(3, 4), (len(scene.test_ids), 1, 1))
    )
    white = exposure[..., :3].sum(-1).mean(1)[scene.train_ids]  # of (1, 1, 1)
    bright = GAIN[scene.train_ids % 2] > 1
    assert white[bright].mean() / white[~bright].mean() == pytest.approx(GAIN[0] / GAIN[1], rel=0.25)
    off, _ = trained(scene, Exposed(scene.views), replace(CONFIG, exposure="off"))
    assert off.per_view == {}


def test_photos_that_say_nothing_of_their_exposure_are_named(scene):
    none = np.zeros(0, np.int64), np.zeros(0, np.int32), np.zeros((0, 2), np.float32)
    fields = ("track_points", "track_views", "track_uv")
    blind = replace(scene, points=replace(scene.points, **dict(zip(fields, none, strict=True))))
    update, found = exposure_update(blind, Photos(scene.views), CONFIG)
    assert update is None
    assert "--train.exposure affine" in found
    update, found = exposure_update(blind, Photos(scene.views), replace(CONFIG, exposure="affine"))
    assert update is not None
    assert not update.start.any()
    assert "as asked for" in found


def test_one_exposure_of_all_photos_stays_near_the_identity(scene):
    done, _ = trained(scene, Photos(scene.views), replace(CONFIG, exposure="affine", max_steps=80))
    exposure = transforms(done.per_view["exposure"])
    assert np.abs(exposure - np.eye(3, 4)).max() < 0.15


def test_updates_move_the_views_of_a_step_and_keep_the_mean():
    rows = torch.tensor([1, 2, 4])
    update = ExposureUpdate(rows, 100, torch.zeros(5, 12), None)  # type: ignore[arg-type]
    parameters = ViewParameters.zeros(5, 12)
    update(parameters, [2], torch.ones(1, 12), 1)
    torch.testing.assert_close(parameters.values[rows].mean(0), torch.zeros(12))
    assert bool((parameters.values[2] < 0).all())
    assert not parameters.values[[0, 3]].any()


def test_early_stopping_looks_through_the_exposure(scene):
    labels = np.full(len(scene.points.xyz), -1, np.int16)
    training = begin(scene, Exposed(scene.views), labels, replace(CONFIG, exposure="affine"))
    training.state.per_view["exposure"].values[3] = 0.25
    camera = training.stepper.camera(training.state, 3)
    assert camera.exposure is not None
    np.testing.assert_allclose(camera.exposure, np.eye(3, 4) + 0.25)


def test_a_fit_undoes_an_exposure_despite_saturation_and_other_content():
    rng = np.random.default_rng(0)
    image = rng.random((48, 64, 3), np.float32)
    E = np.array([[1.4, 0.1, 0, -0.03], [0, 1.2, 0.05, 0.02], [0.04, 0, 0.8, 0.05]], np.float32)
    photo = (image @ E[:, :3].T + E[:, 3]).clip(0, 1)
    assert (photo == 1).mean() > 0.05
    np.testing.assert_allclose(fit_exposure(image, photo), E, atol=0.01)
    photo[:8] = rng.random((8, 64, 3), np.float32)  # somebody stands there
    np.testing.assert_allclose(fit_exposure(image, photo), E, atol=0.03)


@pytest.mark.parametrize("value", [0.0, 0.4, 1.0])
def test_a_fit_to_a_photo_of_one_colour_is_finite(value):
    image = np.full((16, 16, 3), 0.5, np.float32)
    found = fit_exposure(image, np.full_like(image, value))
    assert np.isfinite(found).all()
    assert np.abs(found - np.eye(3, 4)).max() < 2


def test_a_resumed_training_is_the_same(scene, tmp_path):
    config = replace(CONFIG, exposure="affine", max_steps=24, level_every=12)
    photos, labels = Exposed(scene.views), np.full(len(scene.points.xyz), -1, np.int16)
    whole, _ = trained(scene, photos, config)
    for event in train(scene, photos, labels, config, folder=tmp_path):
        if getattr(event, "step", 0) == 13:
            break
    again, _ = trained(scene, photos, config, folder=tmp_path)
    assert torch.equal(again.per_view["exposure"].values, whole.per_view["exposure"].values)
    assert torch.equal(again.gaussians.means, whole.gaussians.means)
