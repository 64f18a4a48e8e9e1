import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from sagesplat.core.errors import LabelError, SceneError
from sagesplat.scene.scene import Camera, Lens, Points, Scene, View
from sagesplat.scene.undistort import pinhole
from sagesplat.segment import masks as masks_module
from sagesplat.segment.mask_files import import_masks
from sagesplat.segment.masks import Masks, Taxonomy, mask_path, prepare_folder, read_mask, write_mask

LABELS = {"unlabelled": 255, "labels": {"3": "car", "184": "tree-merged"}}


def scene_of(*names, width=4, height=2, lens=None, K=None):
    camera = Camera(
        np.eye(4, dtype=np.float32), np.asarray(np.eye(3) if K is None else K, np.float32), width, height
    )
    none = np.zeros(0, np.int64)
    points = Points(
        np.zeros((0, 3), np.float32),
        np.zeros((0, 3), np.uint8),
        none,
        none.astype(np.int32),
        np.zeros((0, 2), np.float32),
    )
    return Scene("s", Path(), tuple(View(n, camera, Path(n), lens) for n in names), points)


def save(path, pixels, labels=LABELS):
    path.parent.mkdir(parents=True, exist_ok=True)
    (pixels if isinstance(pixels, Image.Image) else Image.fromarray(pixels)).save(path)
    if labels is not None:
        (path.parent / "labels.json").write_text(json.dumps(labels))


def imported(scene, folder):
    missing = import_masks(scene, folder, folder / "out")
    masks = Masks(folder / "out", Taxonomy.read(folder / "out" / "labels.json"))
    return masks, missing


IDS = np.array([[3, 3, 184, 255], [3, 184, 184, 255]], np.uint8)
WANTED = np.array([[3, 3, 184, -1], [3, 184, 184, -1]])


def palette(ids):
    image = Image.fromarray(ids).convert("P")
    image.putdata(ids.ravel().tolist())
    image.putpalette([i * 7 % 256 for i in range(768)])
    return image


@pytest.mark.parametrize(
    "pixels",
    [IDS, IDS.astype(np.uint16), palette(IDS), IDS.repeat(3, 0).repeat(3, 1)],
    ids=["8 bits", "16 bits", "palette", "3 x as large"],
)
def test_import_of_ids(tmp_path, pixels):
    save(tmp_path / "a.png", pixels)
    scene = scene_of("a.jpg", "sub/b.jpg")
    masks, missing = imported(scene, tmp_path)
    assert missing == ["sub/b.jpg"]
    assert masks.taxonomy.names == {3: "car", 184: "tree-merged"}
    assert masks[scene.views[0]].dtype == np.int16
    np.testing.assert_array_equal(masks[scene.views[0]], WANTED)
    assert (masks[scene.views[1]] == -1).all()
    assert np.asarray(Image.open(tmp_path / "out" / "a.png")).dtype == np.uint8


def test_names_of_files(tmp_path):
    save(tmp_path / "deep" / "a.jpg.png", np.full((2, 4), 184, np.uint8), None)
    save(tmp_path / "deep" / "a.png", np.full((2, 4), 3, np.uint8), None)  # of another photo, a.JPG say
    save(tmp_path / "b.v2.png", np.full((2, 4), 3, np.uint8))
    scene = scene_of("deep/a.jpg", "b.v2.jpg")
    masks, missing = imported(scene, tmp_path)
    assert missing == []
    assert [np.unique(masks[v]).tolist() for v in scene.views] == [[184], [3]]


