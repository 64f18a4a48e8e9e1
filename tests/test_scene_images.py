"""Photos of every kind become 8-bit RGB at the size of their view."""

from pathlib import Path

import numpy as np
import pytest
from conftest import random_gaussians, write_capture
from PIL import Image

from sagesplat.core.errors import SceneError
from sagesplat.scene import images
from sagesplat.scene.images import Photos, load_photo, photo_size
from sagesplat.scene.scene import Camera, View


def view_of(path, width: int = 6, height: int = 4) -> View:
    K = np.array([[5, 0, width / 2], [0, 5, height / 2], [0, 0, 1]], np.float32)
    return View(path.name, Camera(np.eye(4, dtype=np.float32), K, width, height), path)


GREY = np.arange(24, dtype=np.uint8).reshape(4, 6) * 10
RGB = np.random.default_rng(1).integers(0, 256, (4, 6, 3)).astype(np.uint8)


def saved(path, array, **options):
    Image.fromarray(array).save(path, **options)
    return view_of(path)


def test_grey_of_any_depth(tmp_path):
    expected = np.repeat(GREY[..., None], 3, axis=2)
    sixteen = GREY.astype(np.uint16) * 257
    for name, array in (
        ("8.png", GREY),
        ("16.png", sixteen),
        ("16.tiff", sixteen),
        ("32.tiff", sixteen.astype(np.int32)),
    ):
        np.testing.assert_array_equal(load_photo(saved(tmp_path / name, array)), expected)
    Image.fromarray(GREY).convert("P").save(tmp_path / "p.png")
    np.testing.assert_array_equal(load_photo(view_of(tmp_path / "p.png")), expected)


def test_alpha_goes_over_black(tmp_path):
    alpha = np.zeros((4, 6, 1), np.uint8)
    alpha[1] = 255
    photo = load_photo(saved(tmp_path / "a.png", np.concatenate([RGB, alpha], axis=2)))
    np.testing.assert_array_equal(photo[1], RGB[1])
    assert (photo[[0, 2, 3]] == 0).all()


def test_exif_orientation_is_not_applied(tmp_path):
    exif = Image.Exif()
    exif[0x0112] = 6  # turn by 90 degrees
    view = saved(tmp_path / "a.png", RGB, exif=exif)
    assert photo_size(view.image_path) == (6, 4)
    np.testing.assert_array_equal(load_photo(view), RGB)


def test_shrinking_averages_areas(tmp_path):
    path = saved(tmp_path / "a.png", RGB).image_path
    means = RGB.reshape(2, 2, 3, 2, 3).mean(axis=(1, 3))
    assert np.abs(load_photo(view_of(path, 3, 2)) - means).max() <= 1  # Pillow rounds rows, then columns


@pytest.mark.parametrize("content", [b"", b"no image", None])
def test_unreadable_photo_is_one_line(tmp_path, content):
    path = saved(
        tmp_path / "a.png", np.random.default_rng(0).integers(0, 256, (90, 90, 3)).astype(np.uint8)
    ).image_path
    path.write_bytes(path.read_bytes()[:9000] if content is None else content)
    with pytest.raises(SceneError, match=r"a\.png: not readable as a photo"):
        load_photo(view_of(path, 90, 90))


def test_photos_cache_within_the_limit(tmp_path, monkeypatch):
    views = [saved(tmp_path / f"{i}.png", np.full((4, 6, 3), i, np.uint8)) for i in range(3)]
    loaded = []

    def load(view):
        loaded.append(view.name)
        return load_photo(view)

    monkeypatch.setattr(images, "load_photo", load)
    photos = Photos(views, cache_bytes=2 * RGB.nbytes)
    assert len(photos) == 3
    assert loaded == []
    for _ in range(2):
        assert [int(photo.mean()) for photo in photos] == [0, 1, 2]
    assert loaded == ["0.png", "1.png", "2.png", "2.png"]
    assert int(photos[-1].mean()) == 2
    with pytest.raises(IndexError):
        photos[3]


def test_a_photo_that_changes_while_a_command_works_is_noticed(tmp_path: Path) -> None:
    """Else a result would be of two captures."""
    scene = write_capture(tmp_path / "capture", random_gaussians(20, degree=0), views=3)
    photos, paths = Photos(scene.views), [view.image_path for view in scene.views]
    first = photos[0]
    for path in paths[:2]:
        path.write_bytes(paths[2].read_bytes())
    assert photos[0] is first  # what was read counts
    with pytest.raises(SceneError, match=rf"^{paths[1]}: changed since this command began; put the earlier"):
        _ = photos[1]
    with pytest.raises(SceneError, match=rf"^{paths[0]}: changed"):
        photos.check()
    (tmp_path / "capture").rename(tmp_path / "away")
    with pytest.raises(SceneError, match=rf"^{paths[2]}: gone since this command began; put it back, then"):
        _ = photos[2]
    (tmp_path / "away").rename(tmp_path / "capture")
    assert photos[2].shape == first.shape


def test_photos_are_fetched_side_by_side_as_many_as_are_kept(tmp_path: Path) -> None:
    scene = write_capture(tmp_path / "capture", random_gaussians(30, degree=0), views=5)
    alone = [load_photo(view) for view in scene.views]
    photos, told = Photos(scene.views, 3 * alone[0].nbytes), list[tuple[int, int]]()
    photos.fetch([4, 0, 2, 1], 2, lambda done, total: told.append((done, total)))
    assert told == [(1, 3), (2, 3), (3, 3)]
    assert sorted(photos._cache) == [0, 2, 4]
    assert all(np.array_equal(photos[row], alone[row]) for row in range(5))
