"""What the documents say is so: links, files, modules, commands, flags, messages, dates of measurements."""

import importlib
import re
import shlex
import subprocess
import tomllib
import warnings
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

import pytest
import tyro

import sagesplat
from benchmarks.__main__ import names
from sagesplat import cli
from sagesplat.cli.parse import arguments
from tools import doc_tables

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = sorted(path for path in DOCS.rglob("*.md") if path.parent.name != "cli")  # that is generated
README = ROOT / "README.md"
FOREIGN = {  # flags of other tools: pip and uv, ruff, Ray, splat-transform, OpenSplat; a placeholder
    *(
        "--only-binary",
        "--constraint",
        "--dest",
        "--require-hashes",
        "--extra",
        "--upgrade",
        "--force-reinstall",
    ),
    *("--fix", "--address", "--generate", "--head", "--scale", "--decimate"),
    *("--densify-until", "--no-masks", "--flag", "--no-flag"),
}
FOREIGN_FILES = {  # placeholders; gsplat's, instant-ngp's
    *("stages/NAME.py", "docs/a.md", "simple_trainer.py", "docs/nerf_dataset_tips.md")
}
PLACEHOLDER = re.compile(r"…|\.\.\.|\bK\b")  # lines that leave something out, or stand for several


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
    measured = [main_of(name) for name in (*map("benchmarks.{}".format, names()), "tests.fuzz")]
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
    text = re.sub(r"\\\n\s*", "", path.read_text())
    fence = re.compile(r"^```[^\n]*\n(.*?)^```$", re.MULTILINE | re.DOTALL)
    blocks = "\n".join(fence.findall(text)).splitlines()
    text = fence.sub("", text)
    blocks += re.findall(r"^ {4,}\S.*$", text, re.MULTILINE)
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


def anchors(path: Path) -> set[str]:
    """Names of the headings of a page, as GitHub and the site make them."""
    headings = re.findall(r"^#+ (.+)$", path.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\s-]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("path", [*ROOT.glob("*.md"), *PAGES], ids=lambda path: path.name)
def test_links_lead_somewhere(path):
    """As the pages are written; what is generated is followed by `tests/test_site.py`."""
    for target in re.findall(r"\]\(([^)\s]+)\)", path.read_text()):
        if not target.startswith(("http://", "https://", "mailto:")):
            name, _, anchor = target.partition("#")
            there = path.parent / name if name else path
            assert there.exists(), f"{path.name}: {target}"
            assert not anchor or anchor in anchors(there), f"{path.name}: {target}"


def test_no_message_or_comment_names_a_page_that_is_gone():
    folders = (("src", "py"), ("tests", "py"), ("web/src", "ts"))
    for path in (path for folder, kind in folders for path in (ROOT / folder).rglob(f"*.{kind}")):
        for page in set(re.findall(r"\bdocs/[\w/-]+\.md\b", path.read_text())) - FOREIGN_FILES:
            assert (ROOT / page).exists(), f"{path.name}: {page}"


@pytest.mark.parametrize("path", [README, *PAGES], ids=lambda path: path.name)
def test_what_is_named_exists(path):
    """Files, modules, commands and flags."""
    gone = []
    for word in words(path):
        for file in re.findall(r"(?<![\w.*])[\w./-]+\.(?:py|ts|mjs)\b", word):
            known = any(each.endswith(f"/{file.lstrip('./')}") for each in tracked())
            gone += [] if known or file in FOREIGN_FILES else [file]
        names = re.findall(r"(?<!/)\bsagesplat((?:\.\w+)+)", word)
        gone += [name for name in names if resolve(f"sagesplat{name}") is None]
        for module in re.findall(r"python -m ((?:benchmarks|tests|tools)\.[a-z]\w+)", word):
            file = f"/{module.replace('.', '/')}"
            gone += [] if {f"{file}.py", f"{file}/__main__.py"} & set(tracked()) else [module]
        for flag in re.findall(r"(?<![\w-])--[a-z][\w.-]*\w", word):
            group = any(each.startswith(f"{flag}.") for each in flags())  # `--train`: all of its flags
            gone += [] if group or flag in flags() | FOREIGN else [flag]
        command = re.match(r"\s*(?:\.venv/bin/)?sagesplat ([a-z][\w-]*)", word)
        gone += [command[0]] if command and command[1] not in cli.commands() else []
    assert gone == []


