"""Splat formats are found in one registry: what is written is read back, an added format is opened."""

from dataclasses import replace
from pathlib import Path
from types import ModuleType

import pytest
import torch

import sagesplat
from sagesplat.cli import stages, tools
from sagesplat.cli.help import help_of
from sagesplat.core.errors import DataError
from sagesplat.formats.registry import READERS, WRITERS
from sagesplat.formats.splat import SplatReader, SplatWriter
from sagesplat.formats.splats import read_splat, write_splat
from tests.conftest import random_gaussians

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("suffix", [".ply", ".spz", ".SOG"])
def test_categories_and_flags_are_kept(tmp_path, suffix, antialiased):
    g = random_gaussians(60, degree=1)
    g = replace(g, label_ids=(torch.arange(60) // 25 - 1).to(torch.int16))
    path = tmp_path / f"a{suffix}"
    write_splat(path, g, {0: "tree", 1: "Blume ☘"}, antialiased=antialiased)
    splat = read_splat(path)
    assert splat.names == {0: "tree", 1: "Blume ☘"}
    assert splat.antialiased == antialiased
    assert splat.gaussians.counts() == g.counts() == {-1: 25, 0: 25, 1: 10}
    for label in (0, 1):
        ours, read = g.of_labels([label]), splat.gaussians.of_labels([label])
        assert torch.allclose(ours.means.mean(0), read.means.mean(0), atol=5e-3)


def test_other_names_are_refused(tmp_path):
    with pytest.raises(DataError, match=r"a\.glb: .* use \.ply, \.spz, \.sog or lod-meta\.json"):
        write_splat(tmp_path / "a.glb", random_gaussians(3))
    with pytest.raises(DataError, match=r"several levels; name a \.ply, \.spz or \.sog"):
        write_splat(tmp_path / "lod-meta.json", random_gaussians(3))
    assert list(tmp_path.iterdir()) == []


# The file that docs/architecture.md, "How to add a file format", asks for.
TOY = """
import torch

from sagesplat.core.errors import DataError
from sagesplat.core.gaussians import Gaussians
from sagesplat.formats.splat import Splat, SplatReader, SplatWriter
from sagesplat.io.files import atomic_path


def write_toy(path, g):
    with atomic_path(path) as temporary:
        temporary.write_text("toy\\n" + "\\n".join(" ".join(map(str, row)) for row in g.means.tolist()))


def read_toy(path):
    rows = [[float(word) for word in line.split()] for line in path.read_text().split("\\n")[1:]]
    if any(len(row) != 3 for row in rows):
        raise DataError(f"{path}: not three numbers a line; write it again")
    z, n = torch.zeros, len(rows)
    labels = torch.full((n,), -1, dtype=torch.int16)
    g = Gaussians(torch.tensor(rows), z(n, 4) + 1, z(n, 3), z(n), z(n, 1, 3), z(n, 0, 3), labels)
    return Splat(g, "toy")


READER = SplatReader(lambda path, _: read_toy(path), magic=(b"toy\\n",))
WRITER = SplatWriter(lambda path, g, *_: write_toy(path, g))
"""


def test_a_format_is_a_file_and_a_line(tmp_path, monkeypatch):
    toy = ModuleType("toy")
    exec(TOY, toy.__dict__)
    monkeypatch.setitem(READERS, "toy", toy.READER)
    monkeypatch.setitem(WRITERS, ".toy", toy.WRITER)
    g = random_gaussians(5)
    write_splat(tmp_path / "a.toy", g)
    (tmp_path / "a.toy").rename(tmp_path / "renamed")  # the content tells the format
    splat = sagesplat.read_splat(tmp_path / "renamed")
    assert splat.kind == "toy"
    assert torch.equal(splat.gaussians.means, g.means)
    (tmp_path / "b").write_bytes(b"toy\n1 2")
    with pytest.raises(DataError, match="not three numbers"):
        sagesplat.read_splat(tmp_path / "b")
    (tmp_path / "c").write_bytes(b"other")
    with pytest.raises(DataError, match=r"one of .*, toy$"):
        sagesplat.read_splat(tmp_path / "c")
    with pytest.raises(DataError, match=r"use .* or \.toy$"):
        write_splat(tmp_path / "a.other", g)


def test_every_file_with_a_reader_or_writer_is_registered():
    registered = [*READERS.values(), *WRITERS.values()]
    folder = ROOT / "src/sagesplat/formats"
    modules = [__import__(f"sagesplat.formats.{path.stem}", fromlist=["x"]) for path in folder.glob("*.py")]
    found = [v for m in modules for v in vars(m).values() if isinstance(v, SplatReader | SplatWriter)]
    assert {id(one) for one in found} == {id(one) for one in registered}


def test_help_and_documents_name_the_registered_formats():
    page = (ROOT / "docs/formats.md").read_text()
    for text in (help_of("adopt", stages.adopt), page):
        assert [kind for kind in READERS if kind not in " ".join(text.split())] == []
    for text in (help_of("export", tools.export), page):
        assert [name for name in WRITERS if name not in text] == []
    clean = help_of("clean", stages.clean)
    assert [name for name, writer in WRITERS.items() if writer.write and name not in clean] == []
