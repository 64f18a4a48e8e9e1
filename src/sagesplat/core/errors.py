"""Errors that a user can cause. Each message is one line: the path, what is wrong, what to do."""

import unicodedata

_LONGEST = 2500  # characters of a message


class SageError(Exception):
    """Base class of the errors that the CLI prints as one line, with exit code 2.

    Its text is one printable line, whatever it was made of: files and servers decide on parts of many.
    """

    def __str__(self) -> str:
        text = super().__str__()
        if not text.isprintable():
            text = "".join(_shown(c) for c in text)
        return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 520]}...{text[-500:]}"


class SceneError(SageError):
    """A capture (photos, poses, points) that cannot be read."""


class LabelError(SageError):
    """Label images or a taxonomy that are invalid."""


class RunError(SageError):
    """A run folder or setting that does not allow the requested operation."""


class DataError(SageError):
    """A file of Gaussians or a table with invalid content."""


class BackendUnavailable(SageError):
    """A requested backend or optional dependency that is not available."""


class OutOfMemory(SageError):
    """Too little memory, of the machine or its GPU, for the requested operation."""


def _shown(c: str) -> str:
    """A character as it may be printed. Spaces stay what they are: macOS has narrow ones in names."""
    if c.isprintable() or unicodedata.category(c) == "Zs":
        return c
    return " " if c.isspace() else c.encode("unicode_escape").decode()


def short(value: object) -> str:
    """The text of a value or an error for a one-line message: printable, at most about 200 characters."""
    text = str(value) if str(value).isprintable() else repr(str(value))
    return text if len(text) <= 200 else f"{text[:110]}...{text[-80:]}"
