import pytest

from sagesplat.core.errors import LabelError
from sagesplat.segment import coco
from sagesplat.segment.display_names import title_of
from sagesplat.segment.prompts import Prompt, meaning, parse_prompts, prompts_of


def test_prompts_are_separated_by_semicolons() -> None:
    assert parse_prompts(" stone fountain; ivy ;wooden bench; ") == ("stone fountain", "ivy", "wooden bench")
    assert parse_prompts("喷泉; лавка; a <b>bold</b> one; St. Mary's well?") == (
        "喷泉", "лавка", "a <b>bold</b> one", "St. Mary's well?",
    )  # fmt: skip
    assert parse_prompts("cafe\u0301") == ("caf\u00e9",)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("", "one is empty"),
        ("ivy;;tree", "one is empty"),
        ("fountain, ivy", "',' cannot be part of a category; separate prompts by ;"),
        ("iv\x1b[31my", r"control or invisible character, U\+001B"),
        ("unlabelled", "names nothing that could be seen"),
        ("ivy; stone; Ivy", "'ivy' and 'Ivy' mean the same; leave one of them"),
        ("the  Ivy; ivy", "'the  Ivy' and 'ivy' mean the same"),
        ("building-other-merged; ivy; Buildings", "'building-other-merged' and 'Buildings' mean"),
    ],
)
def test_prompts_that_cannot_be(text: str, complaint: str) -> None:
    with pytest.raises(LabelError, match=complaint) as caught:
        parse_prompts(text)
    assert len(str(caught.value)) < 500


def test_the_meaning_of_words() -> None:
    assert meaning("The Wooden_Benches") == "wooden benche"
    assert meaning("grass") == "grass"
    assert meaning("bus") == "bus"
    assert meaning("the") == "the"
    assert meaning("Straße") == meaning("STRASSE")
    shown = {meaning(title_of(name)) for name in coco.NAMES.values()}
    assert len(shown) == len(coco.NAMES)  # no category of COCO is mistaken for another


def test_prompts_that_coco_has_are_cocos_and_others_get_free_ids() -> None:
    assert prompts_of(["stone fountain", "Trees", "chair", "ivy"], {}) == [
        Prompt("stone fountain", "stone fountain", 201),
        Prompt("Trees", "tree-merged", 184),
        Prompt("chair", "chair", 62),
        Prompt("ivy", "ivy", 202),
    ]


def test_ids_beside_those_of_another_segmenter() -> None:
    base = {201: "Ivy", 62: "couch of mine", 184: "tree-merged", 7: "lawn"}
    found = prompts_of(["ivy", "chair", "tree", "lawns", "fountain"], base)
    assert [(p.name, p.label_id) for p in found] == [
        ("Ivy", 201), ("chair", 202), ("tree-merged", 184), ("lawn", 7), ("fountain", 203),
    ]  # fmt: skip


def test_255_is_no_id_of_a_prompt() -> None:
    ids = [prompt.label_id for prompt in prompts_of([f"thing {i}" for i in range(100)], {})]
    assert ids == [*range(201, 255), *range(256, 302)]
