"""Pixels that count: from ignored categories, masks of the photos, and their alpha."""

import unicodedata
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import random_gaussians, write_capture
from PIL import Image

from sagesplat.core.errors import LabelError, SceneError
from sagesplat.scene import describe
from sagesplat.scene._prepare import prepare_photos
from sagesplat.scene.feature_masks import write_feature_masks
from sagesplat.scene.given_masks import VALID_FOLDER as FOLDER
from sagesplat.scene.given_masks import holds_masks, is_mask_among
from sagesplat.scene.images import read_black
from sagesplat.scene.scene import Lens, Scene
from sagesplat.segment.masks import Masks, Taxonomy, mask_path, write_mask
from sagesplat.segment.valid import ALL_VALID, ValidPixels, describe_masks, ignores_alpha, write_valid

PERSON, TREE = 1, 184
TAXONOMY = Taxonomy({PERSON: "person", TREE: "tree-merged"})


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    return write_capture(tmp_path / "capture", random_gaussians(20, degree=0), views=4)  # 48 x 32


def labelled(folder: Path, scene: Scene, person: slice) -> Masks:
    """Label images with a person in some columns of the first view."""
    for row, view in enumerate(scene.views):
        ids = np.full((32, 48), TREE, np.int16)
        if row == 0:
            ids[:, person] = PERSON
        write_mask(mask_path(folder, view), ids, TAXONOMY)
    return Masks(folder, TAXONOMY)


def black(folder: Path, scene: Scene, row: int, size=(48, 32), box=(0, 0, 24, 32), mode="L") -> Path:
    """A mask of a photo that is black in a box."""
    image = Image.new("L", size, 255)
    image.paste(0, box)
    path = folder / Path(scene.views[row].name).with_suffix(".png")
    path.parent.mkdir(parents=True, exist_ok=True)
    image.convert(mode).save(path)
    return path


def test_ignored_categories_are_grown(tmp_path, scene):
    masks = labelled(tmp_path / "masks", scene, slice(10, 14))
    shares = write_valid(scene, tmp_path / "valid", label_ids=masks, ignore=[PERSON], dilation=2)
    valid = ValidPixels(tmp_path / "valid")
    first, *others = (valid[view] for view in scene.views)
    assert first is not None
    assert others == [None, None, None]
    assert np.flatnonzero(~first[5]).tolist() == list(range(8, 16))
    assert shares.tolist() == [pytest.approx(8 / 48), 0, 0, 0]
    assert valid.rows(scene, range(4)) == [0, 1, 2, 3]
    assert write_valid(scene, tmp_path / "valid", label_ids=masks).sum() == 0  # nothing is ignored
    assert ValidPixels(tmp_path / "valid")[scene.views[0]] is None
    assert ALL_VALID[scene.views[0]] is None


def test_a_view_without_a_pixel_and_a_scene_without_one(tmp_path, scene):
    masks = labelled(tmp_path / "masks", scene, slice(0, 48))
    one = replace(scene, test_every=0)
    assert write_valid(one, tmp_path / "valid", label_ids=masks, ignore=[PERSON])[0] == 1
    assert ValidPixels(tmp_path / "valid").rows(one, range(4)) == [1, 2, 3]
    with pytest.raises(LabelError, match="no pixel of any training photo counts"):
        write_valid(scene, tmp_path / "valid", label_ids=masks, ignore=[PERSON, TREE])


@pytest.mark.parametrize("mode", ["1", "L", "P", "RGB", "RGBA", "LA", "I;16"])
def test_masks_of_any_mode_and_resolution(tmp_path, scene, mode):
    black(scene.path / FOLDER, scene, 1, size=(96, 64), box=(0, 0, 40, 64), mode=mode)
    write_valid(scene, tmp_path / "valid")
    valid = ValidPixels(tmp_path / "valid")
    assert valid[scene.views[0]] is None
    found = valid[scene.views[1]]
    assert found is not None
    assert not found[:, :20].any()
    assert found[:, 20:].all()


