"""A whole run whose categories, photos and folders have awkward names."""

import csv
import json
import os
import re
import sys
from pathlib import Path

import numpy as np
import pytest
from conftest import cell_text, random_gaussians, write_capture
from PIL import Image

from sagesplat import cli
from sagesplat.io.files import read_json, write_json

NAMES = {
    1: "[/red]", 2: '=HYPERLINK("x")', 3: "$x^2$", 4: "_grass", 5: "a|b & c_%", 6: "日本語", 7: "e\u0301",
    8: "🚗" * 100, 9: "tree", 10: "Tree", 11: "<b>:car:\\", 12: "-merged",
}  # fmt: skip
KEPT = {**NAMES, 7: "\u00e9"}
SMALL = (
    "--train.max-steps 4 --train.level-every 2 --nest.steps 2 --nest.levels 2 --nest.base-share 0 "
    "--test-every 4 --calibrate-every 3 --threads 1"
)


def call(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], *words: str | Path) -> str:
    """What a command prints; it must succeed."""
    monkeypatch.setattr(sys, "argv", ["sagesplat", *map(str, words)])
    try:
        cli.main()
    except SystemExit as end:
        pytest.fail(f"{end.code}: {capfd.readouterr().err}")
    return "".join(capfd.readouterr())


def make_capture(folder: Path) -> None:
    """Photos with a stripe of each category, at another place in each."""
    scene = write_capture(folder, random_gaussians(300, degree=1, logit=2.0), noise=0.02)
    (folder / "masks").mkdir()
    for row, view in enumerate(scene.views):
        ids = np.roll(np.repeat(np.arange(1, 13, dtype=np.uint8), 4), 4 * row)
        Image.fromarray(np.tile(ids, (32, 1))).save(folder / "masks" / view.name)
    write_json(folder / "masks" / "labels.json", {"labels": {str(i): name for i, name in NAMES.items()}})
    (folder / "masks" / os.fsdecode(b"caf\xe9.txt")).write_text("of no use")


@pytest.mark.slow
@pytest.mark.filterwarnings("error")
def test_a_run_with_awkward_names(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    capture, run = (tmp_path / os.fsdecode(name) for name in (b"[old] caf\xe9 $x$", b"[/red] \xff"))
    make_capture(capture)
    info = call(monkeypatch, capfd, "info", capture)
    assert r"[old] caf\xe9 $x$" in info
    printed = call(monkeypatch, capfd, "run", capture, run, *SMALL.split())
    for name in ("[/red]", "=HYPERLINK", "日本語", ":car:\\"):
        assert name in printed
    assert r"[/red] \xff" in printed
    assert not re.search(r"[\x00-\x09\x0b-\x1f\x7f-\x9f]", printed.replace("\x1b[", ""))
    assert read_json(run / "masks" / "labels.json")["labels"] == {str(i): n for i, n in KEPT.items()}

    page = (run / "nested" / "report" / "index.html").read_text("utf-8")
    assert "&lt;b&gt;:car:\\" in page
    with (run / "nested" / "report" / "tables" / "plan.csv").open(newline="", encoding="utf-8") as file:
        cells = [row[0] for row in csv.reader(file)]
    assert {cell_text(cell) for cell in cells} > set(KEPT.values())
    assert not [cell for cell in cells if cell.startswith(("=", "-", "+", "@"))]

    call(
        monkeypatch, capfd, "bundle", run, tmp_path / "out", "--always", NAMES[7], "--weights", "[/red]", "2"
    )
    manifest = json.loads((tmp_path / "out" / "manifest.json").read_text("utf-8"))
    labels = {label["name"]: label for label in manifest["labels"]}
    assert labels.keys() - {"unlabelled"} == set(KEPT.values())
    assert labels["\u00e9"]["always"]
    assert labels["[/red]"]["weight"] == 2
    uris = [
        {level["uri"] for cell in label["cells"] for level in cell["levels"]} for label in manifest["labels"]
    ]
    assert len(set().union(*uris)) == sum(map(len, uris))  # no category has a file of another one
    assert all(re.fullmatch(r"chunks/[a-z0-9-]+-[0-9a-f]{12}\.sgst", uri) for some in uris for uri in some)

    said = call(monkeypatch, capfd, "export", run, run / "a.ply", "--level", "2", "--only", NAMES[7])
    assert r"[/red] \xff/a.ply" in said