def command_lines(path: Path) -> Iterator[str]:
    """What begins with `sagesplat` in code blocks and between backticks, without comments."""
    text = re.sub(r"\\\n\s*", "", path.read_text())
    fenced = re.findall(r"^```(?:sh|)\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    indented = re.findall(r"^ {4,}(\S.*)$", text, re.MULTILINE)
    for line in ["\n".join(fenced), "\n".join(indented)]:
        yield from re.findall(r"^\s*(?:\$ )?(?:\.venv/bin/)?(sagesplat [a-z-]+ .*?)(?:\s+#.*)?$", line, re.M)
    for line in re.findall(r"`(sagesplat [a-z-]+ [^`]*)`", text.replace("\n", " ")):
        yield line if " -" in line else ""  # in a sentence, arguments may be left out


@pytest.mark.parametrize("path", PAGES, ids=lambda path: str(path.relative_to(DOCS)))
def test_command_lines_are_accepted(path, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # no run folders whose settings would be read
    for line in dict.fromkeys(command_lines(path)):
        if not line or PLACEHOLDER.search(line) or "--help" in line:
            continue
        typed = shlex.split(line.rstrip(","))[1:]
        arguments(typed[0], cli.commands()[typed[0]], typed[1:])


def test_error_messages_are_those_of_the_code():
    """Each message of the page, cut where something stands for a path or a number, is in the sources."""
    files = [*(ROOT / "src").rglob("*.py"), *(ROOT / "web/src").rglob("*.ts")]
    code = "".join(path.read_text() for path in files)
    code = re.sub(r'"\s*\n\s*f?"', "", code)  # a message over several lines
    code = re.sub(r"\$?\{[^{}\n]*\}", "…", code)
    tables = "".join((DOCS / "help" / name).read_text() for name in ("errors.md", "troubleshooting.md"))
    messages = re.findall(r"^\| `(?!RUN|infeas|uncal|lift|unlab)([^`]{12,})` \|", tables, re.MULTILINE)
    assert len(messages) > 15
    for message in messages:
        for part in (part.strip(" .:;,()") for part in message.split("…")):
            assert part in code, f"{message}: no {part!r}"


def test_measured_tables_say_when_on_which_commit_and_how():
    found = list(doc_tables.tables(DOCS))
    assert len(found) > 50
    unsaid = [
        f"{table.page}:{table.line}"
        for table in found
        if not (table.measured and table.commit and (table.command or table.page.startswith("developers/")))
    ]
    assert unsaid == []


def test_the_architecture_is_that_of_the_package():
    """Layers, folders, and the files of the core types."""
    text = (DOCS / "architecture.md").read_text()
    contract = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"][0]
    layers = [line.replace("sagesplat.", "").replace("|", "·") for line in contract["layers"]]
    assert "\n".join(f"    {layer}" for layer in layers) in text
    folders = {path.parent.name for path in (ROOT / "src" / "sagesplat").glob("*/__init__.py")}
    assert set(re.findall(r"^\| `(\w+)/` \|", text, re.MULTILINE)) == folders
    rows = re.findall(r"^\| ((?:`\w+`(?:, )?)+) \| `([\w/]+\.py)` \|", text, re.MULTILINE)
    assert len(rows) > 10
    for types, file in rows:
        source = (ROOT / "src" / "sagesplat" / file).read_text()
        for name in re.findall(r"`(\w+)`", types):
            assert re.search(rf"^class {name}\b", source, re.MULTILINE), f"{name} in {file}"


def test_what_the_paper_page_names_exists():
    """Functions after `sagesplat.`, and test files with the tests behind the colon."""
    text = (DOCS / "paper.md").read_text()
    rows = [line.split("|")[1:-1] for line in text.splitlines() if line.startswith("| ") and "`" in line]
    for row in rows:
        for name in re.findall(r"`((?:[a-z]\w*\.)+\w+)`", row[1]):
            assert resolve(f"sagesplat.{name}") is not None, name
        pattern = r"((?:`test_[\w*]+`(?:, )?)+)(?:: ((?:`test_\w+`(?:, )?)+))?"
        for files, tests in re.findall(pattern, row[-1]):
            globs = [f"{name}.py" for name in re.findall(r"`([\w*]+)`", files)]
            paths = [path for each in globs for path in (ROOT / "tests").glob(each)]
            assert len(paths) >= len(globs), files
            source = "".join(path.read_text() for path in paths)
            for test in re.findall(r"`(\w+)`", tests):
                assert f"def {test}(" in source, test
