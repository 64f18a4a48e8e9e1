"""The documentation site: builds without a warning, links lead somewhere, command lines are accepted."""

import re
import shlex
import subprocess
import sys
import threading
from collections.abc import Iterator
from functools import partial
from html import unescape
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import unquote, urlsplit

import browser as chromium
import pytest
from browser import open_page
from page_checks import wrong_with

import sagesplat
from sagesplat import cli
from sagesplat.cli.parse import arguments
from tools import doc_tables

if TYPE_CHECKING:
    from playwright.sync_api import Browser

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = sorted(DOCS.rglob("*.md"))
PLACEHOLDER = re.compile(r"…|\.\.\.|\bK\b")  # lines that leave something out, or stand for several


class Page:
    """The anchors of a page, and where its links and pictures lead."""

    def __init__(self, text: str) -> None:
        self.anchors = {unescape(name) for name in re.findall(r'<[^>]*?\s(?:id|name)="([^"]+)"', text)}
        self.targets = {unescape(target) for target in re.findall(r'<[^>]*?\s(?:href|src)="([^"]+)"', text)}


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
    assert unsaid == [], "`python -m tools.doc_tables` lists them"


@pytest.fixture(scope="module")
def browser(site: Path) -> Iterator["Browser"]:
    if reason := chromium.missing():
        pytest.skip(reason)
    with chromium.launch() as launched:
        yield launched


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_pages_are_sound_on_a_phone(site, browser, scheme):
    """From the disk, at 360 px: nothing wider than the screen, no complaint, contrast, names, sizes."""
    for name in ("index", "help/errors", "start/first-scene", "guides/gpu", "labels", "viewer"):
        address = (site / f"{name}.html").as_uri()
        with open_page(address, (360, 740), browser=browser, scheme=scheme) as opened:
            page = opened.page
            assert page.evaluate("document.documentElement.scrollWidth") <= 360, name
            assert page.evaluate("[...document.images].every((image) => image.alt)"), name
            assert wrong_with(page) == [], name
            assert opened.complaints == [], name


OUTSIDE = """() => {
  const at = document.activeElement;
  const box = at.getBoundingClientRect();
  const inside = box.right > 0 && box.bottom > 0 && box.left < innerWidth && box.top < innerHeight;
  return [at === document.body, inside ? "" : at.outerHTML.slice(0, 120)];
}"""


FOCUSED = """(drawer) => {
  const link = [...document.querySelectorAll(`${drawer} a`)].find((a) => a.getClientRects().length);
  link.focus();
  const box = link.getBoundingClientRect();
  return [link === document.activeElement, box.left >= 0 && box.right <= innerWidth];
}"""


def test_the_focus_stays_on_the_screen_of_a_phone(site, browser):
    """Drawers beside the screen take no focus while they are closed, and the keyboard opens them."""
    with open_page((site / "labels.html").as_uri(), (360, 740), browser=browser) as opened:
        page = opened.page
        page.add_style_tag(content="* { scroll-behavior: auto !important; transition: none !important; }")
        found = list[str]()
        for _ in range(100):
            page.keyboard.press("Tab")
            ended, outside = page.evaluate(OUTSIDE)
            if ended:
                break
            found.append(outside)
        assert len(found) > 10
        assert list(filter(None, found)) == []
        for switch, drawer in (("#__navigation", ".sidebar-drawer"), ("#__toc", ".toc-drawer")):
            assert page.evaluate(FOCUSED, drawer)[0] is False
            page.focus(switch)
            page.keyboard.press("Space")
            assert page.evaluate(FOCUSED, drawer) == [True, True]
            page.focus(switch)
            page.keyboard.press("Space")


def test_search_finds_a_flag_from_the_disk(site, browser):
    address = f"{(site / 'search.html').as_uri()}?q=gradient-freeze-share"
    with open_page(address, browser=browser) as opened:
        found = opened.wait_for("document.querySelectorAll('#search-results li a').length")
        assert found > 0
        assert opened.complaints == []


def test_scenes_of_the_gallery_are_live(site, browser):
    if not any((site / "gallery").glob("*.html")):
        pytest.skip("no scenes in build/gallery; `make gallery` makes one")
    handler = partial(SimpleHTTPRequestHandler, directory=str(site))
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        address = f"http://127.0.0.1:{server.server_port}/gallery.html"
        with open_page(address, (700, 500), browser=browser) as opened:
            inside = "document.querySelector('iframe.bundle').contentWindow.sagesplat"
            opened.page.evaluate("document.querySelector('iframe.bundle').scrollIntoView()")
            assert opened.wait_for(f"{inside} && {inside}.ready.then(() => {inside}.state().count > 0)", 60)
            assert opened.complaints == []
        server.shutdown()
