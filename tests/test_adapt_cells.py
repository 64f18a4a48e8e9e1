"""Descriptions of cells and how viewpoints see them, against the formulas computed in another way."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from sagesplat.adapt.cells import (
    POINTS,
    STEPS,
    Cells,
    describe_cells,
    look,
    reaching,
    read_cells,
    write_cells,
)
from sagesplat.core.errors import DataError
from sagesplat.core.gaussians import Gaussians
from sagesplat.scene.scene import Camera
from tests.conftest import random_gaussians


def gaussians(means, cells, scales=(1.0, 1.0, 1.0), logits=0.0) -> Gaussians:
    n, zeros = len(means), torch.zeros
    return Gaussians(
        torch.as_tensor(np.array(means), dtype=torch.float32), torch.eye(4)[:1].repeat(n, 1),
        torch.tensor(scales).log().expand(n, 3).clone(), zeros(n) + logits, zeros(n, 1, 3), zeros(n, 0, 3),
        torch.as_tensor(np.array(cells), dtype=torch.int16),
    )  # fmt: skip


def camera(K=((50.0, 0, 20), (0, 40, 30), (0, 0, 1)), angle=0.4, position=(0.5, -0.2, -3)) -> Camera:
    cos, sin = np.cos(angle), np.sin(angle)
    w2c = np.eye(4)
    w2c[:3, :3] = [[cos, 0, -sin], [0, 1, 0], [sin, 0, cos]]
    w2c[:3, 3] = -w2c[:3, :3] @ np.array(position)
    return Camera(w2c.astype(np.float32), np.array(K, np.float32), 64, 48)


def seen_by_planes(cells: Cells, view: Camera) -> tuple[list[float], list[float]]:
    """Shares and distances of `look`, with planes through rays of the picture's corners in world space."""
    K, w2c = view.K.astype(float), view.w2c.astype(float)
    R, position = w2c[:3, :3], -w2c[:3, :3].T @ w2c[:3, 3]
    corners = [(0, 0), (view.width, 0), (view.width, view.height), (0, view.height)]
    rays = [R.T @ np.linalg.solve(K, [u, v, 1]) for u, v in corners]
    normals = [R[2], *(np.cross(rays[i], rays[(i + 1) % 4]) for i in range(4))]
    middle = sum(rays)
    normals = [n / np.linalg.norm(n) * np.sign(n @ middle) for n in normals]
    shares, distances = [], []
    for points, areas, radius in zip(cells.points(), cells.areas(), cells.radius, strict=True):
        found = []
        for point, area in zip(points, areas, strict=True):
            height = min(n @ (point - position) for n in normals)
            inside = min(max(0.5 + height / (2 * radius), 0), 1)
            found.append((np.linalg.norm(point - position), area * inside))
        solid = sum(weight / distance**2 for distance, weight in found)
        shares.append(solid * K[0, 0] * K[1, 1] / (view.width * view.height))
        running, total = 0.0, sum(weight for _, weight in found)
        distances.append(np.nan)
        for distance, weight in sorted(found):
            running += weight
            if running >= 0.25 * total and total > 0:
                distances[-1] = distance
                break
    return shares, distances


def test_look_is_what_planes_in_world_space_give():
    g = random_gaussians(600, degree=0)
    ids = torch.arange(600, dtype=torch.int16) % 4
    moved = g.means + torch.tensor([[0.0, 0, 0], [3, 0, 1], [0, 1, 4], [0, 0, -60]])[ids.long()]
    cells = describe_cells(
        Gaussians(moved, g.quats, g.log_scales, g.logit_opacities, g.sh0, g.shN, ids),
        dict.fromkeys(range(4), 7),
    )
    views = [camera(), camera(angle=-0.5, position=(1, 0, -5))]
    sight = look(cells, views)
    for row, view in enumerate(views):
        shares, distances = seen_by_planes(cells, view)
        np.testing.assert_allclose(sight.apparent[row], shares, rtol=1e-5, atol=1e-12)
        np.testing.assert_allclose(sight.distance[row], distances, rtol=1e-6)
        assert sight.apparent[row, 3] == 0  # behind the camera
        assert np.isnan(sight.distance[row, 3])
    assert (sight.apparent[:, :3] > 0).any(0).all()


def test_a_gaussian_on_the_axis_by_hand():
    cells = describe_cells(gaussians([[0, 0, 4]], [3], scales=(0.1, 0.5, 0.2)), {3: 9})
    assert cells.label_of == {3: 9}
    assert cells.radius.tolist() == [0]
    assert cells.area[0] == pytest.approx(0.5 * 0.2 * 0.5)  # the longer axes times the opacity
    np.testing.assert_allclose(cells.points()[0, 0], [0, 0, 4])
    assert cells.areas()[0].tolist() == pytest.approx([0.05, *[0] * (POINTS - 1)])
    sight = look(cells, [camera(K=((32, 0, 32), (0, 24, 24), (0, 0, 1)), angle=0, position=(0, 0, 0))])
    assert sight.apparent[0, 0] == pytest.approx(0.05 / 16 * 32 * 24 / (64 * 48))
    assert sight.distance[0, 0] == pytest.approx(4)


