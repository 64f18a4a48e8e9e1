"""Differences of exposure: found from tracks, else from EXIF, and not where there are none."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from PIL.TiffImagePlugin import IFDRational
from test_scene_vignetting import SIDE, patches

from sagesplat.scene.gains import exposure_values, photo_gains
from sagesplat.scene.scene import Points, Scene, View

VIEWS = 8


def test_gains_of_light_are_found():
    rng = np.random.default_rng(1)
    light = 2 ** rng.uniform(-0.7, 0.7, (VIEWS, 1)) * (1 + rng.uniform(-0.15, 0.15, (VIEWS, 3)))
    scene, photos = patches(None, light)
    gains = photo_gains(scene, photos, range(VIEWS))
    assert gains.source == "tracks"
    assert gains.differ
    ev = np.log2(light)
    found = 2.4 * np.log2(gains.gain)
    np.testing.assert_allclose(found - found.mean(0), ev - ev.mean(0), atol=0.05)
    assert gains.range_ev == pytest.approx(np.ptp(ev.mean(1)), abs=0.06)
    transforms = gains.transforms()
    np.testing.assert_allclose(transforms.mean(0), np.eye(3, 4), atol=1e-6)
    own = exposure_values(transforms)
    np.testing.assert_allclose(own - own.mean(), gains.ev, atol=0.02)


def test_what_differs_by_point_is_no_exposure():
    """Colours that change with the viewing direction, each as it likes."""
    scene, photos = patches(None, np.ones((VIEWS, 3)), noise=0.5)
    assert not photo_gains(scene, photos, range(VIEWS)).differ


def test_light_that_follows_the_direction_needs_no_transforms():
    """The same exposures are worth a transform where neighbours on the path do not have the same."""
    light = 2 ** np.sin(2 * np.pi * np.arange(40) / 40)[:, None].repeat(3, 1)
    found = {}
    for name, of_views in {"smooth": light, "mixed": np.random.default_rng(2).permutation(light)}.items():
        scene, photos = patches(None, of_views)
        found[name] = photo_gains(scene, photos, range(40))
        assert found[name].range_ev == pytest.approx(2, abs=0.1)
    assert found["smooth"].follow_direction
    assert not found["smooth"].differ
    assert found["mixed"].differ
    assert not found["mixed"].follow_direction


def test_a_few_occluded_points_change_little():
    light = np.where(np.arange(VIEWS) % 2, 1.5, 1.0)[:, None] * np.ones(3)
    scene, photos = patches(None, light)
    photos[3][: SIDE // 5] = 255 - photos[3][: SIDE // 5]  # somebody stands there
    gains = photo_gains(scene, photos, range(VIEWS))
    np.testing.assert_allclose(gains.ev - gains.ev[0], np.log2(light).mean(1), atol=0.06)


def test_only_the_named_photos_are_looked_at():
    scene, photos = patches(None, np.where(np.arange(VIEWS) == 2, 4.0, 1.0)[:, None] * np.ones(3))
    rows = [row for row in range(VIEWS) if row != 2]
    gains = photo_gains(scene, photos, rows)
    assert len(gains.gain) == VIEWS - 1
    assert not gains.differ


def without_tracks(scene: Scene, folder: Path, times: list[int]) -> Scene:
    """The scene without tracks, its photos on disk with exposure times 1 / `times` s (0: no EXIF)."""
    views = []
    for view, time in zip(scene.views, times, strict=True):
        path, exif = folder / f"{view.name}.jpg", Image.Exif()
        if time:
            exif.get_ifd(0x8769).update({0x829A: IFDRational(1, time), 0x8827: 100})
        Image.new("RGB", (SIDE, SIDE)).save(path, exif=exif)
        views.append(View(view.name, view.camera, path))
    none = np.zeros(0, np.int64), np.zeros(0, np.int32), np.zeros((0, 2), np.float32)
    points = Points(scene.points.xyz, scene.points.rgb, *none)
    return Scene("patches", folder, tuple(views), points, test_every=0)


def test_exif_tells_it_without_tracks(tmp_path):
    scene, photos = patches(None, np.ones((VIEWS, 3)))
    times = [100 * (1 + row % 2) for row in range(VIEWS)]
    gains = photo_gains(without_tracks(scene, tmp_path, times), photos, range(VIEWS))
    assert gains.source == "EXIF"
    assert gains.differ
    assert gains.range_ev == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize("times", [[0] * VIEWS, [100] * (VIEWS - 1) + [0]])
def test_without_tracks_and_exif_nothing_is_known(tmp_path, times):
    scene, photos = patches(None, np.ones((VIEWS, 3)))
    gains = photo_gains(without_tracks(scene, tmp_path, times), photos, range(VIEWS))
    assert gains.source == "nothing"
    assert not gains.differ
    np.testing.assert_array_equal(gains.gain, 1)
