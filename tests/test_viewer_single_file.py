"""A bundle as one page: what is in it, and what it is not written over."""

import base64
import hashlib
import json
import re
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from conftest import pinhole, random_gaussians

from sagesplat.adapt.cells import describe_cells
from sagesplat.core.errors import DataError, RunError
from sagesplat.formats.increments import DIGITS, write_increments
from sagesplat.formats.stream_header import AS_GIVEN
from sagesplat.formats.stream_increments import write_streams
from sagesplat.viewer import single_file
from sagesplat.viewer.manifest import CameraEntry, Category, Contents
from sagesplat.viewer.single_file import write_single_file

SCRIPT = 'const a = "</script><!-- <SCRIPT>";'
PAGE = """<!doctype html>
<html lang="en">
  <head>
    <meta http-equiv="Content-Security-Policy" content="default-src 'none'; script-src 'self'" />
    <link rel="preload" href="manifest.json" as="fetch" crossorigin  />
    <script type="module" crossorigin src="./assets/index-1.js"></script>
    <link rel="stylesheet" crossorigin href="./assets/index-2.css">
  </head>
  <body>
    <!-- poster -->
    <p class="hint">
      It needs a web server.
    </p>
  </body>
</html>
"""


@pytest.fixture
def viewer(tmp_path: Path) -> Path:
    folder = tmp_path / "viewer"
    (folder / "assets").mkdir(parents=True)
    (folder / "index.html").write_text(PAGE)
    (folder / "assets" / "index-1.js").write_text(SCRIPT)
    (folder / "assets" / "index-2.css").write_text("a { color: red }")
    (folder / "assets" / "spark-1.wasm").write_bytes(b"\0asm")
    (folder / "THIRD_PARTY_LICENSES.txt").write_text("MIT")
    return folder


@pytest.fixture
def contents(tmp_path: Path) -> Contents:
    g = random_gaussians(30, degree=1).select(torch.arange(30))
    sizes = {label: (2, n) for label, n in g.counts().items()}
    chunks = write_increments(
        tmp_path / "chunks", g, sizes, {3: "car", 184: "tree"}, label_of={i: i for i in sizes}
    )
    categories = [Category(i, f"c{i}", f"c{i}", "#808080") for i in sizes]
    cells, cameras = describe_cells(g, {i: i for i in sizes}), [CameraEntry("a.jpg", "train", pinhole())]
    return Contents("tiny", 1.0, cameras, categories, cells, chunks, tmp_path / "chunks", 1)


def test_everything_is_in_the_page(tmp_path, viewer, contents) -> None:
    out = tmp_path / "new" / "scene.html"
    written = write_single_file(out, contents, viewer, b"\xff\xd8")
    page = out.read_text()
    files = {
        uri: base64.b64decode(text)
        for uri, text in re.findall(
            r'<script type="application/octet-stream" data-uri="([^"]+)">([^<]*)</', page
        )
    }
    manifest = json.loads(files.pop("manifest.json"))
    assert manifest["pack"] is None
    assert (files.pop("THIRD_PARTY_LICENSES.txt"), b"Apache" in files.pop("LICENSES.txt")) == (b"MIT", True)
    assert files.pop("assets/spark.wasm") == b"\0asm"  # there are levels in SPZ
    levels = [level for label in manifest["labels"] for cell in label["cells"] for level in cell["levels"]]
    assert [hashlib.sha256(files[level["uri"]]).hexdigest()[:DIGITS] for level in levels] == [
        level["sha256"] for level in levels
    ]
    assert len(files) == len(levels)
    assert (written.total, written.chunks) == (len(out.read_bytes()), sum(map(len, files.values())))
    assert "data:image/jpeg;base64,/9g=" in page
    assert not re.search(r'(src|href)="(?!data:)', page)
    assert "web server" not in page
    write_single_file(tmp_path / "again.html", contents, viewer, b"\xff\xd8")
    assert (tmp_path / "again.html").read_bytes() == out.read_bytes()


def test_its_policy_names_its_script_and_style_and_nothing_ends_the_script(
    tmp_path, viewer, contents
) -> None:
    write_single_file(tmp_path / "a.html", contents, viewer)
    page = (tmp_path / "a.html").read_text()
    (script,) = re.findall(r'<script type="module">(.*?)</script>', page)
    assert script == r'const a = "\x3c/script>\x3c!-- <SCRIPT>";'
    (style,) = re.findall(r"<style>(.*?)</style>", page)
    for kind, text in (("script-src", script), ("style-src", style)):
        hashed = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
        assert f"{kind} 'sha256-{hashed}'" in page
    assert page.count("Content-Security-Policy") == 1
    assert "'self'" not in page


def test_only_new_files_and_earlier_pages_are_written(tmp_path, viewer, contents) -> None:
    mine, folder, page = tmp_path / "mine.html", tmp_path / "folder.html", tmp_path / "scene.HTM"
    mine.write_text("<p>my page")
    folder.mkdir()
    for out, says in (
        (mine, "not a page that sagesplat wrote; name a new file"),
        (folder, "a folder; name a new file"),
        (tmp_path / "bundle", r"name that ends in \.html"),
    ):
        with pytest.raises(RunError, match=says):
            write_single_file(out, contents, viewer)
    assert mine.read_text() == "<p>my page"
    write_single_file(page, contents, viewer)
    write_single_file(page, contents, viewer)
    before = page.read_bytes()
    next((tmp_path / "chunks").glob("tree*")).write_bytes(b"damaged")
    with pytest.raises(DataError, match="not the chunk that was written"):
        write_single_file(page, contents, viewer)
    assert page.read_bytes() == before
    assert sorted(p.name for p in tmp_path.iterdir() if p.is_file()) == ["mine.html", "scene.HTM"]


def test_what_browsers_do_not_open_is_refused(tmp_path, viewer, contents, monkeypatch) -> None:
    monkeypatch.setattr(single_file, "MOST", 100)
    with pytest.raises(
        RunError, match=r"a\.html: .* MB of increments are more than .*leave out --single-file"
    ):
        write_single_file(tmp_path / "a.html", contents, viewer)
    assert not (tmp_path / "a.html").exists()


def test_streams_of_cells_that_take_turns_in_a_file_are_checked_and_written(tmp_path, viewer) -> None:
    """The lowest sets of all cells of a category come first in its file, then what replaces them."""
    g = random_gaussians(60, degree=1)
    cells = torch.arange(60, dtype=torch.int16) // 30
    g = replace(g, label_ids=cells, logit_opacities=torch.full((60,), 1.0))
    sizes, label_of = {0: (4, 30), 1: (4, 30)}, {0: 7, 1: 7}
    made = write_streams(
        tmp_path / "chunks", g, sizes, {7: "tree"}, label_of=label_of, replaces={0: (2,), 1: (2,)},
        last=AS_GIVEN[0],
    )  # fmt: skip
    assert len({one.uri for one in made.increments}) == 1
    cameras = [CameraEntry("a.jpg", "train", pinhole())]
    contents = Contents(
        "tiny", 1.0, cameras, [Category(7, "tree", "tree", "#808080")], describe_cells(g, label_of),
        made.increments, tmp_path / "chunks", 1,
    )  # fmt: skip
    write_single_file(tmp_path / "a.html", contents, viewer)
    inside = re.findall(r'data-uri="chunks/([^"]+)">([^<]*)<', (tmp_path / "a.html").read_text())
    assert [base64.b64decode(text) for _, text in inside] == [
        (tmp_path / "chunks" / made.increments[0].uri).read_bytes()
    ]
