"""The checks of pages find what is wrong, and nothing else."""

from collections.abc import Iterator
from typing import Any

import browser as chromium
import pytest
from browser import launch
from page_checks import wrong_with, wrong_with_keyboard

pytestmark = pytest.mark.skipif(chromium.missing() is not None, reason=chromium.missing() or "")

SOUND = """<!doctype html><html lang="en"><head><title>t</title>
<meta name="viewport" content="width=device-width"><style>
 body { background: #fff; color: #222 } button, input { min-width: 24px; min-height: 24px }
 .card { position: fixed; bottom: 0; color: #222; background: rgb(255 255 255 / 90%) }
</style></head><body><main><h1>One</h1><h2>Two</h2>
<button>Press</button> <a href="#x">link</a> <label>Name <input></label> <div class="card">over anything</div>
CONTENT</main></body></html>"""
BROKEN = {
    '<p style="color:#999">pale</p>': "contrast 2.85",
    '<p style="opacity:.4">faint</p>': "contrast",
    '<p style="position:fixed;background:rgb(255 255 255 / 50%)">on what?</p>': "contrast",
    '<p style="color:#888;font-size:18px"> nearly large</p>': "contrast 3.54",
    "<button><svg></svg></button>": "no name",
    "<input>": "no name",
    '<button style="min-width:0;width:9px;padding:0" title="x"></button>': "smaller than 24 px",
    '<img src="data:,">': "no alt",
    '<p id="a">1</p><p id="a">2</p>': "id twice",
    "<h4>Four</h4>": "heading jumps",
    '<div style="width:2000px;height:3px"></div>': "px wide",
}


@pytest.fixture(scope="module")
def page() -> Iterator[Any]:
    with launch() as browser:
        yield browser.new_page(viewport={"width": 360, "height": 500})


def test_a_sound_page(page: Any) -> None:
    page.set_content(SOUND.replace("CONTENT", '<p style="color:#888;font-size:24px">large</p>'))
    assert wrong_with(page) == []
    assert wrong_with_keyboard(page) == []


@pytest.mark.parametrize("content", BROKEN)
def test_what_is_wrong_is_found(page: Any, content: str) -> None:
    page.set_content(SOUND.replace("CONTENT", content))
    found = wrong_with(page)
    assert found, content
    assert all(BROKEN[content] in line for line in found)


@pytest.mark.parametrize(
    ("content", "what"),
    [
        ("<style>:focus { outline: none }</style>", "focus is not shown"),
        ('<button style="position:fixed;left:-99px">Away</button>', "focus is out of the window"),
    ],
)
def test_a_focus_that_nobody_sees(page: Any, content: str, what: str) -> None:
    page.set_content(SOUND.replace("CONTENT", content))
    assert any(what in line for line in wrong_with_keyboard(page))
