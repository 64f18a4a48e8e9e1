import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from PIL import Image

from sagesplat.core.errors import BackendUnavailable, LabelError, SceneError
from sagesplat.scene.images import Photos
from sagesplat.scene.scene import Camera, Points, Scene, View
from sagesplat.segment.masks import Masks, Taxonomy
from sagesplat.segment.segmenters import (
    Segmented,
    Segmenter,
    answer,
    arg_max_resized,
    group_classes,
    parse_device,
    segment_views,
)
from sagesplat.segment.soft import read_soft, write_soft

SKY, TREE = 187, 184


class Bright:
    """Sky where a photo is bright, else tree; with a probability of 0.8 at half the photo's resolution."""

    def __init__(self, names: dict[int, str] | None = None):
        self.taxonomy = Taxonomy(names or {TREE: "tree-merged", SKY: "sky-other-merged"})
        self.sizes: list[list[tuple[int, ...]]] = []

    def __call__(self, photos: Sequence[np.ndarray], /) -> list[Segmented]:
        self.sizes.append([photo.shape[:2] for photo in photos])
        return [self.segmented(photo[..., 0] > 127) for photo in photos]

    def segmented(self, bright: np.ndarray) -> Segmented:
        label_ids = np.where(bright, SKY, TREE).astype(np.int16)
        sky = np.where(bright[::2, ::2], 0.8, 0.2).astype(np.float32)
        return Segmented(label_ids, np.stack([1 - sky, sky]), np.array([TREE, SKY], np.int16))


def scene_of(sizes: dict[str, tuple[int, int]], path: Path = Path("scene")) -> Scene:
    eye4, eye3 = np.eye(4, dtype=np.float32), np.eye(3, dtype=np.float32)
    views = tuple(View(name, Camera(eye4, eye3, w, h), path / name) for name, (h, w) in sizes.items())
    none = np.zeros(0, np.int64)
    points = Points(
        np.zeros((0, 3), np.float32),
        np.zeros((0, 3), np.uint8),
        none,
        none.astype(np.int32),
        np.zeros((0, 2), np.float32),
    )
    return Scene("s", path, views, points)


