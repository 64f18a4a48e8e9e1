"""Lines for the terminal."""

import sys
from typing import TextIO

from sagesplat.core.names import visible


def say(*lines: object, file: TextIO | None = None) -> None:
    """Print lines that may hold names and paths: what a terminal would obey is shown (`names.visible`)."""
    print(*(visible(str(line)) for line in lines), sep="\n", file=file, flush=True)


def print_any_character() -> None:
    """Let standard output show as an escape what its encoding does not have, rather than fail."""
    reconfigure = getattr(sys.stdout, "reconfigure", None)  # what a test or a notebook puts there has none
    if reconfigure is not None:
        reconfigure(errors="backslashreplace")
