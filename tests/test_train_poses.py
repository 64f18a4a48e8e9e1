"""Pose refinement: gauge, axes and divergence; poses that are a little off are found again."""

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from conftest import orbit, random_gaussians, write_capture
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sagesplat.core.config import TrainConfig
from sagesplat.core.geometry import project, to_camera
from sagesplat.raster import rasterize
from sagesplat.scene.images import Photos
from sagesplat.train import poses
from sagesplat.train.early_stopping import label_quality
from sagesplat.train.events import Trained
from sagesplat.train.poses import (
    diverged,
    fit_pose,
    gauge_motions,
    motion_axes,
    moved,
    pose_update,
    refined_cameras,
)
from sagesplat.train.trainer import begin, train
from sagesplat.train.view_parameters import ViewParameters

TRUTH = random_gaussians(60, degree=0, logit=2.0, log_scale=-1.8)
NOISE = np.array([0.012, -0.01, 0.008, 0.02, -0.015, 0.02])  # rad, world units


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_capture(tmp_path_factory.mktemp("poses") / "capture", TRUTH, noise=0.02)


def with_noise(scene, seed=0):
    """The scene with poses that are a little off, each in another direction."""
    signs = np.random.default_rng(seed).choice([-1, 1], (len(scene.views), 6))
    views = []
    for view, sign in zip(scene.views, signs, strict=True):
        w2c = moved(view.camera.w2c, sign * NOISE)
        views.append(replace(view, camera=replace(view.camera, w2c=w2c)))
    return replace(scene, views=tuple(views))


def pixels(a, b, xyz):
    """How far apart two cameras see points, root mean square, pixels."""
    apart = project(xyz, a.w2c, a.K)[0] - project(xyz, b.w2c, b.K)[0]
    return float(np.sqrt((apart**2).sum(1).mean()))


@settings(max_examples=30, derandomize=True)
@given(st.lists(st.floats(-1, 1), min_size=6, max_size=6))
def test_a_motion_moves_points_in_the_camera(motion):
    camera, points = orbit(1)[0], TRUTH.means.numpy()
    w2c = moved(camera.w2c, np.array(motion))
    expected = to_camera(points, camera.w2c) @ Rotation.from_rotvec(motion[:3]).as_matrix().T + motion[3:]
    assert np.abs(to_camera(points, w2c) - expected).max() < 1e-5
    assert np.abs(w2c[:3, :3].astype(np.float64) @ w2c[:3, :3].T - np.eye(3)).max() < 1e-6


def test_axes_move_the_image_by_their_length(scene, monkeypatch):
    monkeypatch.setattr(poses, "_PRIOR", 200.0)  # else motions that hardly show are kept small
    camera, axes, step = scene.views[0].camera, motion_axes(scene, 0), 1e-4
    xyz = scene.points.xyz[scene.points.track_points[scene.points.track_views == 0]]
    effects = []
    for axis in axes.T:
        there, back = (project(xyz, moved(camera.w2c, s * axis), camera.K)[0] for s in (step, -step))
        effects.append(((there - back) / (2 * step * camera.K[0, 0])).ravel() / np.sqrt(len(xyz)))
    assert np.abs(np.array(effects) @ np.array(effects).T - np.eye(6)).max() < 0.03


def test_views_of_few_points_or_without_tracks_have_axes(scene):
    behind = replace(scene.points, xyz=scene.points.xyz - np.array([0, 0, 100], np.float32))
    axes = motion_axes(replace(scene, points=behind), 0)
    assert np.abs(axes).max() < 4 * scene.scale
    assert np.linalg.matrix_rank(axes) == 6
    none = {name: getattr(scene.points, name)[:0] for name in ("track_points", "track_views", "track_uv")}
    axes = motion_axes(replace(scene, points=replace(scene.points, **none)), 0)
    expected = motion_axes(scene, 0)
    assert np.abs(np.linalg.norm(axes, axis=0) / np.linalg.norm(expected, axis=0) - 1).max() < 0.1


def test_a_similarity_of_the_world_is_a_motion_without_effect(scene):
    """The cameras of a turned, shifted and scaled world differ by combinations of the gauge motions."""
    w2c = np.stack([view.camera.w2c for view in scene.views]).astype(np.float64)
    basis = gauge_motions(w2c, scene.scale).reshape(-1, 7)
    turn, shift, factor, step = np.array([0.3, -0.5, 0.2]), np.array([0.1, 0.2, -0.3]), 1.7, 1e-5
    motions = []
    for camera in w2c:
        centre = -camera[:3, :3].T @ camera[:3, 3]
        rotation = Rotation.from_rotvec(step * turn).as_matrix()
        new_centre = np.exp(step * np.log(factor)) * rotation @ centre + step * shift
        new_rotation = camera[:3, :3] @ rotation.T
        motions.append(Rotation.from_matrix(new_rotation @ camera[:3, :3].T).as_rotvec())
        motions.append(-new_rotation @ new_centre - new_rotation @ camera[:3, :3].T @ camera[:3, 3])
    wanted = np.concatenate(motions) / step
    found = basis @ np.linalg.lstsq(basis, wanted)[0]
    assert np.abs(found - wanted).max() < 1e-4 * np.abs(wanted).max()


