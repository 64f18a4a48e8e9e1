"""Writes RAD version 1, Spark's splats in chunks of 65,536, without a tree of levels, which Spark can build.

All numbers are little endian, and what follows a text or a property begins at a multiple of 8 bytes:

    "RAD0", length of the JSON (uint32), JSON with the places of the chunks
    for each chunk: "RADC", length of its JSON (uint32), JSON, bytes of its properties (uint64), properties

A property is raw deflate of one component of all splats after the other. `f32_lebytes` has the first bytes of
all floats, then the second, and so on; `ln_f16` are half floats of logarithms, `s8` signed bytes of parts of
`max`. A rotation is x y z of a quaternion with a positive w. Labels are beside the file.

The format is that of Spark 2.2's `rad.rs` (MIT licence; described, not copied). It does not say whether the
scene was trained with antialiasing; Spark draws so unless it is told otherwise.
"""

import json
import struct
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from sagesplat.core.errors import DataError
from sagesplat.core.gaussians import Gaussians
from sagesplat.core.sh import sh0_to_rgb
from sagesplat.formats.labels import write_or_remove_labels
from sagesplat.formats.sog_write import GENERATOR
from sagesplat.formats.splat import SplatWriter, check_writable
from sagesplat.io.files import atomic_path

_CHUNK = 65536
_HALF = 65504  # the largest half float


def write_rad(
    path: Path,
    g: Gaussians,
    names: Mapping[int, str] | None = None,
    *,
    parents: Mapping[int, str] | None = None,
) -> int:
    """Write Gaussians as a RAD file, atomically, with the labels beside it; rows keep their order.

    Positions are float32; opacities, colours, log scales and rotations half floats; harmonics of a degree are
    rounded to 1/127 of their largest.

    Args:
        path: The .rad to write.
        g: N Gaussians in COLMAP's axes, on any device. Spark shows them as they are, y down.
        names: Category names by label id, for the sidecar.
        parents: Names of the categories that instances are of, by the instance's label id; likewise.

    Returns:
        The size in bytes, without the sidecar.

    Raises:
        DataError: For no Gaussians, NaN or Inf, or a quaternion of zeros.
    """
    g = g.detach().to("cpu")
    check_writable(g, str(path))
    if not len(g):
        raise DataError(f"{path}: no Gaussians; write other levels")
    largest = [float(band.abs().max()) or 1.0 for band in _bands(g)]
    chunks = [
        _chunk(g.select(torch.arange(first, min(first + _CHUNK, len(g)))), first, largest)
        for first in range(0, len(g), _CHUNK)
    ]
    ends = np.cumsum([0, *map(len, chunks)]).tolist()
    places = [{"offset": at, "bytes": len(chunk)} for at, chunk in zip(ends, chunks, strict=False)]
    head = _text(b"RAD0", {
        "version": 1, "type": "gsplat", "count": len(g), "maxSh": g.sh_degree, "chunkSize": _CHUNK,
        "allChunkBytes": ends[-1], "chunks": places, "comment": GENERATOR,
    })  # fmt: skip
    with atomic_path(path) as temporary:
        temporary.write_bytes(b"".join([head, *chunks]))
    write_or_remove_labels(path, g.label_ids, names or {}, parents or {})
    return len(head) + ends[-1]


def _bands(g: Gaussians) -> list[torch.Tensor]:
    """The harmonics of each degree, [N, 2 degree + 1, 3]."""
    return [g.shN[:, degree * degree - 1 : (degree + 1) ** 2 - 1] for degree in range(1, g.sh_degree + 1)]


def _chunk(g: Gaussians, first: int, largest: list[float]) -> bytes:
    properties, content = [], b""
    for described, values in _properties(g, largest):
        packer = zlib.compressobj(9, zlib.DEFLATED, -15)  # -15: raw
        packed = packer.compress(values) + packer.flush()
        properties.append(described | {"offset": len(content), "bytes": len(packed), "compression": "gz"})
        content += _padded(packed)
    size = len(content)
    head = _text(b"RADC", {
        "version": 1, "base": first, "count": len(g), "payloadBytes": size, "maxSh": g.sh_degree,
        "properties": properties,
    })  # fmt: skip
    return head + struct.pack("<Q", size) + content


def _properties(g: Gaussians, largest: list[float]) -> Iterator[tuple[dict[str, Any], bytes]]:
    """Name and encoding of each property, and its bytes."""
    quats = torch.nn.functional.normalize(g.quats.double())
    quats = torch.where(quats[:, :1] < 0, -quats, quats)
    halves = {
        "alpha": ("f16", g.logit_opacities.sigmoid()[:, None]),
        "rgb": ("f16", sh0_to_rgb(g.sh0[:, 0])),
        "scales": ("ln_f16", g.log_scales),
        "orientation": ("f16", quats[:, 1:]),
    }
    floats = np.ascontiguousarray(g.means.numpy().T, "<f4")
    yield {"property": "center", "encoding": "f32_lebytes"}, floats.reshape(-1, 1).view(np.uint8).T.tobytes()
    for name, (encoding, values) in halves.items():
        rows = values.clamp(-_HALF, _HALF).numpy().T
        yield {"property": name, "encoding": encoding}, np.ascontiguousarray(rows, "<f2").tobytes()
    for i, (band, most) in enumerate(zip(_bands(g), largest, strict=True), start=1):
        steps = (band.flatten(1) / most * 127).round().numpy().T
        described = {"property": f"sh{i}", "encoding": "s8", "min": -most, "max": most}
        yield described, np.ascontiguousarray(steps, np.int8).tobytes()


def _text(magic: bytes, document: dict[str, Any]) -> bytes:
    text = json.dumps(document).encode()
    return magic + struct.pack("<I", len(text)) + _padded(text)


def _padded(content: bytes) -> bytes:
    return content + bytes(-len(content) % 8)


WRITER = SplatWriter(lambda path, g, names, parents, antialiased: write_rad(path, g, names, parents=parents))
