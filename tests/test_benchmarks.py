"""Benchmarks run, and use public names."""

import ast
import json
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

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


def run_benchmark(monkeypatch: pytest.MonkeyPatch, *words: str) -> None:
    """`python -m benchmarks WORDS` in this process, which has compiled the kernels already."""
    for name in ("__main__", words[0]):  # runpy warns of what is loaded
        monkeypatch.delitem(sys.modules, f"benchmarks.{name}", raising=False)
    monkeypatch.setattr(sys, "argv", ["benchmarks", *words])
    runpy.run_module("benchmarks", run_name="__main__", alter_sys=True)


def test_a_benchmark_ends_with_one_line_of_json(capsys, monkeypatch):
    run_benchmark(monkeypatch, "kernels", "--counts", "200", "--size", "64", "64", "--repeats", "1")
    rows = json.loads(capsys.readouterr().out.splitlines()[-1])["rows"]
    assert [row["overlap"] for row in rows] == ["sparse", "sparse", "dense", "dense"]
    assert all(row["pairs"] > 10_000 and row["share_of_peak_forward"] > 0 for row in rows)


def test_a_benchmark_that_is_not_there_is_one_line():
    command = [sys.executable, "-m", "benchmarks", "none"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert ", ".join(names()) in line