def test_ids_beyond_8_bits_and_only_occurring_names(tmp_path):
    labels = {"labels": {"255": "lamp", "300": "statue", "7": "never"}}
    pixels = np.array([[255, 300, 65535, 255]] * 2, np.uint16)
    save(tmp_path / "a.png", pixels, labels)
    save(tmp_path / "b.png", np.full((2, 4), 255, np.uint8), None)
    scene = scene_of("a.jpg", "b.jpg")
    masks, _ = imported(scene, tmp_path)
    assert masks.taxonomy.names == {255: "lamp", 300: "statue"}
    np.testing.assert_array_equal(masks[scene.views[0]], [[255, 300, -1, 255]] * 2)
    assert (masks[scene.views[1]] == 255).all()
    again = import_masks(scene, tmp_path / "out", tmp_path / "out2")  # what we write can be read as input
    assert again == []
    for name in ("a", "b"):
        assert (tmp_path / "out" / f"{name}.png").read_bytes() == (
            tmp_path / "out2" / f"{name}.png"
        ).read_bytes()


def test_unlabelled_is_255_unless_stated(tmp_path):
    save(tmp_path / "a.png", IDS, {"labels": LABELS["labels"]})
    np.testing.assert_array_equal(imported(scene := scene_of("a.jpg"), tmp_path)[0][scene.views[0]], WANTED)
    save(tmp_path / "a.png", np.where(IDS == 255, 0, IDS), LABELS | {"unlabelled": 0})
    np.testing.assert_array_equal(imported(scene, tmp_path)[0][scene.views[0]], WANTED)
    save(tmp_path / "a.png", IDS, LABELS | {"unlabelled": 0})
    with pytest.raises(LabelError, match=r"a\.png: unknown ids 255; name them in labels\.json"):
        import_masks(scene, tmp_path, tmp_path / "out")


def test_resampling_takes_the_nearest_pixel(tmp_path):
    ids = np.random.default_rng(0).choice(np.array([3, 184, 255], np.uint8), (33, 67))
    save(tmp_path / "a.png", ids)
    scene = scene_of("a.jpg", width=17, height=8)  # 33 / 4 rounded down, 67 / 4 rounded up
    masks, _ = imported(scene, tmp_path)
    centres_y, centres_x = (np.arange(8) + 0.5) * 33 / 8, (np.arange(17) + 0.5) * 67 / 17
    expected = ids[centres_y.astype(int)][:, centres_x.astype(int)].astype(int)
    np.testing.assert_array_equal(masks[scene.views[0]], np.where(expected == 255, -1, expected))


def test_label_images_are_undistorted_like_photos(tmp_path):
    """A straight edge in the world is straight again; at half size too."""
    lens = Lens("SIMPLE_RADIAL", (100.0, 64.0, 48.0, -0.15), 128, 96)
    K = pinhole(lens)
    v, u = np.mgrid[:96, :128] + 0.5
    distorted_x, distorted_y = (u - 64) / 100, (v - 48) / 100
    x, y = distorted_x, distorted_y
    for _ in range(50):  # the ray that each pixel of the lens sees, by fixed-point iteration
        radial = 1 - 0.15 * (x**2 + y**2)
        x, y = distorted_x / radial, distorted_y / radial
    ids = np.where(x > 0.3, 3, 184).astype(np.uint8)
    scene = scene_of("a.jpg", width=128, height=96, lens=lens, K=K)
    columns = (np.arange(128) + 0.5 - K[0, 2]) / K[0, 0]
    for step, tolerance in ((1, 0.02), (2, 0.04)):
        save(tmp_path / "a.png", ids[::step, ::step])
        masks, _ = imported(scene, tmp_path)
        found = masks[scene.views[0]]
        sure = np.abs(columns - 0.3) > tolerance
        np.testing.assert_array_equal(
            found[:, sure], np.where(columns > 0.3, 3, 184)[sure][None].repeat(96, 0)
        )


LENS = Lens("SIMPLE_RADIAL", (100.0, 64.0, 48.0, -0.15), 128, 96)
FLAT = (120, 94)  # px, of the undistorted photo: another aspect ratio


