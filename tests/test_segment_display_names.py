"""Names of categories, for people."""

import pytest

from sagesplat.segment.coco import NAMES
from sagesplat.segment.display_names import meant, title_of, titles


@pytest.mark.parametrize(
    ("name", "title"),
    [
        ("grass-merged", "grass"), ("building-other-merged", "building"), ("sky-other-merged", "sky"),
        ("door-stuff", "door"), ("wall-brick", "wall brick"), ("dining table", "dining table"),
    ],
)  # fmt: skip
def test_titles(name: str, title: str) -> None:
    assert title_of(name) == title


def test_names_that_become_the_same_stay_as_they_are() -> None:
    names = {1: "wall-other-merged", 2: "wall", 3: "grass-merged", -1: "unlabelled"}
    assert titles(names) == {1: "wall-other-merged", 2: "wall", 3: "grass", -1: "unlabelled"}


def test_no_two_of_cocos_share_a_title() -> None:
    shown = titles(NAMES).values()
    assert len(set(shown)) == len(NAMES)
    assert not [title for title in shown if "-" in title]


def test_what_is_typed_is_a_name_or_its_title() -> None:
    names = ("grass-merged", "wall-other-merged", "wall", "wall-wood", "wall wood")
    assert meant("grass-merged", names) == "grass-merged"
    assert meant("grass", names) == "grass-merged"
    assert meant("wall", names) == "wall"
    assert meant("sky", names) == "sky"
    assert meant("floor", ("floor-wood", "floor-merged", "floor-stuff")) == "floor"  # of two, none
