"""Floaters are found by their criteria, and removed as far as no view misses them."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from conftest import orbit, random_gaussians, write_capture
from torch import Tensor

from sagesplat.core.config import CleanConfig
from sagesplat.core.gaussians import Gaussians, concat
from sagesplat.raster import rasterize, set_threads
from sagesplat.scene.images import Photos
from sagesplat.scene.scene import Scene, View
from sagesplat.train.clean import CRITERIA, Floaters, clean, find_floaters

CONFIG = CleanConfig()
N = 120


@pytest.fixture(scope="module")
def truth() -> Gaussians:
    return random_gaussians(N, degree=0, log_scale=-1.6, logit=3.0)


@pytest.fixture(scope="module")
def scene(truth: Gaussians, tmp_path_factory: pytest.TempPathFactory) -> Scene:
    made = write_capture(tmp_path_factory.mktemp("clean"), truth, views=12, noise=0.02)
    return replace(made, test_every=5, calibrate_every=4)


def blobs(means: Tensor, *, size: float = 0.04, logit: float = 1.0, label: int = 3) -> Gaussians:
    n = len(means)
    g = random_gaussians(n, degree=0)
    return replace(
        g, means=means.float(), log_scales=torch.full((n, 3), float(np.log(size))),
        logit_opacities=torch.full((n,), logit), label_ids=torch.full((n,), label, dtype=torch.int16),
    )  # fmt: skip


def before_cameras(count: int, share: float) -> Tensor:
    """Places in front of the cameras of the capture, at this share of the way to the cloud."""
    centres = np.stack([camera.position for camera in orbit(count)])
    rng = np.random.default_rng(0)
    at = centres + share * (np.array([0, 0, 4]) + rng.normal(0, 0.3, centres.shape) - centres)
    return torch.from_numpy(at)


def rows_of(floaters: Floaters, name: str) -> list[int]:
    return np.flatnonzero(floaters.found[name]).tolist()


def find(g: Gaussians, scene: Scene, **options) -> Floaters:
    return find_floaters(g, scene, scene.train_ids.tolist(), **options)


def remove(g: Gaussians, floaters: Floaters, scene: Scene, config: CleanConfig = CONFIG, **options):
    kinds = {"train": scene.train_ids.tolist(), "calibration": scene.calibration_ids.tolist()}
    return clean(g, floaters, scene, Photos(scene.views), config, kinds=kinds, backend="cpu", **options)


def test_what_no_view_shows_is_hardly_shown(truth: Gaussians, scene: Scene) -> None:
    behind = blobs(torch.tensor([[0.0, 0, -6], [0.5, 0.2, -5]]))
    floaters = find(concat([truth, behind]), scene)
    assert list(floaters.found) == list(CRITERIA)
    assert rows_of(floaters, "hardly shown")[-2:] == [N, N + 1]
    assert floaters.weight[N:].max() == 0 < floaters.weight[:N].max()


def test_mist_beside_the_cameras_is_hardly_shown(
    truth: Gaussians, scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Photos show the rim of it only; who turned around would stand before a wall."""
    camera = scene.views[0].camera
    right = 0.5 * (camera.width - camera.K[0, 2]) / camera.K[0, 0] + 0.25  # 2.5 standard deviations outside
    beside = camera.position + right * camera.w2c[0, :3] + 0.5 * camera.w2c[2, :3]
    g = concat([truth, blobs(torch.from_numpy(beside)[None], size=0.1, logit=6.0)])
    monkeypatch.setattr("sagesplat.train.clean._SHOWN_SHARE", 0.1)  # photos are small
    floaters = find_floaters(g, scene, [0])
    found = rows_of(floaters, "hardly shown")
    assert N in found
    assert floaters.weight[N] > 0
    assert np.median(floaters.weight[found]) < 0.3 * np.median(floaters.weight[:N])  # the others are hidden
    assert not rows_of(find(g, scene, hardly_shown=False), "hardly shown")


def test_blobs_before_the_cameras_are_in_front_and_little_else(truth: Gaussians, scene: Scene) -> None:
    g = concat([truth, blobs(before_cameras(8, 0.2), size=0.02)])
    floaters = find(g, scene, hardly_shown=False)
    found = set(rows_of(floaters, "in front"))
    assert found >= set(range(N, N + 8))
    assert len(found) <= 8 + 2
    cleaned = remove(g, floaters, scene)
    assert not cleaned.keep[N:].any()
    assert cleaned.keep[:N].sum() >= N - 2
    assert cleaned.after["train"] > cleaned.before["train"] + 1


