"""Readers of splat files, levels, arrays and training checkpoints."""

import json
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch

from sagesplat.adapt.ladder import read_ladder, read_prefixes
from sagesplat.core.gaussians import Gaussians
from sagesplat.core.second_opacity import SecondOpacities
from sagesplat.formats.increments import read_increments, read_index, totals
from sagesplat.formats.levels import check_level, read_level, write_level, write_set
from sagesplat.formats.offsets import read_offset
from sagesplat.formats.ply import read_ply, write_ply
from sagesplat.formats.spz import encode_spz, read_spz
from sagesplat.formats.stream import decode_stream, encode_stream, palette_of, starts_of_streams
from sagesplat.formats.stream_header import harmonics_of, turned_round
from sagesplat.formats.stream_increments import read_streams
from sagesplat.formats.stream_palette import Palette
from sagesplat.scene.scene import Camera, Lens, Points, Scene, View
from sagesplat.scene.stored import read_scene, write_scene
from sagesplat.segment.lift import LiftedLabels
from sagesplat.train.boundaries import BlockLevels, read_block, write_block
from sagesplat.train.checkpoint import latest_checkpoint, write_checkpoint
from sagesplat.train.state import initial_state
from sagesplat.train.view_parameters import ViewParameters
from tests.fuzz.hostile import Reader
from tests.fuzz.readers.making import PHOTOS, as_json, file, splats, written

SETTINGS = json.dumps({"settings": {"steps": 2, "antialiased": True}})  # of the checkpoint
CHUNK = {"label_id": 2, "cell": 2, "level": 1, "count": 3, "nbytes": 99, "gpu_bytes": 48, "sha256": "0" * 64}


def _ply(folder: Path, size: int) -> list[bytes]:
    return [written(folder / "g.ply", lambda path: write_ply(path, splats(3 * size), {2: "sky"}))]


def _spz(folder: Path, size: int) -> list[bytes]:
    if size > 1:  # the best that gzip can do: nothing but zeros
        return [encode_spz(_equal(3 * size))]
    labelled = encode_spz(splats(), names={1: "tree"})
    return [encode_spz(splats()), encode_spz(splats(bases=0), coarse=True), labelled]


def _streams(folder: Path, size: int) -> list[bytes]:
    if size > 1:  # the best that the coder can do: nothing but the likeliest symbols
        return [encode_stream(_equal(3 * size), [size, 3 * size]).content]
    second = SecondOpacities(torch.linspace(-3, 3, 5), {2: (0.0, 0.5, 1.0)})
    some = [encode_stream(splats(5, bases), [1, 3, 5]).content for bases in (0, 3, 15)]
    some.append(encode_stream(splats(5), [1, 3, 5], second=second).content)
    palette = Palette(1, (5, 4), harmonics_of(turned_round(splats(5)).shN, (5, 4), 1.0))
    rows = encode_stream(splats(5), [1, 3, 5], palette=palette).content
    return [*some, some[0] + some[-1] + some[1], palette.encoded() + rows + some[0]]


def _read_streams(folder: Path, content: bytes) -> None:
    starts, palette = starts_of_streams(content), palette_of(content)
    for start, end in pairwise([*starts, len(content)]):
        decode_stream(content[start:end], palette=palette)


def _equal(count: int) -> Gaussians:
    return splats(1).select(torch.zeros(count, dtype=torch.int64))


def _index(folder: Path, size: int) -> list[bytes]:
    content = encode_spz(splats())
    (folder / "sky-01.spz").write_bytes(content)
    chunk = CHUNK | {"uri": "sky-01.spz", "nbytes": len(content)}
    chunks = [chunk | {"level": 1 + i % 3} for i in range(size)]
    write_ply(folder / "sky-02.ply", splats())
    replacing = chunk | {"uri": "sky-02.ply", "level": 2, "refine": "REPLACE"}
    both = {"format": "spz+ply", "chunks": [chunk, replacing]}
    streams = {"format": "stream", "chunks": _ranges(folder)}
    sets = [one | {"cell": 2, "level": level} for level, one in enumerate(_ranges(folder), 1)]
    sets[2]["refine"] = "REPLACE"  # a second stream of the cell
    last = {"format": "stream+ply", "chunks": [*sets, replacing | {"level": 5}]}
    return as_json(
        {"format": "spz", "chunks": chunks}, {"format": "spz", "chunks": [chunk, chunk]}, both, streams, last
    )


def _ranges(folder: Path) -> list[dict[str, Any]]:
    """The entries of two coded streams with two opacities, which lie in one file of the folder."""
    second = SecondOpacities(torch.linspace(-3, 3, 5), {2: (0.0, 0.5, 1.0)})
    coded = encode_stream(splats(5), [1, 3, 5], second=second)
    (folder / "sky-0.sgst").write_bytes(2 * coded.content)
    part = CHUNK | {"uri": "sky-0.sgst"}
    return [
        part
        | {"cell": cell, "level": k, "count": k, "nbytes": high - low, "offset": start + low, "weight": w}
        for cell, start in ((2, 0), (5, len(coded.content)))
        for k, (low, high), w in zip((1, 2), pairwise((0, *coded.ends)), coded.weights, strict=False)
    ]


