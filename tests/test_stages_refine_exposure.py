"""Exposures in a run: learned, fitted for held-out views, used and named by what follows."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
from conftest import SMALL_RUN, random_gaussians, write_capture
from PIL import Image

from sagesplat.adapt.viewpoints import capture_cameras
from sagesplat.core.config import BlocksConfig
from sagesplat.core.events import StageDone, Warned
from sagesplat.io.files import write_json
from sagesplat.run.job import Job
from sagesplat.run.run_dir import RunDir
from sagesplat.scene.refined import read_refined
from sagesplat.stages.blocks import train_scene
from sagesplat.stages.pipeline import run_all
from sagesplat.stages.refine import read_refined_figures
from sagesplat.stages.results import evaluation_of

CONFIG = replace(SMALL_RUN, train=replace(SMALL_RUN.train, exposure="affine"))


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run on photos of which every third one is darker, and its events."""
    folder, events = tmp_path_factory.mktemp("exposed"), []
    truth = random_gaussians(120, degree=0, logit=2.0)
    scene, masks = write_capture(folder / "capture", truth, noise=0.02), folder / "capture" / "masks"
    masks.mkdir()
    for row, view in enumerate(scene.views):
        size = (view.camera.width, view.camera.height)
        Image.new("L", size, 3).save(masks / view.name)
        photo = np.asarray(Image.open(view.image_path)).astype(float)
        Image.fromarray((photo * (0.6 if row % 3 == 0 else 1.0)).round().astype(np.uint8)).save(
            view.image_path
        )
    write_json(masks / "labels.json", {"labels": {"3": "car"}})
    run_all(Job(RunDir(folder / "run"), events.append, "cpu"), folder / "capture", CONFIG)
    return folder / "run", events


def test_held_out_views_are_fitted_to_their_photos(run):
    job = Job(RunDir(run[0]), lambda event: None, "cpu")
    scene = job.scene
    cameras = read_refined(job.run.cameras, len(scene.views))
    np.testing.assert_allclose(cameras.exposure[scene.train_ids].mean(0), np.eye(3, 4), atol=1e-5)
    held_out = np.setdiff1d(np.arange(len(scene.views)), scene.train_ids)
    assert cameras.fitted[held_out].all()
    assert not cameras.fitted[scene.train_ids].any()
    assert np.array_equal(cameras.w2c, [view.camera.w2c for view in job.given_scene.views])
    assert all(view.camera.exposure is not None for view in scene.views)
    assert all(view.camera.exposure is None for view in job.given_scene.views)


def test_figures_are_kept_and_said(run):
    figures = read_refined_figures(RunDir(run[0]).refined).exposure
    assert figures is not None
    assert figures.psnr is not None
    assert figures.psnr["exposed"] > figures.psnr["plain"]
    lines = {event.name: event.lines for event in run[1] if isinstance(event, StageDone)}
    assert any("with colours fitted to their photos" in line for line in lines["train"])
    assert "rendered with the exposure of their photos" in lines["observe"][0]
    assert any("cc_psnr" in line for line in lines["evaluate"])
    assert any("colour transform per photo" in event.text for event in run[1] if isinstance(event, Warned))


def test_fidelity_and_drawn_viewpoints_are_without_exposure(run):
    job = Job(RunDir(run[0], "nested"), lambda event: None, "cpu")
    assert all(camera.exposure is None for camera in capture_cameras(job.scene))
    rows = evaluation_of(job)
    whole = rows.select(np.isfinite(rows.cc_psnr))
    assert len(whole)
    assert (whole.psnr >= whole.plain_psnr).mean() > 0.5
    page = (job.run.adapted / "report" / "index.html").read_text("utf-8")
    assert "The photos differ in exposure" in page


def test_switched_off_nothing_is_left(run, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(run[0], folder)
    job = Job(RunDir(folder), lambda event: None, "cpu", force=True)
    train_scene(job, replace(CONFIG.train, exposure="off", max_steps=4, level_every=4), BlocksConfig(), 0)
    assert not job.run.cameras.exists()
    assert not job.run.refined.exists()
    assert job.scene is job.given_scene