def test_masks_that_views_name_and_masks_in_the_folder_add_up(tmp_path, scene):
    named = black(tmp_path / "elsewhere", scene, 1, box=(40, 0, 48, 32))
    black(scene.path / FOLDER, scene, 1, box=(0, 0, 8, 32))
    views = tuple(replace(v, valid_path=named) if i == 1 else v for i, v in enumerate(scene.views))
    write_valid(replace(scene, views=views), tmp_path / "valid")
    found = ValidPixels(tmp_path / "valid")[scene.views[1]]
    assert found is not None
    assert found[:, 8:40].all()
    assert found.mean() == pytest.approx(32 / 48)


def test_masks_follow_the_lens(tmp_path, scene):
    """A mask is of the photo as it was taken: the lens moves its edge as it moves the photo's."""
    black(scene.path / FOLDER, scene, 1, box=(0, 0, 12, 32))
    lens = Lens("SIMPLE_RADIAL", (40.0, 24.0, 16.0, 0.2), 48, 32)
    views = tuple(replace(view, lens=lens) for view in scene.views)
    write_valid(replace(scene, views=views), tmp_path / "valid")
    found = ValidPixels(tmp_path / "valid")[scene.views[1]]
    assert found is not None
    assert 12 < np.argmax(found[0]) <= 16


def test_masks_that_cannot_be_used(tmp_path, scene):
    path = black(scene.path / FOLDER, scene, 1, size=(48, 48))
    with pytest.raises(LabelError, match="48 x 48 pixels, but its photo has 48 x 32"):
        write_valid(scene, tmp_path / "valid")
    path.rename(path.with_name("other.png"))
    with pytest.raises(LabelError, match=r"no mask of any photo; name them like the photos \(00.png"):
        write_valid(scene, tmp_path / "valid")
    path.write_bytes(b"GIF89a")
    with pytest.raises(SceneError, match="not a readable mask"):
        write_valid(scene, tmp_path / "valid")
    Image.new("1", (4, 4)).save(tmp_path / "00.png")
    with pytest.raises(LabelError, match="4 x 4 pixels where the scene has 48 x 32; make the masks again"):
        ValidPixels(tmp_path)[scene.views[0]]


def with_alpha(scene: Scene, clear: tuple[slice, slice]) -> None:
    """Make part of every photo transparent."""
    for view in scene.views:
        with Image.open(view.image_path) as image:
            pixels = np.array(image.convert("RGBA"))
        pixels[(*clear, 3)] = 0
        Image.fromarray(pixels).save(view.image_path)


def test_transparent_borders_are_of_cut_out_objects(tmp_path, scene):
    with_alpha(scene, (slice(0, 6), slice(None)))  # a strip at the top: a third of the border
    assert ignores_alpha(scene)
    assert write_valid(scene, tmp_path / "valid")[0] == pytest.approx(6 / 32)
    assert not ignores_alpha(replace(scene, alpha="background"))
    for edge in ((slice(None), slice(0, 6)), (slice(None), slice(-6, None)), (slice(-6, None), slice(None))):
        with_alpha(scene, edge)
    assert not ignores_alpha(scene)
    assert write_valid(scene, tmp_path / "valid").sum() == 0
    assert ignores_alpha(replace(scene, alpha="ignore"))


def test_black_is_zero_in_every_channel(tmp_path):
    pixels = np.zeros((2, 3, 3), np.uint8)
    pixels[0, 1] = (0, 0, 9)
    Image.fromarray(pixels).save(tmp_path / "m.png")
    assert read_black(tmp_path / "m.png", 6).tolist() == [[False, True, False], [False] * 3]


NAMES = (
    "masks_valid/{stem}.png",
    "masks/{stem}.png",
    "masks/{name}.png",
    "masks/{name}.mask.png",
    "masks/{stem}_mask.png",
    "masks/{stem}.jpg",
    "mask/{stem}.PNG",
    "mask/{stem}.mask.png",
    ".mask/{stem}.png",
    "images/masks/{name}.png",
    "images/{name}.mask.png",
    "images/{stem}_mask.png",
)


