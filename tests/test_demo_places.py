import numpy as np
import pytest
from PIL import Image
from scipy.spatial import KDTree

from sagesplat.core.errors import SceneError
from sagesplat.demo import capture
from sagesplat.demo.cameras import grid_cameras
from sagesplat.demo.capture import cached_capture, make_capture
from sagesplat.demo.places import SPACING, build_places, centres_of, ways_of
from sagesplat.demo.points import project
from sagesplat.demo.render import lit_world
from sagesplat.demo.world import BRICK
from sagesplat.scene.colmap import load_colmap

PLACES, VIEWS, WIDTH, HEIGHT = (2, 2), 40, 48, 36
TABLE, PAVEMENT, BUILDING, SKY = 67, 191, 197, 187


@pytest.fixture(scope="module")
def workspace(tmp_path_factory):
    folder = tmp_path_factory.mktemp("demo") / "grid"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sagesplat.demo.world.LIGHT_CELLS", 2)  # coarse shadows, made in a moment
        make_capture(folder, views=VIEWS, width=WIDTH, height=HEIGHT, places=PLACES)
    return folder


@pytest.fixture(scope="module")
def scene(workspace):
    return load_colmap(workspace)


@pytest.fixture(scope="module")
def masks(workspace):
    return np.stack([np.array(Image.open(path)) for path in sorted((workspace / "masks").glob("*.png"))])


@pytest.fixture(scope="module")
def world(workspace):
    return lit_world(0, PLACES)  # the workspace's, still in memory


def nearest_place(xy):
    return KDTree(centres_of(PLACES)).query(xy)[1]


def test_same_seed_same_bytes(workspace, tmp_path):
    make_capture(tmp_path / "again", views=VIEWS, width=WIDTH, height=HEIGHT, places=PLACES)
    files = [path.relative_to(workspace) for path in sorted(workspace.rglob("*")) if path.is_file()]
    assert len(files) == VIEWS + VIEWS + 1 + 3
    assert all((tmp_path / "again" / path).read_bytes() == (workspace / path).read_bytes() for path in files)


def test_grid():
    np.testing.assert_allclose(centres_of((2, 1)), [[-SPACING / 2, 0], [SPACING / 2, 0]])
    assert len(ways_of((1, 1))) == 0
    assert sorted(map(tuple, ways_of((2, 2)))) == [(0, 1), (0, 2), (1, 3), (2, 3)]
    assert len(ways_of((3, 2))) == 7


def test_houses_stand_around_the_grid_alone():
    world = build_places(0, (3, 3))
    houses = world.body_place[world.body_material == BRICK]
    assert set(houses) == set(range(9)) - {4}
    roofs = [(body[:, :2] * body[:, 3:]).sum(0) for body in world.bodies[world.body_material == BRICK]]
    assert (np.abs(roofs).max(1) > SPACING).all()


def test_places_differ(world):
    assert len(np.unique(world.tints.reshape(4, -1), axis=0)) == 4
    counts = np.bincount(nearest_place(world.leaves[:, :2]))
    assert len(counts) == len(set(counts)) == 4


def test_a_seed_makes_a_world(world):
    np.testing.assert_array_equal(build_places(0, PLACES).leaves, world.leaves)
    assert not np.array_equal(build_places(1, PLACES).leaves, world.leaves)


def test_leaves_fit_their_boxes(world):
    bins = len(world.axes)
    low, high = np.repeat(world.boxes[bins:, :3], 4, axis=0), np.repeat(world.boxes[bins:, 3:], 4, axis=0)
    for axis in (6, 9):
        u = world.leaves[:, axis : axis + 3]
        tip = u / (u * u).sum(1, keepdims=True)
        for end in (world.leaves[:, :3] - tip, world.leaves[:, :3] + tip):
            assert (end > low - 1e-9).all()
            assert (end < high + 1e-9).all()


def test_cameras_keep_clear(world):
    at = np.stack([camera.position for camera in grid_cameras(PLACES, 400, WIDTH, HEIGHT, 0)]).astype(float)
    assert KDTree(world.leaves[:, :3]).query(at)[0].min() > 0.25
    for planes in world.bodies:
        assert ((planes[:, :3] @ at.T) > planes[:, 3:]).any(0).all()


