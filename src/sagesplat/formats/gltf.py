"""glTF with splats (KHR_gaussian_splatting, ratified by Khronos): .glb, and .gltf with its buffers.

Attributes of a primitive of points: POSITION, and with the extension's name before a colon ROTATION (xyzw),
SCALE (standard deviations), OPACITY (0 to 1), SH_DEGREE_L_COEF_M. Axes are left, up, front. An SPZ inside
(KHR_gaussian_splatting_compression_spz_2, a draft) is read, too: its bytes are those of an .spz.
"""

import base64
import binascii
import json
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import torch

from sagesplat.core.errors import DataError, short
from sagesplat.core.gaussians import Gaussians, concat
from sagesplat.core.transform import transformed
from sagesplat.formats.splat import Splat, SplatReader
from sagesplat.formats.spz import decode_spz
from sagesplat.io.files import loads_json, regular

_NAME = "KHR_gaussian_splatting"
_SPZ = (f"{_NAME}_compression_spz_2", f"{_NAME}_compression_spz")
_CURE = "export it again"
_TYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
_NODES = 10_000
_HALF_TURN = np.diag([-1.0, -1.0, 1.0])  # about z: from left, up, front to right, down, front


@dataclass(frozen=True)
class _Asset:
    """A glTF document and its buffers."""

    json: dict[str, Any]
    buffers: list[bytes]

    def view(self, index: int) -> tuple[bytes, int, int, int]:
        """Buffer, first byte, size and stride (0: none) of a buffer view; ValueError if it is none."""
        view = _entry(self.json["bufferViews"], index)
        content = _entry(self.buffers, view["buffer"])
        start, size, stride = view.get("byteOffset", 0), view["byteLength"], view.get("byteStride", 0)
        if not all(type(n) is int and n >= 0 for n in (start, size, stride)) or start + size > len(content):
            raise ValueError(f"bytes {start!r:.20} + {size!r:.20} of {len(content)}")
        return content, start, size, stride

    def accessor(self, index: int, kind: str) -> np.ndarray:
        """An accessor's values, float32 [N, width]; ValueError if they are not there, or of another kind."""
        accessor = _entry(self.json["accessors"], index)
        count, offset = accessor["count"], accessor.get("byteOffset", 0)
        if "sparse" in accessor or accessor["type"] != kind:
            raise ValueError(f"{accessor['type']!r:.20} in place of {kind}, or a sparse accessor")
        if not all(type(n) is int and n >= 0 for n in (count, offset)):
            raise ValueError(f"{count!r:.20} values")
        dtype, width = np.dtype(_TYPES[accessor["componentType"]]), _WIDTHS[kind]
        content, start, size, stride = self.view(accessor["bufferView"])
        row = width * dtype.itemsize
        stride = stride or row
        if not row <= stride <= 252 or (count and offset + (count - 1) * stride + row > size):
            raise ValueError(f"{count} values, more than fit")
        steps = (stride, dtype.itemsize)
        values = np.ndarray((count, width), dtype, content, start + offset if count else 0, steps)
        if dtype.kind == "f" or not accessor.get("normalized", False):
            return values.astype(np.float32)
        return (values / np.float32(np.iinfo(dtype).max)).clip(-1, 1)  # type: ignore


def read_gltf(path: Path) -> Splat:
    """Read the splats of a .glb or .gltf, where its nodes put them.

    DataError for a file without any, one that is damaged, or what it holds is not supported: linear colours,
    other kernels, a mesh in several nodes, and nodes that scale axes differently.
    """
    try:
        asset = _asset(path)
        parts, left = [], sum({id(buffer): len(buffer) for buffer in asset.buffers}.values())
        for mesh, matrix in _meshes(asset.json):
            for nbytes, part in _primitives(asset, mesh):
                left -= nbytes
                if left < 0:  # or a few bytes could be those of many splats
                    raise ValueError("primitives that share their positions")
                parts.append(transformed(part, *_rigid(_turned(matrix))))
        if not parts:
            raise ValueError(f"no primitives with {_NAME}")
    except DataError:
        raise
    except OSError as error:
        name = Path(error.filename or path).name
        raise DataError(f"{path}: {name} cannot be read ({error.strerror}); {_CURE}") from None
    except (ValueError, TypeError, LookupError, AttributeError, ArithmeticError, struct.error) as error:
        text = short(error) if isinstance(error, ValueError) else short(repr(error))
        raise DataError(f"{path}: not a glTF with splats ({text}); {_CURE}") from None
    return Splat(parts[0] if len(parts) == 1 else concat(parts), "glTF")


def _entry(entries: list[Any], index: Any) -> Any:
    if type(index) is not int or not 0 <= index < len(entries):
        raise ValueError(f"entry {index!r:.20} of {len(entries)}")
    return entries[index]


def _asset(path: Path) -> _Asset:
    content, binary = regular(path).read_bytes(), b""
    if content.startswith(b"glTF"):
        chunks = dict(_chunks(content))
        content, binary = chunks[b"JSON"], chunks.get(b"BIN\0", b"")
    document = loads_json(content)
    uris = [buffer.get("uri") for buffer in document.get("buffers", [])]
    found = {uri: binary if uri is None else _buffer(path, uri) for uri in uris}
    return _Asset(document, [found[uri] for uri in uris])


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
    if set(name) & set("/\\:\0") or (path.parent / name).is_symlink():
        raise ValueError(f"{short(name)} is not in its folder")
    return regular(path.parent / name).read_bytes()


