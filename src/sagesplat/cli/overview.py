"""What `sagesplat --help` prints, read from the sources of the commands: loading them takes longer."""

import ast
import shutil
import textwrap
from collections.abc import Iterator
from pathlib import Path

FILES = ("stages.py", "studies.py", "tools.py")
GROUPS = {
    "Make a scene with levels": "demo run adopt plan labels instances clean",
    "Look at it": "info view report",
    "Share it": "bundle export",
    "Measure": "measure evaluate compare",
    "Research": "sweep crossview transfer early-stopping",
    "One stage of a run at a time": "masks lift fuse train nest observe sample fit compose",
    "This machine": "doctor download completion",
}
"""Titles and commands, as both are listed: what one wants first, stages of their own last."""


def overview() -> str:
    """All commands by what one wants, each with the first line of its docstring."""
    width = max(60, min(110, shutil.get_terminal_size().columns))
    lines = ["usage: sagesplat COMMAND ...", "", "Semantic-driven adaptive Gaussian splatting."]
    about = dict(summaries())
    for title, names in GROUPS.items():
        lines += ["", title]
        for name in names.split():
            entry = f"  {name:18}{about[name]}"
            lines += textwrap.wrap(entry, width, subsequent_indent=" " * 20, drop_whitespace=True)
    return "\n".join([*lines, "", "`sagesplat COMMAND --help` lists the options of a command."])


def summaries() -> Iterator[tuple[str, str]]:
    """Names of the functions that `base.command` decorates, as one types them, and what they do in a line."""
    for file in FILES:
        for node in ast.parse(Path(__file__).with_name(file).read_bytes()).body:
            if isinstance(node, ast.FunctionDef) and any(map(_is_command, node.decorator_list)):
                yield node.name.replace("_", "-"), _doc(node).partition("\n")[0]


def _doc(node: ast.FunctionDef) -> str:
    """A function's docstring; `ast.get_docstring` would import `inspect`."""
    match node.body[0]:
        case ast.Expr(ast.Constant(str() as text)):
            return text.strip()
    return ""


def _is_command(decorator: ast.expr) -> bool:
    return isinstance(decorator, ast.Name) and decorator.id == "command"
