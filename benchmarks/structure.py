"""How a package is built: entries at its top, imports between them, cycles, lengths of functions and files.

It reads the sources and imports nothing, so it works on any checkout. Imports for type checkers alone
(`if TYPE_CHECKING`) do not count; those inside functions do.
"""

import ast
from collections.abc import Iterator, Mapping
from itertools import product
from pathlib import Path
from statistics import median
from typing import Any


def measure(package: Path) -> dict[str, Any]:
    """The figures of the package in a folder, e.g. src/sagesplat."""
    files = {_module(package, path): path for path in sorted(package.rglob("*.py"))}
    trees = {name: ast.parse(path.read_text()) for name, path in files.items()}
    edges = {
        (name, target)
        for name, tree in trees.items()
        for target in _imports(name, tree, files)
        if target != name and target.count(".")  # not the package itself: its version
    }
    arrows = {(_top(a), _top(b)) for a, b in edges if a.count(".")}
    arrows = {(a, b) for a, b in arrows if a != b}
    lengths = {
        f"{name}.{node.name}": (node.end_lineno or node.lineno) - node.lineno + 1
        for name, tree in trees.items()
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
    }
    lines = {str(path.relative_to(package)): len(path.read_text().splitlines()) for path in files.values()}
    return {
        "entries": len({_top(name) for name in files if name.count(".")}),
        "files": len(files),
        "lines": sum(lines.values()),
        "arrows": len(arrows),
        "cycles": cycles(arrows),
        "imports": len(edges),
        "functions": len(lengths),
        "function_median": median(lengths.values()),
        "function_longest": _longest(lengths),
        "functions_over_60": sum(n > 60 for n in lengths.values()),
        "file_median": median(lines.values()),
        "file_longest": _longest(lines),
        "files_over_300": sum(n > 300 for n in lines.values()),
    }


def _module(package: Path, path: Path) -> str:
    """The dotted name of a file of a package."""
    parts = [package.name, *path.relative_to(package).with_suffix("").parts]
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def _top(module: str) -> str:
    return module.split(".")[1]


def _imports(name: str, tree: ast.AST, modules: Mapping[str, Path]) -> Iterator[str]:
    """Modules of the package that a module imports: the deepest that each import names."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            continue
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            parents = node.level - (modules[name].stem == "__init__") if node.level else 0
            base = name.rsplit(".", parents)[0] if node.level else ""
            source = ".".join(part for part in (base, node.module) if part)
            names = [
                full if (full := f"{source}.{alias.name}") in modules else source for alias in node.names
            ]
        yield from (each for each in names if each in modules)
        yield from _imports(name, node, modules)


def cycles(arrows: set[tuple[str, str]]) -> list[list[str]]:
    """Groups that import each other in a circle: strongly connected components of two and more."""
    names = sorted({name for arrow in arrows for name in arrow})
    reached = {name: {b for a, b in arrows if a == name} for name in names}
    for middle, name in product(names, names):  # Warshall: the middle one in the outer loop
        if middle in reached[name]:
            reached[name] |= reached[middle]
    groups = {tuple(b for b in names if b in reached[a] and a in reached[b]) for a in names}
    return sorted(list(group) for group in groups if len(group) > 1)


def _longest(lengths: Mapping[str, int]) -> str:
    name = max(lengths, key=lambda each: lengths[each])
    return f"{lengths[name]} ({name})"


def table(results: Mapping[str, Mapping[str, Any]]) -> str:
    """Markdown: a row a figure, a column a package."""
    rows = [["", *results], ["---"] * (1 + len(results))]
    for name in next(iter(results.values())):
        values = [result[name] for result in results.values()]
        if name == "cycles":
            values = ["; ".join(map(", ".join, groups)) or "none" for groups in values]
        rows.append([name.replace("_", " "), *(f"{v:g}" if isinstance(v, float) else str(v) for v in values)])
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)
