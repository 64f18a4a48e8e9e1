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
from sagesplat.formats.splats import read_splat, write_splat, writer_of
from tests.conftest import random_gaussians

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("suffix", [".ply", ".spz", ".SOG", ".glb", ".compressed.PLY"])
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
    known = r"\.ply, \.spz, \.sog, \.glb, \.compressed\.ply, \.splat, \.rad, \.ssog"
    with pytest.raises(DataError, match=rf"a\.ksplat: .* use {known} or lod-meta\.json"):
        write_splat(tmp_path / "a.ksplat", random_gaussians(3))
    with pytest.raises(DataError, match=r"several levels; name a \.ply, .* or \.rad"):
        write_splat(tmp_path / "lod-meta.json", random_gaussians(3))
    with pytest.raises(DataError, match=r"a\.ssog: holds several levels; name a \.ply"):
        write_splat(tmp_path / "a.ssog", random_gaussians(3))
    for name in ("a.html", "a.HTM"):  # what people try for a page
        with pytest.raises(
            DataError, match=rf"{name}: a page .* `sagesplat bundle RUN .* --single-file` writes"
        ):
            write_splat(str(tmp_path / name), random_gaussians(3))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "kind"), [("a.compressed.ply", "compressed PLY"), ("a.splat", ".splat"), ("b.compressed", "")]
)
def test_the_name_says_the_format(tmp_path, name, kind):
    if not kind:
        with pytest.raises(DataError, match="says no format"):
            writer_of(tmp_path / name)
        return
    g = random_gaussians(300, degree=1)
    g = replace(g, label_ids=(torch.arange(300) % 3 - 1).to(torch.int16))
    write_splat(tmp_path / name, g, {0: "tree", 1: "sky"}, parents={1: "sky-other"})
    splat = read_splat(tmp_path / name)
    assert splat.kind == kind
    assert (splat.names, splat.parents) == ({0: "tree", 1: "sky"}, {1: "sky-other"})
    rows = torch.cdist(g.means, splat.gaussians.means).argmin(1)
    assert rows.unique().numel() == 300
    back = splat.gaussians.select(rows)
    assert torch.equal(back.label_ids, g.label_ids)
    ranges = g.means.max(0).values - g.means.min(0).values
    steps = ranges / 1023 if kind == "compressed PLY" else torch.zeros(3)
    assert ((back.means - g.means).abs() <= steps).all()
    torch.testing.assert_close(back.log_scales, g.log_scales, atol=5e-3, rtol=0)
    torch.testing.assert_close(
        back.logit_opacities.sigmoid(), g.logit_opacities.sigmoid(), atol=0.51 / 255, rtol=0
    )
    colours, read = ((some.sh0 * 0.28209479 + 0.5).clamp(0, 1) for some in (g, back))
    torch.testing.assert_close(read, colours, atol=0.02, rtol=0)
    turns = torch.nn.functional.normalize(g.quats), torch.nn.functional.normalize(back.quats)
    assert ((turns[0] * turns[1]).sum(1).abs() > 0.9995).all()
    if kind == "compressed PLY":
        torch.testing.assert_close(back.shN, g.shN.clamp(-4, 4), atol=1 / 32 + 1e-6, rtol=0)
        assert (back.shN - g.shN.clamp(-4, 4)).mean(0).abs().max() < 2e-4  # rounding turns no colour


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