def test_updates_leave_the_gauge_alone(scene):
    update = pose_update(scene, 100, 1)
    parameters, generator = ViewParameters.zeros(len(scene.views), 6), torch.Generator().manual_seed(0)
    for step in range(4, 30):
        view = int(scene.train_ids[step % len(scene.train_ids)])
        update(parameters, [view], torch.randn(1, 6, generator=generator), step)
    values = parameters.values[scene.train_ids].reshape(-1)
    assert values.norm() > 0.01
    assert (update.gauge.T @ values).abs().max() < 1e-6 * values.norm()
    assert (parameters.values[scene.test_ids] == 0).all()


def test_a_pose_that_diverges_is_put_back(scene):
    update = pose_update(scene, 100, 1)
    parameters = ViewParameters.zeros(len(scene.views), 6)
    wild, other = scene.train_ids[:2].tolist()
    parameters.values[wild] = 50.0
    for step in range(90, 98):
        update(parameters, [wild, other], torch.ones(2, 6), step)
    assert diverged(parameters).tolist() == [row == wild for row in range(len(scene.views))]
    assert (parameters.values[wild] == 0).all()
    assert (parameters.values[other] != 0).any()
    cameras = refined_cameras(scene, update, parameters)
    assert cameras[wild] is scene.views[wild].camera


def test_most_poses_diverge_and_all_are_put_back(scene):
    update, parameters = pose_update(scene, 100, 1), ViewParameters.zeros(len(scene.views), 6)
    parameters.values[scene.train_ids] = 50 * torch.randn(len(scene.train_ids), 6)
    update(parameters, scene.train_ids[:1].tolist(), torch.ones(1, 6), 5)
    assert diverged(parameters)[scene.train_ids].all()
    assert (parameters.values == 0).all()


@pytest.mark.parametrize("antialiased", [False, True])
def test_the_pose_of_a_photo_is_found_from_fixed_gaussians(scene, antialiased):
    config, given_scene = TrainConfig(antialiased=antialiased), with_noise(scene, seed=3)
    right, off, axes = scene.views[2].camera, given_scene.views[2].camera, motion_axes(given_scene, 2)
    photo = rasterize(TRUTH, right, antialiased=antialiased).rgb.clamp(0, 1).numpy()
    found = fit_pose(TRUTH, off, (photo * 255).round().astype(np.uint8), axes, scene.scale, config)
    xyz = TRUTH.means.numpy()
    assert pixels(off, right, xyz) > 0.5
    assert pixels(found, right, xyz) < 0.05


def test_a_photo_of_something_else_leaves_the_pose(scene):
    camera, axes = scene.views[2].camera, 300 * motion_axes(scene, 2)  # steps far out of the scene
    photo = np.random.default_rng(0).integers(0, 255, (camera.height, camera.width, 3), dtype=np.uint8)
    assert fit_pose(TRUTH, camera, photo, axes, scene.scale, TrainConfig()) is camera


def test_training_mends_poses(scene):
    off = with_noise(scene)
    config = TrainConfig(max_steps=300, level_every=300, sh_degree=0, poses=True)
    labels, xyz = np.full(len(scene.points.xyz), -1, np.int16), TRUTH.means.numpy()
    trained = list(train(off, Photos(off.views), labels, config))[-1]
    assert isinstance(trained, Trained)
    cameras = refined_cameras(off, pose_update(off, 300, 1), trained.per_view["pose"])
    before, after = (
        [pixels(c, scene.views[row].camera, xyz) for row, c in enumerate(some) if row in scene.train_ids]
        for some in ([view.camera for view in off.views], cameras)
    )
    assert np.mean(after) < 0.5 * np.mean(before)


def test_categories_are_measured_from_refined_cameras(scene):
    labels = np.full(len(scene.points.xyz), -1, np.int16)
    training = begin(scene, Photos(scene.views), labels, TrainConfig(max_steps=10, poses=True))
    training.state.per_view["pose"].values[2] = 0.01
    update = pose_update(scene, 10, 1)
    expected = refined_cameras(scene, update, training.state.per_view["pose"])
    for row in (1, 2):
        assert np.array_equal(training.stepper.camera(training.state, row).w2c, expected[row].w2c)
    masks: Any = {view: np.full((32, 48), -1, np.int16) for view in scene.views}
    tiles, photos = replace(training.stepper.active_tiles, masks=masks), training.stepper.photo_loader
    given, refined = (
        label_quality(
            training.state.gaussians, tiles, photos, {-1: [2]}, training.config, 0, camera_of=camera
        )
        for camera in (None, partial(training.stepper.camera, training.state))
    )
    assert given != refined
