"""Reference pages that are written from the code: the command line and the names of `sagesplat`.

A page holds a line `<!-- commands -->` or `<!-- names: A B -->`, which is replaced when the page is read;
`<!-- other names -->` are those of `sagesplat` that no line lists. Each command has a page in reference/cli/,
written before Sphinx looks for pages and not part of the repository; `<!-- commands -->` links to them.
"""

import ast
import inspect
import re
import textwrap
from collections.abc import Callable, Iterator
from dataclasses import is_dataclass
from pathlib import Path
from typing import Any

import sagesplat
from sagesplat.cli import commands
from sagesplat.cli.help import Flag, field_help, flags_of
from sagesplat.cli.overview import GROUPS, summaries
from sagesplat.core.errors import SageError
from sagesplat.io.files import write_text

_PAGES = ["reference/cli", "reference/python"]
_LISTED = r"<!-- names: ([\w ]+?) -->"


def setup(app: Any) -> dict[str, bool]:
    """Called by Sphinx."""
    app.connect("builder-inited", _write_pages)
    app.connect("source-read", _fill)
    app.connect("env-get-outdated", lambda *_: _PAGES)
    app.connect("autodoc-process-docstring", _keep_asterisks, priority=400)
    app.connect("autodoc-process-docstring", _keep_colons, priority=600)  # after napoleon's
    return {"parallel_read_safe": True}


def _fill(app: Any, page: str, source: list[str]) -> None:
    if page in _PAGES:
        text = source[0].replace("<!-- commands -->", "\n".join(_commands()))
        listed = {name for names in re.findall(_LISTED, text) for name in names.split()}
        others = [name for name in sagesplat.__all__ if page == "reference/python" and name not in listed]
        text = text.replace("<!-- other names -->", f"## More\n\n{_names(others)}" if others else "")
        source[0] = re.sub(_LISTED, lambda m: _names(m[1].split()), text)


def _names(names: list[str]) -> str:
    """Functions and classes, documented by their docstrings."""
    return "\n\n".join(map(_name, names))


def _keep_asterisks(app: Any, what: str, name: str, value: object, options: Any, lines: list[str]) -> None:
    """Docstrings are plain text: an asterisk outside of code is no markup."""
    for i, line in enumerate(lines):
        if not line.lstrip().startswith((">>>", "...")):
            lines[i] = re.sub(r"(`[^`]*`)|\*", lambda m: m[1] or r"\*", line)


def _keep_colons(app: Any, what: str, name: str, value: object, options: Any, lines: list[str]) -> None:
    """Napoleon takes what stands before a colon in the first line of a property or a field for its type."""
    get = getattr(value, "fget", None) or getattr(value, "func", None)  # of a cached property
    if what == "property" and get:
        lines[:] = (inspect.getdoc(get) or "").splitlines()
    elif what == "attribute":
        kind, field = name.split(".")[-2:]
        lines[:] = [_marked(field_help(getattr(sagesplat, kind)).get(field, ""))]


def _name(name: str) -> str:
    value = getattr(sagesplat, name)
    if name == "Event":
        return _event(value)
    if not inspect.isclass(value):
        kind, options = "autofunction" if callable(value) else "autodata", []
    elif issubclass(value, SageError):
        kind, options = "autoexception", []
    else:
        kind, options = "autoclass", [":members:", ":exclude-members: __init__, __new__"]
    directive = "\n   ".join([f".. {kind}:: sagesplat.{name}", *options])
    return f"```{{eval-rst}}\n{directive}\n```\n\n{_fields(value) if is_dataclass(value) else ''}"


def _event(value: Any) -> str:
    """All kinds of events, with links; those that `sagesplat` does not export are documented here."""
    homes = {
        kind: "sagesplat" if kind.__name__ in sagesplat.__all__ else kind.__module__
        for kind in value.__args__
    }
    kinds = ", ".join(f":py:class:`~{home}.{kind.__name__}`" for kind, home in homes.items())
    parts = [f"```{{eval-rst}}\n.. py:data:: sagesplat.Event\n\n   Any of {kinds}.\n```"]
    for kind, home in homes.items():
        if home != "sagesplat":
            directive = f".. autoclass:: {home}.{kind.__name__}\n   :exclude-members: __init__, __new__"
            parts.append(f"```{{eval-rst}}\n{directive}\n```\n\n{_fields(kind)}")
    return "\n\n".join(parts)


