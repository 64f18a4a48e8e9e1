"""glTF with splats (KHR_gaussian_splatting, ratified by Khronos): .glb, and .gltf with its buffers.

Attributes of a primitive of points: POSITION, and with the extension's name before a colon ROTATION (xyzw),
SCALE (standard deviations), OPACITY (0 to 1), SH_DEGREE_L_COEF_M. Axes are left, up, front. What drafts had
is read, too: logarithms of scales, COLOR_0, _ROTATION and _SCALE, and an SPZ inside.

Categories are ids of features (`_FEATURE_ID_0`, EXT_mesh_features): label ids, 65535 for none; their names
are in the primitive's `extras`.
"""

import base64
import binascii
import json
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import unquote

import numpy as np
import torch

from sagesplat.core.errors import DataError, short
from sagesplat.core.gaussians import Gaussians, concat
from sagesplat.core.geometry import NO_OFFSET, Position, offset_of
from sagesplat.core.sh import C0
from sagesplat.core.transform import placed, transformed
from sagesplat.formats.labels import labelled
from sagesplat.formats.splat import SOME, Splat, SplatReader
from sagesplat.formats.spz import decode_spz
from sagesplat.io.files import loads_json, regular

NAME = "KHR_gaussian_splatting"
_SPZ = (
    f"{NAME}_compression_spz_2",
    f"{NAME}_compression_spz",
    "KHR_spz_gaussian_splats_compression",  # drafts, in place of NAME
    "KHR_spz_compression",
)
_SUPPORTED = {NAME, *_SPZ, "KHR_mesh_quantization", "EXT_mesh_features", "EXT_structural_metadata"}
_NO_MATTER = ("KHR_materials_", "KHR_texture_", "EXT_texture_", "KHR_lights_")  # for splats
COLOURS = "srgb_rec709_display"
_COLOURS = (COLOURS, "BT.709", "BT.709-sRGB")  # the latter are of drafts
_DRAFTS = {"ROTATION": "_ROTATION", "SCALE": "_SCALE"}
_CURE = "export it again"
_TYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5126: "<f4"}
_INDICES = {5121: "u1", 5123: "<u2", 5125: "<u4"}  # of sparse accessors
_WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
_NODES = 10_000
_MOST_LOG = 50.0  # of a scale: e^50 is none
EXTRAS, ANTIALIASED = "sagesplat-labels", "sagesplat-antialiased"
FEATURES = "_FEATURE_ID_0"
UNLABELLED = 65535  # feature id
HALF_TURN = np.diag([-1.0, -1.0, 1.0])  # about z: from left, up, front to right, down, front


