"""Examples in docstrings run as written; those that need a capture or a run are marked +SKIP."""

import doctest
import importlib
from pathlib import Path

import pytest

import sagesplat

PACKAGE = Path(sagesplat.__file__).parent
MODULES = sorted(
    ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts).removesuffix(".__init__")
    for path in PACKAGE.rglob("*.py")
    if ">>> " in path.read_text(encoding="utf-8")
)


@pytest.mark.parametrize("name", MODULES)
def test_examples_run_as_written(name):
    found = [test for test in doctest.DocTestFinder().find(importlib.import_module(name)) if test.examples]
    assert found
    runner = doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE)
    for test in found:
        report: list[str] = []
        runner.run(test, out=report.append)
        assert not report, "".join(report)
