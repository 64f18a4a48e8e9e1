import numpy as np
import pytest

from sagesplat.demo.cameras import demo_cameras
from sagesplat.demo.raycast import hit_leaves
from sagesplat.demo.render import camera_rays, lit_world, render_view
from sagesplat.demo.world import build_world

TABLE, PAVEMENT, SKY_ID = 67, 191, 187


@pytest.fixture(scope="module")
def camera():
    return demo_cameras(12, 96, 72, 0)[3]


@pytest.fixture(scope="module")
def view(camera):
    return render_view(camera)


def rays_of(camera):
    v, u = (np.indices((camera.height, camera.width)) + 0.5).reshape(2, -1)
    return camera_rays(camera, np.stack([u, v], 1))


def test_depth_of_the_paving_is_that_of_the_plane(camera, view):
    _, label, depth = view
    origins, directions, z_share = rays_of(camera)
    plane = (-origins[:, 2] / directions[:, 2] * z_share).reshape(label.shape)
    assert (label == PAVEMENT).mean() > 0.1
    np.testing.assert_allclose(depth[label == PAVEMENT], plane[label == PAVEMENT], rtol=1e-5)


def test_box_tree_finds_what_trying_every_leaf_finds(camera):
    world = lit_world(0, (1, 1))
    origins, directions, _ = rays_of(camera)
    rng = np.random.default_rng(5)
    frame = world.leaves
    for i in rng.choice(len(directions), 60, replace=False):
        o, d = origins[i], directions[i]
        with np.errstate(divide="ignore", invalid="ignore"):
            t = ((frame[:, :3] - o) * frame[:, 3:6]).sum(1) / (frame[:, 3:6] @ d)
            out = o + t[:, None] * d - frame[:, :3]
            a, b = (out * frame[:, 6:9]).sum(1), (out * frame[:, 9:]).sum(1)
            inside = (t > 1e-3) & (np.abs(b) < 1 - a * a)
        nearest = np.where(inside, t, 1e9).min()
        ray = o[0], o[1], o[2], d[0], d[1], d[2]
        found, row = hit_leaves(world, *ray, 1e9, False)
        assert found == pytest.approx(nearest, rel=1e-6)
        assert (row >= 0) == inside.any()
        assert (hit_leaves(world, *ray, 1e9, True)[1] >= 0) == inside.any()


def test_no_leaf_fills_the_tree_alone():
    # seed 3 has just more leaves than a power of two: thousands of copies of one leaf made rays crawl
    for seed in (0, 3):
        copies = np.unique(build_world(seed).leaves, axis=0, return_counts=True)[1]
        assert copies.max() <= 2
