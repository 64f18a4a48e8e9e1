"""Photos on their way to the device that trains."""

import numpy as np
import pytest
import torch
from conftest import pinhole

from sagesplat.scene.scene import Points, Scene, View
from sagesplat.train.photo_loader import PhotoLoader


class Album:
    """Photos that know how often each was asked for."""

    def __init__(self, count: int):
        rng = np.random.default_rng(0)
        self.photos = [rng.integers(0, 256, (20, 30, 3), np.uint8) for _ in range(count)]
        self.asked: list[int] = []

    def __getitem__(self, row: int) -> np.ndarray:
        self.asked.append(row)
        return self.photos[row]


@pytest.fixture
def scene(tmp_path) -> Scene:
    views = tuple(View(f"{i}.png", pinhole(30, 20), tmp_path / f"{i}.png") for i in range(4))
    none = np.zeros((0, 3))
    points = Points(
        none.astype(np.float32), none.astype(np.uint8), np.zeros(0, np.int64), np.zeros(0, np.int32),
        np.zeros((0, 2), np.float32),
    )  # fmt: skip
    return Scene("album", tmp_path, views, points)


def test_a_cpu_gets_unit_floats(scene):
    album = Album(4)
    photo, camera = PhotoLoader(scene, album, torch.device("cpu"))(2)  # type: ignore[arg-type]
    np.testing.assert_array_equal(photo.numpy(), album.photos[2].astype(np.float32) / 255)
    assert (camera.width, camera.height) == (30, 20)
    small, seen = PhotoLoader(scene, album, torch.device("cpu"))(2, 2)  # type: ignore[arg-type]
    assert small.shape == (seen.height, seen.width, 3) == (10, 15, 3)


def test_a_device_keeps_bytes_up_to_its_limit_and_fetches_the_rest_ahead(scene):
    """On the meta device, which takes tensors like a GPU and holds nothing."""
    album = Album(4)
    feed = PhotoLoader(scene, album, torch.device("meta"), limit=2 * 20 * 30 * 3)  # type: ignore[arg-type]
    for row in (0, 1, 2, 3) * 2:
        photo, camera = feed(row)
        assert (photo.dtype, photo.device.type, tuple(photo.shape)) == (torch.uint8, "meta", (20, 30, 3))
        assert camera is scene.views[row].camera
    assert [album.asked.count(row) for row in range(4)] == [1, 1, 2, 2]
    feed.expect(3)
    feed.expect(3)  # it comes already
    feed.expect(0)  # it is there
    feed(3)
    assert [album.asked.count(row) for row in range(4)] == [1, 1, 2, 3]


def test_what_goes_wrong_ahead_is_told_at_its_step(scene):
    class Broken(Album):
        def __getitem__(self, row: int) -> np.ndarray:
            raise OSError("gone")

    feed = PhotoLoader(scene, Broken(4), torch.device("meta"), limit=0)  # type: ignore[arg-type]
    feed.expect(1)
    with pytest.raises(OSError, match="gone"):
        feed(1)
