"""Viewpoints drawn from the Gaussians alone: what kind of splat, which way is up, and what is seen."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from sagesplat.adapt import free_poses, free_viewpoints
from sagesplat.adapt.free_space import sphere
from sagesplat.adapt.free_viewpoints import FreeViewpoints, free_cameras
from sagesplat.core.errors import RunError
from sagesplat.core.gaussians import Gaussians, concat
from sagesplat.core.geometry import project, weighted_quantile
from sagesplat.raster import rasterize


@pytest.fixture(autouse=True)
def _few_probes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(free_viewpoints, "_PROBES", 300)
    monkeypatch.setattr(free_poses, "_PROBES", 300)
    monkeypatch.setattr(free_poses, "_BATCH", 128)


def discs(means: np.ndarray, normals: np.ndarray, radius: float, logit: float = 4.0) -> Gaussians:
    """Flat round Gaussians, thin along their normals."""
    quats = np.column_stack([1 + normals[:, 2], -normals[:, 1], normals[:, 0], 0 * normals[:, 0]])
    quats[normals[:, 2] < -0.999] = [0, 1, 0, 0]  # half a turn
    count = len(means)
    scales = np.log(np.tile([radius, radius, radius / 20], (count, 1)))
    return Gaussians(
        means=torch.from_numpy(means.astype(np.float32)),
        quats=torch.from_numpy(quats.astype(np.float32)),
        log_scales=torch.from_numpy(scales.astype(np.float32)),
        logit_opacities=torch.full((count,), float(logit)),
        sh0=torch.rand(count, 1, 3, generator=torch.Generator().manual_seed(1)),
        shN=torch.zeros(count, 0, 3),
        label_ids=torch.zeros(count, dtype=torch.int16),
    )


def ball(radius: float = 1.0, count: int = 300) -> Gaussians:
    """An object: the surface of a ball around (2, 0, 5)."""
    normals = sphere(count)
    return discs(radius * normals + [2, 0, 5], normals, 2 * radius / np.sqrt(count))


def room(height: float = 2.6) -> Gaussians:
    """A place: a floor of 6 x 4, walls and a table; y is down, the floor is at y = 0."""
    rng = np.random.default_rng(0)
    sides = [
        ([-3, 0, -2], [6, 0, 0], [0, 0, 4]),
        ([-3, -height, -2], [6, 0, 0], [0, height, 0]),
        ([-3, -height, 2], [6, 0, 0], [0, height, 0]),
        ([-3, -height, -2], [0, 0, 4], [0, height, 0]),
        ([3, -height, -2], [0, 0, 4], [0, height, 0]),
        ([-0.5, -0.8, -0.5], [1, 0, 0], [0, 0, 1]),
    ]
    parts = []
    for corner, u, v in np.array(sides, float):
        area = np.cross(u, v)
        count = max(20, int(25 * np.linalg.norm(area)))
        means = corner + rng.random((count, 1)) * u + rng.random((count, 1)) * v
        parts.append(discs(means, np.tile(area / np.linalg.norm(area), (count, 1)), 0.2))
    return concat(parts)


ROOM = room()
YARD = room(1.6)
BALL = ball()


def moved(g: Gaussians, *, scale: float = 1.0, turn: Rotation | None = None, shift: float = 0.0) -> Gaussians:
    """The same splat elsewhere."""
    turn = turn or Rotation.identity()
    means = scale * turn.apply(g.means.numpy().astype(np.float64)) + shift
    quats = (turn * Rotation.from_quat(g.quats.numpy(), scalar_first=True)).as_quat(scalar_first=True)
    return replace(
        g,
        means=torch.from_numpy(means.astype(np.float32)),
        quats=torch.from_numpy(quats.astype(np.float32)),
        log_scales=g.log_scales + float(np.log(scale)),
    )


def positions(found: FreeViewpoints) -> np.ndarray:
    return np.stack([camera.position for camera in found.cameras]).astype(np.float64)


def seen(g: Gaussians, found: FreeViewpoints) -> np.ndarray:
    """Share of each image that something covers."""
    return np.array([float(rasterize(g, c.resized(64, 48)).alpha.mean()) for c in found.cameras])


def test_an_object_is_looked_at_from_around():
    found = free_cameras(BALL, 24)
    assert found.kind == "object"
    assert found.reason.startswith("object: it encloses ")
    np.testing.assert_allclose(found.centre, [2, 0, 5], atol=0.1)
    assert 0.9 < found.radius < 1.4
    away = (positions(found) - found.centre) / found.radius
    distance = np.linalg.norm(away, axis=1)
    assert distance.min() > 1.05
    assert distance.max() / distance.min() > 2
    rise = np.degrees(np.arcsin(away @ found.up / distance))
    assert -21 < rise.min() < 0
    assert 45 < rise.max() < 71
    assert (seen(BALL, found) > 0.02).all()
    for camera in found.cameras:
        (pixel,), (depth,) = project(found.centre[None], camera.w2c, camera.K)
        assert depth > 0
        assert (np.abs(pixel - [256, 192]) < [200, 150]).all()
        assert camera.w2c[1, :3] @ found.up < 0  # the camera's y is down


def test_any_first_part_is_spread_over_all_sides():
    found = free_cameras(BALL, 40)
    away = positions(found) - found.centre
    turn = np.arctan2(away[:, 2], away[:, 0])
    for count in (8, 16, 40):
        gaps = np.diff(np.sort(turn[:count]), append=turn[:count].min() + 2 * np.pi)
        assert gaps.max() < 1.7 * 2 * np.pi / count


def test_the_object_fills_the_frame_at_the_middle_distance():
    found = free_cameras(BALL, 60)
    factor = np.linalg.norm(positions(found) - found.centre, axis=1)
    share = seen(BALL, found)
    order = np.argsort(factor)
    assert share[order[:5]].mean() > 0.5  # 0.6 of what fits
    assert 0.08 < share[order[-5:]].mean() < 0.25  # twice as far


def test_in_a_place_one_stands_over_the_floor_and_clear_of_the_walls():
    found = free_cameras(ROOM, 24)
    assert found.kind == "place"
    assert "normal of a floor" in found.reason
    assert np.degrees(np.arccos(found.up @ [0, -1, 0])) < 3
    x, y, z = positions(found).T
    assert (np.abs(x) < 2.9).all()
    assert (np.abs(z) < 1.9).all()
    assert (y < -0.15).all()
    assert (y > -2.2).all()
    assert (seen(ROOM, found) > 0.5).all()
    level = np.degrees(np.arcsin([camera.direction @ found.up for camera in found.cameras]))
    assert np.abs(level).max() < 41
    assert np.abs(level.mean() + 10) < 8
    turn = np.array([np.arctan2(c.direction[2], c.direction[0]) for c in found.cameras])
    assert np.hypot(np.cos(turn).mean(), np.sin(turn).mean()) < 0.6  # in all directions


@pytest.mark.parametrize("g", [BALL, ROOM], ids=["object", "place"])
def test_more_begin_with_the_same_and_another_seed_has_others(g):
    few, many = free_cameras(g, 6), free_cameras(g, 12)
    for a, b in zip(few.cameras, many.cameras, strict=False):
        assert (a.w2c == b.w2c).all()
    other = free_cameras(g, 6, seed=1)
    assert not np.isclose(positions(other), positions(few)).all(1).any()


@pytest.mark.parametrize("g", [BALL, ROOM], ids=["object", "place"])
@pytest.mark.parametrize("scale", [1e6, 1e-6])
def test_the_unit_of_the_file_does_not_matter(g, scale):
    here, there = free_cameras(g, 6), free_cameras(moved(g, scale=scale), 6)
    assert here.kind == there.kind
    np.testing.assert_allclose(positions(there) / scale, positions(here), atol=0.05)
    assert there.radius / scale == pytest.approx(here.radius, rel=1e-2)


@pytest.mark.parametrize("turned", [[90, 0, 0], [-90, 0, 0], [17, 0, 9], [0, 0, 90]])
def test_the_floor_says_which_way_is_up(turned):
    turn = Rotation.from_euler("xyz", turned, degrees=True)
    found = free_cameras(moved(YARD, turn=turn), 2)
    assert found.kind == "place"
    assert np.degrees(np.arccos(found.up @ turn.apply([0, -1, 0]))) < 3


def test_a_floor_of_the_convention_wins_over_a_larger_wall():
    assert np.degrees(np.arccos(free_cameras(room(5), 1).up @ [0, -1, 0])) < 3


def test_up_as_given_and_without_a_floor():
    assert free_cameras(BALL, 1).up.tolist() == [0, -1, 0]
    assert "the convention; no floor" in free_cameras(BALL, 1).reason
    assert free_cameras(BALL, 1, up="z").up.tolist() == [0, 0, 1]
    assert free_cameras(BALL, 1, up=np.array([0.0, 3.0, 0.0])).up.tolist() == [0, 1, 0]
    assert "as given" in free_cameras(BALL, 1, up="z").reason


def test_nothing_is_looked_at_from_below_its_floor():
    rng = np.random.default_rng(1)
    floor = rng.uniform([-1, 1, 2], [5, 1, 8], (900, 3))
    found = free_cameras(concat([BALL, discs(floor, np.tile([0, 1.0, 0], (900, 1)), 0.15)]), 20)
    assert found.kind == "object"
    assert "normal of a floor" in found.reason
    assert positions(found)[:, 1].max() < 1.0


def test_floaters_and_a_far_sky_change_little():
    sky = discs(300 * sphere(60) + [2, 0, 5], sphere(60), 70)
    rng = np.random.default_rng(0)
    dust = discs(rng.normal(0, 20, (20, 3)), sphere(20), 0.02, logit=-3)
    found, plain = free_cameras(concat([BALL, dust, sky]), 10), free_cameras(BALL, 10)
    assert found.kind == "object"
    assert (
        np.linalg.norm(positions(found) - found.centre, axis=1).max()
        < 1.5 * np.linalg.norm(positions(plain) - plain.centre, axis=1).max()
    )
    assert np.linalg.norm(found.centre - plain.centre) < 0.3


def test_field_of_view_is_that_of_the_longer_side():
    wide, tall = (free_cameras(BALL, 1, fov=90, size=size).cameras[0] for size in ((300, 200), (200, 300)))
    assert wide.K[0, 0] == tall.K[0, 0] == pytest.approx(150)
    assert (wide.width, wide.height, tall.K[0, 2]) == (300, 200, 100)


def degenerate() -> dict[str, Gaussians]:
    rng = np.random.default_rng(0)
    plane = np.stack([rng.uniform(-1, 1, 400), np.zeros(400), rng.uniform(-1, 1, 400)], 1)
    wild = BALL.log_scales.clone()
    wild[::7], wild[1::7] = 80.0, -90.0
    return {
        "one": BALL.select(torch.tensor([0])),
        "all in one place": BALL.select(torch.zeros(50, dtype=torch.int64)),
        "a plane": discs(plane, np.tile([0, 1.0, 0], (400, 1)), 0.1),
        "extreme scales": replace(BALL, log_scales=wild),
    }


@pytest.mark.parametrize("name", degenerate())
def test_degenerate_splats_are_looked_at(name):
    found = free_cameras(degenerate()[name], 5)
    assert len(found.cameras) == 5
    assert all(np.isfinite(camera.w2c).all() for camera in found.cameras)
    if name == "a plane":
        assert found.kind == "object"
        assert positions(found)[:, 1].max() < 0  # over it


def test_nothing_in_sight():
    clear = replace(BALL, logit_opacities=torch.full_like(BALL.logit_opacities, -12.0))
    with pytest.raises(RunError, match="no viewpoint has any of the 300 Gaussians in sight"):
        free_cameras(clear, 2)
    with pytest.raises(RunError, match="no Gaussians"):
        free_cameras(BALL.select(torch.zeros(0, dtype=torch.int64)), 2)


@pytest.mark.parametrize(
    "wrong",
    [
        *({"count": 0}, {"count": 10**6}, {"fov": 0}, {"fov": 179}, {"fov": np.nan}, {"size": (0, 4)}),
        *({"up": "down"}, {"up": "y\x1b"}, {"up": np.zeros(3)}, {"up": np.array([np.nan, 0, 1])}),
    ],
)
def test_impossible_arguments(wrong):
    with pytest.raises(RunError, match=r"choose|give"):
        free_cameras(BALL, **{"count": 2, **wrong})


def test_quantiles_by_weight():
    values, weights = np.array([3.0, 1.0, 2.0]), np.array([1.0, 8.0, 1.0])
    assert [weighted_quantile(values, weights, q) for q in (0, 0.5, 0.85, 1)] == [1, 1, 2, 3]


def test_small_renders_of_many_gaussians_draw_some_that_cover_as_much(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    g = ball(count=3000)
    cameras = free_cameras(g, 6, kind="object").cameras
    monkeypatch.setattr(free_viewpoints, "_MANY", 1000)
    fewer = free_viewpoints._fewer(g)
    assert len(fewer) == 1000
    for camera in cameras:
        small = camera.within(96)
        full, some = (float((rasterize(one, small).alpha > 0.5).float().mean()) for one in (g, fewer))
        assert some == pytest.approx(full, rel=0.1)
    again = free_cameras(g, 6, kind="object").cameras
    assert all(np.array_equal(a.w2c, b.w2c) for a, b in zip(cameras, again, strict=True))
