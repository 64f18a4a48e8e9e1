"""Splats of other tools: formats by content, values by hand, what is dropped, one line for the rest."""

import json
import struct
from pathlib import Path

import numpy as np
import pytest
import torch

from sagesplat.core.errors import DataError
from sagesplat.core.gaussians import PARAMETERS, Gaussians, concat
from sagesplat.formats.labels import sidecar, write_labels
from sagesplat.formats.ply import write_ply
from sagesplat.formats.splat import OPAQUE
from sagesplat.formats.splats import num_lods, read_splat
from sagesplat.formats.spz import encode_spz, write_spz
from tests.fuzz.readers.foreign_splats import archived, compressed_ply, dotsplat, put_sog, sog, streamed, webp
from tests.fuzz.readers.making import splats
from tests.test_formats_ply import columns_of, foreign, make, same


def close(values: torch.Tensor, expected: object, tolerance: float = 1e-6) -> None:
    np.testing.assert_allclose(values.numpy(), np.asarray(expected), rtol=tolerance, atol=tolerance)


def refused(path: Path, *parts: str, **options: object) -> None:
    with pytest.raises(DataError) as caught:
        read_splat(path, **options)  # type: ignore[arg-type]
    assert all(part in str(caught.value) for part in (str(path), *parts)), caught.value


def test_the_content_tells_the_format(tmp_path):
    g = splats(5)
    write_ply(tmp_path / "p", g, {2: "sky"})
    write_spz(tmp_path / "z.ply", g)
    (tmp_path / "c.spz").write_bytes(compressed_ply(300, 8))
    (tmp_path / "s.splat").write_bytes(archived(*sog(7)))
    (tmp_path / "d.SPLAT").write_bytes(dotsplat(4))
    put_sog(tmp_path / "folder", *sog(9, version=1))
    names = ("p", "z.ply", "c.spz", "s.splat", "d.SPLAT", "folder")
    read = {name: read_splat(tmp_path / name) for name in names}
    kinds = {name: (splat.kind, len(splat.gaussians), splat.antialiased) for name, splat in read.items()}
    assert kinds == {
        "p": ("PLY", 5, False),
        "z.ply": ("SPZ 3", 5, False),
        "c.spz": ("compressed PLY", 300, True),
        "s.splat": ("SOG", 7, True),
        "d.SPLAT": (".splat", 4, False),
        "folder": ("SOG 1", 9, False),
    }
    assert same(read["p"].gaussians, g)
    assert read["p"].names == {2: "sky"}
    assert all(num_lods(tmp_path / name) == 1 for name in names)


@pytest.mark.parametrize("bases", [0, 3, 8, 15])
def test_a_ply_of_any_order_and_type(tmp_path, bases):
    g = make(20, bases)
    columns = {name: column.astype(np.float64) for name, column in columns_of(g).items()}
    labels = np.arange(20, dtype=np.float32)
    foreign(tmp_path / "a.ply", dict(reversed(columns.items())) | {"label": labels.astype("f4")}, ">")
    read = read_splat(tmp_path / "a.ply")
    assert all(torch.equal(getattr(read.gaussians, name), getattr(g, name)) for name in PARAMETERS)
    assert read.gaussians.label_ids.tolist() == list(range(20))
    for dtype in ("u1", "u2", "u4"):
        unsigned = np.arange(20).astype(dtype)
        unsigned[3] = np.iinfo(dtype).max
        foreign(tmp_path / "a.ply", columns | {"label": unsigned})
        assert read_splat(tmp_path / "a.ply").gaussians.label_ids[2:5].tolist() == [2, -1, 4]
    foreign(tmp_path / "a.ply", columns | {"label": np.full(20, 2.5)})
    refused(tmp_path / "a.ply", "20 values of label")


def test_what_cannot_be_drawn_is_dropped_and_counted(tmp_path):
    g = make(8, 3)
    g.means[0, 1] = float("nan")
    g.shN[1, 2, 0] = float("inf")
    g.quats[2] = 0
    g.logit_opacities[3] = float("-inf")
    g.logit_opacities[4] = float("inf")
    g.log_scales[5, 0] = float("-inf")
    write_ply(tmp_path / "a.ply", g)
    splat = read_splat(tmp_path / "a.ply")
    assert splat.announced == 8
    assert splat.dropped == {"NaN or infinite": 2, "a rotation of zeros": 1, "invisible": 2}
    kept = g.select(torch.tensor([4, 6, 7]))
    kept.logit_opacities[0] = OPAQUE
    assert same(splat.gaussians, kept)


