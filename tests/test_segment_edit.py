"""Merging, keeping and folding categories: on tables, on arrays, on a folder of masks, killed half-way."""

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from sagesplat.core.errors import LabelError
from sagesplat.scene.scene import Camera, View
from sagesplat.segment import edit
from sagesplat.segment.edit import (
    count_pixels,
    edit_labels,
    edit_table,
    fold_table,
    parse_merge,
    parse_names,
)
from sagesplat.segment.masks import Masks, Taxonomy, mask_path, write_labels, write_mask

CAR, PLANT, VASE, TREE = 3, 64, 86, 184
TAXONOMY = Taxonomy({CAR: "car", PLANT: "potted plant", VASE: "vase", TREE: "tree-merged"})
IMAGES = [  # 16 pixels
    [[CAR, CAR, PLANT, VASE], [TREE, TREE, -1, -1]],
    [[CAR, TREE, TREE, TREE], [TREE, PLANT, PLANT, -1]],
]


def _folder(folder: Path, images: list[list[list[int]]] = IMAGES) -> list[View]:
    camera = Camera(np.eye(4, dtype=np.float32), np.eye(3, dtype=np.float32), 4, 2)
    views = [View(f"{i}.jpg", camera, Path(f"{i}.jpg")) for i in range(len(images))]
    for view, image in zip(views, images, strict=True):
        write_mask(mask_path(folder, view), np.array(image, np.int16), TAXONOMY)
    write_labels(folder, TAXONOMY, set(TAXONOMY.names))
    return views


def _read(folder: Path, views: list[View]) -> list[list[list[int]]]:
    masks = Masks(folder, Taxonomy.read(folder / "labels.json"))
    return [masks[view].tolist() for view in views]


def _bytes(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_forms_of_the_command_line() -> None:
    assert parse_names(" grass-merged, tree-merged,grass-merged", "keep") == ("grass-merged", "tree-merged")
    assert parse_names(" ", "keep") == ()
    assert parse_merge("plant=tree-merged, vase = plant") == {"plant": "tree-merged", "vase": "tree-merged"}
    assert parse_merge("potted plant=vase") == {"potted plant": "vase"}
    assert parse_merge("") == {}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("plant", "merge 'plant': not of the form FROM=INTO"),
        ("a=b=c", "merge 'a=b=c': not"),
        ("a=b,a=c", "merge: a goes into b and into c"),
        ("x=a,a=b,b=a", "merge: x = a = b = a is a circle"),
    ],
)
def test_merges_that_are_refused(text: str, message: str) -> None:
    with pytest.raises(LabelError) as error:
        parse_merge(text)
    assert str(error.value).startswith(message)


def test_merge_and_keep_as_a_table() -> None:
    taxonomy, table = edit_table(TAXONOMY, keep=("tree-merged",), merge={"vase": "potted plant"})
    assert taxonomy.names == {TREE: "tree-merged"}
    label_ids = np.array([[CAR, PLANT, VASE, TREE, -1]], np.int16)
    assert table[label_ids].tolist() == [[-1, -1, -1, TREE, -1]]
    taxonomy, table = edit_table(TAXONOMY, merge={"vase": "potted plant", "potted plant": "tree-merged"})
    assert taxonomy.names == {CAR: "car", TREE: "tree-merged"}
    new = table[label_ids]
    assert new.tolist() == [[CAR, TREE, TREE, TREE, -1]]
    assert new.dtype == np.int16


def test_new_names_get_ids_that_are_free() -> None:
    taxonomy, table = edit_table(
        Taxonomy({CAR: "car", 2: "x", 187: "y", 201: "z"}),
        merge={"car": "sky-other-merged", "x": "road", "y": "greenery"},
    )
    assert taxonomy.names == {149: "road", 201: "z", 202: "sky-other-merged", 203: "greenery"}
    assert table[[CAR, 2, 187, 201, -1]].tolist() == [202, 149, 203, 201, -1]
    busy = Taxonomy({i: str(i) for i in range(201, 255)})
    assert 256 in edit_table(busy, merge={"201": "new"})[0].names  # 255 is unlabelled in 8-bit files


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"keep": ["tre-merged"]},
            "keep: no category 'tre-merged'; did you mean tree-merged? there are car, ",
        ),
        ({"merge": {"cars": "vase"}}, "merge: no category 'cars'; did you mean car? there are car, potted"),
        ({"keep": ["vase"], "merge": {"vase": "car"}}, "keep: vase is merged into car; keep that"),
        ({"min_share": 1.5}, "min_share 1.5 is no share"),
        ({"min_share": 0.9}, "no category with pixels and at least 0.9 of them is left of car, potted"),
    ],
)
def test_what_cannot_be_done_is_one_line_and_writes_nothing(
    tmp_path: Path, options: dict, message: str
) -> None:
    views = _folder(tmp_path)
    before = _bytes(tmp_path)
    with pytest.raises(LabelError) as error:
        edit_labels(tmp_path, views, **options)
    assert str(error.value).startswith(message)
    assert _bytes(tmp_path) == before


