"""The command line: one short function per command, each loads, calls and saves."""

import os
import sys
from typing import NoReturn

import tyro

from sagesplat import __version__
from sagesplat.cli import stages, studies, tools  # noqa: F401  (their commands register themselves)
from sagesplat.cli.base import COMMANDS
from sagesplat.core.errors import SageError


def main() -> None:
    """Run a command; errors that a user can cause are one line and exit code 2."""
    name, *words = sys.argv[1:] or ["--help"]
    if name in ("-h", "--help", "--version"):
        print(f"sagesplat {__version__}" if name == "--version" else _overview())
        return
    if name not in COMMANDS:
        _fail(f"no command {name!r}; there are {', '.join(COMMANDS)}")
    try:
        tyro.cli(COMMANDS[name], prog=f"sagesplat {name}", args=words)
    except SageError as error:
        _fail(str(error))
    except KeyboardInterrupt:
        _fail("interrupted; what is finished is kept: run the same command again to go on")
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except OSError as error:
        where = error.filename or "input/output"
        _fail(f"{where}: {error.strerror or error}; check the path, its rights and the disk")


def _overview() -> str:
    """What `sagesplat --help` prints."""
    lines = ["usage: sagesplat COMMAND ...", "", "Semantic-driven adaptive Gaussian splatting.", ""]
    for name, function in COMMANDS.items():
        lines.append(f"  {name:10}{(function.__doc__ or '').splitlines()[0]}")
    return "\n".join([*lines, "", "`sagesplat COMMAND --help` lists the settings of a command."])


def _fail(message: str) -> NoReturn:
    print(f"sagesplat: {' '.join(message.split())}", file=sys.stderr)
    raise SystemExit(2)
