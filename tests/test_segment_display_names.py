"""Names of categories for people."""

import pytest

from sagesplat.segment.coco import NAMES
from sagesplat.segment.display_names import titles


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (["grass-merged", "building-other-merged", "vase"], ["grass", "building", "vase"]),
        (["grass-merged", "grass", "vase"], ["grass-merged", "grass", "vase"]),
        (["grass-merged@0", "grass-merged@12", "unlabelled@0"], ["grass@0", "grass@12", "unlabelled@0"]),
        (["grass-merged@0", "grass@0", "grass@1"], ["grass-merged@0", "grass@0", "grass@1"]),
        ([], []),
    ],
)
def test_titles_are_short_unless_two_would_be_equal(names: list[str], expected: list[str]) -> None:
    assert titles(dict(enumerate(names))) == dict(enumerate(expected))


def test_no_two_of_cocos_share_a_title() -> None:
    shown = titles(NAMES).values()
    assert len(set(shown)) == len(NAMES)
    assert not [title for title in shown if "-" in title]