def taken(lens: Lens = LENS) -> np.ndarray:
    """Labels of the photo that a lens takes of an upright edge at x = 0.3 and a level one at y = -0.2."""
    f, cx, cy, k = lens.params
    v, u = np.mgrid[: lens.height, : lens.width] + 0.5
    distorted_x, distorted_y = (u - cx) / f, (v - cy) / f
    x, y = distorted_x, distorted_y
    for _ in range(50):  # the ray that each pixel of the lens sees, by fixed-point iteration
        radial = 1 + k * (x**2 + y**2)
        x, y = distorted_x / radial, distorted_y / radial
    return np.where(x > 0.3, 3, np.where(y > -0.2, 184, 255)).astype(np.uint8)


def undistorted_capture(folder, size=FLAT, orientation=1, lens=LENS):
    """A capture of one photo that structure from motion undistorted and cropped, and what it should show."""
    (folder / "images").mkdir(parents=True)
    width, height = size
    Image.new("RGB", size).save(folder / "images" / "a.jpg")
    about = {"model": lens.model, "params": lens.params, "width": lens.width, "height": lens.height}
    raw = {"lenses": [about], "photos": {"a.jpg": [0, orientation]}}
    (folder / "poses.json").write_text(json.dumps({"raw": raw}))
    K = np.array([[115.0, 0, width / 2], [0, 115.0, height / 2], [0, 0, 1]])
    scene = scene_of("a.jpg", width=width, height=height, K=K)
    view = replace(scene.views[0], image_path=folder / "images" / "a.jpg")
    x = (np.arange(width) + 0.5 - width / 2) / 115
    y = (np.arange(height) + 0.5 - height / 2) / 115
    expected = np.where(x > 0.3, 3, np.where(y[:, None] > -0.2, 184, -1))
    sure = (np.abs(x - 0.3) > 0.02) & (np.abs(y[:, None] + 0.2) > 0.02)
    return replace(scene, path=folder, views=(view,)), expected, sure


@pytest.mark.parametrize(
    ("label", "orientation"),
    [
        (taken(), 1),
        (taken(), 3),  # upright, as viewers show it
        (taken().repeat(2, 0).repeat(2, 1), 1),
        (taken(), 6),
        (np.rot90(taken(), 1), 6),  # as its pixels are stored
        (np.rot90(taken(), -1), 8),
        (taken().T, 5),
    ],
    ids=["raw", "raw 180", "raw, twice as large", "upright", "stored 6", "stored 8", "stored 5"],
)
def test_label_images_of_raw_photos_follow_the_undistorted_ones(tmp_path, label, orientation):
    """Until now they were taken for the undistorted photos' where their aspect ratios were alike."""
    scene, expected, sure = undistorted_capture(tmp_path / "capture", orientation=orientation)
    save(tmp_path / "m" / "a.png", np.ascontiguousarray(label))
    masks, _ = imported(scene, tmp_path / "m")
    np.testing.assert_array_equal(masks[scene.views[0]][sure], expected[sure])
    assert sure.mean() > 0.8


def test_label_images_of_undistorted_photos_stay(tmp_path):
    scene, expected, _ = undistorted_capture(tmp_path / "capture")
    save(tmp_path / "m" / "a.png", np.where(expected == -1, 255, expected).astype(np.uint8))
    np.testing.assert_array_equal(imported(scene, tmp_path / "m")[0][scene.views[0]], expected)


def test_label_images_that_fit_both_or_none_are_refused(tmp_path):
    scene, _, _ = undistorted_capture(tmp_path / "capture", size=(124, 93))  # the same aspect ratio
    save(tmp_path / "m" / "a.png", taken()[::2, ::2])
    with pytest.raises(
        LabelError, match=r"64 x 48 pixels fit its photo, 128 x 96, and the .* 124 x 93; scale"
    ):
        imported(scene, tmp_path / "m")
    save(tmp_path / "m" / "a.png", taken()[:80])
    with pytest.raises(
        LabelError, match="128 x 80 pixels, but its photo has 128 x 96, and 124 x 93 where it"
    ):
        imported(scene, tmp_path / "m")
    save(tmp_path / "m" / "a.png", taken())
    imported(scene, tmp_path / "m")


