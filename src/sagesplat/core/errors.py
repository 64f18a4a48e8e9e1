"""Errors that a user can cause. Each message is one line: the path, what is wrong, what to do."""

import re

from sagesplat.core.names import visible

_LINE_ENDS = re.compile(r"[\t-\r\x1c-\x1f\x85\u2028\u2029]")
_LONGEST = 2500  # characters of a message


class SageError(Exception):
    """Base class of the errors that the CLI prints as one line, with exit code 2.

    Its text is one printable line, whatever it was made of: files and servers decide on parts of many.
    """

    def __str__(self) -> str:
        text = super().__str__()
        if not text.isprintable():
            text = visible(_LINE_ENDS.sub(" ", text))
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


def short(value: object) -> str:
    """The text of a value or an error for a one-line message: printable, at most about 200 characters."""
    text = str(value) if str(value).isprintable() else repr(str(value))
    return text if len(text) <= 200 else f"{text[:110]}...{text[-80:]}"