@dataclass(frozen=True)
class _Asset:
    """A glTF document and its buffers."""

    json: dict[str, Any]
    buffers: list[bytes | None]  # None: a buffer without content, which compressed views fall back to
    notes: dict[str, None] = field(default_factory=dict)  # as in Splat
    names: dict[int, str] = field(default_factory=dict)
    parents: dict[int, str] = field(default_factory=dict)
    antialiased: list[bool] = field(default_factory=list)  # of primitives that say it

    @property
    def nbytes(self) -> int:
        """Bytes of all buffers, each counted once."""
        return sum({id(buffer): len(buffer) for buffer in self.buffers if buffer}.values())

    def view(self, index: int) -> tuple[bytes, int, int, int]:
        """Buffer, first byte, size and stride (0: none) of a buffer view; ValueError if it is none."""
        view = _entry(self.json["bufferViews"], index)
        content = _entry(self.buffers, view["buffer"])
        if content is None:
            how = " and ".join(map(short, view.get("extensions", {}))) or "it has no uri"
            raise ValueError(f"buffer {view['buffer']} has no content: {how}")
        start, size, stride = view.get("byteOffset", 0), view["byteLength"], view.get("byteStride", 0)
        if not all(type(n) is int and n >= 0 for n in (start, size, stride)) or start + size > len(content):
            raise ValueError(f"bytes {start!r:.20} + {size!r:.20} of {len(content)}")
        return content, start, size, stride

    def accessor(self, index: int, *kinds: str, unit: bool = False) -> np.ndarray:
        """An accessor's values, float32 [N, width]; ValueError if they are not there, or of other kinds.

        `unit`: integers stand for numbers up to 1, whether the accessor says so or not.
        """
        accessor = _entry(self.json["accessors"], index)
        count, kind = accessor["count"], accessor["type"]
        if kind not in kinds:
            raise ValueError(f"{kind!r:.20} in place of {' or '.join(kinds)}")
        dtype, width, sparse = (
            np.dtype(_TYPES[accessor["componentType"]]),
            _WIDTHS[kind],
            accessor.get("sparse"),
        )
        if "bufferView" in accessor:
            values = self._rows(accessor, count, dtype, width)
        elif sparse and type(count) is int and 0 <= 12 * count <= self.nbytes:  # as positions take
            values = np.zeros((count, width), dtype)
        else:
            raise ValueError("an accessor without a buffer view: compressed by an extension?")
        if sparse:
            number, indices = sparse["count"], sparse["indices"]
            rows = self._rows(indices, number, np.dtype(_INDICES[indices["componentType"]]), 1)[:, 0]
            values = values.copy()
            values[rows] = self._rows(sparse["values"], number, dtype, width)
        if dtype.kind == "f" or not (unit or accessor.get("normalized", False)):
            return values.astype(np.float32)
        return (values / np.float32(np.iinfo(dtype).max)).clip(-1, 1)  # type: ignore

    def _rows(self, part: dict[str, Any], count: int, dtype: np.dtype, width: int) -> np.ndarray:
        """The values [count, width] of the buffer view that an accessor, or a part of it, names."""
        offset = part.get("byteOffset", 0)
        if not all(type(n) is int and n >= 0 for n in (count, offset)):
            raise ValueError(f"{count!r:.20} values")
        content, start, size, stride = self.view(part["bufferView"])
        row = width * dtype.itemsize
        stride = stride or row
        if not row <= stride <= 252 or (count and offset + (count - 1) * stride + row > size):
            raise ValueError(f"{count} values, more than fit")
        at = start + offset if count else 0
        return np.ndarray((count, width), dtype, content, at, (stride, dtype.itemsize))


def read_gltf(path: Path) -> Splat:
    """Read the splats of a .glb or .gltf, where its nodes put them.

    DataError for a file without any, one that is damaged, or one that requires or holds what is not
    supported: other extensions, linear colours, other kernels.
    """
    try:
        asset = _asset(path)
        required = asset.json.get("extensionsRequired", [])
        unknown = [name for name in required if name not in _SUPPORTED and not name.startswith(_NO_MATTER)]
        if unknown:
            raise DataError(
                f"{path}: requires {', '.join(map(short, unknown[:5]))}, not supported; export it without"
            )
        parts, left = [], asset.nbytes
        for mesh, matrix in _meshes(asset.json):
            for nbytes, part in _primitives(asset, mesh):
                left -= nbytes
                if left < 0:  # or a few bytes could be those of many splats
                    raise ValueError("primitives or instances that share their positions too often")
                parts.append((part, _turned(matrix)))
        if not parts:
            raise ValueError(f"no primitives with {NAME}")
        g, offset = _joined(parts)
    except DataError:
        raise
    except OSError as error:
        name = Path(error.filename or path).name
        raise DataError(f"{path}: {name} cannot be read ({error.strerror}); {_CURE}") from None
    except (ValueError, TypeError, LookupError, AttributeError, ArithmeticError, struct.error) as error:
        text = short(error) if isinstance(error, ValueError) else short(repr(error))
        raise DataError(f"{path}: not a glTF with splats that is read ({text}); {_CURE}") from None
    return Splat(
        g, "glTF", asset.names, any(asset.antialiased), parents=asset.parents, notes=tuple(asset.notes),
        offset=offset,
    )  # fmt: skip


