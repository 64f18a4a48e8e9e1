"""The command line: one short function per command, each loads, calls and saves."""

import os
import shutil
import sys
import textwrap
from typing import NoReturn

from sagesplat import __version__
from sagesplat.cli import stages, studies, tools  # noqa: F401  (their commands register themselves)
from sagesplat.cli.base import COMMANDS
from sagesplat.cli.help import help_of
from sagesplat.cli.parse import arguments, current_command
from sagesplat.cli.say import print_any_character, say
from sagesplat.core import signals
from sagesplat.core.errors import SageError
from sagesplat.core.memory import named_memory
from sagesplat.io.files import CURES

_CHECK = "check the path, its rights and the disk"


def main() -> None:
    """Run a command; errors that a user can cause are one line and exit code 2."""
    print_any_character()
    try:
        _run(*sys.argv[1:] or ["--help"])
        sys.stdout.flush()
    except BrokenPipeError:  # such as `| head`; Python flushes once more at its end
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _run(name: str, *words: str) -> None:
    if name in ("-h", "--help", "--version"):
        print(f"sagesplat {__version__}" if name == "--version" else _overview())
        return
    name = current_command(name)
    if name not in COMMANDS:
        _fail(f"no command {name!r}; there are {', '.join(COMMANDS)}")
    function = COMMANDS[name]
    if {"-h", "--help", "--help-all"} & set(words):
        print(help_of(name, function, everything="--help-all" in words))
        return
    try:
        with named_memory(f"sagesplat {name}"):
            function(**arguments(name, function, list(words)))
    except SageError as error:
        _fail(str(error))
    except KeyboardInterrupt as error:
        signals.leave(error)
    except BrokenPipeError:
        raise
    except OSError as error:
        where = error.filename or "input/output"
        _fail(f"{where}: {error.strerror or error}; {CURES.get(error.errno or 0, _CHECK)}")


def _overview() -> str:
    """What `sagesplat --help` prints."""
    width = max(60, min(110, shutil.get_terminal_size().columns))
    lines = ["usage: sagesplat COMMAND ...", "", "Semantic-driven adaptive Gaussian splatting.", ""]
    for name, function in COMMANDS.items():
        text = f"  {name:18}{(function.__doc__ or '').splitlines()[0]}"
        lines += textwrap.wrap(text, width, subsequent_indent=" " * 20, drop_whitespace=True)
    return "\n".join([*lines, "", "`sagesplat COMMAND --help` lists the options of a command."])


def _fail(message: str) -> NoReturn:
    say(f"sagesplat: {' '.join(message.split())}", file=sys.stderr)
    raise SystemExit(2)