@pytest.mark.parametrize("form", NAMES)
def test_masks_of_other_trainers(tmp_path, scene, form):
    """Black and white images are masks of what counts, under any usual name; it is said what was found."""
    expected = np.ones((32, 48), bool)
    expected[:, :24] = False
    for view in scene.views:
        path = scene.path / form.format(name=view.name, stem=Path(view.name).stem)
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(np.where(expected, np.uint8(255), np.uint8(0))).save(path, quality=95)
    said: list[str] = []
    shares = write_valid(scene, tmp_path / "valid", say=said.append)
    valid = ValidPixels(tmp_path / "valid")
    assert all(np.array_equal(np.asarray(valid[view]), expected) for view in scene.views)
    assert shares.tolist() == [0.5] * 4
    assert len(said) == 1
    assert "masks of 4 of 4 photos" in said[0]
    assert "black pixels do not count (if it is the white ones, name the folder masks_inverted)" in said[0]
    assert describe_masks(scene) == said[0]
    assert "masks" not in dict(describe(scene))


@pytest.mark.parametrize("form", ["masks_inverted/{stem}.png", "images/dynamic_mask_{stem}.png"])
def test_masks_whose_names_say_that_they_are_inverted(tmp_path, scene, form):
    path = scene.path / form.format(stem=Path(scene.views[0].name).stem)
    path.parent.mkdir(exist_ok=True)
    pixels = np.zeros((32, 48), np.uint8)
    pixels[:, :24] = 255
    Image.fromarray(pixels).save(path)
    said: list[str] = []
    write_valid(scene, tmp_path / "valid", say=said.append)
    valid = ValidPixels(tmp_path / "valid")[scene.views[0]]
    assert valid is not None
    assert not valid[:, :24].any()
    assert valid[:, 24:].all()
    assert "white pixels do not count, as their names say" in said[0]


@pytest.mark.parametrize("inverted", [False, True])
def test_points_tell_which_pixels_of_masks_count(tmp_path, scene, inverted):
    """Where structure from motion found no point in white, it is the white pixels that do not count."""
    rng = np.random.default_rng(0)
    uv = rng.uniform([24, 0], [48, 32], (100, 2)).astype(np.float32)  # in the right half
    tracks = np.zeros(100, np.int64), np.repeat(np.arange(4, dtype=np.int32), 25)
    points = replace(scene.points, track_points=tracks[0], track_views=tracks[1], track_uv=uv)
    scene = replace(scene, points=points)
    for row in range(4):
        path = black(scene.path / "masks", scene, row)
        if inverted:
            Image.fromarray(255 - np.asarray(Image.open(path))).save(path)
    said: list[str] = []
    write_valid(scene, tmp_path / "valid", say=said.append)
    valid = ValidPixels(tmp_path / "valid")[scene.views[0]]
    assert valid is not None
    assert valid[:, 24:].all()
    assert not valid[:, :24].any()
    assert ("white pixels do not count, since the points" in said[0]) == inverted


def test_label_images_are_no_masks(tmp_path):
    """Neither those with a labels.json, nor images of other values than black and white."""
    for name, values in {"ids": (3, 184), "many": (0, 1, 2), "void": (7, 255)}.items():
        folder = tmp_path / name
        folder.mkdir()
        pixels = np.resize(np.array(values, np.uint8), (8, 8))
        Image.fromarray(pixels).save(folder / "a.png")
        assert not holds_masks(folder)
    for name, values in {"ones": (0, 1), "white": (255,), "black": (0,), "both": (0, 255)}.items():
        folder = tmp_path / name
        folder.mkdir()
        Image.fromarray(np.resize(np.array(values, np.uint8), (8, 8))).save(folder / "a.png")
        assert holds_masks(folder)
    (tmp_path / "both" / "labels.json").write_text("{}")
    assert not holds_masks(tmp_path / "both")
    assert not holds_masks(tmp_path / "missing")
    soft = Image.linear_gradient("L").resize((8, 256))  # all greys
    soft.save(tmp_path / "white" / "b.png")
    assert not holds_masks(tmp_path / "white")


def test_photos_named_like_masks_are_photos(tmp_path):
    """A mask among photos is one that is black and white and named after another photo."""
    names = frozenset(["a.jpg", "a_mask.png", "b_mask.jpg", "a.jpg.mask.png"])
    for name in names:
        Image.new("L", (8, 8), 255 if name.startswith("a") else 90).save(tmp_path / name)
    found = {name for name in names if is_mask_among(tmp_path / name, names)}
    assert found == {"a_mask.png", "a.jpg.mask.png"}


