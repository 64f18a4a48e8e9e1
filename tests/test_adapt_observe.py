"""Distances of categories, eroded masks and what is measured in a view."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import pinhole, random_gaussians, write_capture

from sagesplat.adapt.observe import (
    TOTAL,
    as_unit,
    distances_in_views,
    erode,
    measure,
    widest_lens,
    within_lens,
)
from sagesplat.metrics.image import psnr, squared_error_map, ssim_map


def test_distances_are_the_percentile_of_the_points_in_sight(tmp_path):
    scene = write_capture(tmp_path, random_gaussians(200))
    labels = np.arange(200, dtype=np.int16) % 2
    nearest, default = distances_in_views(scene, labels, 0.0), distances_in_views(scene, labels)
    for row, view in enumerate(scene.views):
        for label in (0, 1):
            expected = []
            for x in scene.points.xyz[labels == label]:
                u, v, depth = view.camera.K @ (view.camera.w2c[:3, :3] @ x + view.camera.w2c[:3, 3])
                if depth > 0 and 0 <= u / depth < view.camera.width and 0 <= v / depth < view.camera.height:
                    expected.append(np.linalg.norm(x - view.camera.position))
            assert nearest[label][row] == pytest.approx(min(expected), rel=1e-5)
            assert default[label][row] == pytest.approx(np.percentile(expected, 5), rel=1e-5)


def test_a_category_out_of_sight_has_no_distance(tmp_path):
    scene = write_capture(tmp_path, random_gaussians(50))
    scene.points.xyz[7] = (0, 0, -50)  # behind every camera
    labels = np.zeros(50, np.int16)
    labels[7] = 9
    assert np.isnan(distances_in_views(scene, labels)[9]).all()


def test_a_picture_wider_than_the_photos_is_cut_to_them():
    photo = replace(
        pinhole(), K=np.array([[50, 0, 30], [0, 60, 20], [0, 0, 1]], np.float32), width=60, height=40
    )
    lens = widest_lens([photo, replace(photo, width=30)])
    shaped = np.sqrt(60 * 40 * 20 / 9 / (50 * 60)) / 2  # the longer side of a phone's picture of that area
    assert lens == pytest.approx((shaped, shaped))
    assert widest_lens([replace(photo, width=200)])[0] == pytest.approx(2.0)
    assert widest_lens([replace(photo, width=200)])[1] == pytest.approx(shaped * np.sqrt(200 / 60))
    lens = (0.6, 1 / 3)
    assert within_lens(photo, lens) is photo
    assert within_lens(photo.resized(600, 400), lens).width == 600
    middle = np.array([[50, 0, 20], [0, 60, 45], [0, 0, 1]], np.float32)
    phone = replace(photo, width=40, height=90, K=middle)
    cut = within_lens(phone, lens)
    assert (cut.width, cut.height) == (40, 40)  # around the principal point
    assert cut.K[:2, 2].tolist() == [20, 20]
    assert (cut.w2c == phone.w2c).all()


def test_measure_takes_means_of_the_map_over_each_mask():
    rng = np.random.default_rng(0)
    photo = rng.integers(0, 256, (40, 50, 3), np.uint8)
    image = np.clip(as_unit(photo) + rng.normal(0, 0.1, photo.shape), 0, 1).astype(np.float32)
    label_ids = np.where(np.arange(50) < 25, -1, 7)[None].repeat(40, 0).astype(np.int16)
    rows = measure(image, as_unit(photo), label_ids)
    quality = ssim_map(image, as_unit(photo))
    assert set(rows) == {-1, 7, TOTAL}
    assert rows[7]["ssim"] == pytest.approx(quality[:, 25:].mean(), abs=1e-6)
    assert rows[7]["ssim_eroded"] == pytest.approx(quality[:, 30:].mean(), abs=1e-6)
    error = np.square(image - as_unit(photo))[:, :25].mean()
    assert rows[-1]["psnr"] == pytest.approx(-10 * np.log10(error), abs=1e-3)
    assert rows[TOTAL]["num_pixels"] == 2000
    assert measure(as_unit(photo), as_unit(photo), label_ids)[TOTAL]["psnr"] == pytest.approx(100)


def test_pixels_that_do_not_count_are_in_no_mean():
    rng = np.random.default_rng(3)
    image, photo = rng.random((2, 30, 40, 3)).astype(np.float32)
    label_ids = np.where(np.arange(40) < 20, 3, 7)[None].repeat(30, 0).astype(np.int16)
    valid = np.ones((30, 40), bool)
    valid[:, 25:] = False
    rows = measure(image, photo, label_ids, valid=valid)
    noise = np.where(valid[..., None], photo, 0.5).astype(np.float32)
    assert measure(image, noise, label_ids, valid=valid) == rows
    assert {label: of["num_pixels"] for label, of in rows.items()} == {3: 600, 7: 150, TOTAL: 750}
    errors = squared_error_map(image, photo)
    assert rows[TOTAL]["psnr"] == pytest.approx(float(psnr(errors[valid].mean())))
    assert rows[7]["psnr"] == pytest.approx(float(psnr(errors[:, 20:25].mean())))
    assert rows[3]["ssim"] == pytest.approx(measure(image, photo, label_ids)[3]["ssim"])
    assert np.isnan(measure(image, photo, label_ids, valid=np.zeros_like(valid))[TOTAL]["psnr"])


def test_erode_keeps_pixels_that_are_far_from_any_border():
    label_ids = np.full((40, 50), 3, np.int16)
    label_ids[:, 25:] = 4
    inner = erode(label_ids)
    assert set(np.unique(inner[:, :20])) == {3}
    assert set(np.unique(inner[:, 30:])) == {4}
    assert not np.isin(inner[:, 20:30], (3, 4)).any()
