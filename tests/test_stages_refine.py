"""Refined cameras in a run: written, used by what comes after training, removed when nothing is refined."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
from conftest import SMALL_RUN

from sagesplat.core.config import BlocksConfig
from sagesplat.core.events import StageDone
from sagesplat.run.job import Job
from sagesplat.run.records import uses
from sagesplat.run.run_dir import RunDir
from sagesplat.scene.refined import read_refined
from sagesplat.stages.block_levels import nest_scene
from sagesplat.stages.blocks import train_scene
from sagesplat.stages.observe import observe_levels
from sagesplat.stages.refine import read_refined_figures

POSES = replace(SMALL_RUN.train, max_steps=40, level_every=20, poses=True)


@pytest.fixture(scope="module")
def refined(finished_run, tmp_path_factory):
    """A run whose training was done again with --train.poses, and the training's lines."""
    folder = tmp_path_factory.mktemp("refined") / "run"
    shutil.copytree(finished_run, folder)
    shutil.copytree(finished_run.parent / "capture", folder.parent / "capture")
    events = []
    train_scene(Job(RunDir(folder), events.append, "cpu", force=True), POSES, BlocksConfig(), 0)
    return folder, next(event.lines for event in events if isinstance(event, StageDone))


def test_cameras_and_figures_are_written(refined):
    folder, lines = refined
    job = Job(RunDir(folder), lambda event: None, "cpu")
    cameras, given = read_refined(job.run.cameras, len(job.scene.views)), job.given_scene
    moved = [not np.array_equal(w2c, v.camera.w2c) for w2c, v in zip(cameras.w2c, given.views, strict=True)]
    assert any(moved[row] for row in given.train_ids)
    assert not cameras.fitted[given.train_ids].any()
    assert cameras.fitted[given.test_ids].any()
    assert all(np.array_equal(v.camera.w2c, w2c) for v, w2c in zip(job.scene.views, cameras.w2c, strict=True))
    figures = read_refined_figures(job.run.refined).poses
    assert figures is not None
    assert figures.psnr is not None
    assert figures.psnr[1] > figures.psnr[0] - 0.01
    assert "poses of training views moved by" in lines[1]
    assert f"{figures.psnr[1]:.2f} dB with poses fitted to their photos" in lines[-1]


def test_what_follows_is_made_from_them(refined, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(refined[0], folder)
    job = Job(RunDir(folder), lambda event: None, "cpu", force=True)
    nest_scene(job, SMALL_RUN.nest, 0)
    observe_levels(job, SMALL_RUN.fit)
    assert uses(job.run, "nest", job.run.cameras)
    assert uses(job.run, "observe", job.run.cameras)
    train_scene(job, SMALL_RUN.train, BlocksConfig(), 0)  # without poses
    assert not job.run.cameras.exists()
    assert not job.run.refined.exists()
    assert job.scene is job.given_scene


def test_a_run_that_ended_before_they_were_written_writes_them(refined, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(refined[0], folder)
    run = RunDir(folder)
    before = read_refined(run.cameras, 8)
    for path in (run.cameras, run.refined, run.provenance("train")):
        path.unlink()
    train_scene(Job(run, lambda event: None, "cpu"), POSES, BlocksConfig(), 0)
    after = read_refined(run.cameras, 8)
    assert np.array_equal(before.w2c, after.w2c)
    assert np.array_equal(before.fitted, after.fitted)