def _read_index(path: Path) -> None:
    chunks = read_index(path.parent)
    totals(chunks, [2, 5], 5, "nbytes")
    if len(chunks) < 10:  # what many chunks hold is not bounded by their index
        read_increments(path.parent, chunks)
        if {chunk.format for chunk in chunks} == {"stream"}:
            read_streams(path.parent, chunks)


def checkpoints(folder: Path, size: int) -> list[bytes]:
    state = initial_state(splats(3 * size), 0)
    state.queue, state.frozen = [1, 0], {2: 1}
    state.per_view = {"pose": ViewParameters.zeros(3, 6)}
    return [written(folder / "c.npz", lambda path: write_checkpoint(path, state, SETTINGS))]


def _read_checkpoint(path: Path) -> None:
    latest_checkpoint(path, SETTINGS)


def _levels(folder: Path, size: int) -> list[bytes]:
    write_level(folder, 7, splats(3 * size), recovering=False, sh_degree=1)
    return [written(folder / "000007.npz", lambda path: None)]


def _read_level(path: Path) -> None:
    check_level(path)
    read_level(path)


def _read_snapshots(path: Path) -> None:
    ladder = read_ladder(path.parent)
    ladder.load(ladder.levels[-1])


def _nested(folder: Path, size: int) -> list[bytes]:
    g = splats(3 * size)
    sizes = {2: [1, 3 * size - 1], 5: [0, 1]}
    plain = partial(write_set, g=g, step=7, sizes=sizes, place=np.ones(3 * size))
    if size > 1:
        return [written(folder / "n.npz", plain)]
    return [
        written(folder / "n.npz", write) for write in (plain, partial(plain, replaces={2: [2]}, exact=True))
    ]


def _read_nested(path: Path) -> None:
    ladder = read_prefixes(path)
    ladder.load(ladder.levels[-1])


def _block(folder: Path, size: int) -> list[bytes]:
    block = BlockLevels(splats(3 * size), {2: (1, 3 * size - 1), 5: (0, 1)}, {2: 3, 5: 184})
    return [written(folder / "b.npz", lambda path: write_block(path, block, 7))]


def _lifted(folder: Path, size: int) -> list[bytes]:
    count = np.ones(4 * size, np.int32)
    (folder / "points").write_text(str(len(count)))
    return [written(folder / "l.npz", LiftedLabels(count.astype(np.int16) - 1, count, count).write)]


def _read_lifted(path: Path) -> None:
    LiftedLabels.read(path, int(path.with_name("points").read_text()))


def _stored(folder: Path, size: int) -> list[bytes]:
    camera = Camera(np.eye(4, dtype=np.float32), np.eye(3, dtype=np.float32), 8, 6)
    lens = Lens("OPENCV", (4.0, 4.0, 4.0, 3.0, 0.1, 0.0, 0.0, 0.0), 8, 6)
    views = tuple(View(f"{i}{n}", camera, Path(f"/p/{i}{n}"), lens) for i in range(size) for n in PHOTOS)
    rows, xyz = np.arange(3), np.zeros((3, 3), np.float32)
    points = Points(xyz, xyz.astype(np.uint8), rows, rows.astype(np.int32), xyz[:, :2])
    return [written(folder / "s.npz", lambda path: write_scene(path, Scene("s", folder, views, points)))]


READERS = (
    Reader("ply-splats", ".ply", _ply, file("g.ply", read_ply)),
    Reader(
        "offset",
        ".xyz",
        lambda folder, size: [b"412346 5312345 188" + b" " * size + b"\n"],
        file("g.ply.offset.xyz", lambda path: read_offset(path.with_name("g.ply"))),
        3000,
    ),
    Reader("spz", ".spz", _spz, file("g.spz", read_spz), 10_000),
    Reader("stream", ".sgst", _streams, _read_streams, 10_000),
    Reader("chunks", ".json", _index, file("index.json", _read_index)),
    Reader("checkpoint", ".npz", checkpoints, file("c.npz", _read_checkpoint)),
    Reader("block-levels", ".npz", _block, file("b.npz", read_block)),
    Reader("level", ".npz", _levels, file("000007.npz", _read_level)),
    Reader("snapshots", ".npz", _levels, file("levels/000007.npz", _read_snapshots)),
    Reader("nested", ".npz", _nested, file("n.npz", _read_nested)),
    Reader("lifted", ".npz", _lifted, file("l.npz", _read_lifted), 3000),
    Reader("stored", ".npz", _stored, file("s.npz", read_scene), 100),
)
