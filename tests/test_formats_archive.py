"""Archives with a splat in them: streamed SOG in one file, zipped files; several, none, hostile ones."""

import io
import json
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch

from sagesplat.core.errors import DataError
from sagesplat.formats import archive
from sagesplat.formats.labels import sidecar
from sagesplat.formats.ply import write_ply
from sagesplat.formats.splats import num_lods, read_splat, write_splat
from tests.fuzz.readers.foreign_splats import archived, gltf, put_sog, sog, streamed
from tests.test_formats_ply import make, same


def zipped(path: Path, files: dict[str, bytes]) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as made:
        for name, content in files.items():
            made.writestr(name, content)
    return path


def files_below(folder: Path, above: str = "") -> dict[str, bytes]:
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {above + path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


@pytest.mark.parametrize("above", ["", "scene/", "a/b c/"])
def test_a_streamed_sog_in_one_file(tmp_path, above):
    folder = tmp_path / "scene"
    for level in ("0_0", "1_0"):
        put_sog(folder / level, *sog(6, 0, seed=int(level[0])))
    (folder / "lod-meta.json").write_text(json.dumps(streamed()))
    path = zipped(tmp_path / "scene.ssog", files_below(folder, above) | {"__MACOSX/._lod-meta.json": b"x"})
    assert num_lods(path) == 2
    for lod in (0, 1):
        assert same(read_splat(path, lod).gaussians, read_splat(folder, lod).gaussians)
    assert read_splat(path).kind == "streamed SOG in a ZIP"
    with pytest.raises(DataError, match=r"scene\.ssog: .*lod-meta\.json: no level 2"):
        read_splat(path, 2)


def test_one_splat_in_an_archive(tmp_path):
    g = make(30, 8)
    write_ply(tmp_path / "a.ply", g, {3: "tree"})
    inside = {
        "x/a.ply": (tmp_path / "a.ply").read_bytes(),
        "x/a.ply.labels.json": sidecar(tmp_path / "a.ply").read_bytes(),
    }
    others = {"x/cameras.json": b"[]", "x/input.png": b"png", ".hidden.ply": b"ply", "meta.json": b"{}"}
    splat = read_splat(zipped(tmp_path / "a.zip", others | inside))
    assert same(splat.gaussians, g)
    assert splat.kind == "PLY in a ZIP"
    document, content = gltf(make(4, 0))
    document["buffers"] = [{"uri": "b.bin"}]
    both = {"s.gltf": json.dumps(document).encode(), "b.bin": content, "b.txt": b"x"}
    assert len(read_splat(zipped(tmp_path / "b.zip", both)).gaussians) == 4
    sog_file = archived(*sog(7))
    assert read_splat(zipped(tmp_path / "c.zip", {"a/s.sog": sog_file})).kind == "SOG in a ZIP"
    with zipfile.ZipFile(io.BytesIO(sog_file)) as made:
        parts = {f"a/{name}": made.read(name) for name in made.namelist()}
    assert len(read_splat(zipped(tmp_path / "d.zip", parts)).gaussians) == 7


def test_what_lies_beside_a_splat_in_an_archive(tmp_path):
    """Its offset counts; points of its capture are no second splat."""
    g = make(30, 0)
    write_splat(tmp_path / "a.ply", g, offset=(412346.0, 5312346.0, 188.0))
    inside = {f"x/{path.name}": path.read_bytes() for path in tmp_path.iterdir()}
    header = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n"
    points = {"input.ply": f"{header}end_header\n1 2 3\n".encode()}
    splat = read_splat(zipped(tmp_path / "a.zip", inside | points))
    assert splat.offset == (412346.0, 5312346.0, 188.0)
    assert torch.equal(splat.gaussians.means, g.means)
    with pytest.raises(DataError, match=r"b\.zip: input\.ply: \d+ splat properties missing"):
        read_splat(zipped(tmp_path / "b.zip", points))


def test_archives_that_are_refused(tmp_path, monkeypatch):
    write_ply(tmp_path / "a.ply", make(30, 0))
    content = (tmp_path / "a.ply").read_bytes()
    for files, message in (
        ({"a.ply": content, "b/c.ply": content, "d.SPZ": b""}, r"3 splats in it \(a.ply, b/c.ply, d.SPZ\)"),
        ({"a.txt": content}, "an archive without a splat"),
        ({"../a.ply": content, "/b.ply": content, "c\\d.ply": content}, "an archive without a splat"),
        ({"a.zip": content}, "an archive without a splat"),
        ({"a.ply": content[:-9]}, r"bad\.zip: a\.ply: 30 Gaussians announced, 29 present"),
        ({"a.ply": np.random.default_rng(0).bytes(999)}, r"bad\.zip: a\.ply: no splat format"),
    ):
        with pytest.raises(DataError, match=message) as caught:
            read_splat(zipped(tmp_path / "bad.zip", files))
        assert str(caught.value).startswith(f"{tmp_path / 'bad.zip'}: ")
    monkeypatch.setattr(archive, "_FREE", 2**16)
    with pytest.raises(DataError, match="unpacks to too much"):
        read_splat(zipped(tmp_path / "bomb.zip", {"a.ply": content + bytes(10**6)}))
    path = zipped(tmp_path / "a.zip", {"a.ply": content})
    path.write_bytes(path.read_bytes()[:-30])
    with pytest.raises(DataError, match=r"a\.zip: a damaged archive .*; copy it again"):
        read_splat(path)


def test_nothing_stays_behind(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "tmp"))
    (tmp_path / "tmp").mkdir()
    write_ply(tmp_path / "a.ply", make(3, 0))
    path = zipped(tmp_path / "a.zip", {"a.ply": (tmp_path / "a.ply").read_bytes()})
    assert torch.equal(read_splat(path).gaussians.means, make(3, 0).means)
    assert list((tmp_path / "tmp").iterdir()) == []
