import pytest

from sagesplat.core.errors import DataError, short


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("a.ply: wrong; do this", "a.ply: wrong; do this"),
        ("a\nb\tc\u2028d", "a b c d"),
        ("\x1b[31mred \x00\x9b \u202e", "\\x1b[31mred \\x00\\x9b \\u202e"),
        ("\udcff and \ud800", "\\xff and \\ud800"),
        ("Straße 東京, 3.41\u202fPM.png", "Straße 東京, 3.41\u202fPM.png"),
    ],
)
def test_messages_are_one_printable_line(text: str, shown: str):
    assert str(DataError(text)) == shown


def test_messages_have_an_end():
    text = str(DataError("x" * 10**6 + "; do this"))
    assert len(text) < 3000
    assert text.endswith("; do this")


def test_values_in_messages_are_short():
    assert short("a\nb") == repr("a\nb")
    assert len(short("x" * 999)) <= 200
