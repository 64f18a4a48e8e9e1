"""The command line: one short function per command, each loads, calls and saves."""

import os
import sys
from collections.abc import Callable
from typing import NoReturn

from sagesplat import __version__
from sagesplat.core import signals


def commands() -> dict[str, Callable[..., None]]:
    """All commands by name. Loading them takes longer than printing their overview, which does not."""
    from sagesplat.cli import stages, studies, tools  # noqa: F401  (their commands register themselves)
    from sagesplat.cli.base import COMMANDS

    return COMMANDS


def main() -> None:
    """Run a command; errors that a user can cause are one line and exit code 2."""
    from sagesplat.cli.say import print_any_character

    print_any_character()
    try:
        _run(*sys.argv[1:] or ["--help"])
        sys.stdout.flush()
    except BrokenPipeError:  # such as `| head`; Python flushes once more at its end
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _run(name: str, *words: str) -> None:
    if name == "--version":
        print(f"sagesplat {__version__}")
    elif name in ("-h", "--help"):
        from sagesplat.cli.overview import overview

        print(overview())
    else:
        _command(name, *words)


def _command(name: str, *words: str) -> None:
    from sagesplat.cli.help import help_of
    from sagesplat.cli.parse import arguments
    from sagesplat.core.errors import SageError
    from sagesplat.core.memory import named_memory

    known = commands()
    if name not in known:
        _fail(f"no command {name!r}; there are {', '.join(known)}")
    function = known[name]
    if {"-h", "--help", "--help-all"} & set(words):
        print(help_of(name, function, everything="--help-all" in words))
        return
    try:
        with named_memory(f"sagesplat {name}"):
            function(**arguments(name, function, list(words)))
    except SageError as error:
        _fail(str(error))
    except (KeyboardInterrupt, SystemError) as error:
        signals.leave(error)
    except BrokenPipeError:
        raise
    except OSError as error:
        from sagesplat.io.files import CURES

        where = error.filename or "input/output"
        cure = CURES.get(error.errno or 0, "check the path, its rights and the disk")
        _fail(f"{where}: {error.strerror or error}; {cure}")


def _fail(message: str) -> NoReturn:
    from sagesplat.cli.say import say

    say(f"sagesplat: {' '.join(message.split())}", file=sys.stderr)
    raise SystemExit(2)