@pytest.mark.parametrize(
    ("pixels", "labels", "complaint"),
    [
        (IDS, None, "no labels.json"),
        (IDS, {"labels": {"3": "car"}}, "unknown ids 184"),
        (IDS, ["car"], "not of the form"),
        (IDS, {"labels": {"3": "car", "4": "car"}}, "name of its own"),
        (IDS, {"labels": {"3": "unlabelled"}}, '"unlabelled": 3'),
        (IDS, {"labels": {"40000": "car"}}, r"outside 0 \.\.\. 32767"),
        (IDS, {"unlabelled": 3, "labels": {"3": "car"}}, "has a name too"),
        (np.zeros((2, 4, 3), np.uint8), LABELS, "mode RGB where one channel"),
        (np.full((4, 4), 3, np.uint8), LABELS, "4 x 4 pixels, but its photo has 4 x 2"),
        (np.full((2, 4), 255, np.uint8), LABELS, "every pixel is unlabelled"),
    ],
)
def test_unusable_input(tmp_path, pixels, labels, complaint):
    save(tmp_path / "a.png", pixels, labels)
    with pytest.raises(LabelError, match=complaint) as caught:
        import_masks(scene_of("a.jpg"), tmp_path, tmp_path / "out")
    message = str(caught.value)
    assert "\n" not in message
    assert message.startswith(str(tmp_path))
    assert not (tmp_path / "out" / "labels.json").exists()


def test_unusable_folders(tmp_path):
    scene = scene_of("a.jpg")
    save(tmp_path / "c.png", IDS)
    with pytest.raises(LabelError, match=r"no label image for any view; name them like the photos \(a\.png"):
        import_masks(scene, tmp_path, tmp_path / "out")
    with pytest.raises(LabelError, match="masks of the run itself"):
        import_masks(scene, tmp_path, tmp_path)
    for name in ("/etc/a.jpg", "../a.jpg"):
        with pytest.raises(LabelError, match="outside the image folder"):
            mask_path(tmp_path, scene_of(name).views[0])


def test_lossy_images_are_no_ids(tmp_path):
    save(tmp_path / "a.png", IDS)
    Image.fromarray(IDS).save(tmp_path / "a.png", format="JPEG")
    with pytest.raises(LabelError, match="not a readable PNG"):
        import_masks(scene_of("a.jpg"), tmp_path, tmp_path / "out")


@settings(max_examples=50)
@given(st.lists(st.integers(0, 32767), min_size=1, max_size=5, unique=True), st.integers(0, 2**32 - 1))
def test_masks_read_back_as_written(tmp_path_factory, ids, seed):
    taxonomy = Taxonomy({i: f"label {i}" for i in sorted(ids)})
    label_ids = np.random.default_rng(seed).choice(np.array([-1, *ids], np.int16), (5, 7))
    path = tmp_path_factory.mktemp("masks") / "a.png"
    write_mask(path, label_ids, taxonomy)
    np.testing.assert_array_equal(read_mask(path, taxonomy), label_ids)
    taxonomy.write(path.with_name("labels.json"))
    assert Taxonomy.read(path.with_name("labels.json")) == taxonomy


def test_masks_of_another_scene_are_refused(tmp_path):
    write_mask(tmp_path / "a.png", np.full((2, 4), 3, np.int16), Taxonomy({3: "car"}))
    scene = scene_of("a.jpg", "b.jpg")
    with pytest.raises(LabelError, match=r"4 x 2 pixels where the scene has 8 x 4"):
        Masks(tmp_path, Taxonomy({3: "car"}))[scene_of("a.jpg", width=8, height=4).views[0]]
    with pytest.raises(LabelError, match="unknown ids 3"):
        Masks(tmp_path, Taxonomy({4: "bus"}))[scene.views[0]]


