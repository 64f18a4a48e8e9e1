"""The documentation site: builds without a warning, links lead somewhere, command lines are accepted."""

import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest

import sagesplat
from benchmarks import doc_tables
from sagesplat import cli
from sagesplat.cli.parse import arguments

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = sorted(DOCS.rglob("*.md"))
PLACEHOLDER = re.compile(r"…|\.\.\.|\bK\b")  # lines that leave something out, or stand for several


class Page(HTMLParser):
    """The anchors of a page, and where its links and pictures lead."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.anchors: set[str] = set()
        self.targets: set[str] = set()
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        for key, value in attrs:
            if key in ("id", "name"):
                self.anchors.add(value or "")
            elif key in ("href", "src") and value:
                self.targets.add(value)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("sphinx", reason="Sphinx is missing: pip install '.[docs]'")
    out = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", "-b", "html", "-d", out / "trees"]
    done = subprocess.run([*command, DOCS, out / "html"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return out / "html"


def test_links_pictures_and_anchors_lead_somewhere(site):
    pages = {path: Page(path.read_text()) for path in site.rglob("*.html")}
    assert len(pages) > 40
    gone = []
    for path, page in pages.items():
        for target in page.targets:
            link = urlsplit(target)
            if link.scheme or link.netloc:
                continue
            there = (path.parent / unquote(link.path)).resolve() if link.path else path
            found = there.exists() and there.is_relative_to(site)
            anchor = unquote(link.fragment)
            if found and anchor and there in pages:
                found = anchor in pages[there].anchors
            gone += [] if found else [f"{path.relative_to(site)}: {target}"]
    assert gone == []


def test_nothing_is_loaded_from_elsewhere(site):
    """The site works offline: scripts, styles and pictures are its own."""
    for path in site.rglob("*.html"):
        loaded = re.findall(
            r'<(?:script|img|link|iframe)\b[^>]*(?:src|href)="(https?:[^"]+)"', path.read_text()
        )
        assert loaded == [], path.name


def test_every_command_and_public_name_is_in_the_reference(site):
    commands = Page((site / "reference/cli.html").read_text()).anchors
    assert {f"sagesplat-{name}" for name in cli.commands()} <= commands
    names = Page((site / "reference/python.html").read_text()).anchors
    assert {f"sagesplat.{name}" for name in sagesplat.__all__} <= names


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
        words = shlex.split(line.rstrip(","))[1:]
        assert words[0] in cli.commands(), line
        arguments(words[0], cli.commands()[words[0]], words[1:])


def test_error_messages_are_those_of_the_code():
    """Each message of the page, cut where something stands for a path or a number, is in the sources."""
    files = [*(ROOT / "src").rglob("*.py"), *(ROOT / "web/src").rglob("*.ts")]
    code = "".join(path.read_text() for path in files)
    code = re.sub(r'"\s*\n\s*f?"', "", code)  # a message over several lines
    code = re.sub(r"\$?\{[^{}\n]*\}", "…", code)
    tables = "".join((DOCS / "help" / name).read_text() for name in ("errors.md", "troubleshooting.md"))
    messages = re.findall(r"^\| `(?!RUN|infeas|uncal|lift|unlab)([^`]{12,})` \|", tables, re.MULTILINE)
    assert len(messages) > 25
    for message in messages:
        for part in (part.strip(" .:;,()") for part in message.split("…")):
            assert part in code, f"{message}: no {part!r}"


def test_measured_tables_say_when_on_which_commit_and_how():
    found = list(doc_tables.tables(DOCS))
    assert len(found) > 60
    unsaid = [
        f"{table.page}:{table.line}"
        for table in found
        if not (table.measured and table.commit and (table.command or table.page.startswith("developers/")))
    ]
    assert unsaid == [], "`python -m benchmarks tables` lists them"