def _joined(parts: list[tuple[Gaussians, np.ndarray]]) -> tuple[Gaussians, Position]:
    """All Gaussians where their matrices put them, less an offset that float32 would round too much."""
    step = sum(len(g) for g, _ in parts) // SOME + 1
    some = [g.means[::step].double().numpy() @ matrix[:3, :3].T + matrix[:3, 3] for g, matrix in parts]
    moved = any(matrix[:3, 3].any() for _, matrix in parts)  # else float32 has rounded already
    offset = offset_of(np.concatenate(some)) if moved else NO_OFFSET
    for _, matrix in parts:
        matrix[:3, 3] -= offset
    made = [placed(g, matrix) for g, matrix in parts]
    return made[0] if len(made) == 1 else concat(made), offset


def _entry(entries: list[Any], index: Any) -> Any:
    if type(index) is not int or not 0 <= index < len(entries):
        raise ValueError(f"entry {index!r:.20} of {len(entries)}")
    return entries[index]


def _asset(path: Path) -> _Asset:
    content, binary = regular(path).read_bytes(), None
    if content.startswith(b"glTF"):
        chunks = dict(reversed(list(_chunks(content))))  # the first of each kind
        content, binary = chunks[b"JSON"], chunks.get(b"BIN\0", b"")
    document = loads_json(content)
    buffers, found = document.get("buffers", []), dict[str, bytes]()
    for buffer in buffers:
        if isinstance(uri := buffer.get("uri"), str) and uri not in found:
            found[uri] = _buffer(path, uri)
    contents = [found.get(buffer.get("uri")) for buffer in buffers]
    if buffers and "uri" not in buffers[0] and not _falls_back(buffers[0]):
        contents[0] = binary  # the chunk is of the first buffer alone
    return _Asset(document, contents)


def _falls_back(buffer: dict[str, Any]) -> bool:
    """Whether a buffer stands for what a compression extension unpacks."""
    return any(ext.get("fallback") is True for ext in buffer.get("extensions", {}).values())


def _chunks(content: bytes) -> Iterator[tuple[bytes, bytes]]:
    _, version, size = struct.unpack_from("<4sII", content)
    if version != 2 or size != len(content):
        raise ValueError(f"version {version}, {size} of {len(content)} bytes")
    at = 12
    while at < len(content):
        size, kind = struct.unpack_from("<I4s", content, at)
        if at + 8 + size > len(content):
            raise ValueError("a chunk is cut off")
        yield kind, content[at + 8 : at + 8 + size]
        at += 8 + size


def _buffer(path: Path, uri: str) -> bytes:
    """The bytes of a buffer: in the URI, or in a file in the folder of `path`."""
    if uri.startswith("data:"):
        try:
            return base64.b64decode(uri.partition(",")[2], validate=True)
        except binascii.Error as error:
            raise ValueError(f"a data URI: {error}") from None
    name = unquote(uri)
    parts, file = PurePosixPath(name).parts, path.parent / name
    outside = not parts or ".." in parts or bool(set(name) & set("\\:\0")) or name.startswith("/")
    if outside or not file.resolve().is_relative_to(path.parent.resolve()) or file.is_symlink():
        raise ValueError(f"{short(name)} is not in its folder")
    return regular(file).read_bytes()


def _meshes(document: dict[str, Any]) -> Iterator[tuple[dict[str, Any], np.ndarray]]:
    """The meshes of the scene and the matrix [4, 4] of each."""
    nodes, meshes = document.get("nodes", []), document.get("meshes", [])
    below = {child for node in nodes for child in node.get("children", [])}
    roots = [i for i in range(len(nodes)) if i not in below]  # without scenes
    if scenes := document.get("scenes"):
        roots = _entry(scenes, document.get("scene", 0)).get("nodes", [])
    if len(nodes) > _NODES:
        raise ValueError(f"{len(nodes)} nodes")
    waiting, seen = [(root, np.eye(4)) for root in roots], set()
    while waiting:
        index, above = waiting.pop()
        node = _entry(nodes, index)
        if index in seen or len(seen) > _NODES:
            raise ValueError(f"node {index} is in its tree twice")
        seen.add(index)
        matrix = above @ _matrix(node)
        if "mesh" in node:
            if "EXT_mesh_gpu_instancing" in node.get("extensions", {}):
                raise ValueError("EXT_mesh_gpu_instancing of a node is not supported")
            yield _entry(meshes, node["mesh"]), matrix
        waiting += [(child, matrix) for child in node.get("children", [])]