def test_a_point_on_the_edge_counts_by_half():
    cells = Cells(
        np.array([0]), np.array([0]), np.array([[4.0, 0, 4, 4, 0, 4]]),
        np.concatenate([np.full((1, 1, 4), 255, np.uint8), np.zeros((1, 15, 4), np.uint8)], 1),
        np.array([2.0]), np.array([0.3]),
    )  # fmt: skip
    sight = look(cells, [camera(K=((32, 0, 32), (0, 24, 24), (0, 0, 1)), angle=0, position=(0, 0, 0))])
    assert sight.apparent[0, 0] == pytest.approx(2 * 0.5 / 32 * 32 * 24 / (64 * 48))


def test_cells_are_in_sight_from_where_they_were_seen():
    points = [[3.0, 0, 2], [9.0, 0, 2], [0.0, 0, 4]]  # outside of the picture, far outside, within
    cells = describe_cells(gaussians(points, [0, 1, 2]), dict.fromkeys(range(3), 7))
    view = camera(K=((32, 0, 32), (0, 24, 24), (0, 0, 1)), angle=0, position=(0, 0, 0))
    assert (look(cells, [view]).apparent[0] > 0).tolist() == [False, False, True]
    same = reaching(cells, [view], np.array([[9e-4, 0.0, 0.5]]))  # too little to count
    assert same.radius.tolist() == cells.radius.tolist()
    wider = reaching(cells, [view, view], np.array([[0.01, 0.0, 0.5], [0.0, 0.0, 0.5]]))
    assert wider.radius[0] == pytest.approx(1 / np.sqrt(2) / 0.9)  # its distance from the plane x = z
    assert wider.radius[1:].tolist() == cells.radius[1:].tolist()
    nothing = reaching(replace(cells, grid=cells.grid * 0), [view], np.full((1, 3), 0.5))
    assert nothing.radius.tolist() == cells.radius.tolist()  # no areas: in sight from nowhere
    before, after = (look(some, [view]).apparent[0] for some in (cells, wider))
    assert 0 < after[0] < before[2]
    assert after[1:].tolist() == before[1:].tolist()


def test_equal_places_are_one_point_and_invisible_gaussians_have_no_area():
    cells = describe_cells(gaussians([[1, 2, 3]] * 40, [0] * 40), {0: 0})
    assert cells.radius[0] == pytest.approx(0, abs=1e-9)
    np.testing.assert_allclose(cells.points()[cells.areas() > 0], [[1, 2, 3]] * (cells.areas() > 0).sum())
    assert cells.areas().sum() == pytest.approx(40 * 0.5)
    cells = describe_cells(gaussians(np.eye(3), [0] * 3, logits=-2000.0), {0: 0})
    assert cells.area[0] == pytest.approx(0, abs=1e-100)
    assert np.isfinite(cells.points()).all()
    sight = look(cells, [camera()])
    assert sight.apparent[0, 0] == pytest.approx(0, abs=1e-100)


def test_points_are_within_half_a_step_of_their_places():
    means = np.random.default_rng(3).normal(0, [1, 20, 300], (POINTS, 3))
    cells = describe_cells(gaussians(means, [0] * POINTS), {0: 0})
    step = np.ptp(means.astype(np.float32), axis=0) / STEPS
    assert (np.abs(cells.points()[0] - means) <= step / 2 * 1.001 + 1e-4).all()
    np.testing.assert_allclose(cells.areas()[0], 0.5)
    assert cells.radius[0] == 0


def test_cells_of_many_gaussians_keep_area_and_spread():
    rng = np.random.default_rng(0)
    means = rng.normal(0, 1, (5000, 3))
    cells = describe_cells(gaussians(means, [0] * 5000), {0: 0})
    assert cells.areas().sum() == pytest.approx(2500)
    middle = (cells.points()[0] * cells.areas()[0, :, None]).sum(0) / 2500
    assert np.abs(middle).max() < 0.1
    assert 0.6 < cells.radius[0] < 1.6  # 16 points for a unit ball, from each along an axis
    again = describe_cells(gaussians(means, [0] * 5000), {0: 0})
    assert all(np.array_equal(a, b) for a, b in zip(vars(cells).values(), vars(again).values(), strict=True))


def test_files_come_back(tmp_path):
    cells = describe_cells(gaussians(np.eye(3)[[0, 1, 2, 2]], [0, 1, 0, 4]), {0: 5, 1: 5, 4: 2})
    write_cells(tmp_path / "cells.npz", cells)
    back = read_cells(tmp_path / "cells.npz")
    for name, value in vars(cells).items():
        np.testing.assert_array_equal(getattr(back, name), value)


@pytest.mark.parametrize(
    "damage",
    [
        {"ids": np.array([1, 1])}, {"ids": np.array([[0, 1]])}, {"labels": np.array([0])},
        {"grid": np.zeros((2, POINTS, 4), np.int16)}, {"grid": np.zeros((2, 3, 4), np.uint8)},
        {"area": np.array([1, -1.0])}, {"bounds": np.full((2, 6), np.nan)}, {"radius": np.array(["a", "b"])},
        {"labels": None},
    ],
)  # fmt: skip
def test_damaged_files_are_one_line(tmp_path, damage):
    g = gaussians([[0, 0, 0], [1, 0, 0]], [0, 1])
    arrays = vars(describe_cells(g, {0: 0, 1: 0})) | damage
    path = tmp_path / "cells.npz"
    np.savez(path, **{name: value for name, value in arrays.items() if value is not None})
    with pytest.raises(DataError, match=r"cells\.npz: not a file of cells \([^\n]*sagesplat nest` again$"):
        read_cells(path)
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(DataError, match=r"cells\.npz: [^\n]*$"):
        read_cells(path)
