"""Colour correction as gsplat's cc metrics have it."""

import numpy as np

from sagesplat.metrics.color_correct import color_correct_affine


def photo() -> np.ndarray:
    return np.random.default_rng(0).random((24, 32, 3), np.float32)


def test_it_undoes_gains_and_offsets_of_each_channel():
    y = photo()
    image = y * np.array([0.7, 0.8, 0.5], np.float32) + np.array([0.1, 0.0, 0.2], np.float32)
    np.testing.assert_allclose(color_correct_affine(image, y), y, atol=1e-5)


def test_an_image_that_has_the_photos_colours_stays():
    y = photo()
    assert (color_correct_affine(y, y) == y).mean() > 0.5
    np.testing.assert_allclose(color_correct_affine(y, y), y, atol=1e-6)


def test_images_of_one_colour_are_finite():
    flat = np.full((8, 8, 3), 0.3, np.float32)
    for image, y in ((flat, flat), (flat, photo()[:8, :8]), (photo()[:8, :8], flat)):
        found = color_correct_affine(image, y)
        assert ((found >= 0) & (found <= 1)).all()
