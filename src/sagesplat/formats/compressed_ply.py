"""PlayCanvas's compressed PLY: chunks of 256 Gaussians with the range of their values, 16 bytes a Gaussian.

Element `chunk` has the smallest and largest position, log scale and colour of each 256 rows of `vertex`,
which packs into four 32-bit words, from the highest bits on:

    packed_position   x 11 bits, y 10, z 11, between the chunk's
    packed_rotation   2 bits: which of w x y z is largest, positive and omitted; the others, 10 bits each:
                      value / sqrt(2) + 0.5
    packed_scale      as the position
    packed_color      r g b, 8 bits each, between the chunk's; opacity

Element `sh`, if it is there, has f_rest_0.. as bytes: value / 8 + 0.5.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch

from sagesplat.core.errors import DataError, short
from sagesplat.core.gaussians import Gaussians
from sagesplat.core.sh import BASES, C0
from sagesplat.formats.labels import write_or_remove_labels
from sagesplat.formats.ply import is_antialiased
from sagesplat.formats.quantisation import OTHERS, largest_restored, logits_of_bytes
from sagesplat.formats.sog_write import sog_order
from sagesplat.formats.splat import Splat, SplatReader, SplatWriter, check_writable
from sagesplat.io.files import atomic_path
from sagesplat.io.ply_header import Element, read_elements, skip

_CHUNK = 256  # Gaussians
_BLOCK = 256 * _CHUNK  # Gaussians that are decoded at a time
_WORDS = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_BITS = np.array([[21, 11], [11, 10], [0, 11]], np.uint32)  # of positions and scales: shift, width


def _is_compressed(file: BinaryIO) -> bool:
    """Whether a PLY is a compressed one; not if it is damaged: the reader of PLY files says what is wrong."""
    try:
        elements = read_elements(file)[1]
    except ValueError:
        return False
    return any(element.name == "vertex" and _WORDS[0] in element.types for element in elements)


def read_compressed_ply(path: Path) -> Splat:
    """Read a compressed PLY. DataError where it is damaged, cut off, or lacks a property.

    Opacities of 0 and 255 become those a quarter of a step further inside, as in `decode_spz`.
    """
    try:
        with path.open("rb") as file:
            order, elements, comments = read_elements(file)
            if not order:
                raise DataError(f"{path}: text PLY is not supported; save it as binary_little_endian")
            tables = _tables(path, file, order, elements)
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror}); give a splat .ply") from None
    except ValueError as error:
        raise DataError(f"{path}: not readable as a PLY file ({short(error)}); give a splat .ply") from None
    with np.errstate(all="ignore"):  # NaN and infinite ranges give such values, which are dropped later
        return Splat(_decoded(tables), "compressed PLY", antialiased=is_antialiased(comments))


def _tables(path: Path, file: BinaryIO, order: str, elements: list[Element]) -> dict[str, np.ndarray]:
    """The rows of the elements chunk, vertex and sh, after checking that all of them are there."""
    named = {element.name: element for element in elements}
    chunk, vertex, sh = (named.get(name, Element(name, 0, {})) for name in ("chunk", "vertex", "sh"))
    if chunk.lists or vertex.lists or sh.lists:
        raise DataError(f"{path}: a compressed PLY with lists is not supported; compress the scene again")
    bases = len(sh.types) // 3
    wanted = [*_ranges("", "xyz"), *_ranges("scale_", "xyz")]
    missing = [name for name in wanted if not chunk.types.get(name, "").startswith("f")]
    missing += [name for name in _WORDS if vertex.types.get(name) != "u4"]
    missing += [f"f_rest_{i}" for i in range(3 * bases) if sh.types.get(f"f_rest_{i}") != "u1"]
    if missing:
        raise DataError(f"{path}: {len(missing)} properties missing ({missing[0]}); compress the scene again")
    if len(sh.types) != 3 * bases or bases not in BASES or sh.count not in (0, vertex.count):
        raise DataError(f"{path}: {sh.count} rows of {len(sh.types)} harmonics; compress the scene again")
    if chunk.count < -(-vertex.count // _CHUNK):
        raise DataError(
            f"{path}: {chunk.count} chunks for {vertex.count} Gaussians; compress the scene again"
        )
    rows, waiting = {}, [one.name for one in elements if one.name in ("chunk", "vertex", "sh")]
    for element in elements:
        if element.name not in waiting:
            if len(rows) < len(waiting):
                skip(file, order, element)
            continue
        if element.count * element.dtype(order).itemsize > path.stat().st_size - file.tell():
            raise DataError(
                f"{path}: {vertex.count} Gaussians announced; the file is truncated, copy it again"
            )
        rows[element.name] = np.fromfile(file, element.dtype(order), element.count)
    return rows


def _ranges(kind: str, axes: str) -> list[str]:
    return [f"{end}_{kind}{axis}" for end in ("min", "max") for axis in axes]


def _decoded(tables: dict[str, np.ndarray]) -> Gaussians:
    chunk, vertex = tables["chunk"], tables["vertex"]
    places, scales = (_of(chunk, _ranges(kind, "xyz")) for kind in ("", "scale_"))
    colours = np.repeat(np.array([[[0.0]], [[1.0]]], np.float32), len(chunk), 1).repeat(3, 2)
    if set(_ranges("", "rgb")) <= set(chunk.dtype.names or ()):
        colours = _of(chunk, _ranges("", "rgb"))
    bases = len(tables["sh"].dtype.names or ()) // 3 if len(tables.get("sh", ())) else 0
    count = len(vertex)
    shapes = {"means": (3,), "quats": (4,), "log_scales": (3,), "sh0": (1, 3), "shN": (bases, 3)}
    values = {name: np.empty((count, *shape), np.float32) for name, shape in shapes.items()}
    values["logit_opacities"] = np.empty(count, np.float32)
    for start in range(0, count, _BLOCK):
        rows = slice(start, min(start + _BLOCK, count))
        of = np.arange(rows.start, rows.stop) // _CHUNK
        position, rotation, scale, colour = (vertex[name][rows].astype(np.uint32) for name in _WORDS)
        values["means"][rows] = _between(places[:, of], _thirds(position))
        values["log_scales"][rows] = _between(scales[:, of], _thirds(scale))
        values["quats"][rows] = _rotations(rotation)
        rgb = _between(colours[:, of], (colour[:, None] >> np.array([24, 16, 8], np.uint32) & 255) / 255)
        values["sh0"][rows, 0] = (rgb - 0.5) / C0
        values["logit_opacities"][rows] = logits_of_bytes(colour & 255)
        for i in range(3 * bases):
            values["shN"][rows, i % bases, i // bases] = _harmonics(tables["sh"][f"f_rest_{i}"][rows])
    tensors = {name: torch.from_numpy(value) for name, value in values.items()}
    return Gaussians(**tensors, label_ids=torch.full((count,), -1, dtype=torch.int16))


def _of(chunk: np.ndarray, names: list[str]) -> np.ndarray:
    """Smallest and largest values [2, chunks, 3]."""
    columns = [chunk[name].astype(np.float32) for name in names]
    return np.stack([np.stack(columns[:3], 1), np.stack(columns[3:], 1)])


def _between(ends: np.ndarray, share: np.ndarray) -> np.ndarray:
    return ends[0] + (ends[1] - ends[0]) * share


def _thirds(words: np.ndarray) -> np.ndarray:
    """Numbers in [0, 1], [N, 3], of 11, 10 and 11 bits."""
    most = (1 << _BITS[:, 1]) - 1
    return (words[:, None] >> _BITS[:, 0] & most) / most


def _rotations(words: np.ndarray) -> np.ndarray:
    """Quaternions wxyz [N, 4]."""
    fields = words[:, None] >> np.array([20, 10, 0], np.uint32) & np.uint32(1023)
    others = (fields / 1023 - 0.5) * 2**0.5
    return largest_restored(words >> 30, others)


def write_compressed_ply(
    path: Path,
    g: Gaussians,
    names: Mapping[int, str] | None = None,
    *,
    parents: Mapping[int, str] | None = None,
    antialiased: bool = False,
) -> None:
    """Write a compressed PLY atomically, rows by category and in Morton order; labels go beside it.

    Positions, log scales and colours are rounded between those of 256 neighbours, as the layout above says;
    log scales are clipped to [-20, 20], harmonics to [-4, 4]. Arguments as those of `write_ply`.

    Raises:
        DataError: For NaN or Inf, or a quaternion of zeros.
    """
    g = g.detach().to("cpu")
    check_writable(g, str(path))
    g = g.select(torch.from_numpy(sog_order(g)))
    count, bases = len(g), g.shN.shape[1]
    chunk, vertex = _packed(g)
    elements = [("chunk", chunk), ("vertex", vertex)]
    if bases:
        rest = g.shN.transpose(1, 2).reshape(count, 3 * bases).double().numpy()
        sh: np.ndarray = np.empty(count, [(f"f_rest_{i}", "u1") for i in range(3 * bases)])
        for i, name in enumerate(sh.dtype.names or ()):
            sh[name] = _dithered(rest[:, i])
        elements.append(("sh", sh))
    lines = ["ply", "format binary_little_endian 1.0"]
    lines += ["comment SplatRenderMode: mip"] if antialiased else []
    kinds = {"f4": "float", "u4": "uint", "u1": "uchar"}
    for name, rows in elements:
        lines.append(f"element {name} {len(rows)}")
        lines += [f"property {kinds[rows.dtype[key].str[1:]]} {key}" for key in rows.dtype.names or ()]
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        file.write("\n".join([*lines, "end_header", ""]).encode())
        for _, rows in elements:
            rows.tofile(file)
        write_or_remove_labels(path, g.label_ids, names or {}, parents or {})


def _packed(g: Gaussians) -> tuple[np.ndarray, np.ndarray]:
    """The rows of the elements chunk and vertex."""
    count = len(g)
    chunks = -(-count // _CHUNK)
    rgb = (g.sh0[:, 0].double() * C0 + 0.5).numpy()
    scales = g.log_scales.double().clamp(-20, 20).numpy()
    ranges: dict[str, np.ndarray] = {}
    shares = []
    for kind, axes, values in (
        ("", "xyz", g.means.double().numpy()),
        ("scale_", "xyz", scales),
        ("", "rgb", rgb),
    ):
        starts = np.arange(0, count, _CHUNK)
        low, high = (reduce.reduceat(values, starts).astype("<f4") for reduce in (np.minimum, np.maximum))
        ranges |= dict(zip(_ranges(kind, axes), [*low.T, *high.T], strict=True))
        low, high = (np.repeat(ends, _CHUNK, axis=0)[:count].astype(np.float64) for ends in (low, high))
        shares.append((values - low) / np.where(high > low, high - low, 1))
    chunk: np.ndarray = np.empty(chunks, [(name, "<f4") for name in ranges])
    for name, column in ranges.items():
        chunk[name] = column
    vertex: np.ndarray = np.empty(count, [(name, "<u4") for name in _WORDS])
    vertex["packed_position"], vertex["packed_scale"] = (_words(share, _BITS) for share in shares[:2])
    opacities = torch.sigmoid(g.logit_opacities.double())[:, None].numpy()
    eights = np.array([[24, 8], [16, 8], [8, 8], [0, 8]], np.uint32)
    vertex["packed_color"] = _words(np.concatenate([shares[2], opacities], 1), eights)
    q = g.quats.double().numpy()
    largest = np.abs(q).argmax(1)
    q = q / (np.linalg.norm(q, axis=1) * np.sign(q[np.arange(count), largest]))[:, None]
    others = np.take_along_axis(q, OTHERS[largest], axis=1) / 2**0.5 + 0.5
    tens = np.array([[20, 10], [10, 10], [0, 10]], np.uint32)
    vertex["packed_rotation"] = largest.astype(np.uint32) << 30 | _words(others, tens)
    return chunk, vertex


def _words(shares: np.ndarray, fields: np.ndarray) -> np.ndarray:
    """Words, uint32 [N], of numbers in [0, 1], [N, K], in fields of a shift and a width, [K, 2]."""
    most = (1 << fields[:, 1].astype(np.int64)) - 1
    values = np.rint(shares * most).clip(0, most).astype(np.uint32)
    return (values << fields[:, 0]).sum(1, dtype=np.uint32)


def _dithered(values: np.ndarray) -> np.ndarray:
    """Bytes of harmonics [N]; what one is rounded by is made up for by the next.

    The format has no 0, only 1/64 on either side of it: rounding each by itself would turn most, which are
    small, the same way, and the picture with them.
    """
    sums = np.rint(np.cumsum(((values / 8 + 0.5) * 256 - 0.5).clip(0, 255)))
    return np.diff(sums, prepend=0.0).clip(0, 255).astype(np.uint8)


def _harmonics(values: np.ndarray) -> np.ndarray:
    share = np.where(values == 0, 0.0, np.where(values == 255, 1.0, (values + 0.5) / 256))
    return (share - 0.5) * 8


READER = SplatReader(
    lambda path, _: read_compressed_ply(path), magic=(b"ply\n", b"ply\r"), accepts=_is_compressed
)
WRITER = SplatWriter(
    lambda path, g, names, parents, antialiased: write_compressed_ply(
        path, g, names, parents=parents, antialiased=antialiased
    ),
    antialiases=False,
)