def half_bright(height: int, width: int) -> np.ndarray:
    photo = np.zeros((height, width, 3), np.uint8)
    photo[: height // 2] = 255
    return photo


SIZES = {"a.jpg": (16, 32), "b.jpg": (32, 16), "c/d.jpg": (16, 32), "e.jpg": (16, 32)}
PHOTOS = [half_bright(*size) for size in SIZES.values()]


def test_views_of_one_size_are_segmented_together(tmp_path: Path) -> None:
    scene, segmenter, calls = scene_of(SIZES), Bright(), []
    segment_views(
        scene, PHOTOS, segmenter, tmp_path, batch=2, on_view=lambda done, total: calls.append((done, total))
    )
    assert sorted(segmenter.sizes) == [[(16, 32)], [(16, 32), (16, 32)], [(32, 16)]]
    assert calls == [(1, 4), (2, 4), (3, 4), (4, 4)]
    taxonomy = Taxonomy.read(tmp_path / "labels.json")
    assert taxonomy.names == segmenter.taxonomy.names
    for view in scene.views:
        label_ids, height = Masks(tmp_path, taxonomy)[view], view.camera.height
        assert (label_ids[: height // 2] == SKY).all()
        assert (label_ids[height // 2 :] == TREE).all()


def test_only_what_is_missing_is_made(tmp_path: Path) -> None:
    scene, target, soft = scene_of(SIZES), tmp_path / "masks", tmp_path / "soft"
    segment_views(scene, PHOTOS, Bright(), target)
    again = Bright()
    segment_views(scene, PHOTOS, again, target)
    assert again.sizes == []
    assert (target / "labels.json").exists()
    segment_views(scene, PHOTOS, again, target, soft=soft)  # the label images are there, the rest is not
    assert len(again.sizes) == 4
    segment_views(scene, PHOTOS, again, target, soft=soft)
    assert len(again.sizes) == 4
    (soft / "c" / "d.npz").unlink()
    (target / "a.png").write_bytes(b"damaged")
    segment_views(scene, PHOTOS, again, target, soft=soft, batch=8)
    assert again.sizes[4:] == [[(16, 32), (16, 32)]]


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
    segmenter: Segmenter = Bright()
    with pytest.raises(LabelError, match="a scene without views"):
        segment_views(scene_of({}), [], segmenter, tmp_path / "out")
    same = scene_of({"a.jpg": (16, 32), "a.png": (16, 32)})
    with pytest.raises(LabelError, match="the same name but for the suffix"):
        segment_views(same, PHOTOS, segmenter, tmp_path / "out")
    scene = scene_of({"a.png": (16, 32), "b.png": (16, 32)}, tmp_path)
    Image.new("L", (32, 16), 200).save(tmp_path / "a.png")  # grey
    (tmp_path / "b.png").write_bytes(b"damaged")
    with pytest.raises(SceneError, match=r"b\.png: not readable"):
        segment_views(scene, Photos(scene.views), segmenter, tmp_path / "out")
    assert (tmp_path / "out" / "a.png").exists()


def test_one_pixel(tmp_path: Path) -> None:
    photo = np.full((1, 1, 3), 255, np.uint8)
    segment_views(scene_of({"a.jpg": (1, 1)}), [photo], Bright(), tmp_path / "m", soft=tmp_path / "s")
    ids, p = read_soft(tmp_path / "s" / "a.npz")
    assert ids.ravel().tolist() == [SKY, TREE, -1, -1]
    np.testing.assert_allclose(p.ravel(), [0.8, 0.2, 0, 0], atol=1 / 510)


def test_probabilities_are_stored_at_a_quarter(tmp_path: Path) -> None:
    segment_views(scene_of(SIZES), PHOTOS, Bright(), tmp_path / "masks", soft=tmp_path / "soft")
    ids, p = read_soft(tmp_path / "soft" / "c" / "d.npz")
    assert (ids.dtype, p.dtype, ids.shape) == (np.int16, np.float32, (4, 4, 8))
    assert (ids[0, :2] == SKY).all()
    assert (ids[0, 2:] == TREE).all()
    assert (ids[2:] == -1).all()
    np.testing.assert_allclose(p[:2], np.broadcast_to([[[0.8]], [[0.2]]], (2, 4, 8)), atol=1 / 510)
    # where the network is coarser than that, its pixels are kept
    coarse = np.array([[[0.25, 0.5]]], np.float32)
    write_soft(tmp_path / "x.npz", coarse, np.array([SKY], np.int16), (100, 200))
    ids, p = read_soft(tmp_path / "x.npz")
    assert p.shape == (4, 1, 2)
    np.testing.assert_allclose(p[0], [[0.25, 0.5]], atol=1 / 510)


@settings(max_examples=40, deadline=None)
@given(
    p=hnp.arrays(
        np.float32, hnp.array_shapes(min_dims=3, max_dims=3, max_side=7), elements=st.floats(0, 1, width=32)
    ),
    scale=st.integers(1, 9),
)
def test_the_likeliest_categories_come_back(
    p: np.ndarray, scale: int, tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.mktemp("soft") / "a.npz"
    p = p / max(1, p.sum(0).max())
    ids = np.arange(len(p), dtype=np.int16) * 3
    write_soft(path, p, ids, (p.shape[1] * scale, p.shape[2] * scale))
    found_ids, found = read_soft(path)
    assert (np.diff(found, axis=0) <= 0).all()  # the likeliest first
    assert ((found > 0) == (found_ids >= 0)).all()
    if scale >= 4:  # nothing was averaged
        assert found.shape == (4, *p.shape[1:])
        best = -np.sort(-p, axis=0)[:4]
        np.testing.assert_allclose(found[: len(best)], best, atol=1 / 509)
        rows, columns = np.mgrid[: p.shape[1], : p.shape[2]]
        for of_rank, value in zip(found_ids, found, strict=True):
            known = of_rank >= 0
            np.testing.assert_allclose(
                value[known], p[of_rank[known] // 3, rows[known], columns[known]], atol=1 / 509
            )


def test_no_probability_at_all(tmp_path: Path) -> None:
    write_soft(tmp_path / "a.npz", np.zeros((0, 3, 5), np.float32), np.zeros(0, np.int16), (64, 64))
    ids, p = read_soft(tmp_path / "a.npz")
    assert ids.shape == p.shape == (4, 3, 5)
    assert (ids == -1).all()
    assert not p.any()


def test_damaged_probabilities(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    with pytest.raises(LabelError, match="no such file"):
        read_soft(path)
    path.write_bytes(b"PK damaged")
    with pytest.raises(LabelError, match="not the probabilities"):
        read_soft(path)
    good = {"ids": np.zeros((4, 2, 2), np.int16), "probabilities": np.zeros((4, 2, 2), np.uint8)}
    wrong = (
        {"ids": good["ids"]},
        good | {"ids": np.array([None])},
        good | {"probabilities": np.zeros((4, 2, 3), np.uint8)},
        good | {"probabilities": np.zeros((4, 2, 2), np.float32)},
    )
    for arrays in wrong:
        np.savez(path, allow_pickle=True, **arrays)
        with pytest.raises(LabelError, match="not the probabilities") as caught:
            read_soft(path)
        assert "\n" not in str(caught.value)


def test_groups_and_answers() -> None:
    ids, group = group_classes([SKY, None, TREE, SKY])
    assert ids.tolist() == [-1, TREE, SKY]
    assert group.tolist() == [2, 0, 1, 2]
    p = np.array([[[0.5, 0.1]], [[0.499, 0.899]], [[0.001, 0.001]]], np.float32)
    found = answer(p, p, ids, 2, 4)
    assert found.label_ids.tolist() == [[-1, TREE, TREE, TREE]] * 2  # 0.4 to 0.6 a quarter of the way
    assert found.ids.tolist() == [TREE]  # sky is less than 8 bits show
    assert found.probabilities is not None
    np.testing.assert_array_equal(found.probabilities, p[1:2])


def test_names_of_devices() -> None:
    assert parse_device("auto") == ("auto", 0)
    assert parse_device("cpu") == ("cpu", 0)
    assert parse_device("cuda") == ("cuda", 0)
    assert parse_device("cuda:12") == ("cuda", 12)
    for wrong in ("", "gpu", "cuda:", "cuda:-1", "cuda:1 ", "CPU"):
        with pytest.raises(BackendUnavailable, match="is not known"):
            parse_device(wrong)


def test_the_marker_is_plain(tmp_path: Path) -> None:
    segment_views(scene_of({"a.jpg": (16, 32)}), PHOTOS[:1], Bright(), tmp_path)
    marker = json.loads((tmp_path / ".taxonomy.json").read_text())
    assert marker == {"184": "tree-merged", "187": "sky-other-merged"}


@settings(max_examples=60, deadline=None)
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
