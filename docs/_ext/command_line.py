"""Reference pages that are written from the code: the command line and the names of `sagesplat`.

A page holds a line `<!-- commands -->` or `<!-- names: A B -->`, which is replaced when the page is read.
"""

import inspect
import re
from collections.abc import Callable, Iterator
from typing import Any

import sagesplat
from sagesplat.cli import commands
from sagesplat.cli.help import Flag, flags_of
from sagesplat.core.errors import SageError

_PAGES = ["reference/cli", "reference/python"]
_PARTS = {
    "stages": "The main job and its stages",
    "studies": "Studies of finished runs",
    "tools": "What goes in, what comes out, this machine",
}


def setup(app: Any) -> dict[str, bool]:
    """Called by Sphinx."""
    app.connect("source-read", _fill)
    app.connect("env-get-outdated", lambda *_: _PAGES)
    return {"parallel_read_safe": True}


def _fill(app: Any, page: str, source: list[str]) -> None:
    if page in _PAGES:
        text = source[0].replace("<!-- commands -->", "\n".join(_commands()))
        source[0] = re.sub(r"<!-- names: ([\w ]+?) -->", lambda m: _names(m[1].split()), text)


def _names(names: list[str]) -> str:
    """Functions and classes, documented by their docstrings."""
    return "\n\n".join(map(_name, names))


def _name(name: str) -> str:
    value = getattr(sagesplat, name)
    if not inspect.isclass(value):
        kind, options = "autofunction" if callable(value) else "autodata", []
    elif issubclass(value, SageError):
        kind, options = "autoexception", []
    else:
        kind, options = "autoclass", [":members:", ":exclude-members: __init__, __new__"]
    directive = "\n   ".join([f".. {kind}:: sagesplat.{name}", *options])
    return f"```{{eval-rst}}\n{directive}\n```"


def _commands() -> Iterator[str]:
    """Every command with its options, as Markdown."""
    part = ""
    for name, function in commands().items():
        module = function.__module__.rpartition(".")[2]
        if module != part:
            part = module
            yield f"## {_PARTS[part]}\n"
        yield from _command(name, function)


def _command(name: str, function: Callable[..., None]) -> Iterator[str]:
    flags = list(flags_of(function))
    words = [flag for flag in flags if not flag.name.startswith("--")]
    shown = [f"[{flag.name}]" if flag.default is not None else flag.name for flag in words]
    yield f"### sagesplat {name}\n"
    yield (inspect.getdoc(function) or "").partition("\n\nArgs:")[0] + "\n"
    yield f"    {' '.join(['sagesplat', name, *shown, '[OPTIONS]'])}\n"
    yield f"```{{program}} sagesplat {name}\n```\n"
    for group in dict.fromkeys(flag.group for flag in flags):
        yield f"**{group.rstrip('.')}**\n" if group else ""
        for flag in flags:
            if flag.group == group:
                yield f"````{{option}} {f'{flag.name} {flag.values}'.strip()}\n{_help(flag)}\n````\n"


def _help(flag: Flag) -> str:
    """The help of a flag and its default, with what Markdown would take for markup escaped."""
    text = re.sub(r"([*_<>\[\]|])", r"\\\1", flag.help)
    default = flag.default
    if isinstance(default, bool) or default in (None, "", (), {}):
        return f"{text} (default: on)" if default is True else text
    shown = " ".join(map(str, default)) if isinstance(default, tuple) else default
    return f"{text} (default: `{f'{shown:g}' if isinstance(shown, float) else shown}`)"
