"""Errors that a user can cause. Each message is one line: the path, what is wrong, what to do."""


class SageError(Exception):
    """Base class of the errors that the CLI prints as one line, with exit code 2."""


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