def test_names_and_colors():
    taxonomy = Taxonomy({1: "person", 125: "gravel-merged", 201: "statue"})
    assert [taxonomy.name(i) for i in (1, 201, -1)] == ["person", "statue", "unlabelled"]
    assert taxonomy.color(1) == (220, 20, 60)  # COCO's
    assert taxonomy.color(125) != (255, 160, 98)  # COCO calls 125 gravel
    colors = [taxonomy.color(i) for i in (-1, 1, 125, 201)]
    assert len(set(colors)) == 4
    assert all(0 <= c <= 255 for color in colors for c in color)
    assert Taxonomy({9: "statue"}).color(9) == taxonomy.color(201)


def test_photos_that_some_disks_take_for_one(tmp_path):
    prepare_folder(tmp_path, scene_of("a.jpg", "sub/a.jpg", "b.jpg").views)
    for one, other in (("a.jpg", "A.png"), ("caf\u00e9.jpg", "cafe\u0301.jpg"), ("a.jpg", "a.png")):
        with pytest.raises(LabelError, match="has the same name but for the suffix or capitals; rename one"):
            prepare_folder(tmp_path, scene_of(one, other).views)


@pytest.mark.parametrize(
    "damage",
    [
        lambda raw: [],
        lambda raw: {"lenses": 3},
        lambda raw: raw | {"photos": {"a.jpg": [1, 1]}},
        lambda raw: raw | {"photos": {"a.jpg": [0, 9]}},
        lambda raw: raw | {"photos": {"a.jpg": [0]}},
        lambda raw: raw | {"lenses": [raw["lenses"][0] | {"model": "NONE"}]},
        lambda raw: raw | {"lenses": [raw["lenses"][0] | {"params": [1e999, 1, 1, 1]}]},
        lambda raw: raw | {"lenses": [raw["lenses"][0] | {"width": 1e999}]},
    ],
)
def test_a_damaged_report_of_poses_is_one_line(tmp_path, damage):
    scene, _, _ = undistorted_capture(tmp_path / "capture")
    save(tmp_path / "m" / "a.png", taken())
    path = tmp_path / "capture" / "poses.json"
    raw = json.loads(path.read_text())["raw"]
    path.write_text(json.dumps({"raw": damage(raw)}))
    with pytest.raises(SceneError, match=r"poses\.json: not a report of poses \(.*\); find the poses again"):
        imported(scene, tmp_path / "m")


def test_the_cache_keeps_what_fits(tmp_path, monkeypatch):
    taxonomy, scene = Taxonomy({3: "car"}), scene_of("a.jpg", "b.jpg")
    for name in "ab":
        write_mask(tmp_path / f"{name}.png", np.full((2, 4), 3, np.int16), taxonomy)
    monkeypatch.setattr(masks_module, "CACHE_BYTES", 20)
    masks = Masks(tmp_path, taxonomy)
    assert all((masks[v] == 3).all() for v in scene.views)
    assert masks[scene.views[0]] is masks[scene.views[0]]
    assert masks[scene.views[1]] is not masks[scene.views[1]]


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("x" * 101, "101 characters"), ("a\x1b[31m", r"U\+001B"), ("a\ud800", "not UTF-8"), (" ", "blank"),
        ("a\u202eb", r"U\+202E"), (" a", "begins or ends with a space"), (7, "no text"),
    ],
)  # fmt: skip
def test_names_that_may_not_be_are_refused_where_they_are_read(tmp_path, name, why):
    save(tmp_path / "a.png", IDS, {"labels": {"3": name, "184": "tree"}})
    with pytest.raises(LabelError, match=f"{why}; rename it") as raised:
        imported(scene_of("a.jpg"), tmp_path)
    said = str(raised.value)
    assert said.startswith(f"{tmp_path / 'labels.json'}: label 3 is named ")
    assert said.isprintable()
    assert len(said) < 600
