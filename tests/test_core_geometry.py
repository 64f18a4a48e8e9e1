"""Projection and nearest neighbours against brute force."""

import numpy as np
import pytest
from conftest import pinhole
from hypothesis import given, settings
from hypothesis import strategies as st

from sagesplat.core.geometry import mean_neighbour_distance, project, to_camera


@settings(max_examples=30, derandomize=True)
@given(st.integers(2, 40), st.integers(1, 5), st.integers(0, 1000))
def test_mean_neighbour_distance_is_brute_force(count, k, seed):
    xyz = np.random.default_rng(seed).normal(size=(count, 3)).astype(np.float32)
    squared = np.square(xyz[:, None].astype(float) - xyz).sum(-1)
    nearest = np.sort(squared, axis=1)[:, 1 : k + 1]  # the first is the point itself
    actual = mean_neighbour_distance(xyz, k)
    assert actual.dtype == np.float32
    np.testing.assert_allclose(actual, np.sqrt(nearest.mean(1)), rtol=1e-5)


def test_neighbours_of_lone_and_of_equal_points():
    assert mean_neighbour_distance(np.zeros((0, 3), np.float32)).shape == (0,)
    assert mean_neighbour_distance(np.zeros((1, 3), np.float32)) > 0
    equal = mean_neighbour_distance(np.ones((9, 3), np.float32))
    np.testing.assert_allclose(equal, 1e-7)  # its logarithm is taken


def test_projection_through_the_full_matrix():
    camera = pinhole()
    xyz = np.random.default_rng(0).normal([0, 0, 3], 2, (200, 3)).astype(np.float32)
    local = to_camera(xyz, camera.w2c)
    homogeneous = np.c_[xyz, np.ones(200)] @ camera.w2c.T.astype(float)
    np.testing.assert_allclose(local, homogeneous[:, :3], atol=1e-5)
    pixels, depths = project(xyz, camera.w2c, camera.K)
    np.testing.assert_array_equal(depths, local[:, 2])
    front = depths > 0.1
    assert 0 < front.sum() < 200
    uvw = homogeneous[:, :3] @ camera.K.T.astype(float)
    np.testing.assert_allclose(pixels[front], uvw[front, :2] / uvw[front, 2:], rtol=1e-4, atol=1e-3)
    assert np.isnan(pixels[depths <= 0]).all()


def test_the_axis_meets_the_principal_point():
    camera = pinhole()
    ahead = camera.position + 5 * camera.direction
    pixels, depths = project(ahead[None], camera.w2c, camera.K)
    np.testing.assert_allclose(pixels[0], camera.K[:2, 2], atol=1e-4)
    assert depths[0] == pytest.approx(5, abs=1e-5)
