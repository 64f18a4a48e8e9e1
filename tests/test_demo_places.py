import numpy as np
import pytest
from PIL import Image
from scipy.spatial import KDTree

from sagesplat.demo import capture
from sagesplat.demo.cameras import grid_cameras
from sagesplat.demo.capture import cached_capture, make_capture
from sagesplat.demo.places import centres_of
from sagesplat.demo.points import project
from sagesplat.demo.render import lit_world
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


def test_cameras_keep_clear(workspace):
    world = lit_world(0, PLACES)  # the workspace's, still in memory
    at = np.stack([camera.position for camera in grid_cameras(PLACES, 400, WIDTH, HEIGHT, 0)]).astype(float)
    assert KDTree(world.leaves[:, :3]).query(at)[0].min() > 0.25
    for planes in world.bodies:
        assert ((planes[:, :3] @ at.T) > planes[:, 3:]).any(0).all()


def test_cache_keeps_grids_apart(tmp_path, monkeypatch):
    calls = []

    def fake(folder, **arguments):
        calls.append((folder.name, arguments["places"], arguments.get("views")))
        folder.mkdir(parents=True)

    monkeypatch.setattr(capture, "make_capture", fake)
    monkeypatch.setenv("SAGESPLAT_CACHE", str(tmp_path))
    assert cached_capture().parent == cached_capture(places=(3, 2)).parent == cached_capture().parent
    assert calls == [("courtyard", (1, 1), None), ("courtyards-3x2", (3, 2), 630)]
