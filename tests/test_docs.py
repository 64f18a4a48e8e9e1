"""What the documents name is there: links, files, modules, commands and flags."""

import importlib
import re
import subprocess
import tomllib
import warnings
from collections.abc import Callable
from functools import cache
from pathlib import Path

import pytest
import tyro

import sagesplat
from benchmarks.__main__ import names
from sagesplat import cli

ROOT = Path(__file__).parents[1]
DOCS = sorted([ROOT / "README.md", *(ROOT / "docs").rglob("*.md")])
FOREIGN = {  # flags of other tools
    *("--only-binary", "--constraint", "--dest", "--require-hashes"),  # pip
    "--fix", "--address", "--generate", "--no-index", "--find-links", "--revision", "--extra", "--upgrade",
    "--decimate",  # splat-transform
    "--densify-until", "--no-masks",  # OpenSplat
}  # fmt: skip

FOREIGN_FILES = {"stages/NAME.py", "simple_trainer.py"}  # a placeholder; gsplat's


@cache
def tracked() -> list[str]:
    """Files of the repository, those not yet added too."""
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    if done.returncode:
        pytest.skip("not a git checkout")
    return [f"/{line}" for line in done.stdout.splitlines()]


def main_of(name: str) -> Callable[..., None]:
    """What `python -m NAME` calls."""
    module = importlib.import_module(name)
    return (importlib.import_module(f"{name}.__main__") if hasattr(module, "__path__") else module).main


@cache
def flags() -> set[str]:
    """Every flag of every command, of `sagesplat`, of benchmarks, of the fuzzer."""
    found = {"--version", "--help", "--help-all"}
    measured = [
        main_of(name) for name in (*map("benchmarks.{}".format, names()), "tests.fuzz", "tools.pictures")
    ]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # tyro has no other way to its parsers yet
        waiting = list(map(tyro.extras.get_parser, [*cli.commands().values(), *measured]))
    while waiting:
        for action in waiting.pop()._actions:
            found.update(action.option_strings)
            if isinstance(action.choices, dict):
                waiting += action.choices.values()
    return found


def words(path: Path) -> list[str]:
    """What stands between backticks, and the lines of code blocks."""
    text = path.read_text()
    fenced = "\n".join(re.findall(r"^```\w*\n([^`]*)^```$", text, re.MULTILINE))
    blocks = [*re.findall(r"^ {4,}\S.*$", text, re.MULTILINE), *fenced.splitlines()]
    return [" ".join(word.split()) for word in re.findall(r"`([^`]+)`", text)] + blocks


def resolve(name: str) -> object | None:
    """The module, class, function or constant of a dotted name, None without one."""
    found: object = sagesplat
    for part in name.split(".")[1:]:
        if not hasattr(found, part):
            try:
                importlib.import_module(f"{getattr(found, '__name__', '')}.{part}")
            except ImportError:
                return None
        found = getattr(found, part)
    return found


def anchor(title: str) -> str:
    """GitHub's anchor of a title."""
    return re.sub(r"[^\w\- ]", "", title.strip().lower()).replace(" ", "-")


@pytest.mark.parametrize("path", DOCS, ids=lambda path: path.name)
def test_links_lead_somewhere(path):
    for target in re.findall(r"\]\(([^)\s]+)\)", path.read_text()):
        if target.startswith(("http://", "https://")):
            continue
        file, _, part = target.partition("#")
        there = (path.parent / file) if file else path
        assert there.exists(), f"{path.name}: {target}"
        if part and there.suffix == ".md":
            titles = re.findall(r"^#+ (.+)$", there.read_text(), re.MULTILINE)
            assert part in {anchor(title) for title in titles}, f"{path.name}: {target}"


@pytest.mark.parametrize("path", DOCS, ids=lambda path: path.name)
def test_files_and_modules_exist(path):
    gone = []
    for word in words(path):
        for file in re.findall(r"(?<![\w.*])[\w./-]+\.(?:py|ts|mjs)\b", word):
            known = any(each.endswith(f"/{file.lstrip('./')}") for each in tracked())
            if not known and file not in FOREIGN_FILES:
                gone.append(file)
        for name in re.findall(r"\bsagesplat((?:\.\w+)+)", word):
            if resolve(f"sagesplat{name}") is None:
                gone.append(f"sagesplat{name}")
    assert gone == []


@pytest.mark.parametrize("path", DOCS, ids=lambda path: path.name)
def test_commands_and_flags_exist(path):
    gone = []
    for word in words(path):
        for flag in re.findall(r"(?<![\w-])--[a-z][\w.-]*\w", word):
            group = any(each.startswith(f"{flag}.") for each in flags())  # `--train`: all of its flags
            gone += [] if group or flag in flags() | FOREIGN else [flag]
        found = re.match(r"\s*(?:\.venv/bin/)?sagesplat ([a-z][\w-]*)", word)
        gone += [found[0]] if found and found[1] not in cli.commands() else []
    assert gone == []


def test_core_types_are_where_the_architecture_says():
    text = (ROOT / "docs" / "architecture.md").read_text()
    rows = re.findall(r"^\| ((?:`\w+`(?:, )?)+) \| `([\w/]+\.py)` \|", text, re.MULTILINE)
    assert len(rows) > 20
    for types, file in rows:
        source = (ROOT / "src" / "sagesplat" / file).read_text()
        for name in re.findall(r"`(\w+)`", types):
            assert re.search(rf"^class {name}\b", source, re.MULTILINE), f"{name} in {file}"


def test_layers_and_folders_are_those_of_the_package():
    text = (ROOT / "docs" / "architecture.md").read_text()
    contract = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"][0]
    layers = [line.replace("sagesplat.", "").replace("|", "·") for line in contract["layers"]]
    assert "\n".join(f"    {layer}" for layer in layers) in text
    folders = {path.parent.name for path in (ROOT / "src" / "sagesplat").glob("*/__init__.py")}
    assert set(re.findall(r"^\| `(\w+)/` \|", text, re.MULTILINE)) == folders


def test_what_the_paper_page_names_exists():
    """Functions after `sagesplat.`, and test files with the tests behind the colon."""
    text = (ROOT / "docs" / "paper.md").read_text()
    rows = [line.split("|")[1:-1] for line in text.splitlines() if line.startswith("| ") and "`" in line]
    named = 0
    for row in rows:
        for name in re.findall(r"`((?:[a-z]\w*\.)+\w+)`", row[1]):
            assert resolve(f"sagesplat.{name}") is not None, name
            named += 1
        pattern = r"((?:`test_[\w*]+`(?:, )?)+)(?:: ((?:`test_\w+`(?:, )?)+))?"
        for files, tests in re.findall(pattern, row[-1]):
            globs = [f"{name}.py" for name in re.findall(r"`([\w*]+)`", files)]
            paths = [path for each in globs for path in (ROOT / "tests").glob(each)]
            assert len(paths) >= len(globs), files
            source = "".join(path.read_text() for path in paths)
            for test in re.findall(r"`(\w+)`", tests):
                assert f"def {test}(" in source, test
                named += 1
    assert named > 40
