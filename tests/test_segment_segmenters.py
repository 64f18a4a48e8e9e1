from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import test_segment_masks as masks
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from PIL import Image

from sagesplat.core.errors import BackendUnavailable, SceneError
from sagesplat.scene.images import Photos
from sagesplat.scene.scene import Camera, Scene, View
from sagesplat.segment.masks import Taxonomy, write_labels
from sagesplat.segment.segmenters import Segmented, arg_max_resized, group_classes, parse_device, segment_some

SKY, TREE = 187, 184


def segment_views(scene: Scene, photos, segmenter, target: Path, **options) -> None:
    """Write the label images of all views, then labels.json."""
    rows = range(len(scene.views))
    occurring = segment_some(scene, photos, segmenter, target, rows, **options)
    write_labels(target, segmenter.taxonomy, occurring)


class Bright:
    """Sky where a photo is bright, else tree."""

    def __init__(self, names: dict[int, str] | None = None):
        self.taxonomy = Taxonomy(names or {TREE: "tree-merged", SKY: "sky-other-merged"})
        self.sizes: list[list[tuple[int, ...]]] = []

    def __call__(self, photos: Sequence[np.ndarray], /) -> list[Segmented]:
        self.sizes.append([photo.shape[:2] for photo in photos])
        return [self.segmented(photo[..., 0] > 127) for photo in photos]

    def segmented(self, bright: np.ndarray) -> Segmented:
        return Segmented(np.where(bright, SKY, TREE).astype(np.int16))


def scene_of(sizes: dict[str, tuple[int, int]], path: Path = Path("scene")) -> Scene:
    eye4, eye3 = np.eye(4, dtype=np.float32), np.eye(3, dtype=np.float32)
    views = tuple(View(name, Camera(eye4, eye3, w, h), path / name) for name, (h, w) in sizes.items())
    return replace(masks.scene_of(), views=views, path=path)


def half_bright(height: int, width: int) -> np.ndarray:
    photo = np.zeros((height, width, 3), np.uint8)
    photo[: height // 2] = 255
    return photo


SIZES = {"a.jpg": (16, 32), "b.jpg": (32, 16), "c/d.jpg": (16, 32), "e.jpg": (16, 32)}
PHOTOS = [half_bright(*size) for size in SIZES.values()]


def test_only_what_is_missing_is_made(tmp_path: Path) -> None:
    scene, target = scene_of(SIZES), tmp_path / "masks"
    segment_views(scene, PHOTOS, Bright(), target)
    again = Bright()
    segment_views(scene, PHOTOS, again, target)
    assert again.sizes == []
    assert (target / "labels.json").exists()
    (target / "c" / "d.png").unlink()
    (target / "a.png").write_bytes(b"damaged")
    segment_views(scene, PHOTOS, again, target)
    assert again.sizes == [[(16, 32)], [(16, 32)]]


def test_a_killed_run_keeps_what_it_has(tmp_path: Path) -> None:
    def killed(done: int, total: int) -> None:
        if done == 3:
            raise KeyboardInterrupt

    scene, segmenter = scene_of(SIZES), Bright()
    with pytest.raises(KeyboardInterrupt):
        segment_views(scene, PHOTOS, segmenter, tmp_path, on_view=killed)
    assert not (tmp_path / "labels.json").exists()
    segment_views(scene, PHOTOS, segmenter, tmp_path)
    assert len(segmenter.sizes) == 4


def test_categories_of_two_kinds_are_not_mixed(tmp_path: Path) -> None:
    scene = scene_of(SIZES)
    segment_views(scene, PHOTOS, Bright(), tmp_path)
    other = Bright({TREE: "wood", SKY: "air"})  # the same ids mean something else
    with pytest.raises(KeyboardInterrupt):
        segment_views(scene, PHOTOS, other, tmp_path, on_view=interrupt)
    assert len(list(tmp_path.rglob("*.png"))) == 1
    segment_views(scene, PHOTOS, other, tmp_path)
    assert len(other.sizes) == 4
    assert Taxonomy.read(tmp_path / "labels.json").names == {TREE: "wood", SKY: "air"}
    (tmp_path / ".taxonomy.json").write_text("damaged")
    segment_views(scene, PHOTOS, other, tmp_path)
    assert len(other.sizes) == 8


def interrupt(done: int, total: int) -> None:
    raise KeyboardInterrupt


def test_unusable_scenes(tmp_path: Path) -> None:
    scene = scene_of({"a.png": (16, 32), "b.png": (16, 32)}, tmp_path)
    Image.new("L", (32, 16), 200).save(tmp_path / "a.png")  # grey
    (tmp_path / "b.png").write_bytes(b"damaged")
    with pytest.raises(SceneError, match=r"b\.png: not readable"):
        segment_views(scene, Photos(scene.views), Bright(), tmp_path / "out")
    assert (tmp_path / "out" / "a.png").exists()


def test_groups_and_the_largest_logit() -> None:
    ids, group = group_classes([SKY, None, TREE, SKY])
    assert ids.tolist() == [-1, TREE, SKY]
    assert group.tolist() == [2, 0, 1, 2]
    p = np.array([[[0.5, 0.1]], [[0.499, 0.899]], [[0.001, 0.001]]], np.float32)
    found = ids[arg_max_resized(p, 2, 4)]
    assert found.tolist() == [[-1, TREE, TREE, TREE]] * 2  # 0.4 to 0.6 a quarter of the way


@settings(max_examples=60)
@given(
    hnp.arrays(
        np.float32, hnp.array_shapes(min_dims=3, max_dims=3, max_side=6), elements=st.floats(-9, 9, width=32)
    ),
    st.integers(1, 12),
    st.integers(1, 12),
)
def test_no_class_that_wins_is_passed_over(logits: np.ndarray, height: int, width: int) -> None:
    found = arg_max_resized(logits, height, width)
    resized = [Image.fromarray(logit).resize((width, height), Image.Resampling.BILINEAR) for logit in logits]
    np.testing.assert_array_equal(found, np.stack([np.asarray(image) for image in resized]).argmax(0))


def test_names_of_devices() -> None:
    assert parse_device("auto") == ("auto", 0)
    assert parse_device("cpu") == ("cpu", 0)
    assert parse_device("cuda") == ("cuda", 0)
    assert parse_device("cuda:12") == ("cuda", 12)
    for wrong in ("", "gpu", "cuda:", "cuda:-1", "cuda:1 ", "CPU"):
        with pytest.raises(BackendUnavailable, match="is not known"):
            parse_device(wrong)
