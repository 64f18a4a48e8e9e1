"""Benchmarks run, and use public names."""

import ast
import json
import subprocess
import sys
from pathlib import Path

from benchmarks.__main__ import names

ROOT = Path(__file__).parents[1]


def test_benchmarks_use_public_names_only():
    allowed = {"_fields", "_exit"}  # of NamedTuple, of os
    private = []
    for path in sorted((ROOT / "benchmarks").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            names = []
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith(
                ("sagesplat", "benchmarks")
            ):
                names = [*(node.module or "").split("."), *(n.name for n in node.names)]
            elif isinstance(node, ast.Attribute) and not (
                isinstance(node.value, ast.Name) and node.value.id in ("self", "cls")
            ):
                names = [node.attr]
            private += [
                f"{path.relative_to(ROOT)}:{getattr(node, 'lineno', 0)} {name}"
                for name in names
                if name.startswith("_") and not name.startswith("__") and name not in allowed
            ]
    assert private == []


def test_a_benchmark_ends_with_one_line_of_json():
    command = [sys.executable, "-m", "benchmarks", "kernels", "--counts", "200", "--size", "64", "64"]
    command += ["--repeats", "1"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    rows = json.loads(done.stdout.splitlines()[-1])["rows"]
    assert [row["overlap"] for row in rows] == ["sparse", "sparse", "dense", "dense"]
    assert all(row["pairs"] > 10_000 and row["share_of_peak_forward"] > 0 for row in rows)


def test_a_benchmark_that_is_not_there_is_one_line():
    command = [sys.executable, "-m", "benchmarks", "none"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert ", ".join(names()) in line
