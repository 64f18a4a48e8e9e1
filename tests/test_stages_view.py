"""What `sagesplat view` shows: a bundle, the bundle of a run, or a training as it goes on."""

import json
import os
import sys
import types
from pathlib import Path

import pytest

pytest.importorskip("starlette", reason="needs the extra `view`")
pytest.importorskip("uvicorn", reason="needs the extra `view`")
from conftest import wait_for
from test_viewer_server import MANIFEST, ask, viewing, write_files

from sagesplat.core.errors import BackendUnavailable, RunError, SageError
from sagesplat.run.records import FORMAT
from sagesplat.stages import view as stages_view
from sagesplat.stages.view import show
from sagesplat.viewer import server, site


@pytest.fixture
def bundle(tmp_path: Path) -> Path:
    return write_files(tmp_path / "bundle", {"manifest.json": MANIFEST})


def test_a_bundle_is_shown(bundle: Path, monkeypatch: pytest.MonkeyPatch):
    opened: list[str] = []
    monkeypatch.setattr(server, "has_display", lambda: True)
    monkeypatch.setattr(server.webbrowser, "open", opened.append)
    view = show(bundle, print, port=0)
    with viewing(view, browser=True) as port:
        assert f"adb reverse tcp:{port} tcp:{port}" in view.hint
        wait_for(lambda: opened == list(view.urls))
        assert ask(port, "/manifest.json")[2] == MANIFEST


