"""The flags of a command and their help, read from its signature and its docstrings."""

import ast
import inspect
import re
import shutil
import sys
import textwrap
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, is_dataclass
from functools import cache
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

from tyro.conf import Positional

_POSITIONAL = get_args(Positional[int])[1]
_MANY = 25  # flags: a command with more shows only the common ones first
_COMMON = {
    "--downscale", "--segmenter", "--prompts", "--model", "--labels.merge", "--train.max-steps", "--fuse",
    "--blocks.count", "--ladder", "--target-fidelity", "--target-ssim", "--budget", "--device", "--seed",
    "--force", "--yes",
}  # fmt: skip
_WIDEST = 100  # characters of a line
_KINDS: dict[Any, str] = {bool: "", str: "TEXT", Path: "PATH", dict: "NAME VALUE ..."}


@dataclass(frozen=True)
class Flag:
    """One argument of a command."""

    name: str  # --train.max-steps, or RUN for a positional one
    group: str  # heading it is listed under
    values: str  # what is to be typed after it
    help: str
    default: Any
    setting: tuple[str, ...]  # the parameter of the command, and the field of its dataclass
    kind: Any  # its annotation, with limits

    @property
    def off(self) -> str:
        """How one that is on or off is turned off: --no-fuse, --train.no-antialiased."""
        first, dot, last = self.name.rpartition(".")
        return f"{first}.no-{last}" if dot else self.name.replace("--", "--no-", 1)


def flag_of(word: str) -> str:
    """The name of the flag that a word names, also one that turns it off."""
    return re.sub(r"(^--|\.)no-", r"\1", word.partition("=")[0].replace("_", "-"), count=1)


def flags_of(function: Callable[..., None]) -> Iterator[Flag]:
    """The arguments of a command, in the order of its parameters and of their dataclasses' fields."""
    hints = get_type_hints(function, include_extras=True)
    described = _described(inspect.getdoc(function) or "")
    for name, parameter in inspect.signature(function).parameters.items():
        hint, *marks = get_args(hints[name]) if get_origin(hints[name]) is Annotated else (hints[name],)
        marked = {
            key: value
            for key in ("name", "metavar", "help")
            for mark in marks
            if (value := getattr(mark, key, None)) is not None
        }
        default = None if parameter.default is parameter.empty else parameter.default
        if is_dataclass(hint):
            prefix = "" if marked.get("name") == "" else f"{name}."
            inner = get_type_hints(hint, include_extras=True)
            for field in fields(hint):
                yield Flag(
                    f"--{prefix}{field.name.replace('_', '-')}", _first_line(_home(hint, field.name)),
                    _values(inner[field.name]), field_help(hint).get(field.name, ""),
                    getattr(default, field.name), (name, field.name), inner[field.name],
                )  # fmt: skip
        else:
            positional = _POSITIONAL in marks
            shown = marked.get("metavar") or marked.get("name") or name.replace("_", "-")
            help = " ".join(str(marked.get("help") or described.get(name, "")).split())
            yield Flag(
                shown if positional else f"--{shown}", "" if positional else "Options",
                "" if positional else _values(hint), help, default, (name,), hints[name],
            )  # fmt: skip


def help_of(name: str, function: Callable[..., None], everything: bool = False) -> str:
    """What `sagesplat NAME --help` prints: all flags, or of many only those that most people need."""
    flags = list(flags_of(function))
    positional = [flag for flag in flags if not flag.name.startswith("--")]
    options = [flag for flag in flags if flag.name.startswith("--")]
    short = len(options) > _MANY and not everything
    width = max(40, min(_WIDEST, shutil.get_terminal_size().columns))
    words = [f"[{f.name}]" if f.default is not None else f.name for f in positional]
    doc = (inspect.getdoc(function) or "").partition("\n\nArgs:")[0]
    lines = ["usage: " + " ".join(["sagesplat", name, *words, "[OPTIONS]"]), ""]
    for paragraph in doc.split("\n\n"):
        lines += [*textwrap.wrap(paragraph, width), ""]
    for flag in positional:
        lines += _entry(flag, width)
    if short:
        lines += ["", "Common options"]
        for flag in options:
            lines += _entry(flag, width) if flag.name in _COMMON else []
        more = f"`sagesplat {name} --help-all` lists all {len(options)} options."
    else:
        for group in dict.fromkeys(flag.group for flag in options):
            lines += ["", *textwrap.wrap(group.rstrip("."), width)]
            for flag in options:
                lines += _entry(flag, width) if flag.group == group else []
        more = ""
    return "\n".join([*lines, "", more] if more else lines)


def _entry(flag: Flag, width: int) -> list[str]:
    """A flag, and its help below."""
    no_default = flag.default is None or flag.default in (False, "", (), {})
    default = flag.default
    if isinstance(default, tuple):
        default = " ".join(map(str, default))
    elif isinstance(default, float):
        default = f"{default:g}"
    text = flag.help if no_default or isinstance(default, bool) else f"{flag.help} [{default}]".strip()
    return [
        f"  {flag.name} {flag.values}".rstrip(),
        *textwrap.wrap(
            text, width, initial_indent=" " * 6, subsequent_indent=" " * 6, break_on_hyphens=False
        ),
    ]


def _values(hint: Any) -> str:
    """What is typed for a type: INT, {a,b}, PATH ..."""
    kind, of = get_origin(hint) or hint, get_args(hint)
    if kind is Annotated:
        return _values(of[0])
    if kind in (UnionType, Union):  # X | None
        return _values(of[0])
    if kind is Literal:
        return "{" + ",".join(map(str, of)) + "}"
    if kind is tuple:
        return " ".join("..." if part is Ellipsis else _values(part) for part in of)
    return _KINDS.get(kind, getattr(kind, "__name__", str(kind)).upper())


def _home(kind: Any, field: str) -> Any:
    """The class, of a dataclass and those it inherits from, that has a field itself."""
    return next(c for c in kind.__mro__ if field in inspect.get_annotations(c))


def _first_line(kind: Any) -> str:
    return (inspect.getdoc(kind) or kind.__name__).partition("\n")[0]


@cache
def field_help(kind: Any) -> dict[str, str]:
    """The docstrings under the fields of a dataclass, and of those it inherits from."""
    found: dict[str, str] = {}
    for base in reversed(kind.__mro__[:-1]):
        body = _classes(base.__module__)[base.__name__]
        for field, below in zip(body.body, body.body[1:], strict=False):
            if isinstance(field, ast.AnnAssign) and isinstance(below, ast.Expr):
                assert isinstance(field.target, ast.Name)
                assert isinstance(below.value, ast.Constant)
                found[field.target.id] = " ".join(str(below.value.value).split())
    return found


@cache
def _classes(module: str) -> dict[str, ast.ClassDef]:
    """The classes of a module; one parse of its file, where `inspect.getsource` needs one a class."""
    body = ast.parse(Path(str(sys.modules[module].__file__)).read_bytes()).body
    return {node.name: node for node in body if isinstance(node, ast.ClassDef)}


def _described(doc: str) -> dict[str, str]:
    """The arguments that a function's docstring describes."""
    parts = re.split(r"^    (\w+): ", doc.partition("Args:\n")[2], flags=re.MULTILINE)
    return dict(zip(parts[1::2], parts[2::2], strict=True))
