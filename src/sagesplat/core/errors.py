"""Errors a user can cause. Each message is one line: the path, what is wrong, the cure."""


class SageError(Exception):
    """Base of every error that the command line prints as one line with exit code 2."""


class SceneError(SageError):
    """A capture (photos, poses, points) that cannot be read."""


class LabelError(SageError):
    """Label images or a taxonomy that cannot be used."""


class RunError(SageError):
    """A run folder that does not fit what is asked of it."""


class DataError(SageError):
    """A file of Gaussians or a table with content that cannot be used."""


class BackendUnavailable(SageError):
    """A named backend or optional dependency that this machine does not have."""


class OutOfMemory(SageError):
    """The GPU has too little memory for what is asked of it."""


def short(value: object) -> str:
    """What an error says, or a value of a file, as part of one line: clipped, without line ends."""
    text = str(value) if str(value).isprintable() else repr(str(value))
    return text if len(text) <= 200 else f"{text[:110]}...{text[-80:]}"
