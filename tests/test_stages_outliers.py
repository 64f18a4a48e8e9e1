"""Outlier masks of a finished training: written, used by what is fitted afterwards, and removed again."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import SMALL_RUN, job_of
from PIL import Image

from sagesplat.adapt.observe import render_rgb
from sagesplat.core.config import TrainConfig
from sagesplat.run.job import Job
from sagesplat.segment.masks import mask_path
from sagesplat.segment.valid import ValidPixels, write_view
from sagesplat.stages import compose
from sagesplat.stages.outliers import write_inliers
from sagesplat.stages.shared import inlier_inputs
from sagesplat.stages.train import train_levels

FIGURE = slice(8, 24), slice(8, 20)
ON, OFF = TrainConfig(outliers=True), TrainConfig()


@pytest.fixture
def job(run: Path) -> Job:
    """A run on photos of its own model, with a figure in the training view 1 and the test view 0."""
    job = job_of(run)
    scene, g = job.scene, job.load_last_level()
    assert 0 in scene.test_ids
    assert 1 in scene.train_ids
    photos = [render_rgb(g, view.camera, backend="cpu", antialiased=False) * 255 for view in scene.views]
    for photo in photos[:2]:
        photo[FIGURE] = np.where(photo[FIGURE].mean((0, 1)) < 128, 255, 0)
    for row, photo in enumerate(photos):
        job.photos[row][:] = photo.round()
    return job


def test_masks_are_written_used_and_removed(job: Job, monkeypatch: pytest.MonkeyPatch):
    g, views = job.load_last_level(), job.scene.views
    valid = np.ones((32, 48), bool)
    valid[:, 40:] = False
    write_view(job.run.valid, views[2], valid)
    assert inlier_inputs(job.run) == [job.run.valid]
    (line,) = write_inliers(job, job.run, ON, g)
    assert line.startswith(f"outliers in 1 of {len(job.scene.train_ids)} training photos, ")
    assert line.endswith(f"% of their pixels; {job.run.inliers} shows them in black")
    found = job.inliers[views[1]]
    assert found is not None
    assert not found[FIGURE].any()
    assert found[:, 30:].all()
    assert job.inliers[views[0]] is None  # held out: a figure does not rise by what is left out
    np.testing.assert_array_equal(job.inliers[views[2]], valid)
    assert np.asarray(Image.open(mask_path(job.run.inliers, views[1]))).dtype == bool
    assert inlier_inputs(job.run) == [job.run.inliers]
    used: list[ValidPixels] = []
    monkeypatch.setattr(compose, "tune", lambda *args, valid, **options: used.append(valid))
    compose.tune_composition(job, g, 1)
    assert used[0].folder == job.run.inliers
    assert write_inliers(job, job.run, OFF, g) == []
    assert not job.run.inliers.exists()
    assert job.inliers is job.valid


def test_photos_without_outliers_are_said_to_have_none(job: Job):
    """Nor has a photo that does not fit as a whole any."""
    g = job.load_last_level()
    job.photos[1][:] = 255
    (line,) = write_inliers(job, job.run, ON, g)
    assert line == f"outliers in 0 of {len(job.scene.train_ids)} training photos, 0.0% of their pixels"
    assert not list(job.run.inliers.iterdir())


def test_another_training_has_masks_of_its_own_or_none(run: Path):
    job = job_of(run, force=True)
    config = replace(SMALL_RUN.train, max_steps=4, level_every=4)
    for outliers in (True, False, True):
        train_levels(job, replace(config, outliers=outliers), 0)
        assert job.run.inliers.exists() == outliers
        assert not job.run.replacement.path.exists()