@pytest.mark.threads
def test_views_side_by_side_and_one_by_one_find_the_same(
    truth: Gaussians, scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    g = concat([truth, blobs(before_cameras(8, 0.2), size=0.02)])
    set_threads(2)
    together = find(g, scene)
    monkeypatch.setattr("sagesplat.train.clean._SIDE_BY_SIDE", 0)
    alone = find(g, scene)
    assert any(rows.any() for rows in alone.found.values())
    assert np.array_equal(together.weight, alone.weight)
    assert all(np.array_equal(together.found[name], rows) for name, rows in alone.found.items())


def test_without_tracks_content_is_what_the_gaussians_show(truth: Gaussians, scene: Scene) -> None:
    points = scene.points
    none = replace(
        points, track_points=points.track_points[:0], track_views=points.track_views[:0],
        track_uv=points.track_uv[:0],
    )  # fmt: skip
    g = concat([truth, blobs(before_cameras(8, 0.2), size=0.02)])
    found = set(rows_of(find(g, replace(scene, points=none), hardly_shown=False), "in front"))
    assert found >= set(range(N, N + 8))
    assert len(found) <= 8 + 2


def test_what_paints_a_far_category_contradicts_it(
    truth: Gaussians, scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    x, y = np.meshgrid(np.linspace(-14, 14, 12), np.linspace(-10, 10, 9))
    wall = torch.from_numpy(np.stack([x.ravel(), y.ravel(), np.full(x.size, 24.0)], 1))
    sky = blobs(wall, size=1.6, logit=6.0, label=187)
    haze = blobs(torch.tensor([[0.0, -1.6, 4.0], [0.6, -1.7, 4.2], [-0.7, -1.7, 3.9]]), size=0.2)
    near = truth.select(truth.means[:, 1] > -0.6)  # nothing else before the upper part of the sky
    g = concat([near, sky, haze])

    def label_image(view: View) -> np.ndarray:
        alpha = rasterize(near, view.camera).alpha.numpy()
        return np.where(alpha > 0.3, 3, 187).astype(np.int16)

    monkeypatch.setattr("sagesplat.train.clean._CONTENT_DEPTH", 0)
    found = rows_of(find(g, scene, label_image=label_image), "category")
    n = len(near) + len(sky)
    assert set(found) >= {n, n + 1, n + 2}
    assert len(found) <= 3 + 0.1 * len(near)
    assert not set(found) & set(range(len(near), n))
    assert not rows_of(find(g, scene), "category")  # without label images nothing contradicts


def test_what_views_would_miss_stays(truth: Gaussians, scene: Scene) -> None:
    needed = np.zeros(N, bool)
    needed[:40] = True
    weight = find(truth, scene).weight
    floaters = Floaters({"hardly shown": needed}, weight)
    cleaned = remove(truth, floaters, scene)
    gone = np.flatnonzero(~cleaned.keep)
    assert cleaned.found == {"hardly shown": 40}
    assert len(gone) < 40
    assert all(cleaned.before[k] - cleaned.after[k] <= CONFIG.max_loss for k in ("train", "calibration"))
    stay = np.setdiff1d(np.flatnonzero(needed), gone)
    assert weight[gone].max(initial=0) <= weight[stay].min()  # those of the least weight go first
    assert remove(truth, floaters, scene, replace(CONFIG, max_loss=100)).keep.sum() == N - 40


def test_without_photos_what_is_seen_of_the_splat_itself_stays(truth: Gaussians, scene: Scene) -> None:
    g = concat([truth, blobs(torch.tensor([[0.0, 0, -6]]))])
    shown = np.zeros(N + 1, bool)
    shown[int(find(g, scene).weight.argmax())] = True
    hidden = np.arange(N + 1) == N
    weight = find(g, scene).weight
    for rows, goes in ((shown, False), (hidden, True)):
        cleaned = remove(g, Floaters({"hardly shown": rows}, weight), scene, real=False)
        assert cleaned.keep.all() != goes
