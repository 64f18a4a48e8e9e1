"""The figures of `python -m benchmarks structure`, on a package of a few lines."""

import json

import pytest

from benchmarks import structure
from benchmarks.__main__ import structure as command

FILES = {
    "__init__.py": '__version__ = "1"\n',
    "a/__init__.py": "",
    "a/one.py": "from toy import __version__\nfrom toy.b import two\nfrom toy.a.short import f\n",
    "a/short.py": "def f():\n    return 1\n\n\ndef g():\n    x = 2\n    y = 3\n    return x + y\n",
    "b/__init__.py": "from .two import later\n",
    "b/two.py": "def later():\n    import toy.c\n\n    return toy.c\n",
    "c.py": "import typing\nfrom toy.a import one\n\nif typing.TYPE_CHECKING:\n    import toy.d\n",
    "d.py": "import json\nfrom toy.c import one\n",
}


@pytest.fixture
def toy(tmp_path):
    for name, text in FILES.items():
        path = tmp_path / "toy" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return tmp_path / "toy"


def test_figures_of_a_small_package(toy):
    found = structure.measure(toy)
    assert found["entries"] == 4
    assert found["files"] == len(FILES)
    assert found["arrows"] == 4  # a -> b -> c -> a and d -> c; not c -> d, which is for type checkers
    assert found["cycles"] == [["a", "b", "c"]]
    # one -> two, one -> short, b -> two, two -> c, c -> one, d -> c
    assert found["imports"] == 6
    assert (found["functions"], found["function_median"]) == (3, 4)
    assert found["function_longest"] == "4 (toy.a.short.g)"  # the first of two
    assert found["file_longest"] == "8 (a/short.py)"


def test_two_circles_are_two_components():
    arrows = {("a", "b"), ("b", "a"), ("b", "c"), ("c", "d"), ("d", "c"), ("d", "e")}
    assert structure.cycles(arrows) == [["a", "b"], ["c", "d"]]
    assert structure.cycles({("a", "b"), ("b", "c")}) == []


def test_the_command_prints_a_table_and_one_line_of_json(toy, capsys):
    command((toy,))
    lines = capsys.readouterr().out.splitlines()
    assert json.loads(lines[-1])[str(toy)]["cycles"] == [["a", "b", "c"]]
    assert "| arrows | 4 |" in lines


def test_a_folder_that_is_no_package_is_one_line(tmp_path):
    with pytest.raises(SystemExit, match="not a Python package; name its folder") as caught:
        command((tmp_path,))
    assert str(tmp_path) in str(caught.value)
    assert "\n" not in str(caught.value)
