"""The figures of `python -m benchmarks.structure`, on a checkout of a few lines."""

import json

import pytest

from benchmarks import structure

LATER = "import typing\nfrom sagesplat.a import one\n\nif typing.TYPE_CHECKING:\n    import sagesplat.d\n"
FILES = {
    "src/sagesplat/__init__.py": '__version__ = "1"\n',
    "src/sagesplat/a/__init__.py": "",
    "src/sagesplat/a/one.py": "from sagesplat import __version__\nfrom sagesplat.b import two\n",
    "src/sagesplat/a/short.py": "def f():\n    return 1\n\n\ndef g():\n    x = 2\n    return x\n",
    "src/sagesplat/b/__init__.py": "from .two import later\n",
    "src/sagesplat/b/two.py": "def later():\n    import sagesplat.c\n\n    return sagesplat.c\n",
    "src/sagesplat/c.py": LATER,
    "src/sagesplat/d.py": "import json\nfrom sagesplat.c import one\n",
    "tests/test_a.py": "assert True\n",
    "tests/fuzz/one.py": "1\n2\n",
    "benchmarks/readers/one.py": "1\n",
    "benchmarks/speed.py": "1\n2\n3\n",
    "web/src/core/a.ts": "1\n",
    "web/test/a.test.ts": "1\n2\n",
    "docs/index.md": "x" * 2400,
}


@pytest.fixture
def checkout(tmp_path):
    for name, text in FILES.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return tmp_path


def test_figures_of_a_small_checkout(checkout):
    found = structure.measure(checkout)
    assert (found["lines of source"], found["lines of benchmarks"]) == (22, 3)
    assert found["lines of tests, fuzzing included"] == 4
    assert (found["lines of TypeScript"], found["lines of its tests"]) == (1, 2)
    assert (found["kB of documents"], found["options of run"]) == (2, None)
    assert (found["files"], found["folders"]) == (8, 4)
    # a -> b -> c -> a and d -> c; not c -> d, which is for type checkers
    assert (found["imports between folders"], found["circles of folders"]) == (4, ["a b c"])
    assert (found["functions"], found["lines of a function, median"]) == (3, 3)
    assert found["longest functions"] == ["b.two.later 4", "a.short.g 3", "a.short.f 2"]
    assert found["longest files"][0] == "a/short.py 7"


def test_two_circles_are_two_components():
    arrows = {("a", "b"), ("b", "a"), ("b", "c"), ("c", "d"), ("d", "c"), ("d", "e")}
    assert structure.circles(arrows) == ["a b", "c d"]
    assert structure.circles({("a", "b"), ("b", "c")}) == []


def test_before_and_after_is_a_table_and_one_line_of_json(checkout, tmp_path, capsys):
    structure.main(checkout, against=str(checkout))
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "|  | before | after |"
    assert "| lines of source | 22 | 22 |" in lines
    assert json.loads(lines[-1])["after"]["circles of folders"] == ["a b c"]