def test_none_left(tmp_path):
    g = make(3, 0)
    g.quats[:] = 0
    write_ply(tmp_path / "a.ply", g)
    refused(tmp_path / "a.ply", "none of its 3 Gaussians can be drawn (3 a rotation of zeros)")
    write_ply(tmp_path / "a.ply", make(0, 0))
    refused(tmp_path / "a.ply", "no Gaussians in it")
    (tmp_path / "a.splat").write_bytes(b"")
    refused(tmp_path / "a.splat", "no Gaussians in it")


def test_other_files_are_refused_in_one_line(tmp_path):
    (tmp_path / "a.ply").write_bytes(b"\x89PNG\r\n\x1a\n and so on")
    refused(tmp_path / "a.ply", "no splat format that is known")
    (tmp_path / "b.json").write_text('{"camera_model": "PINHOLE"}')
    refused(tmp_path / "b.json", "no splat format")
    (tmp_path / "c.sog").write_bytes(b"PK\x03\x04 and so on")
    refused(tmp_path / "c.sog", "a damaged archive")
    (tmp_path / "d.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n0\n"
    )
    refused(tmp_path / "d.ply", "13 splat properties missing (y, z, f_dc_0, f_dc_1, ...)")
    (tmp_path / "e.splat").write_bytes(bytes(33))
    refused(tmp_path / "e.splat", "1 bytes after 1 Gaussians")
    refused(tmp_path / "none.ply", "No such file")
    refused(tmp_path, "a folder without lod-meta.json or meta.json")
    write_ply(tmp_path / "f.ply", make(2, 0))
    refused(tmp_path / "f.ply", "PLY has one level", lod=1)


def test_a_compressed_ply_by_hand(tmp_path):
    content = compressed_ply(258, 3)
    (tmp_path / "a.ply").write_bytes(content)
    g = read_splat(tmp_path / "a.ply").gaussians
    body = content[content.index(b"end_header\n") + 11 :]
    row = 257
    chunk = struct.unpack_from("<18f", body, 72)  # smallest and largest x y z, of scales, of colours
    position, rotation, scale, colour = struct.unpack_from("<4I", body, 144 + 16 * row)

    def between(at: int, shares: list[float]) -> list[float]:
        low, high = chunk[at : at + 3], chunk[at + 3 : at + 6]
        return [a + (b - a) * share for a, b, share in zip(low, high, shares, strict=True)]

    def thirds(word: int) -> list[float]:
        return [(word >> 21) / 2047, (word >> 11 & 1023) / 1023, (word & 2047) / 2047]

    close(g.means[row], between(0, thirds(position)))
    close(g.log_scales[row], between(6, thirds(scale)))
    rgb = between(12, [(colour >> shift & 255) / 255 for shift in (24, 16, 8)])
    close(g.sh0[row, 0], [(value - 0.5) / 0.28209479177387814 for value in rgb], 1e-5)
    close(g.logit_opacities[row].sigmoid(), (colour & 255) / 255)
    others = [((rotation >> shift & 1023) / 1023 - 0.5) * 2**0.5 for shift in (20, 10, 0)]
    others.insert(rotation >> 30, max(0, 1 - sum(value**2 for value in others)) ** 0.5)
    close(g.quats[row], others)
    sh = body[144 + 16 * 258 + 9 * row :][:9]
    expected = [(0 if byte == 0 else 1 if byte == 255 else (byte + 0.5) / 256) * 8 - 4 for byte in sh]
    close(g.shN[row].T.flatten(), expected)


def test_other_elements_of_a_compressed_ply(tmp_path):
    sound = compressed_ply(300, 3)
    (tmp_path / "a.ply").write_bytes(sound)
    head, body = sound.split(b"end_header\n", 1)
    lists = b"".join(struct.pack("<B3i", 3, 0, 1, 2) for _ in range(5))
    face, first = b"element face 5\nproperty list uchar int vertex_indices\n", head.index(b"element")
    before = head[:first] + face + head[first:] + b"end_header\n" + lists + body
    for content in (before, head + face + b"end_header\n" + body + lists):
        (tmp_path / "b.ply").write_bytes(content)
        assert same(read_splat(tmp_path / "b.ply").gaussians, read_splat(tmp_path / "a.ply").gaussians)
    (tmp_path / "b.ply").write_bytes(before[:-1])
    refused(tmp_path / "b.ply", "truncated")


def test_a_compressed_ply_that_does_not_fit_together(tmp_path):
    sound = compressed_ply(300, 3)
    for old, new, message in (
        (b"element chunk 2", b"element chunk 1", "1 chunks for 300 Gaussians"),
        (b"uint packed_scale", b"uint packed_stale", "packed_scale"),
        (b"element sh 300", b"element sh 299", "299 rows of 9 harmonics"),
    ):
        (tmp_path / "a.ply").write_bytes(sound.replace(old, new))
        refused(tmp_path / "a.ply", message)
    (tmp_path / "a.ply").write_bytes(sound[:-1])
    refused(tmp_path / "a.ply", "truncated")


