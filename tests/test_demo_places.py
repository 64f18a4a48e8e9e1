import numpy as np
import pytest
from PIL import Image
from scipy.spatial import KDTree

from sagesplat.demo.cameras import grid_cameras
from sagesplat.demo.capture import make_capture
from sagesplat.demo.places import SPACING, centres_of, ways_of
from sagesplat.demo.points import project
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


def test_grid():
    np.testing.assert_allclose(centres_of((2, 1)), [[-SPACING / 2, 0], [SPACING / 2, 0]])
    assert len(ways_of((1, 1))) == 0
    assert sorted(map(tuple, ways_of((2, 2)))) == [(0, 1), (0, 2), (1, 3), (2, 3)]
    assert len(ways_of((3, 2))) == 7


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
