"""Run the notebooks of examples/ and keep what they print and draw: python tools/notebooks.py [NAME.ipynb]

They run in a folder of their own under /tmp, one after the other: later ones use the run of the first.
"""

import ast
import base64
import contextlib
import io
import json
import os
import sys
import tempfile
from pathlib import Path
from typing import Any

NOTEBOOKS = Path(__file__).parents[1] / "examples" / "notebooks"


def execute(notebook: dict[str, Any], settings: str | None = None) -> dict[str, Any]:
    """Run the code cells in their order, in the current folder; the names that they leave.

    Args:
        notebook: the parsed .ipynb; what its cells print and draw replaces their outputs
        settings: code in place of the first cell's, which holds the sizes
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    names: dict[str, Any] = {"__name__": "__main__"}
    cells = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    for number, cell in enumerate(cells, 1):
        printed = io.StringIO()
        code = settings if settings and number == 1 else "".join(cell["source"])
        with contextlib.redirect_stdout(printed):
            value = _value(code, f"cell {number}", names)
        cell["execution_count"] = number
        text = printed.getvalue().splitlines(keepends=True)
        cell["outputs"] = [{"output_type": "stream", "name": "stdout", "text": text}] if text else []
        if value is not None:
            cell["outputs"].append(_result(value, number))
        for figure in pyplot.get_fignums():
            jpeg = io.BytesIO()
            pyplot.figure(figure).savefig(jpeg, format="jpeg", dpi=80, bbox_inches="tight")
            picture = base64.b64encode(jpeg.getvalue()).decode()
            output = {"output_type": "display_data", "metadata": {}, "data": {"image/jpeg": picture}}
            cell["outputs"].append(output)
        pyplot.close("all")
    return names


def _value(code: str, name: str, names: dict[str, Any]) -> Any:
    """Run a cell; what its last line is, where that is an expression."""
    tree = ast.parse(code)
    last = tree.body[-1] if tree.body else None
    if not isinstance(last, ast.Expr):
        exec(compile(tree, name, "exec"), names)
        return None
    exec(compile(ast.Module(tree.body[:-1], []), name, "exec"), names)
    return eval(compile(ast.Expression(last.value), name, "eval"), names)


def _result(value: Any, number: int) -> dict[str, Any]:
    """What a notebook shows of a value, without pages of megabytes: they are made, and left out."""
    if hasattr(value, "_repr_html_"):
        value._repr_html_()
    data = {"text/plain": repr(value).splitlines(keepends=True)}
    return {"output_type": "execute_result", "execution_count": number, "metadata": {}, "data": data}


def main() -> None:
    paths = [Path(name).resolve() for name in sys.argv[1:]] or sorted(NOTEBOOKS.glob("*.ipynb"))
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        for path in paths:
            notebook = json.loads(path.read_text(encoding="utf-8"))
            execute(notebook)
            path.write_text(json.dumps(notebook, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
            print(f"{path}: {path.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