def _fields(kind: Any) -> str:
    """The fields of a dataclass, with the comments beside them."""
    source = textwrap.dedent(inspect.getsource(kind))
    lines, rows = source.splitlines(), []
    (body,) = ast.parse(source).body
    assert isinstance(body, ast.ClassDef)
    for node in body.body:
        if isinstance(node, ast.AnnAssign) and not ast.unparse(node.target).startswith("_"):
            text = "\n".join(lines[node.lineno - 1 : node.end_lineno])
            comment = re.search(r"#\s*(.*)", text)
            told = re.sub(r"([*_<>\[\]|])", r"\\\1", comment[1]) if comment else ""
            hint = ast.unparse(node.annotation).replace("|", "\\|")
            rows.append((f"| `{ast.unparse(node.target)}` | `{hint}` | {told} |", told))
    if not any(told for _, told in rows):  # their docstrings are shown already
        return ""
    return "\n".join(["| field | type | |", "|---|---|---|", *(row for row, _ in rows)])


def _escaped(text: str) -> str:
    return re.sub(r"([*_<>\[\]|])", r"\\\1", text)


def _marked(text: str) -> str:
    """A text with its flags set as code."""
    return re.sub(r"(?<![\w`-])(--[a-z][\w.-]*\w)", r"`\1`", text)


def _commands() -> Iterator[str]:
    """The commands by what one wants, with links to their pages, as Markdown."""
    about = dict(summaries())
    for title, names in GROUPS.items():
        yield f"## {title}\n\n| command | |\n|---|---|"
        for name in names.split():
            yield f"| [`sagesplat {name}`](cli/{name}.md) | {_marked(_escaped(about[name]))} |"
        yield ""
    listed = "\n".join(f"cli/{name}" for names in GROUPS.values() for name in names.split())
    yield f"```{{toctree}}\n:hidden:\n\n{listed}\n```"


def _write_pages(app: Any) -> None:
    """A page for each command; unchanged ones stay as they are, so that Sphinx does not read them again."""
    folder = Path(app.srcdir) / "reference" / "cli"
    pages = {f"{name}.md": "\n".join(_command(name, function)) for name, function in commands().items()}
    for path in folder.glob("*.md"):
        if path.name not in pages:
            path.unlink()
    for name, text in pages.items():
        path = folder / name
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            write_text(path, text)


def _command(name: str, function: Callable[..., None]) -> Iterator[str]:
    """The page of a command with its options, as Markdown."""
    flags = list(flags_of(function))
    words = [flag for flag in flags if not flag.name.startswith("--")]
    shown = [f"[{flag.name}]" if flag.default is not None else flag.name for flag in words]
    yield f"# sagesplat {name}\n"
    yield (inspect.getdoc(function) or "").partition("\n\nArgs:")[0] + "\n"
    yield f"    {' '.join(['sagesplat', name, *shown, '[OPTIONS]'])}\n"
    yield f"```{{program}} sagesplat {name}\n```\n"
    for group in dict.fromkeys(flag.group for flag in flags):
        yield f"## {group.rstrip('.')}\n" if group else ""
        for flag in flags:
            if flag.group == group:
                yield f"````{{option}} {f'{flag.name} {flag.values}'.strip()}\n{_help(flag)}\n````\n"


def _help(flag: Flag) -> str:
    """The help of a flag and its default, with what Markdown would take for markup escaped."""
    text = _marked(_escaped(flag.help))
    default = flag.default
    if isinstance(default, bool) or default in (None, "", (), {}):
        return f"{text} (default: on)" if default is True else text
    shown = " ".join(map(str, default)) if isinstance(default, tuple) else default
    return f"{text} (default: `{f'{shown:g}' if isinstance(shown, float) else shown}`)"