def _matrix(node: dict[str, Any]) -> np.ndarray:
    if "matrix" in node:
        return _numbers(node["matrix"], 16).reshape(4, 4).T
    x, y, z, w = _numbers(node.get("rotation", [0, 0, 0, 1]), 4)
    rows = [[1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)]]
    rows += [[2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)]]
    rows += [[2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)]]
    matrix = np.eye(4)
    matrix[:3, :3] = np.array(rows) * _numbers(node.get("scale", [1, 1, 1]), 3)
    matrix[:3, 3] = _numbers(node.get("translation", [0, 0, 0]), 3)
    return matrix


def _numbers(values: list[Any], count: int) -> np.ndarray:
    if len(values) != count or not all(type(value) in (int, float) for value in values):
        raise ValueError(f"{values!r:.60} in place of {count} numbers")
    numbers = np.array([float(value) for value in values])
    if not (np.abs(numbers) < 1e9).all():
        raise ValueError(f"{values!r:.60} in place of {count} numbers")
    return numbers


def _turned(matrix: np.ndarray) -> np.ndarray:
    """A node's matrix, from its own axes to COLMAP's."""
    return np.block([[HALF_TURN @ matrix[:3]], [np.eye(4)[3:]]])


def _primitives(asset: _Asset, mesh: dict[str, Any]) -> Iterator[tuple[int, Gaussians]]:
    """The splats of a mesh in its own axes, and how many bytes no others should have."""
    for primitive in mesh["primitives"]:
        given = primitive.get("extensions", {})
        splats = given.get(NAME, {} if given.keys() & set(_SPZ) else None)
        if splats is None:
            continue
        _check(asset, splats)
        inside = splats.get("extensions", {}) | given
        packed = next((inside[name] for name in _SPZ if name in inside), None)
        if packed is not None:
            content, start, size, _ = asset.view(packed["bufferView"])
            yield size, transformed(decode_spz(content[start : start + size], name="SPZ in it"), HALF_TURN)
        else:
            g = _attributes(asset, primitive["attributes"])
            yield 12 * len(g), _named(asset, primitive, g)


def _check(asset: _Asset, splats: dict[str, Any]) -> None:
    """ValueError for a kernel or colours that would be drawn wrongly; a note for hints that are not known."""
    if (kernel := splats.get("kernel", "ellipse")) != "ellipse":
        raise ValueError(f"splats of kernel {kernel!r:.60} are not supported")
    if (colours := splats.get("colorSpace", COLOURS)) not in _COLOURS:
        raise ValueError(f"splats of colours {colours!r:.60} are not supported, {COLOURS} is")
    for name in splats.get("extensions", {}).keys() - set(_SPZ):
        asset.notes[f"extension {short(name)} of the splats is not known, and not read"] = None
    for key, usual in (("projection", "perspective"), ("sortingMethod", "cameraDistance")):
        if (hint := splats.get(key, usual)) != usual:
            asset.notes[f"{key} {short(repr(hint))} is not known; it is drawn as {usual}"] = None


