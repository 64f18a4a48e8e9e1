"""Pixels that count: from ignored categories, masks of the photos, and their alpha."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import random_gaussians, write_capture
from PIL import Image

from sagesplat.core.errors import LabelError, SceneError
from sagesplat.scene.detect import VALID_FOLDER as FOLDER
from sagesplat.scene.images import read_black
from sagesplat.scene.scene import Lens, Scene
from sagesplat.segment.masks import Masks, Taxonomy, mask_path, write_mask
from sagesplat.segment.valid import ALL_VALID, ValidPixels, ignores_alpha, write_valid

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
    with pytest.raises(SceneError, match="not a readable PNG"):
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
