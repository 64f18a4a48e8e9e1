"""Labels edited in a real browser, and the server that takes the edits."""

import http.client
import json
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import browser as chromium
import numpy as np
import pytest
from browser import Opened, open_page
from test_viewer_browser import SIZES, cloud, full, ready, serve, settled, three_walls

from sagesplat.core.errors import RunError
from sagesplat.formats.label_edits import Rename, Split, ladder_hash, parse_edits, ranks_of
from sagesplat.formats.stream_increments import read_streams, write_streams
from sagesplat.stages.view import show
from sagesplat.viewer.built import package_viewer
from sagesplat.viewer.bundle import write_bundle

needs_browser = [
    pytest.mark.skipif(chromium.missing() is not None, reason=chromium.missing() or ""),
    pytest.mark.skipif(not (package_viewer() / "index.html").exists(), reason="the viewer is not built"),
]
browser_test = lambda test: [mark(test) for mark in needs_browser][-1]  # noqa: E731
NAMES = {1: "chair 1", 2: "grass-merged", 3: "chair 2"}


@pytest.fixture(scope="module")
def bundle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three walls as streams: two instances of chair, and between them grass, whose left half is white."""
    return _written(tmp_path_factory.mktemp("edit"))


def _written(folder: Path, **streams: Any) -> Path:
    contents = three_walls(folder)
    g = cloud()
    white = ((g.label_ids == 2) & (g.means[:, 0] < 0))[:, None, None]
    g = replace(g, sh0=g.sh0.masked_fill(white, 1.7))
    made = write_streams(folder / "streams", g, SIZES, NAMES, label_of={i: i for i in SIZES}, **streams)
    contents = replace(
        contents,
        categories=[
            replace(one, name=name, title=name)
            for one in contents.categories
            for name in [NAMES[one.label_id]]
        ],
        chunks=made.increments, folder=folder / "streams", ladder=ladder_hash(made.increments, NAMES),
    )  # fmt: skip
    write_bundle(folder / "bundle", contents, package_viewer())
    manifest = json.loads((folder / "bundle" / "manifest.json").read_text())
    for label in manifest["labels"]:
        if label["name"].startswith("chair"):
            label["parent"] = "chair"
    (folder / "bundle" / "manifest.json").write_text(json.dumps(manifest))
    return folder / "bundle"


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium.launch() as running:
        yield running


@pytest.fixture
def editing(bundle: Path, browser: Any) -> Iterator[Opened]:
    with serve(bundle) as url, open_page(url, (900, 640), browser=browser) as opened:
        ready(opened, 1)
        full(opened)
        opened.page.keyboard.press("l")
        yield opened
        assert opened.complaints == []


def said(opened: Opened) -> str:
    return opened.page.inner_text(".picked")


def choose(opened: Opened, name: str) -> None:
    opened.page.locator(".tree button", has_text=name).first.click()


@browser_test
def test_a_click_selects_what_lights_up_and_again_selects_the_next_scope(editing: Opened) -> None:
    page = editing.page
    before = settled(editing)
    page.mouse.click(450, 320)
    assert said(editing).startswith("grass-merged · ")
    lit = settled(editing)
    assert np.abs(lit - before).max() > 0.2
    page.mouse.click(450, 320)
    editing.wait_for("document.querySelector('.picked').textContent.startsWith('part of grass-merged')")
    page.keyboard.press("Escape")
    assert said(editing).startswith("Click what you mean")
    assert np.abs(settled(editing) - before).max() < 0.02
    page.mouse.click(450, 40)
    assert said(editing) == "Nothing is there"


@browser_test
def test_a_region_is_split_off_by_its_ranks(editing: Opened, bundle: Path) -> None:
    page = editing.page
    page.mouse.click(490, 330)  # right of the middle: not white
    page.locator(".scopes button", has_text="Alike").click()
    editing.wait_for("document.querySelector('.picked').textContent.startsWith('part of')")
    page.get_by_label("Name", exact=True).fill("right half")
    page.get_by_label("Make the selection a category").click()
    assert said(editing).startswith("right half · ")
    with page.expect_download() as waiting:
        page.locator(".editor button", has_text="Save").click()
    edits = parse_edits(Path(waiting.value.path()).read_bytes())
    (split,) = edits.operations
    assert isinstance(split, Split)
    ranks = ranks_of(split.gaussians["grass-merged"])
    g, _ = read_streams(bundle.parent / "streams", _listed(bundle))
    grass = g.of_labels([2])
    chosen = np.zeros(len(grass), bool)
    chosen[ranks] = True
    is_white = (grass.sh0[:, 0].min(1).values > 1).numpy()
    assert not (chosen & is_white).any()
    assert chosen.sum() > 0.8 * (~is_white).sum()  # all but those that lie apart


@pytest.mark.slow
@browser_test
def test_where_levels_replace_those_below_ranks_are_of_the_last_one(tmp_path: Path, browser: Any) -> None:
    """Merged splats are in no category of their own: the full model is loaded while the editor is open."""
    bundle = _written(tmp_path, replaces=dict.fromkeys(SIZES, (3,)))
    with serve(bundle) as url, open_page(url, (900, 640), browser=browser) as opened:
        ready(opened, 1)
        page = opened.page
        page.evaluate("sagesplat.set({mode: 'base'})")
        page.keyboard.press("l")
        opened.wait_for("!document.querySelector('.picked').textContent.startsWith('Loading')")
        page.mouse.click(490, 330)
        page.locator(".scopes button", has_text="Alike").click()
        opened.wait_for("document.querySelector('.picked').textContent.startsWith('part of')")
        page.get_by_label("Name", exact=True).fill("right half")
        page.get_by_label("Make the selection a category").click()
        with page.expect_download() as waiting:
            page.locator(".editor button", has_text="Save").click()
        edits = parse_edits(Path(waiting.value.path()).read_bytes())
        assert opened.complaints == []
    (split,) = edits.operations
    assert isinstance(split, Split)
    grass = read_streams(tmp_path / "streams", _listed(bundle))[0].of_labels([2])
    last = grass.sh0[SIZES[2][1] :, 0]  # the third level replaces the second
    is_white = (last.min(1).values > 1).numpy()
    chosen = np.zeros(len(is_white), bool)
    chosen[ranks_of(split.gaussians["grass-merged"])] = True
    assert not (chosen & is_white).any()
    assert chosen.sum() > 0.8 * (~is_white).sum()


def _listed(bundle: Path) -> list[Any]:
    from sagesplat.formats.increments import read_index

    return read_index(bundle.parent / "streams")


@pytest.mark.slow
@browser_test
def test_every_step_works_by_keyboard(editing: Opened) -> None:
    page = editing.page
    page.evaluate("document.activeElement.blur()")
    page.keyboard.press("Enter")
    assert said(editing).startswith("grass-merged")
    page.get_by_label("Name", exact=True).focus()
    page.keyboard.press("Control+a")
    page.keyboard.type("Wiese <b>")
    page.keyboard.press("Tab")
    page.keyboard.press("Enter")  # on "Rename"
    assert said(editing).startswith("Wiese <b> · ")
    page.evaluate("document.getElementById('view').focus()")
    page.keyboard.press("h")
    assert "hidden" in page.locator(".tree button", has_text="Wiese").inner_text()
    page.keyboard.press("f")
    assert "in full" in page.locator(".tree button", has_text="Wiese").inner_text()
    for _ in range(3):
        page.keyboard.press("Control+z")
    assert page.locator(".tree button", has_text="Wiese").count() == 0
    page.keyboard.press("Control+y")
    assert page.locator(".tree button", has_text="Wiese").count() == 1
    page.keyboard.press("l")
    assert page.locator(".editor").is_hidden()


@pytest.mark.slow
@browser_test
def test_instances_are_a_tree_and_fold_back(editing: Opened) -> None:
    page = editing.page
    chair = page.locator(".labels > li", has_text="chair")
    assert chair.count() == 1
    assert "2 instances" in chair.inner_text()
    chair.locator(".instances").first.click()
    assert chair.locator(".parts .name").all_inner_texts() == ["chair 1", "chair 2"]
    choose(editing, "chair")
    assert said(editing).startswith("chair 1, chair 2 · ")
    page.locator(".editor button", has_text="Always in full").click()
    assert page.evaluate("[...sagesplat.settings().always]") == [[1, True], [3, True]]
    page.get_by_label("Weight", exact=True).select_option("4")
    assert page.evaluate("[...sagesplat.settings().weights.values()]") == [4, 1, 4]
    page.get_by_label("Category to merge with").select_option("chair 1")
    page.get_by_label("Merge with the chosen category").click()
    assert said(editing).startswith("chair 1 · ")
    assert page.locator(".tree button").count() == 2


@pytest.mark.slow
@browser_test
def test_a_phone_has_room_for_all_of_it(bundle: Path, browser: Any) -> None:
    with serve(bundle) as url, open_page(url, (360, 740), browser=browser, touch=True) as opened:
        ready(opened, 1)
        page = opened.page
        page.get_by_label("Edit labels (L)").tap()
        page.touchscreen.tap(180, 150)
        opened.wait_for("document.querySelector('.editor button')")
        boxes = [
            one.bounding_box() for one in page.locator(".editor :is(button, select, .field):visible").all()
        ]
        assert all(box and box["x"] >= 0 and box["x"] + box["width"] <= 360 for box in boxes)
        for name in ("Rename", "Split off", "Merge", "Hide", "Always in full", "Save"):
            assert page.locator(".editor button", has_text=name).first.is_visible()
        choose(opened, "grass")
        page.locator(".editor button", has_text="Hide").tap()
        assert "hidden" in page.locator(".tree button", has_text="grass").inner_text()
        assert opened.complaints == []


# the server


EDITS = {
    "format": "sagesplat-label-edits",
    "version": 1,
    "ladder": "a" * 64,
    "operations": [{"op": "rename", "category": "car", "to": "auto"}],
}


@pytest.fixture
def served(tmp_path: Path) -> Iterator[tuple[int, str, Path]]:
    """Port, token and the file of edits of a server that takes them."""
    pytest.importorskip("uvicorn", reason="needs the extra `view`")
    from test_viewer_server import running

    from sagesplat.viewer.edit_endpoint import EditEndpoint
    from sagesplat.viewer.site import Site

    taking = EditEndpoint(tmp_path / "labels.edit.json", lambda: "a" * 64)
    with running(Site(tmp_path, routes=(taking.route,))) as port:
        yield port, taking.token, tmp_path / "labels.edit.json"


def ask(port: int, method: str, token: str | None, body: Any = None, **headers: str) -> tuple[int, str]:
    sent = {"host": f"localhost:{port}", **headers, **({"x-sagesplat-token": token} if token else {})}
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
    content = body if isinstance(body, bytes | None) else json.dumps(body).encode()
    with closing(connection):
        connection.request(method, "/labels.edit.json", content, sent)
        answer = connection.getresponse()
        return answer.status, answer.read().decode()


def test_edits_are_saved_and_read_back(served: tuple[int, str, Path]) -> None:
    port, token, path = served
    assert ask(port, "GET", token) == (204, "")
    status, text = ask(port, "PUT", token, EDITS, origin=f"http://localhost:{port}")
    assert (status, text) == (200, f"Saved; `sagesplat labels apply {path.parent}` makes it so")
    assert parse_edits(path.read_bytes()).operations == (Rename("car", "auto"),)
    assert json.loads(ask(port, "GET", token)[1]) == EDITS


@pytest.mark.parametrize(
    ("headers", "why"),
    [
        ({"host": "evil.example"}, "does not answer to this name"),
        ({"origin": "http://evil.example"}, "other sites"),
        ({"sec-fetch-site": "cross-site"}, "other sites"),
    ],
)
def test_other_sites_are_refused(served: tuple[int, str, Path], headers: dict[str, str], why: str) -> None:
    port, token, path = served
    status, text = ask(port, "PUT", token, EDITS, **headers)
    assert (status, why in text) == (403, True)
    assert not path.exists()


@pytest.mark.parametrize("token", [None, "x" * 32, "\xe9"])
def test_without_the_token_nothing_is_read_or_written(
    served: tuple[int, str, Path], token: str | None
) -> None:
    port, _, path = served
    assert ask(port, "PUT", token, EDITS)[0] == ask(port, "GET", token)[0] == 403
    assert not path.exists()


@pytest.mark.parametrize(
    ("body", "status", "why"),
    [
        ({**EDITS, "version": 9}, 422, "version 9"),
        ({**EDITS, "ladder": "b" * 64}, 409, "another run"),
        ({**EDITS, "operations": [{"op": "rename", "category": "car", "to": "a\u202eb"}]}, 422, "U+202E"),
    ],
)
def test_what_is_no_edit_is_not_saved(
    served: tuple[int, str, Path], body: Any, status: int, why: str
) -> None:
    port, token, path = served
    got, text = ask(port, "PUT", token, body)
    assert (got, why in text, "\n" in text) == (status, True, False)
    assert not path.exists()


def test_preflights_and_other_methods_get_nothing(served: tuple[int, str, Path]) -> None:
    port, token, _ = served
    for method in ("OPTIONS", "DELETE", "POST"):
        assert ask(port, method, token, origin="http://evil.example")[0] == 405


def test_labels_are_edited_on_this_machine_only(finished_run: Path) -> None:
    with pytest.raises(RunError, match="this machine only"):
        show(finished_run, lambda event: None, host="0.0.0.0", edit=True)
    with pytest.raises(RunError, match="leave out --follow"):
        show(finished_run, lambda event: None, follow=True, edit=True)


@pytest.mark.slow
@browser_test
def test_the_viewer_saves_in_the_run_folder(finished_run: Path, tmp_path: Path, browser: Any) -> None:
    import shutil

    from test_viewer_server import viewing

    run = tmp_path / "run"
    shutil.copytree(finished_run, run)
    view = show(run, lambda event: None, port=0, edit=True)
    url = view.urls[0]
    assert "#edit=" in url
    with viewing_at(view, viewing), open_page(url, (900, 640), browser=browser) as opened:
        ready(opened, 1)
        opened.wait_for("!document.querySelector('.editor').hidden")
        choose(opened, "car")
        opened.page.get_by_label("Name", exact=True).fill("auto")
        opened.page.locator(".editor button", has_text="Rename").click()
        opened.page.locator(".editor button", has_text="Save").click()
        opened.wait_for("document.querySelector('.picked').textContent.startsWith('Saved')")
        assert parse_edits((run / "labels.edit.json").read_bytes()).operations == (Rename("car", "auto"),)
        opened.page.reload()
        opened.wait_for("[...document.querySelectorAll('.tree span')].some((s) => s.textContent === 'auto')")
        assert opened.complaints == []


def viewing_at(view: Any, viewing: Any) -> Any:
    """`viewing`, which takes the port from an address without a token."""
    return viewing(replace(view, urls=tuple(url.partition("#")[0] for url in view.urls)))
