"""Votes of trained Gaussians: the weights are what the rasteriser blends with."""

import numpy as np
import pytest
import torch
from conftest import orbit, pinhole, random_gaussians

from sagesplat.raster import Workspace, add_weights, rasterize
from sagesplat.scene.scene import Points, Scene, View
from sagesplat.train.votes import label_weights, winners


class _Masks:
    """Label images that are in memory."""

    def __init__(self, images, names):
        self.images, self.taxonomy = images, type("Taxonomy", (), {"names": names})()

    def __getitem__(self, view):
        return self.images[view.name]


def _expected(g, camera, columns_of, num):
    """The weights as the gradient of features in the float64 reference."""
    features = torch.zeros(len(g), num, requires_grad=True)
    render = rasterize(g, camera, features=features, backend="reference")
    one_hot = torch.from_numpy(columns_of)[..., None] == torch.arange(num)
    assert render.features is not None
    (render.features * one_hot).sum().backward()
    assert features.grad is not None
    return features.grad.numpy()


@pytest.mark.parametrize("num", [1, 3, 5])
@pytest.mark.parametrize("size", [(40, 30), (70, 33)])
def test_weights_are_the_gradient_of_features(num, size):
    g, camera = random_gaussians(120, seed=3), pinhole(*size)
    columns_of = np.random.default_rng(0).integers(-1, num, size[::-1])
    columns_of[:16, :16] = -1  # a tile where nobody votes
    out = np.ones((120, num), np.float32)
    add_weights(g, camera, columns_of, out, workspace=Workspace())
    expected = 1 + _expected(g, camera, columns_of, num)
    np.testing.assert_allclose(out, expected, atol=2e-5 * expected.max())


def _scene():
    g, cameras = random_gaussians(100, seed=5), orbit(3)
    views = tuple(View(f"{i}.png", camera, None) for i, camera in enumerate(cameras))  # type: ignore[arg-type]
    empty = np.zeros((0, 3), np.float32)
    none = np.zeros(0, np.int64)
    points = Points(empty, empty.astype(np.uint8), none, none.astype(np.int32), empty[:, :2])
    rng = np.random.default_rng(1)
    images = {v.name: rng.choice([-1, 2, 7], (32, 48)).astype(np.int16) for v in views}
    return g, Scene("x", None, views, points, 0), _Masks(images, {2: "grass", 7: "sky"})  # type: ignore[arg-type]


def test_views_add_up_and_the_heavier_label_wins():
    g, scene, masks = _scene()
    ids, weights = label_weights(g, scene, masks, [0, 2])  # type: ignore[arg-type]
    assert ids.tolist() == [2, 7]
    expected = np.zeros((100, 2))
    for row in (0, 2):
        view = scene.views[row]
        columns = np.select([masks[view] == 2, masks[view] == 7], [0, 1], -1)
        expected += _expected(g, view.camera, columns, 2)
    np.testing.assert_allclose(weights, expected, atol=1e-4)
    labels = winners(g, ids, weights)
    seen = expected.sum(1) > 1e-3
    assert (labels.numpy()[seen] == ids[expected.argmax(1)[seen]]).all()


def test_what_no_view_shows_keeps_its_label():
    g, scene, masks = _scene()
    g.means[:10, 2] = -50.0  # behind all cameras
    labels = winners(g, *label_weights(g, scene, masks, range(3)))  # type: ignore[arg-type]
    assert torch.equal(labels[:10], g.label_ids[:10])
