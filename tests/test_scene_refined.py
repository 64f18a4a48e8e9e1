"""Refined cameras: the same when read back, one line for anything else."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import random_gaussians, write_capture

from sagesplat.core.config import PosesConfig, SceneConfig
from sagesplat.core.errors import RunError
from sagesplat.run.job import Job
from sagesplat.run.run_dir import RunDir
from sagesplat.scene.refined import given_cameras, read_refined, with_cameras, write_refined
from sagesplat.stages.scene import open_scene


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_capture(tmp_path_factory.mktemp("capture") / "capture", random_gaussians(12, degree=0))


def moved(scene):
    cameras = given_cameras(scene)
    w2c = cameras.w2c.copy()
    w2c[2, :3, 3] += 0.25
    return replace(cameras, w2c=w2c, fitted=np.arange(len(w2c)) == 0)


def test_round_trip(tmp_path, scene):
    write_refined(tmp_path / "cameras.npz", moved(scene))
    back = read_refined(tmp_path / "cameras.npz", len(scene.views))
    for name, array in vars(moved(scene)).items():
        assert np.array_equal(getattr(back, name), array)


def test_the_scene_has_them(scene):
    refined = with_cameras(scene, moved(scene))
    moves = [
        np.abs(a.camera.w2c - b.camera.w2c).max() for a, b in zip(refined.views, scene.views, strict=True)
    ]
    assert np.flatnonzero(moves).tolist() == [2]
    assert refined.views[2].camera.K is scene.views[2].camera.K
    assert refined.train_ids.tolist() == scene.train_ids.tolist()


@pytest.mark.parametrize(
    ("name", "index", "value"),
    [
        ("w2c", (1, 0, 0), 2.0),
        ("exposure", (0, 1, 3), np.inf),
    ],
)
def test_what_is_no_camera_is_refused(tmp_path, scene, name, index, value):
    cameras = moved(scene)
    getattr(cameras, name)[index] = value
    write_refined(tmp_path / "cameras.npz", cameras)
    with pytest.raises(RunError, match=r"cameras\.npz: not the refined cameras of 8 views .*--force"):
        read_refined(tmp_path / "cameras.npz", len(scene.views))


def test_a_job_takes_them_up_when_they_are_written(tmp_path, scene):
    job = Job(RunDir(tmp_path / "run"), lambda event: None, "cpu")
    open_scene(job, scene.path, SceneConfig(), PosesConfig())
    assert job.scene is job.given_scene
    assert job.run.scene_files == [job.run.scene]
    write_refined(job.run.cameras, moved(scene))
    assert job.scene is job.scene
    assert job.scene.views[2].camera.w2c[0, 3] - job.given_scene.views[2].camera.w2c[0, 3] == 0.25
    assert job.run.scene_files == [job.run.scene, job.run.cameras]
    job.run.cameras.unlink()
    assert job.scene is job.given_scene


def test_of_other_views_is_refused(tmp_path, scene):
    write_refined(tmp_path / "cameras.npz", moved(scene))
    with pytest.raises(RunError, match="not the refined cameras of 7 views"):
        read_refined(tmp_path / "cameras.npz", 7)
