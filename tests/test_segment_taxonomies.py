"""Classes of training sets in COCO panoptic: counts, official order, the well-known ones, wild spellings."""

import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sagesplat.core.errors import LabelError
from sagesplat.segment import coco
from sagesplat.segment.taxonomies import SOURCES, Source, guess_source, to_coco, vocabulary

MODELS = Path(__file__).resolve().parents[2] / "shared" / "models"
COUNTS: dict[Source, int] = {"coco": 133, "coco-stuff": 171, "ade20k": 150, "cityscapes": 19}
VOID_IN_COCO = {
    "furniture-other", "metal", "plastic", "solid-other", "structural-other", "waterdrops", "textile-other",
    "cloth", "clothes", "plant-other", "wood", "ground-other",
}  # fmt: skip


def _ids(source: Source) -> dict[str, int | None]:
    names = vocabulary(source)
    return dict(zip(names, to_coco(names, source), strict=True))


def _names(source: Source) -> dict[str, str | None]:
    return {name: None if i is None else coco.NAMES[i] for name, i in _ids(source).items()}


@pytest.mark.parametrize("source", SOURCES)
def test_classes_are_all_there_once_and_known(source: Source) -> None:
    names = vocabulary(source)
    assert len(names) == len(set(names)) == COUNTS[source]
    assert all(name == name.strip() and "," not in name for name in names)
    assert {i for i in to_coco(names, source) if i is not None} <= coco.NAMES.keys()
    assert guess_source(names) == source
    assert to_coco(names) == to_coco(names, source)


def test_coco_stuff_merges_as_coco_panoptic() -> None:
    merged = _names("coco-stuff")
    assert {name for name, target in merged.items() if target is None} == VOID_IN_COCO
    assert set(merged.values()) - {None} == set(coco.NAMES.values())  # every category comes from somewhere
    by_target: dict[str, set[str]] = {}
    for name, target in merged.items():
        if target not in (None, name):
            by_target.setdefault(str(target), set()).add(name)
    assert all(target.endswith("-merged") for target in by_target)
    assert by_target["sky-other-merged"] == {"clouds", "sky-other", "fog"}
    assert by_target["tree-merged"] == {"branch", "tree", "bush", "leaves"}
    assert by_target["pavement-merged"] == {"floor-stone", "pavement"}
    assert by_target["grass-merged"] == {"moss", "grass", "straw"}
    assert sum(map(len, by_target.values())) == 43
    assert sum(name.endswith("-merged") for name in coco.NAMES.values()) == len(by_target) == 17


@pytest.mark.parametrize(
    ("source", "name", "target"),
    [
        ("ade20k", "stairway", "stairs"),
        ("ade20k", "television receiver", "tv"),
        ("ade20k", "pole", None),
        ("cityscapes", "vegetation", "tree-merged"),
        ("cityscapes", "traffic sign", None),
        ("coco-stuff", "wall-brick", "wall-brick"),
    ],
)
def test_well_known_ones(source: Source, name: str, target: str | None) -> None:
    (label_id,) = to_coco([name], source)
    assert (None if label_id is None else coco.NAMES[label_id]) == target


@pytest.mark.parametrize("name", ["Sky_Other", " sky  other ", "sky other, heavens"])
def test_spelling_does_not_matter(name: str) -> None:
    assert to_coco([name], "coco-stuff") == [187]


def test_synonyms_of_others_and_names_without_a_source() -> None:
    assert to_coco(["windowpane, window", "window", "earth, ground"], "ade20k") == [181, 181, 194]
    assert to_coco(["background", "nonsense", ""], "ade20k") == [None, None, None]
    mixed = ["vegetation", "sky-other", "windowpane", "nonsense", "more of it"]  # of no single set
    assert guess_source(mixed) is None
    assert to_coco(mixed) == [184, 187, 181, None, None]


def test_agrees_with_the_published_network() -> None:
    path = MODELS / "ade32.json"
    if not path.exists():
        pytest.skip(f"needs {path}")
    table = json.loads(path.read_text(encoding="utf-8"))["coco_panoptic"]
    del table["others"]
    assert dict(zip(table, to_coco(list(table), "ade20k"), strict=True)) == table


def test_agrees_with_coco_s_own_list() -> None:
    path = MODELS / "coco_panoptic" / "panoptic_coco_categories.json"
    if not path.exists():
        pytest.skip(f"needs {path}")
    categories = json.loads(path.read_text(encoding="utf-8"))
    assert to_coco([c["name"] for c in categories], "coco") == [c["id"] for c in categories]
    assert tuple(c["name"] for c in categories if c["isthing"]) == vocabulary("coco-stuff")[:80]


def test_coco_is_itself() -> None:
    assert to_coco(vocabulary("coco")) == sorted(coco.NAMES)


def test_coco_stuff_has_the_official_order() -> None:
    names = vocabulary("coco-stuff")
    assert names[:80] == vocabulary("coco")[:80]
    assert names[80:] == tuple(sorted(names[80:]))
    order = {
        0: "person",
        79: "toothbrush",
        80: "banner",
        94: "clouds",
        145: "sky-other",
        157: "tree",
        170: "wood",
    }
    assert {i: names[i] for i in order} == order


def test_ade20k_has_the_official_order() -> None:
    names = vocabulary("ade20k")
    order = {
        0: "wall",
        2: "sky",
        9: "grass",
        19: "chair",
        25: "house",
        66: "flower",
        89: "television",
        149: "flag",
    }
    assert {i: names[i] for i in order} == order


@given(st.text(max_size=20), st.sampled_from(SOURCES))
def test_any_text_is_a_category_or_none(name: str, source: Source) -> None:
    (label_id,) = to_coco([name], source)
    assert label_id is None or label_id in coco.NAMES


def test_an_unknown_source_is_one_line() -> None:
    with pytest.raises(LabelError, match=r"^vocabulary 'voc' is not known; use one of coco, coco-stuff, "):
        vocabulary("voc")  # type: ignore[arg-type]
    with pytest.raises(LabelError, match="'voc' is not known"):
        to_coco(["sky"], "voc")  # type: ignore[arg-type]
