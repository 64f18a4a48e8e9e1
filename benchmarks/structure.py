"""What there is to read: lines, documents, options, longest files and functions, imports between folders.

    python -m benchmarks.structure                          # this checkout
    python -m benchmarks.structure --against v0.1.0         # before and after; or another checkout's folder

It reads sources and imports nothing of them, but for the options, which `sagesplat run --help-all` prints.
Imports for type checkers alone (`if TYPE_CHECKING`) do not count; those inside functions do.
"""

import ast
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from itertools import product
from pathlib import Path
from statistics import median
from typing import Any

import tyro

from benchmarks.common import ROOT, finish

LONGEST = 5  # files and functions that are named
FUZZER = ("fuzz", "fuzz_reader", "foreign", "hostile", "mutate")  # before it had a folder below tests/


def main(root: Path = ROOT, against: str = "", write: bool = False) -> None:
    """A table of figures of one checkout, or of two: before and after.

    Args:
        root: folder of the checkout.
        against: a folder, or a revision of `root`, that it is compared with.
        write: keep the figures in benchmarks/results.
    """
    results: dict[str, dict[str, Any]] = {}
    if against and (Path(against) / "src").is_dir():
        results["before"] = measure(Path(against).resolve())
    elif against:
        results["before"] = of_revision(root, against)
    if not (root / "src" / "sagesplat" / "__init__.py").exists():
        raise SystemExit(f"{root}: no checkout; name its folder, which holds src/sagesplat")
    results["after" if against else "now"] = measure(root.resolve())
    print(table(results))
    finish("structure", results, write, "")


def of_revision(root: Path, revision: str) -> dict[str, Any]:
    """Figures of a revision, unpacked for a moment."""
    done = subprocess.run(["git", "-C", str(root), "archive", revision], capture_output=True, check=False)
    if done.returncode:
        raise SystemExit(f"--against {revision}: {done.stderr.decode().strip()}; name a folder or a revision")
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run(["tar", "-x", "-C", folder], input=done.stdout, check=True)
        return measure(Path(folder))


def measure(root: Path) -> dict[str, Any]:
    """The figures of a checkout, by what they are of."""
    package = root / "src" / "sagesplat"
    benchmarks = set((root / "benchmarks").rglob("*.py"))
    fuzzer = {p for p in benchmarks if p.stem in FUZZER or p.parent.name == "readers"}
    tests, files = {*(root / "tests").rglob("*.py"), *fuzzer}, set(package.rglob("*.py"))
    typescript = {*(root / "web" / "test").rglob("*.ts"), *(root / "web" / "test").rglob("*.mjs")}
    made = root / "docs" / "reference" / "cli"  # by the build of the documentation
    documents = [p.stat().st_size for p in (root / "docs").rglob("*.md") if made not in p.parents]
    modules = {_module(package, path): path for path in sorted(files)}
    trees = {name: ast.parse(path.read_text(encoding="utf-8")) for name, path in modules.items()}
    arrows = folder_imports(trees, modules)
    functions = {
        f"{name}.{node.name}": (node.end_lineno or node.lineno) - node.lineno + 1
        for name, tree in trees.items()
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
    }
    lengths = {str(path.relative_to(package)): _lines([path]) for path in files}
    return {
        "lines of source": _lines(files),
        "lines of tests, fuzzing included": _lines(tests),
        "lines of benchmarks": _lines(benchmarks - fuzzer),
        "lines of TypeScript": _lines((root / "web" / "src").rglob("*.ts")),
        "lines of its tests": _lines(typescript),
        "kB of documents": round(sum(documents) / 1000),
        "options of run": options(root),
        "files": len(files),
        "files over 300 lines": sum(n > 300 for n in lengths.values()),
        "longest files": _longest(lengths),
        "functions": len(functions),
        "lines of a function, median": median(functions.values()),
        "functions over 60 lines": sum(n > 60 for n in functions.values()),
        "longest functions": _longest(functions),
        "folders": len({_folder(name) for name in modules if name.count(".")}),
        "imports between folders": len(arrows),
        "circles of folders": circles(arrows),
    }


def options(root: Path) -> int | None:
    """Options of `sagesplat run`, None where it does not answer."""
    env = os.environ | {"PYTHONPATH": str(root / "src"), "COLUMNS": "200"}
    code = "from sagesplat.cli import main; main()"
    command = [sys.executable, "-c", code, "run", "--help-all"]
    done = subprocess.run(command, env=env, capture_output=True, text=True, check=False)
    if done.returncode:
        return None
    found = re.findall(r"^\W*(?:-\w, )?--([\w.-]+)", done.stdout, re.MULTILINE)
    return len(set(found) - {"help", "help-all"})


def _lines(paths: Iterable[Path]) -> int:
    return sum(len(path.read_text(encoding="utf-8").splitlines()) for path in paths)


def _longest(lengths: Mapping[str, int]) -> list[str]:
    names = sorted(lengths, key=lambda name: -lengths[name])[:LONGEST]
    return [f"{name.removeprefix('sagesplat.')} {lengths[name]}" for name in names]


def _module(package: Path, path: Path) -> str:
    """The dotted name of a file of a package."""
    parts = [package.name, *path.relative_to(package).with_suffix("").parts]
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def _folder(module: str) -> str:
    return module.split(".")[1]


def folder_imports(trees: Mapping[str, ast.AST], modules: Mapping[str, Path]) -> set[tuple[str, str]]:
    """Pairs of folders at the top of a package, of which the first imports something of the second."""
    arrows = {
        (_folder(name), _folder(target))
        for name, tree in trees.items()
        for target in _imports(name, tree, modules)
        if name.count(".") and target.count(".")  # not the package itself: its version
    }
    return {(a, b) for a, b in arrows if a != b}


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
            names = [full if (full := f"{source}.{a.name}") in modules else source for a in node.names]
        yield from (each for each in names if each in modules)
        yield from _imports(name, node, modules)


def circles(arrows: set[tuple[str, str]]) -> list[str]:
    """Groups that import each other in a circle: strongly connected components of two and more."""
    names = sorted({name for arrow in arrows for name in arrow})
    reached = {name: {b for a, b in arrows if a == name} for name in names}
    for middle, name in product(names, names):  # Warshall: the middle one in the outer loop
        if middle in reached[name]:
            reached[name] |= reached[middle]
    groups = {tuple(b for b in names if b in reached[a] and a in reached[b]) for a in names}
    return sorted(" ".join(group) for group in groups if len(group) > 1)


def table(results: Mapping[str, Mapping[str, Any]]) -> str:
    """Markdown: a row a figure, a column a checkout."""
    rows = [["", *results], ["---"] * (1 + len(results))]
    for name in next(iter(results.values())):
        values = [result.get(name) for result in results.values()]
        shown = ["<br>".join(v) or "none" if isinstance(v, list) else _number(v) for v in values]
        rows.append([name, *shown])
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:,g}" if value < 1000 else f"{value:,.0f}"


if __name__ == "__main__":
    tyro.cli(main, prog="python -m benchmarks.structure")