@pytest.mark.parametrize("places", [(2, 1), (1, 3), (2, 2), (3, 3)])
def test_cameras_see_several_places(places):
    centres, views = centres_of(places), 60 * places[0] * places[1]
    cameras = grid_cameras(places, views, WIDTH, HEIGHT, 0)
    assert len(cameras) == views
    at = np.stack([camera.position[:2] for camera in cameras])
    tables, seen = np.column_stack([centres, np.full(len(centres), 0.75)]), np.zeros(views, int)
    for i, camera in enumerate(cameras):
        uv, z = project(camera, tables)
        seen[i] = ((z > 0) & (np.abs(uv / [WIDTH, HEIGHT] - 0.5) < 0.5).all(1)).sum()
    assert seen.min() >= 1
    assert (seen >= 2).mean() > 0.2
    orbits = views - views // 5
    own = KDTree(centres).query(at[:orbits])[1]
    assert np.ptp(np.bincount(own, minlength=len(centres))) <= 1
    assert (KDTree(centres).query(at[orbits:])[0] > 3).mean() > 0.4


def test_table_tops_are_where_the_photos_show_them(scene, masks):
    # A disc of half the smallest table's radius; vases, plants and trees may stand before some of it.
    turn = np.arange(12) * np.pi / 6
    disc = 0.4 * np.column_stack([np.cos(turn), np.sin(turn)])
    for centre in centres_of(PLACES):
        top, found = np.column_stack([centre + disc, np.full(12, 0.75)]), []
        for view, mask in zip(scene.views, masks, strict=True):
            if np.linalg.norm(view.camera.position[:2] - centre) < 4:
                uv, z = project(view.camera, top)
                inside = (z > 0) & (np.abs(uv / [WIDTH, HEIGHT] - 0.5) < 0.49).all(1)
                column, row = uv[inside].astype(int).T
                found.append(mask[row, column])
        found = np.concatenate(found)
        assert len(found) > 30
        assert (found == TABLE).mean() > 0.55
        assert set(found) <= {TABLE, 86, 64, PAVEMENT}


def test_points_carry_the_labels_of_the_photos(scene, masks):
    points = scene.points
    column, row = points.track_uv.astype(int).T
    labels = masks[points.track_views, row, column]
    high = points.xyz[points.track_points, 2]
    assert np.abs(high[labels == PAVEMENT]).mean() < 0.1
    assert np.median(high[labels == BUILDING]) > 0.5
    assert np.linalg.norm(points.xyz[points.track_points[labels == SKY]], axis=1).mean() > 40


def test_every_place_has_points_and_views_and_shares_some(scene):
    points = scene.points
    near = np.abs(points.xyz[:, :2]).max(1) < SPACING
    counts = np.bincount(nearest_place(points.xyz[near, :2]), minlength=4)
    assert counts.min() > 0.1 * counts.sum()
    at = np.stack([view.camera.position[:2] for view in scene.views])
    homes = np.asarray(nearest_place(at))
    assert np.bincount(homes).min() >= VIEWS // 5
    watchers = np.zeros((len(points.xyz), 4), bool)
    watchers[points.track_points, homes[points.track_views]] = True
    assert (watchers[near].sum(1) > 1).mean() > 0.03


def test_refusals(tmp_path):
    with pytest.raises(SceneError, match="0 x 2 places"):
        make_capture(tmp_path / "none", places=(0, 2))
    with pytest.raises(SceneError, match="at least 10 each"):
        make_capture(tmp_path / "few", places=(2, 2), views=39)
    assert list(tmp_path.iterdir()) == []


def test_cache_keeps_grids_apart(tmp_path, monkeypatch):
    calls = []

    def fake(folder, **arguments):
        calls.append((folder.name, arguments["places"], arguments.get("views")))
        folder.mkdir(parents=True)

    monkeypatch.setattr(capture, "make_capture", fake)
    monkeypatch.setenv("SAGESPLAT_CACHE", str(tmp_path))
    assert cached_capture().parent == cached_capture(places=(3, 2)).parent == cached_capture().parent
    assert calls == [("courtyard", (1, 1), None), ("courtyards-3x2", (3, 2), 630)]
