"""What a name may be, and what of it reaches file names and the terminal."""

import re
import unicodedata

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sagesplat.core.names import (
    LENGTH,
    check_photo,
    checked,
    clipped,
    collision_key,
    repaired,
    slugs,
    visible,
)

ANY = st.text(st.characters(), max_size=130)  # surrogates and control characters too
AWKWARD = (
    *("[/red]", '=HYPERLINK("x")', "$x^2$", "_grass", "a|b & c_%", "日本語", "é", "🚗", "❤️", "x" * 100),
    *(r"\path", "<b>", "a@3", "-merged", ":car:", "*", "🚗" * 100),
)


@pytest.mark.parametrize("name", AWKWARD)
def test_awkward_names_are_names(name: str) -> None:
    assert checked(name) == unicodedata.normalize("NFC", name)


@pytest.mark.parametrize(
    ("name", "why"),
    [
        (3, "no text"), (None, "no text"), ("", "blank"), (" ", "blank"), ("\u3164\u2800", "blank"),
        ("\u0301", "blank"), (" a", "space"), ("a\u00a0", "space"), ("x" * 101, "101 characters"),
        ("\x9b", "U+009B"), ("a\u202eb", "U+202E"), ("a\u2066b", "U+2066"), ("a\u200bb", "U+200B"),
        ("a\nb", "U+000A"), ("a\ud800", "not UTF-8"),
    ],
)  # fmt: skip
def test_what_is_no_name(name: object, why: str) -> None:
    with pytest.raises(ValueError, match=re.escape(why)):
        checked(name)


def test_both_ways_of_writing_an_accent_are_one_name() -> None:
    assert checked("e\u0301") == checked("\u00e9") == "\u00e9"
    assert checked("e\u0301" * LENGTH) == "\u00e9" * LENGTH


@pytest.mark.parametrize(
    "name", ["a.jpg", "sub dir/Screenshot 10.00.00\u202fAM.png", " a.jpg", "e\u0301.png"]
)
def test_names_of_photos_are_those_of_the_disk(name: str) -> None:
    check_photo(name)


@pytest.mark.parametrize("name", ["", "/a.jpg", "../a.jpg", "a\udce9.jpg", "a\x1b.jpg", "x" * 251, "日" * 84])
def test_what_is_no_photo(name: str) -> None:
    with pytest.raises(ValueError, match="it "):
        check_photo(name)


@given(ANY)
def test_what_is_repaired_is_a_name(name: str) -> None:
    fixed = repaired(name)
    assert len(fixed.encode()) <= 250
    check_photo(fixed.replace("/", "_").replace("..", "_"))
    assert repaired(fixed) == fixed


@given(ANY)
def test_a_name_that_may_be_is_not_repaired(name: str) -> None:
    try:
        name = checked(name)
    except ValueError:
        return
    if name.strip("."):
        assert name.startswith(repaired(name))
    else:  # a folder
        assert repaired(name) == "scene"


@given(ANY, st.integers(0, 300))
def test_clipping_counts_bytes(text: str, nbytes: int) -> None:
    assert len(clipped(text, nbytes).encode("utf-8", "ignore")) <= nbytes


def test_disks_that_know_no_capitals_take_these_for_one() -> None:
    assert collision_key("É.png") == collision_key("e\u0301.PNG")
    assert collision_key("a") != collision_key("b")


@given(st.lists(ANY, unique=True, max_size=8))
def test_slugs_are_short_and_distinct(names: list[str]) -> None:
    found = slugs(dict(enumerate([*names, "tree", "Tree", "tree--1", "日本語"])))
    assert len(set(found.values())) == len(found)
    assert all(re.fullmatch(r"[a-z0-9-]{1,66}", slug) for slug in found.values())


@given(ANY)
def test_what_a_terminal_gets_is_printable(text: str) -> None:
    shown = visible(text)
    assert all(c.isprintable() or unicodedata.category(c) == "Zs" for c in shown)
    shown.encode()
    assert visible(shown) == shown


def test_escapes_are_pythons() -> None:
    assert visible("[a] \x1b[31m\x9b\u202e\n\udce9 é 日") == r"[a] \x1b[31m\x9b\u202e\n\xe9 é 日"
