"""What a name may be: of a category, a photo, a scene; and how names become parts of file names.

Names come from other people's files. They are checked where they are read and not again.
"""

import re
import unicodedata
from collections import Counter
from collections.abc import Mapping
from pathlib import PurePosixPath

LENGTH = 100  # characters of a name, at most
RULE = f"a name has 1 to {LENGTH} printable characters and no space at its ends"
_PART_BYTES = 250  # of a part of a path; disks take 255, and a suffix may be added
_SLUG = 60  # characters of a slug, at most
_FILLERS = "\u115f\u1160\u2800\u3164\uffa0"  # letters and symbols that look like a space


def checked(name: object) -> str:
    """The name in Unicode's composed form (NFC).

    Raises ValueError, which says why, for what is no text, blank, longer than `LENGTH` characters or has a
    space at an end; for control characters, lone surrogates, line separators, and for invisible characters
    such as those that reverse the direction of writing.
    """
    if not isinstance(name, str):
        raise ValueError("it is no text")
    if len(name) > 4 * LENGTH:  # composing never makes it so much shorter
        raise ValueError(f"it has {len(name)} characters")
    name = composed(name)
    _check_characters(name)
    if not any(unicodedata.category(c)[0] in "LNPS" and c not in _FILLERS for c in name):
        raise ValueError("it is blank")
    if name != name.strip():
        raise ValueError("it begins or ends with a space")
    if len(name) > LENGTH:
        raise ValueError(f"it has {len(name)} characters")
    return name


def composed(name: str) -> str:
    """A name as `checked` has it: what is typed may hold an accent as a character of its own."""
    return unicodedata.normalize("NFC", name)


def check_photo(name: str) -> None:
    """ValueError, which says why, for the name of a photo that cannot be used.

    It is a path below the folder of the photos, as it is on the disk: not composed, and of any length that a
    disk takes.
    """
    _check_characters(name)
    path = PurePosixPath(name)
    if path.is_absolute() or ".." in path.parts or not path.parts:
        raise ValueError("it names nothing in the folder of the photos")
    longest = max(len(part.encode()) for part in path.parts)
    if longest > _PART_BYTES:
        raise ValueError(f"a part of it has {longest} bytes, more than {_PART_BYTES}")


def _check_characters(name: str) -> None:
    wrong = None if name.isprintable() else next((c for c in name if not _is_shown(c)), None)
    if wrong is not None and "\ud800" <= wrong <= "\udfff":
        raise ValueError("it is not UTF-8")
    if wrong is not None:
        raise ValueError(f"it holds a control or invisible character, U+{ord(wrong):04X}")


def repaired(name: str, otherwise: str = "scene") -> str:
    """A name that may be, for what is only shown or for a file of our own: `_` for what is wrong in it.

    Names of nothing but dots, which would be folders, become `otherwise`.
    """
    name = cleaned(composed(name[: 4 * LENGTH]))
    name = clipped(name[:LENGTH], _PART_BYTES).strip()
    return name if name.strip(".") else otherwise


def cleaned(text: str) -> str:
    """The text with `_` for control characters, invisible ones and bytes that are not UTF-8."""
    return text if text.isprintable() else "".join(c if _is_shown(c) else "_" for c in text)


def clipped(text: str, nbytes: int) -> str:
    """As much of the beginning of a text as has `nbytes` bytes in UTF-8."""
    return text.encode("utf-8", "surrogatepass")[:nbytes].decode("utf-8", "ignore")


def collision_key(name: str) -> str:
    """The same for names that some disk takes for one: those that differ in case or in composition."""
    return composed(composed(name).casefold())


def slugs(names: Mapping[int, str]) -> dict[int, str]:
    """By label id, a name as a part of a file name: a-z, 0-9 and -, at most 60 of them.

    No two are the same: where nothing is left of a name, too much, or what is left of another one too, the
    label id follows after "--", which is in no other slug.
    """
    plain = {label: re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-") for label, name in names.items()}
    times = Counter(plain.values())
    return {
        label: slug if 0 < len(slug) <= _SLUG and times[slug] == 1 else f"{slug[:_SLUG].strip('-')}--{label}"
        for label, slug in plain.items()
    }


def visible(text: str) -> str:
    """A text for a terminal: escapes such as \\x1b for control characters and all else that is not printable.

    A terminal would obey these, and cannot be sent the bytes of a path that is not UTF-8.
    """
    if text.isprintable():
        return text
    return "".join(c if _is_shown(c) else _escape(c) for c in text)


def _is_shown(c: str) -> bool:
    """Whether a character shows, or is a space (such as macOS has in the names of screenshots)."""
    return c.isprintable() or unicodedata.category(c) == "Zs"


def _escape(c: str) -> str:
    byte = ord(c) - 0xDC00  # of a path that is not UTF-8, if it is one
    return f"\\x{byte:02x}" if 0x80 <= byte <= 0xFF else repr(c)[1:-1]