def test_without_the_extra(bundle: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delitem(sys.modules, "sagesplat.viewer.site")
    monkeypatch.delattr("sagesplat.viewer.site")
    monkeypatch.setitem(sys.modules, "starlette.responses", None)
    with pytest.raises(BackendUnavailable, match=r"pip install 'sagesplat\[view\]'$"):
        show(bundle, print)


def scene(number: int) -> dict[str, bytes]:
    return {"scene.json": b"{}", "provenance/scene.json": json.dumps({"format": number}).encode()}


@pytest.mark.parametrize(
    ("contents", "message"),
    [
        ({}, r"neither a bundle \(no manifest.json\) nor a run folder"),
        ({"manifest.json": b'{"format": "other"}'}, r"manifest.json: not of a sagesplat bundle"),
        (scene(1), r"a run folder of format 1, this sagesplat \(.*\) reads \d; run again into a new"),
        (scene(FORMAT), r"no finished nested levels; run `sagesplat run` again with --ladder nested, or add"),
    ],
)
def test_other_folders(bundle: Path, tmp_path: Path, contents: dict[str, bytes], message: str):
    with pytest.raises(SageError, match=message):
        show(write_files(tmp_path, contents), print, port=0)
    with pytest.raises(RunError, match="no such folder"):
        show(tmp_path / "none", print)
    with pytest.raises(RunError, match="a bundle does not change; leave out --follow"):
        show(bundle, print, port=0, follow=True)


class Bundling(types.ModuleType):
    """In place of sagesplat.stages.bundle: writes what it is told to."""

    def __init__(self) -> None:
        super().__init__("sagesplat.stages.bundle")
        self.made = self.looked = 0
        self.live: bytes | None = None
        self.trouble = ""
        self.viewer: dict[str, bytes] = {}

    def bundle(self, job, out: Path) -> None:
        self.made += 1
        levels = [
            {"uri": f"chunks/{c['uri']}"}
            for c in json.loads((job.run.increments / "index.json").read_text())["chunks"]
        ]
        manifest = {
            "format": "sagesplat-bundle", "live": False, "labels": [{"cells": [{"levels": levels}]}],
            "ladder": "aa",
        }  # fmt: skip
        page = self.viewer["index.html"].replace(
            b"<!-- poster -->", b'<img id="poster" src="poster.jpg" alt="" />'
        )
        write_files(out, {"manifest.json": json.dumps(manifest).encode(), "index.html": page})

    def live_bundle(self, job, folder: Path) -> bool:
        self.looked += 1
        if self.trouble:
            raise RunError(self.trouble)
        if self.live is None:
            return False
        written = folder / "manifest.json"
        if written.exists() and written.read_bytes() == self.live:  # as the real one
            return False
        write_files(folder, {"manifest.json": self.live})
        return True


@pytest.fixture
def bundling(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Bundling:
    fake, package = Bundling(), tmp_path / "package"
    fake.viewer = {"index.html": b"one <!-- poster -->"}
    write_files(package / "viewer" / "static", fake.viewer)
    for name in ("bundle", "live_bundle"):
        monkeypatch.setitem(sys.modules, f"sagesplat.stages.{name}", fake)
    built = package / "viewer" / "static"
    monkeypatch.setattr(stages_view, "package_viewer", lambda: built)
    monkeypatch.setattr(site, "package_viewer", lambda: built)
    monkeypatch.setattr(stages_view, "_EVERY", 0.05)
    return fake


def write_run(folder: Path, chunks: bool = True) -> Path:
    contents = {"scene.json": b"{}", "provenance/scene.json": json.dumps({"format": FORMAT}).encode()}
    if chunks:
        contents["nested/increments/index.json"] = b'{"chunks": [{"uri": "aa"}, {"uri": "bb"}]}'
        contents["nested/promises.json"] = contents["nested/fidelity.json"] = b"{}"
    return write_files(folder, contents)


def test_a_run_s_bundle_is_made_once(tmp_path: Path, bundling: Bundling):
    run = write_run(tmp_path / "run")
    for _ in range(2):
        with show(run, print, port=0):
            pass
        assert bundling.made == 1


@pytest.mark.parametrize("change", ["chunks", "plan", "manifest"])
def test_and_again_when_it_is_out_of_date(tmp_path: Path, bundling: Bundling, change: str):
    run = write_run(tmp_path / "run")
    with show(run, print, port=0):
        pass
    if change == "chunks":
        (run / "nested/increments/index.json").write_text('{"chunks": [{"uri": "aa"}]}')
    elif change == "plan":
        for path in run.rglob("*"):
            os.utime(path, (0, 0))
        (run / "nested/plan.json").write_text("{ }")
    else:
        (run / "bundle/manifest.json").write_text('{"format": "sagesplat-bundle", "labels": [1]}')
    for _ in range(2):
        with show(run, print, port=0):
            pass
        assert bundling.made == 2


@pytest.mark.parametrize("begun", [False, True])
def test_a_run_that_has_not_read_its_photos_is_waited_for(tmp_path: Path, bundling: Bundling, begun: bool):
    run, events = tmp_path / "run", []
    if begun:
        write_files(run, {".lock": b""})
    with viewing(show(run, events.append, port=0, follow=True)) as port:
        assert b"Nothing has been trained yet" in ask(port, "/")[2]
        bundling.live = b'{"live": 1}'
        write_run(run, chunks=False)
        wait_for(lambda: ask(port, "/manifest.json")[2] == bundling.live)
    assert "no run yet" in events[0].text
    with pytest.raises(RunError, match="no such folder"):
        show(tmp_path / "none" / "run", print, port=0, follow=True)


def test_training_is_followed_to_its_end(tmp_path: Path, bundling: Bundling):
    run, events = write_run(tmp_path / "run", chunks=False), []
    view = show(run, events.append, port=0, follow=True)
    with viewing(view) as port:
        status, headers, body = ask(port, "/")
        assert (status, headers["refresh"], b"Nothing has been trained yet" in body) == (503, "2", True)
        assert ask(port, "/manifest.json")[0] == 503

        for live in (b'{"live": 1}', b'{"live": 2}'):
            bundling.live = live
            wait_for(lambda live=live: ask(port, "/manifest.json")[2] == live)
        tag = ask(port, "/manifest.json")[1]["etag"]
        assert ask(port, "/manifest.json", if_none_match=tag)[0] == 304

        write_files(run / "levels", {"000100.npz": b""})
        bundling.trouble = "a level that is being written"
        wait_for(lambda: len(events) > 0)
        looked = bundling.looked
        wait_for(lambda: bundling.looked > looked + 2)
        assert [event.text for event in events] == ["a level that is being written"]  # said once
        assert ask(port, "/manifest.json")[2] == b'{"live": 2}'

        write_run(run)
        wait_for(lambda: b'"live": false' in ask(port, "/manifest.json", if_none_match=tag)[2])
        assert ask(port, "/")[2].startswith(b"one")
        assert bundling.made == 1
