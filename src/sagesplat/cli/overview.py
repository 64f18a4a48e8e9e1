"""What `sagesplat --help` prints, read from the sources of the commands: loading them takes longer."""

import ast
import shutil
import textwrap
from collections.abc import Iterator
from pathlib import Path

FILES = ("stages.py", "studies.py", "tools.py")  # in the order in which their commands are listed


def overview() -> str:
    """All commands, each with the first line of its docstring."""
    width = max(60, min(110, shutil.get_terminal_size().columns))
    lines = ["usage: sagesplat COMMAND ...", "", "Semantic-driven adaptive Gaussian splatting.", ""]
    for name, text in summaries():
        entry = f"  {name:18}{text}"
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
