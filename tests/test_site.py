"""The documentation site: builds without a warning, links lead somewhere, pages are sound in a browser."""

import re
import subprocess
import sys
from collections.abc import Iterator
from html import unescape
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import unquote, urlsplit

import browser as chromium
import pytest
from browser import open_page
from page_checks import wrong_with

import sagesplat
from sagesplat import cli
from sagesplat.cli.help import flags_of

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytestmark = pytest.mark.slow
ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"


class Page:
    """The anchors of a page, and where its links and pictures lead."""

    def __init__(self, text: str) -> None:
        self.anchors = {unescape(name) for name in re.findall(r'<[^>]*?\s(?:id|name)="([^"]+)"', text)}
        self.targets = {unescape(target) for target in re.findall(r'<[^>]*?\s(?:href|src)="([^"]+)"', text)}
        self.links = {unescape(target) for target in re.findall(r'<a\b[^>]*?\shref="([^"]+)"', text)}


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest) -> Path:
    """The site in a theme; Sphinx's plain one takes three quarters of the time of ours."""
    pytest.importorskip("sphinx", reason="Sphinx is missing: pip install '.[docs]'")
    out = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", "-b", "html", "-d", out / "trees"]
    command += ["-D", f"html_theme={request.param}"]
    done = subprocess.run([*command, DOCS, out / "html"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return out / "html"


@pytest.mark.parametrize("site", ["basic", "furo"], indirect=True, scope="module")
def test_links_pictures_and_anchors_lead_somewhere(site):
    pages = {path: Page(path.read_text()) for path in site.rglob("*.html")}
    assert len(pages) > 35
    gone = []
    for path, page in pages.items():
        for target in page.targets:
            link = urlsplit(target)
            if link.scheme or link.netloc:  # a link; scripts, styles and pictures are the site's own
                gone += [] if target in page.links else [f"{path.name} loads {target}"]
                continue
            there = (path.parent / unquote(link.path)).resolve() if link.path else path
            found = there.exists() and there.is_relative_to(site)
            anchor = unquote(link.fragment)
            if found and anchor and there in pages:
                found = anchor in pages[there].anchors
            gone += [] if found else [f"{path.relative_to(site)}: {target}"]
    assert gone == []


@pytest.mark.parametrize("site", ["basic"], indirect=True, scope="module")
def test_every_command_and_public_name_is_in_the_reference(site):
    pages = {f"cli/{name}.html": name for name in cli.commands()}
    assert set(pages) <= Page((site / "reference/cli.html").read_text()).links
    for page, name in pages.items():
        anchors = Page((site / "reference" / page).read_text()).anchors
        flags = [flag.name for flag in flags_of(cli.commands()[name]) if flag.name.startswith("--")]
        assert len([one for one in anchors if one.startswith(f"cmdoption-sagesplat-{name}")]) >= len(flags)
    python = Page((site / "reference/python.html").read_text())
    assert {f"sagesplat.{name}" for name in sagesplat.__all__} <= python.anchors
    for kind in sagesplat.Event.__args__:
        assert any(one.endswith(f".{kind.__name__}") for one in python.links), "Event links to its kinds"


@pytest.fixture(scope="module")
def browser(site: Path) -> Iterator["Browser"]:
    if reason := chromium.missing():
        pytest.skip(reason)
    with chromium.launch() as launched:
        yield launched


@pytest.mark.parametrize("site", ["furo"], indirect=True, scope="module")
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


@pytest.mark.parametrize("site", ["furo"], indirect=True, scope="module")
def test_search_finds_a_flag_from_the_disk(site, browser):
    address = f"{(site / 'search.html').as_uri()}?q=freeze-at"
    with open_page(address, browser=browser) as opened:
        found = opened.wait_for("document.querySelectorAll('#search-results li a').length")
        assert found > 0
        assert opened.complaints == []