def test_transparent_pixels_of_a_mask_do_not_count(tmp_path):
    pixels = np.full((4, 4, 4), 255, np.uint8)
    pixels[:2, :, 3] = 0
    Image.fromarray(pixels).save(tmp_path / "a.png")
    assert read_black(tmp_path / "a.png", 16).tolist() == [[False] * 4] * 2 + [[True] * 4] * 2


def test_a_mask_may_be_the_alpha_channel(tmp_path):
    pixels = np.zeros((4, 4, 4), np.uint8)
    pixels[2:, :, 3] = 255
    Image.fromarray(pixels).save(tmp_path / "a.png")
    assert read_black(tmp_path / "a.png", 16).tolist() == [[False] * 4] * 2 + [[True] * 4] * 2
    Image.new("RGBA", (4, 4), (0, 0, 0, 255)).save(tmp_path / "a.png")
    assert not read_black(tmp_path / "a.png", 16).any()  # of an opaque one colours tell


def test_masks_with_soft_edges(tmp_path):
    pixels = np.zeros((32, 200), np.uint8)
    pixels[:, 90:120], pixels[:, 120:] = np.linspace(5, 250, 30).round(), 255
    Image.fromarray(pixels).save(tmp_path / "a.png")
    assert holds_masks(tmp_path)
    pixels[:, 90:120] = 7  # an object of a label image, with 255 for what is none
    Image.fromarray(pixels).save(tmp_path / "a.png")
    assert not holds_masks(tmp_path)


def test_masks_beside_the_photos_of_each_camera(tmp_path, scene):
    """With equal names of photos, and accents in another form than theirs."""
    views = []
    for row, view in enumerate(scene.views):
        name = f"cam{row % 2}/images/{unicodedata.normalize('NFC', 'ä')}{row // 2}.png"
        photo = tmp_path / "rig" / name
        photo.parent.mkdir(parents=True, exist_ok=True)
        view.image_path.rename(photo)
        mask = np.full((32, 48), 255, np.uint8)
        mask[:, : 12 + 12 * (row % 2)] = 0
        path = photo.parents[1] / "masks" / unicodedata.normalize("NFD", photo.name)
        path.parent.mkdir(exist_ok=True)
        Image.fromarray(mask).save(path)
        views.append(replace(view, name=name, image_path=photo))
    rig = replace(scene, path=tmp_path / "rig", views=tuple(views))
    assert "masks of 4 of 4 photos" in describe_masks(rig)
    assert write_valid(rig, tmp_path / "valid").tolist() == [0.25, 0.5, 0.25, 0.5]
    photos, _ = prepare_photos(tmp_path / "rig", tmp_path / "p", tmp_path / "o", lambda done, total: None)
    assert len(photos) == 4


def test_masks_are_no_photos_to_find_poses_of(tmp_path):
    """Those beside photos without poses, in any of the places; and structure from motion heeds them."""
    photo = np.random.default_rng(0).integers(0, 255, (32, 48, 3), np.uint8)
    for name in ("a.jpg", "sub/b.jpg", "c_mask.jpg"):
        path = tmp_path / "in" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(photo).save(path)
    mask = Image.new("L", (48, 32))
    mask.paste(255, (24, 0, 48, 32))
    for name in ("a.jpg.mask.png", "masks/sub/b.png", ".mask/c_mask.png"):
        path = tmp_path / "in" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        mask.save(path)
    photos, unreadable = prepare_photos(
        tmp_path / "in", tmp_path / "prepared", tmp_path / "out", lambda done, total: None
    )
    assert [photo.path for photo in photos] == ["a.jpg", "c_mask.jpg", "sub/b.jpg"]
    assert not unreadable
    masks = write_feature_masks(
        photos, tmp_path / "in", tmp_path / "masks", tmp_path / "out", "auto", lambda name: None
    )
    assert len(masks) == 3
    for photo in photos:
        with Image.open(tmp_path / "out" / "masks_valid" / Path(photo.final).with_suffix(".png")) as image:
            assert np.array_equal(np.asarray(image), np.asarray(mask))