def _meshes(document: dict[str, Any]) -> Iterator[tuple[dict[str, Any], np.ndarray]]:
    """The meshes of the scene and the matrix [4, 4] of each."""
    nodes, meshes = document.get("nodes", []), document.get("meshes", [])
    below = {child for node in nodes for child in node.get("children", [])}
    roots = [i for i in range(len(nodes)) if i not in below]  # without scenes
    if scenes := document.get("scenes"):
        roots = _entry(scenes, document.get("scene", 0)).get("nodes", [])
    if len(nodes) > _NODES:
        raise ValueError(f"{len(nodes)} nodes")
    waiting, seen, used = [(root, np.eye(4)) for root in roots], set(), set()
    while waiting:
        index, above = waiting.pop()
        node = _entry(nodes, index)
        if index in seen or len(seen) > _NODES:
            raise ValueError(f"node {index} is in its tree twice")
        seen.add(index)
        matrix = above @ _matrix(node)
        if "mesh" in node:
            mesh = _entry(meshes, node["mesh"])
            if node["mesh"] in used:
                raise ValueError("a mesh in several nodes is not supported")
            used.add(node["mesh"])
            yield mesh, matrix
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
    return np.block([[_HALF_TURN @ matrix[:3]], [np.eye(4)[3:]]])


def _rigid(matrix: np.ndarray) -> tuple[np.ndarray, float, np.ndarray | None]:
    """Rotation, scale and translation; ValueError for a matrix that is not made of these."""
    scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    rotation = matrix[:3, :3] / scale if scale > 1e-12 else np.zeros((3, 3))
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-3:
        raise ValueError("a node mirrors or scales its axes differently; apply its transform")
    u, _, vt = np.linalg.svd(rotation)
    near = np.rint(u @ vt)  # turns by quarters stay exact
    exact = np.where(np.abs(u @ vt - near) < 1e-9, near, u @ vt)
    return exact, scale, matrix[:3, 3] if matrix[:3, 3].any() else None


def _primitives(asset: _Asset, mesh: dict[str, Any]) -> Iterator[tuple[int, Gaussians]]:
    """The splats of a mesh in its own axes, and how many bytes no others should have."""
    for primitive in mesh["primitives"]:
        splats = primitive.get("extensions", {}).get(_NAME)
        if splats is None:
            continue
        if splats.get("kernel", "ellipse") != "ellipse" or str(splats.get("colorSpace", "")).startswith(
            "lin"
        ):
            raise ValueError(f"splats of kernel or colours {json.dumps(splats):.100} are not supported")
        inside = [splats.get("extensions", {}).get(name) for name in _SPZ]
        packed = next((view for view in inside if view is not None), None)
        if packed is not None:
            content, start, size, _ = asset.view(packed["bufferView"])
            yield size, transformed(decode_spz(content[start : start + size], name="SPZ in it"), _HALF_TURN)
        else:
            g = _attributes(asset, primitive["attributes"])
            yield 12 * len(g), g


def _attributes(asset: _Asset, attributes: dict[str, int]) -> Gaussians:
    def values(name: str, kind: str = "VEC3") -> np.ndarray:
        if name not in attributes:
            raise ValueError(f"no attribute {name}")
        found = asset.accessor(attributes[name], kind)
        if len(found) != len(means):
            raise ValueError(f"{len(found)} values of {name} for {len(means)} positions")
        return found

    means = asset.accessor(attributes["POSITION"], "VEC3")
    degrees = [d for d in (1, 2, 3) if f"{_NAME}:SH_DEGREE_{d}_COEF_0" in attributes]
    if degrees != [1, 2, 3][: len(degrees)]:
        raise ValueError(f"harmonics of degrees {degrees}")
    coefficients = [f"{_NAME}:SH_DEGREE_{d}_COEF_{i}" for d in degrees for i in range(2 * d + 1)]
    shN = np.empty((len(means), len(coefficients), 3), np.float32)
    for i, name in enumerate(coefficients):
        shN[:, i] = values(name)
    opacities = values(f"{_NAME}:OPACITY", "SCALAR")[:, 0]
    with np.errstate(all="ignore"):  # zeros and what is out of range: such Gaussians are dropped
        log_scales = np.log(values(f"{_NAME}:SCALE"))
        logits = np.log(opacities) - np.log1p(-opacities)
    quats = np.roll(values(f"{_NAME}:ROTATION", "VEC4"), 1, axis=1)
    sh0 = values(f"{_NAME}:SH_DEGREE_0_COEF_0")[:, None]
    arrays = {"means": means, "quats": quats, "log_scales": log_scales, "sh0": sh0, "shN": shN}
    tensors = {
        name: torch.from_numpy(array) for name, array in (arrays | {"logit_opacities": logits}).items()
    }
    return Gaussians(**tensors, label_ids=torch.full((len(means),), -1, dtype=torch.int16))


READER = SplatReader(lambda path, _: read_gltf(path), magic=(b"glTF",), json_key="asset")