def _attributes(asset: _Asset, attributes: dict[str, int]) -> Gaussians:
    def values(name: str, *kinds: str, unit: bool = False) -> np.ndarray:
        draft = _DRAFTS.get(name, "")
        key = draft if draft in attributes and f"{NAME}:{name}" not in attributes else f"{NAME}:{name}"
        key = name if name == "COLOR_0" else key
        if key not in attributes:
            raise ValueError(f"no attribute {key}")
        found = asset.accessor(attributes[key], *kinds, unit=unit)
        if len(found) != len(means):
            raise ValueError(f"{len(found)} values of {key} for {len(means)} positions")
        return found

    means = asset.accessor(attributes["POSITION"], "VEC3")
    degrees = [d for d in (1, 2, 3) if f"{NAME}:SH_DEGREE_{d}_COEF_0" in attributes]
    if degrees != [1, 2, 3][: len(degrees)]:
        raise ValueError(f"harmonics of degrees {degrees}")
    coefficients = [f"SH_DEGREE_{d}_COEF_{i}" for d in degrees for i in range(2 * d + 1)]
    shN = np.empty((len(means), len(coefficients), 3), np.float32)
    for i, name in enumerate(coefficients):
        shN[:, i] = values(name, "VEC3")
    if f"{NAME}:OPACITY" not in attributes and "COLOR_0" in attributes:  # the first drafts
        colours = values("COLOR_0", "VEC3", "VEC4", unit=True)
        opacities = colours[:, 3] if colours.shape[1] == 4 else np.ones(len(means), np.float32)
        sh0 = (colours[:, None, :3] - np.float32(0.5)) / np.float32(C0)
        asset.notes[f"colours and opacities are those of COLOR_0, as drafts of {NAME} had them"] = None
    else:
        opacities = values("OPACITY", "SCALAR", unit=True)[:, 0]
        sh0 = values("SH_DEGREE_0_COEF_0", "VEC3")[:, None]
    quats = np.roll(values("ROTATION", "VEC4"), 1, axis=1)
    arrays = {"means": means, "quats": quats, "sh0": sh0, "shN": shN}
    arrays["log_scales"] = _log_scales(asset, values("SCALE", "VEC3"))
    arrays["logit_opacities"] = _logits(asset, opacities)
    tensors = {name: torch.from_numpy(np.ascontiguousarray(array)) for name, array in arrays.items()}
    return Gaussians(**tensors, label_ids=torch.full((len(means),), -1, dtype=torch.int16))


def _log_scales(asset: _Asset, scales: np.ndarray) -> np.ndarray:
    """Logarithms of scales, which are standard deviations, or as drafts and early exporters had them.

    Standard deviations are not negative, and of a scene's logarithms hardly all are positive.
    """
    if not (scales < 0).any():
        with np.errstate(all="ignore"):  # zeros and NaN: such Gaussians are dropped
            return np.log(scales)
    if (largest := float(np.nanmax(scales))) > _MOST_LOG:
        raise ValueError(f"scales from {float(np.nanmin(scales)):.3g} to {largest:.3g}")
    asset.notes[f"scales are logarithms, as drafts of {NAME} had them"] = None
    return scales


def _logits(asset: _Asset, opacities: np.ndarray) -> np.ndarray:
    """Logits of opacities, which may be logits already: then they are not between 0 and 1."""
    if ((opacities < -0.01) | (opacities > 1.01)).any():
        asset.notes["opacities are logits: they are not between 0 and 1"] = None
        return opacities
    with np.errstate(all="ignore"):  # zeros and NaN: such Gaussians are dropped
        within = opacities.clip(0, 1)
        return np.log(within) - np.log1p(-within)


def _named(asset: _Asset, primitive: dict[str, Any], g: Gaussians) -> Gaussians:
    """The Gaussians with the labels that `write_glb` wrote, if there are any."""
    extras = primitive.get("extras")
    if not isinstance(extras, dict):
        return g
    asset.antialiased.append(extras.get(ANTIALIASED) is True)
    if EXTRAS not in extras or FEATURES not in primitive["attributes"]:
        return g
    ids = asset.accessor(primitive["attributes"][FEATURES], "SCALAR")[:, 0]
    if len(ids) != len(g) or not ((ids >= 0) & (ids <= UNLABELLED) & (ids == np.floor(ids))).all():
        raise ValueError(f"{FEATURES} of {len(ids)} values")
    ids = np.where(ids == UNLABELLED, -1, ids)
    if (ids > 32767).any():
        raise ValueError(f"{FEATURES} up to {ids.max():g}")
    g = replace(g, label_ids=torch.from_numpy(ids.astype(np.int16)))
    splat = labelled(Splat(g, "glTF"), json.dumps(extras[EXTRAS]).encode())
    asset.names.update(splat.names)
    asset.parents.update(splat.parents)
    return splat.gaussians


READER = SplatReader(lambda path, _: read_gltf(path), magic=(b"glTF",), json_key="asset")