def test_pixels_are_counted_and_rare_categories_folded() -> None:
    counts = sum(count_pixels(np.array(image, np.int16), TAXONOMY) for image in IMAGES)
    assert isinstance(counts, np.ndarray)
    assert counts[[CAR, PLANT, VASE, TREE, -1]].tolist() == [3, 3, 1, 6, 3]
    assert counts.sum() == 16
    taxonomy, table = fold_table(TAXONOMY, counts, 3 / 16)
    assert list(taxonomy.names) == [CAR, PLANT, TREE]  # the bound itself stays
    assert table[[CAR, PLANT, VASE, TREE, -1]].tolist() == [CAR, PLANT, -1, TREE, -1]


def test_a_folder_is_merged_kept_and_folded_in_this_order(tmp_path: Path) -> None:
    views = _folder(tmp_path / "in")
    heard: list[tuple[int, int]] = []
    edited = edit_labels(
        tmp_path / "in", views, tmp_path / "out",
        merge={"vase": "potted plant"}, keep=["potted plant", "tree-merged"], min_share=5 / 16,
        on_view=lambda *progress: heard.append(progress),
    )  # fmt: skip
    assert _read(tmp_path / "in", views) == IMAGES
    assert edited.taxonomy.names == {TREE: "tree-merged"}
    assert _read(tmp_path / "out", views) == [
        [[-1] * 4, [TREE, TREE, -1, -1]],
        [[-1, TREE, TREE, TREE], [TREE, -1, -1, -1]],
    ]
    assert heard == [(1, 4), (2, 4), (3, 4), (4, 4)]
    assert edited.record == {
        "merge": {"vase": "potted plant"}, "keep": ["potted plant", "tree-merged"], "ignore": [],
        "min_share": 5 / 16,
        "shares": {"tree-merged": 6 / 16}, "dropped": {"car": 3 / 16}, "folded": {"potted plant": 4 / 16},
    }  # fmt: skip
    assert json.loads(json.dumps(edited.record)) == edited.record


def test_a_killed_edit_in_place_is_finished_by_the_next(tmp_path: Path, monkeypatch) -> None:
    options = {"merge": {"vase": "pot"}, "keep": ["pot", "tree-merged"], "min_share": 1 / 16}
    views = _folder(tmp_path / "a")
    _folder(tmp_path / "b")
    edit_labels(tmp_path / "a", views, **options)

    def killed(path: Path, *rest: object) -> None:
        if path.stem == "1":
            raise KeyboardInterrupt
        write_mask(path, *rest)  # type: ignore[arg-type]

    with monkeypatch.context() as patch:
        patch.setattr(edit, "write_mask", killed)
        with pytest.raises(KeyboardInterrupt):
            edit_labels(tmp_path / "b", views, **options)
    assert _read(tmp_path / "b", views)[1] == IMAGES[1]  # the folder can be read
    edit_labels(tmp_path / "b", views, **options)
    assert _bytes(tmp_path / "a") == _bytes(tmp_path / "b")


@given(st.lists(st.sampled_from([CAR, PLANT, VASE, TREE, -1]), min_size=1, max_size=30))
def test_an_edit_done_twice_is_an_edit_done_once(pixels: list[int]) -> None:
    label_ids = np.array(pixels, np.int16)
    _, table = edit_table(TAXONOMY, merge={"vase": "potted plant"}, keep=["potted plant", "car"])
    once = table[label_ids]
    assert (table[once] == once).all()
    assert ((once == -1) == np.isin(label_ids, [-1, TREE])).all()


def test_masks_that_cannot_be_read_write_nothing(tmp_path: Path) -> None:
    views = _folder(tmp_path)
    Image.new("L", (3, 2)).save(tmp_path / "1.png")
    before = _bytes(tmp_path)
    with pytest.raises(LabelError, match="unknown ids 0"):
        edit_labels(tmp_path, views, merge={"vase": "potted plant"})
    (tmp_path / "labels.json").unlink()
    del before["labels.json"]
    with pytest.raises(LabelError, match=r"labels\.json: no such file"):
        edit_labels(tmp_path, views)
    assert _bytes(tmp_path) == before


def test_merging_into_unlabelled() -> None:
    taxonomy, table = edit_table(TAXONOMY, merge={"vase": "unlabelled"})
    assert VASE not in taxonomy.names
    assert table[VASE] == -1


def test_merging_before_folding_saves_the_rare(tmp_path: Path) -> None:
    views = _folder(tmp_path)
    edited = edit_labels(tmp_path, views, merge={"vase": "pot"}, min_share=0.1)
    assert edited.folded == {"pot": 1 / 16}
    views = _folder(tmp_path)
    edited = edit_labels(tmp_path, views, merge={"vase": "potted plant"}, min_share=0.2)
    assert edited.shares == {"potted plant": 4 / 16, "tree-merged": 6 / 16}
    assert edited.folded == {"car": 3 / 16}
    assert not edited.dropped