@pytest.mark.parametrize("version", [1, 2])
def test_a_sog_by_hand(tmp_path, version):
    meta, images = sog(11, 3, version=version)
    g = read_splat(put_sog(tmp_path, meta, images)).gaussians
    row = 10
    pixel = {
        name: [int(v) for v in image.reshape(-1, 4)[row]]
        for name, image in images.items()
        if "cen" not in name
    }

    def ranged(part: str, axis: int, value: float) -> float:
        low, high = meta[part]["mins"][axis], meta[part]["maxs"][axis]
        return low + (high - low) * value

    logs = [
        ranged("means", i, (pixel["means_l.webp"][i] + 256 * pixel["means_u.webp"][i]) / 65535)
        for i in range(3)
    ]
    close(g.means[row], np.sign(logs) * (np.exp(np.abs(logs)) - 1))
    scales, sh0, quats = pixel["scales.webp"][:3], pixel["sh0.webp"], pixel["quats.webp"]
    others = [(byte / 255 * 2 - 1) / 2**0.5 for byte in quats[:3]]
    others.insert(quats[3] - 252, max(0, 1 - sum(value**2 for value in others)) ** 0.5)
    close(g.quats[row], others)
    centroid = pixel["shN_labels.webp"][0] + 256 * pixel["shN_labels.webp"][1]
    palette = images["shN_centroids.webp"][centroid // 64, centroid % 64 * 3 :][:3, :3]
    if version == 1:
        close(g.log_scales[row], [ranged("scales", i, scales[i] / 255) for i in range(3)])
        close(g.sh0[row, 0], [ranged("sh0", i, sh0[i] / 255) for i in range(3)])
        close(g.logit_opacities[row], ranged("sh0", 3, sh0[3] / 255))
        close(g.shN[row], -0.5 + 0.75 * palette / 255)
    else:
        close(g.log_scales[row], [meta["scales"]["codebook"][byte] for byte in scales])
        close(g.sh0[row, 0], [meta["sh0"]["codebook"][byte] for byte in sh0[:3]])
        close(g.logit_opacities[row].sigmoid(), sh0[3] / 255)
        close(g.shN[row], np.array(meta["shN"]["codebook"])[palette])


def test_a_sog_that_does_not_fit_together(tmp_path):
    meta, images = sog(300, 3)
    path = put_sog(tmp_path, meta, images)
    small = webp(images["sh0.webp"][:2])
    for change, message in (
        ({"count": 10**9}, "1,000,000,000 Gaussians announced"),
        ({"version": 3}, "version 3"),
        ({"scales": meta["scales"] | {"codebook": [1.0] * 257}}, "codebook of 257"),
        ({"sh0": meta["sh0"] | {"files": ["../sh0.webp"]}}, "is no file name"),
        ({"means": meta["means"] | {"mins": [0]}}, "in place of 3 numbers"),
        ({"quats": None}, "not a SOG scene"),
    ):
        path.write_text(json.dumps(meta | change))
        refused(path, message)
    path.write_text(json.dumps(meta))
    (tmp_path / "sh0.webp").write_bytes(small)
    refused(path, "pixels for 300 Gaussians")
    (tmp_path / "shN_labels.webp").write_bytes(webp(images["shN_labels.webp"] * 0 + 255))
    (tmp_path / "sh0.webp").write_bytes(webp(images["sh0.webp"]))
    refused(path, "row 65535 of a palette of 128")


def put_streamed(folder: Path) -> Path:
    for level, seed in (("0_0", 1), ("1_0", 2)):
        put_sog(folder / level, *sog(6, 0, seed=seed))
    (folder / "lod-meta.json").write_text(json.dumps(streamed()))
    return folder / "lod-meta.json"


def test_a_level_of_a_streamed_sog(tmp_path):
    path = put_streamed(tmp_path)
    assert num_lods(path) == 2
    fine, coarse = (read_splat(tmp_path / level / "meta.json").gaussians for level in ("0_0", "1_0"))
    assert same(read_splat(tmp_path).gaussians, fine)
    splat = read_splat(path, 1)
    assert splat.kind == "streamed SOG"
    assert same(splat.gaussians, coarse.select(torch.arange(2)))
    refused(path, "no level 2; it has 0 (the finest) to 1", lod=2)
    path.write_text(json.dumps(streamed() | {"environment": "1_0/meta.json"}))
    assert same(read_splat(path).gaussians, concat([fine, coarse]))
    path.write_text(json.dumps(streamed() | {"environment": ""}))  # as other tools say that there is none
    assert same(read_splat(path).gaussians, fine)


def test_a_streamed_sog_that_does_not_fit_together(tmp_path):
    path = put_streamed(tmp_path / "a")
    put_sog(tmp_path / "b", *sog(6, 0))
    leaf = {"file": 0, "offset": 0, "count": 4}
    for change, message in (
        ({"filenames": ["../b/meta.json"] * 2}, "is not in its folder"),
        ({"filenames": [str(tmp_path / "b" / "meta.json")] * 2}, "is not in its folder"),
        ({"filenames": ["a\u202eb"] * 2}, "is no file name"),
        ({"environment": "x" * 1001}, "is no file name"),
        ({"lodLevels": 0}, "lodLevels: expected int >= 1"),
        ({"tree": {"lods": {"0": leaf | {"offset": 3}}}}, "do not fit the 6 rows"),
        ({"tree": {"children": [{"lods": {"0": leaf}}] * 2}}, "do not fit the 6 rows"),
        ({"tree": {"lods": {"1": leaf}}}, "level 0 has no Gaussians"),
    ):
        path.write_text(json.dumps(streamed() | change))
        refused(path, message)
    (tmp_path / "a" / "circle").symlink_to("circle")
    path.write_text(json.dumps(streamed() | {"filenames": ["circle/meta.json"] * 2}))
    refused(path, "circle/meta.json")
    (tmp_path / "a" / "link").symlink_to(tmp_path / "b")
    path.write_text(json.dumps(streamed() | {"filenames": ["link/meta.json"] * 2}))
    refused(path, "is not in its folder")


def test_a_dotsplat_by_hand(tmp_path):
    row = struct.pack("<6f8B", 1, -2, 3, 0.5, 1, 2, 255, 0, 127, 64, 255, 128, 0, 64)
    zero = struct.pack("<6f8B", *[1] * 6, *[9] * 4, *[128] * 4)
    flat = struct.pack("<6f8B", 1, 1, 1, 0, 1, 1, *[9] * 8)
    (tmp_path / "a.splat").write_bytes(row + zero + flat)
    splat = read_splat(tmp_path / "a.splat")
    g = splat.gaussians
    assert splat.dropped == {"a rotation of zeros": 1, "invisible": 1}
    close(g.means[0], [1, -2, 3])
    close(g.log_scales[0].exp(), [0.5, 1, 2])
    close(g.sh0[0, 0] * 0.28209479177387814 + 0.5, [1, 0, 127 / 255])
    close(g.logit_opacities.sigmoid(), [64 / 255])
    close(g.quats[0], [127 / 128, 0, -1, -0.5])


def test_labels_beside_a_file(tmp_path):
    path = tmp_path / "a.splat"
    path.write_bytes(dotsplat(6))
    labels = torch.tensor([3, 3, -1, 3, 7, 7], dtype=torch.int16)
    written = write_labels(path, labels, {3: "tree", 5: "sky"})
    assert json.loads(written.read_text()) == {
        "format": "sagesplat-labels",
        "version": 1,
        "names": {"3": "tree"},
        "counts": {"3": 3, "-1": 1, "7": 2},
        "runs": [[3, 2], [-1, 1], [3, 1], [7, 2]],
    }
    splat = read_splat(path)
    assert torch.equal(splat.gaussians.label_ids, labels)
    assert splat.names == {3: "tree"}
    path.write_bytes(dotsplat(7))
    with pytest.raises(DataError, match=r"no labels of a.splat .*7 rows.*delete it"):
        read_splat(path)
    for content in ("{}", "[]", '{"format": "sagesplat-labels", "version": 1, "names": 3, "runs": [[1, 7]]}'):
        sidecar(path).write_text(content)
        with pytest.raises(DataError, match=r"no labels of a.splat"):
            read_splat(path)


def test_spz_axes(tmp_path):
    g: Gaussians = make(9, 3)
    (tmp_path / "a.spz").write_bytes(encode_spz(g, frame="rdf", fractional_bits=12))
    close(read_splat(tmp_path / "a.spz", spz_axes="rdf").gaussians.means, g.means, 1e-3)
    close(read_splat(tmp_path / "a.spz").gaussians.means, g.means * torch.tensor([1, -1, -1]), 1e-3)


def test_a_codebook_that_is_too_short_drops_what_needs_it(tmp_path):
    meta, images = sog(40, 0)
    meta["scales"]["codebook"] = meta["scales"]["codebook"][:200]
    splat = read_splat(put_sog(tmp_path, meta, images))
    wrong = int((images["scales.webp"].reshape(-1, 4)[:40, :3] >= 200).any(1).sum())
    assert wrong
    assert splat.dropped == {"NaN or infinite": wrong}
