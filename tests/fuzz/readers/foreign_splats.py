"""Splat files as other tools write them, byte by byte, and their readers."""

import base64
import io
import json
import math
import struct
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from sagesplat.core.gaussians import Gaussians
from sagesplat.formats.labels import sidecar
from sagesplat.formats.ply import write_ply
from sagesplat.formats.splats import num_lods, read_splat
from sagesplat.formats.spz import encode_spz
from tests.fuzz.hostile import MIB, Reader
from tests.fuzz.readers.making import as_json, file, put, splats, written

COLOURS = ("red", "green", "blue")
BANDS = {0: 0, 3: 1, 8: 2, 15: 3}


def compressed_ply(count: int, bases: int = 0, *, colours: bool = True, seed: int = 0) -> bytes:
    """A compressed PLY of random words; of zeros for seed -1."""
    rng, chunks = np.random.default_rng(max(seed, 0)), -(-count // 256)
    kinds = [("", "xyz"), ("scale_", "xyz"), *([("", "rgb")] if colours else [])]
    names = [f"{end}_{kind}{axis}" for kind, axes in kinds for end in ("min", "max") for axis in axes]
    words = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        "comment SplatRenderMode: mip",
        f"element chunk {chunks}",
    ]
    lines += [f"property float {name}" for name in names] + [f"element vertex {count}"]
    lines += [f"property uint {name}" for name in words]
    if bases:
        lines += [f"element sh {count}", *(f"property uchar f_rest_{i}" for i in range(3 * bases))]
    ranges = np.sort(rng.normal(size=(chunks, 2, len(names) // 2)), axis=1).astype("<f4")
    ranges = ranges.reshape(chunks, 2, -1, 3).transpose(0, 2, 1, 3)  # per kind: smallest, then largest
    packed = rng.integers(0, 2**32, (count, 4), np.uint32).astype("<u4")
    sh = rng.integers(0, 256, (count, 3 * bases), np.uint8)
    if seed < 0:
        packed, sh = packed * 0, sh * 0
    body = ranges.tobytes() + packed.tobytes() + sh.tobytes()
    return "\n".join([*lines, "end_header", ""]).encode() + body


def webp(pixels: np.ndarray) -> bytes:
    """A lossless WebP of uint8 pixels [h, w, 3 or 4]."""
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "WEBP", lossless=True, exact=True)
    return buffer.getvalue()


def sog(
    count: int, bases: int = 3, *, version: int = 2, palette: int = 70, seed: int = 0
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """`meta.json` and the images, by name, of a scene of random bytes (of zeros for seed -1)."""
    rng, width = np.random.default_rng(max(seed, 0)), max(4, math.ceil(math.sqrt(count)))
    names = ["means_l", "means_u", "quats", "scales", "sh0", *(["shN_labels"] if bases else [])]
    images = {name: rng.integers(0, 256, (-(-count // width), width, 4), np.uint8) for name in names}
    images["quats"][..., 3] = 252 + images["quats"][..., 3] % 4
    book = sorted(rng.normal(size=256).tolist())
    ends = {"mins": [-1.0, -2.0, 0.5], "maxs": [1.0, 2.5, 0.75]}
    parts: dict[str, dict[str, Any]] = {"means": ends, "quats": {}}
    if version == 1:
        parts["means"] = ends | {"shape": [count, 3]}
        parts["scales"], parts["sh0"] = ends, {"mins": [-1.0, -2.0, 0.5, -4], "maxs": [1, 2.5, 0.75, 5.5]}
        meta: dict[str, Any] = {}
    else:
        parts["scales"], parts["sh0"] = {"codebook": book}, {"codebook": book[::-1]}
        meta = {"version": 2, "count": count, "antialias": True}
    for name, part in parts.items():
        meta[name] = part | {"files": [f"{image}.webp" for image in names if image.startswith(name)]}
    if bases:
        rows = rng.integers(0, palette, images["shN_labels"].shape[:2])
        images["shN_labels"][..., 0], images["shN_labels"][..., 1] = rows & 255, rows >> 8
        images["shN_centroids"] = rng.integers(0, 256, (-(-palette // 64), 64 * bases, 4), np.uint8)
        shN = {"mins": -0.5, "maxs": 0.25} if version == 1 else {"codebook": book, "count": palette}
        meta["shN"] = shN | {"bands": BANDS[bases], "files": ["shN_centroids.webp", "shN_labels.webp"]}
    if seed < 0:
        images = {name: image * 0 for name, image in images.items()}
    return meta, {f"{name}.webp": image[..., :4] for name, image in images.items()}


def put_sog(folder: Path, meta: dict[str, Any], images: dict[str, np.ndarray]) -> Path:
    """Write a scene into a folder; its meta.json."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, image in images.items():
        (folder / name).write_bytes(webp(image))
    (folder / "meta.json").write_text(json.dumps(meta))
    return folder / "meta.json"


def archived(meta: dict[str, Any], images: dict[str, np.ndarray]) -> bytes:
    """The scene as a .sog archive."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("meta.json", json.dumps(meta), zipfile.ZIP_DEFLATED)
        for name, image in images.items():
            archive.writestr(name, webp(image))
    return buffer.getvalue()


def dotsplat(count: int, seed: int = 0) -> bytes:
    """A .splat file of random values."""
    rng = np.random.default_rng(seed)
    rows = (rng.normal(size=3).tolist() + rng.random(3).tolist() for _ in range(count))
    return b"".join(struct.pack("<6f8B", *row, *rng.integers(0, 256, 8).tolist()) for row in rows)


def gltf(g: Gaussians, *, byte_opacities: bool = False, **node: Any) -> tuple[dict[str, Any], bytes]:
    """A glTF document with splats in one node, and its buffer."""
    name = "KHR_gaussian_splatting"
    opacities = g.logit_opacities.sigmoid().numpy()[:, None]
    columns = {
        "POSITION": g.means.numpy(),
        f"{name}:ROTATION": g.quats[:, [1, 2, 3, 0]].numpy(),
        f"{name}:SCALE": g.log_scales.exp().numpy(),
        f"{name}:OPACITY": (opacities * 255).round().astype("u1") if byte_opacities else opacities,
        f"{name}:SH_DEGREE_0_COEF_0": g.sh0[:, 0].numpy(),
    }
    for row, (degree, i) in enumerate(
        [(d, i) for d in (1, 2, 3) for i in range(2 * d + 1)][: g.shN.shape[1]]
    ):
        columns[f"{name}:SH_DEGREE_{degree}_COEF_{i}"] = g.shN[:, row].numpy()
    content, views, accessors = b"", [], []
    for column in columns.values():
        views.append({"buffer": 0, "byteOffset": len(content), "byteLength": column.nbytes})
        content += column.tobytes() + bytes(-column.nbytes % 4)
        kind = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[column.shape[1]]
        component = (
            {"componentType": 5121, "normalized": True}
            if column.dtype == np.uint8
            else {"componentType": 5126}
        )
        accessors.append({"bufferView": len(accessors), "count": len(g), "type": kind} | component)
    primitive = {"mode": 0, "attributes": {key: i for i, key in enumerate(columns)}, "extensions": {name: {}}}
    return {
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0, **node}],
        "meshes": [{"primitives": [primitive]}], "buffers": [{"byteLength": len(content)}],
        "bufferViews": views, "accessors": accessors,
    }, content  # fmt: skip


def glb(document: dict[str, Any], content: bytes) -> bytes:
    """A glTF document and its buffer as a .glb."""
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    body = (
        struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(content), b"BIN\0") + content
    )
    return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body


def streamed(leaves: int = 2, size: int = 3) -> dict[str, Any]:
    """A `lod-meta.json` of two levels, with leaves of `size` rows in the finer one and one in the other."""

    def rows(file: int, offset: int, count: int) -> dict[str, int]:
        return {"file": file, "offset": offset, "count": count}

    children = [{"lods": {"0": rows(0, size * i, size), "1": rows(1, i, 1)}} for i in range(leaves)]
    files = ["0_0/meta.json", "1_0/meta.json"]
    return {"lodLevels": 2, "environment": None, "filenames": files, "tree": {"children": children}}


def _spz_4(folder: Path, size: int) -> list[bytes]:
    names = {2: "sky", 5: "tree"}
    if size > 1:
        similar = splats(20).select(torch.arange(2 * size) % 20)  # equal ones pack better than is read
        return [encode_spz(similar, version=4)]
    return [encode_spz(splats(), version=4, names=names), encode_spz(splats(bases=0), version=4, frame="rdf")]


def _compressed(folder: Path, size: int) -> list[bytes]:
    few = compressed_ply(2, colours=False)
    face = b"element face 1\nproperty list uchar int vertex_indices\nelement chunk"
    head, body = few.replace(b"element chunk", face).split(b"end_header\n", 1)
    lists = head + b"end_header\n" + struct.pack("<B3i", 3, 0, 1, 1) + body
    return [compressed_ply(3 * size, 3, seed=0 if size == 1 else -1), few, lists]


def _named(folder: Path, size: int) -> list[bytes]:
    def write(path: Path) -> None:
        write_ply(path, splats(3 * size), {2: "sky", 5: "tree"}, labels_inside=True)

    if size > 1:
        return [written(folder / "n.ply", write)]
    lists = b"element face 2\nproperty list uchar int vertex_indices\nelement camera 1\nproperty double fx\n"
    head, _, body = written(folder / "n.ply", write).partition(b"end_header\n")
    head = head.replace(b"element vertex", lists + b"element vertex").replace(b"float nx", b"float filter_3D")
    return [written(folder / "n.ply", write), head + b"end_header\n\1" + bytes(13) + body]


def _text(folder: Path, size: int) -> list[bytes]:
    names = ["x", "y", "z", "opacity", "rot_0", "rot_1", "rot_2", "rot_3", "scale_0", "scale_1", "scale_2"]
    header = [
        "ply",
        "format ascii 1.0",
        "element camera 1",
        "property float fx",
        f"element vertex {3 * size}",
    ]
    header += [*(f"property float {name}" for name in names), *(f"property uchar {c}" for c in COLOURS)]
    row = " ".join(["0.5"] * len(names) + ["7"] * 3)
    return ["\n".join([*header, "end_header", "500", *[row] * (3 * size), ""]).encode()]


def _archives(folder: Path, size: int) -> list[bytes]:
    def packed(files: dict[str, bytes]) -> bytes:
        buffer = io.BytesIO()
        with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
            for name, content in files.items():
                archive.writestr(name, content)
        return buffer.getvalue()

    ply = written(folder / "n.ply", lambda path: write_ply(path, splats(3 * size)))
    if size > 1:
        return [packed({"a.splat": dotsplat(1) * 3 * size})]
    files = sorted(put_sog(folder / "0_0", *sog(6, 0)).parent.iterdir())
    level = {f"0_0/{path.name}": path.read_bytes() for path in files}
    description = json.dumps(streamed()).replace("1_0/", "0_0/").encode()
    points = b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n0\n"
    return [packed({"x/a.ply": ply, "points.ply": points}), packed(level | {"lod-meta.json": description})]


def _sogs(folder: Path, size: int) -> list[bytes]:
    if size > 1:
        return [archived(*sog(3 * size, seed=-1))]
    return [archived(*sog(3)), archived(*sog(3, 0, version=1)), archived(*sog(3, 8, version=1))]


def _metas(folder: Path, size: int) -> list[bytes]:
    put_sog(folder, *sog(3 * size))
    meta = json.loads((folder / "meta.json").read_text())
    return [json.dumps(meta).encode(), json.dumps(meta | {"shN": None}).encode()]


def _images(folder: Path, size: int) -> list[bytes]:
    meta, images = sog(3 * size)
    put_sog(folder, meta, images)
    return [webp(images["sh0.webp"] if size == 1 else images["sh0.webp"] * 0)]


def _read_image(folder: Path, content: bytes) -> None:
    put(folder / "sh0.webp", content)
    read_splat(folder)


def _streams(folder: Path, size: int) -> list[bytes]:
    for level in ("0_0", "1_0"):
        put_sog(folder / level, *sog(6 * size, 0))
    return [json.dumps(streamed(2 * size)).encode()]


def _read_streamed(path: Path) -> None:
    for level in range(min(num_lods(path), 2)):
        read_splat(path, level)


def _glbs(folder: Path, size: int) -> list[bytes]:
    document, content = gltf(splats(3 * size), rotation=[0, 0.6, 0, 0.8])
    packed = {"buffer": 0, "byteLength": len(small := encode_spz(splats()))}
    spz: dict[str, Any] = gltf(splats(1))[0] | {"bufferViews": [packed]}
    inside = {"extensions": {"KHR_gaussian_splatting_compression_spz_2": {"bufferView": 0}}}
    spz["meshes"][0]["primitives"][0]["extensions"]["KHR_gaussian_splatting"] = inside
    sparse, values = gltf(splats(4, 0), translation=[4e5, 100.5, -5e6])
    starts = ((len(values), 2), (len(values) + 2, 8))
    sparse["bufferViews"] += [{"buffer": 0, "byteOffset": at, "byteLength": size} for at, size in starts]
    indices = {"bufferView": 5, "componentType": 5121}
    sparse["accessors"][3]["sparse"] = {"count": 2, "indices": indices, "values": {"bufferView": 6}}
    values += struct.pack("<2B2f", 0, 3, 0.5, 0.25)
    whole = glb(*gltf(splats(2, 0), byte_opacities=True))
    return [glb(document, content), whole, glb(spz, small), glb(sparse, values)]


def _gltfs(folder: Path, size: int) -> list[bytes]:
    document, content = gltf(splats(3 * size))
    (folder / "b.bin").write_bytes(content)
    data = base64.b64encode(content).decode()
    return as_json(
        document | {"buffers": [{"uri": "b.bin"}]},
        document | {"buffers": [{"uri": f"data:application/octet-stream;base64,{data}"}]},
    )


def _labels(folder: Path, size: int) -> list[bytes]:
    (folder / "x.splat").write_bytes(dotsplat(3 * size))
    runs = [[2, 1], [-1, 2]] * size
    document = {"format": "sagesplat-labels", "version": 1, "names": {"2": "sky"}, "runs": runs}
    return [json.dumps(document).encode()]


def _read_labels(folder: Path, content: bytes) -> None:
    put(sidecar(folder / "x.splat"), content)
    read_splat(folder / "x.splat")


READERS = (
    Reader("splat-ply", ".ply", _named, file("n.ply", read_splat)),
    Reader("text-ply", ".ply", _text, file("t.ply", read_splat), 100, 4 * MIB),
    Reader("archive", ".zip", _archives, file("a.zip", read_splat), 1000, 16 * MIB),
    Reader("spz-4", ".spz", _spz_4, file("z.spz", read_splat), 10_000),
    Reader("compressed-ply", ".ply", _compressed, file("c.ply", read_splat)),
    Reader("sog", ".sog", _sogs, file("s.sog", read_splat), 1000, 16 * MIB),
    Reader("sog-meta", ".json", _metas, file("meta.json", read_splat), 1000, 16 * MIB),
    Reader("sog-image", ".webp", _images, _read_image, 1000, 16 * MIB),
    Reader("lod-meta", ".json", _streams, file("lod-meta.json", _read_streamed), 100, 16 * MIB),
    Reader("glb", ".glb", _glbs, file("g.glb", read_splat), 300, 4 * MIB),
    Reader("gltf", ".gltf", _gltfs, file("g.gltf", read_splat), 300, 4 * MIB),
    Reader("dotsplat", ".splat", lambda _, size: [dotsplat(3 * size)], file("d.splat", read_splat)),
    Reader("splat-labels", ".json", _labels, _read_labels, 1000),
)
