"""Writes .glb with splats (KHR_gaussian_splatting, as ratified); `gltf.py` has the layout.

Other viewers show points of COLOR_0. Antialiasing, which the extension has no word for, is in the primitive's
`extras`.
"""

import json
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from sagesplat.core.gaussians import Gaussians
from sagesplat.core.sh import sh0_to_rgb
from sagesplat.core.transform import transformed
from sagesplat.formats.gltf import ANTIALIASED, COLOURS, EXTRAS, FEATURES, HALF_TURN, NAME, UNLABELLED
from sagesplat.formats.labels import as_document
from sagesplat.formats.sog_write import GENERATOR
from sagesplat.formats.splat import SplatWriter, check_writable
from sagesplat.io.files import atomic_path

_KINDS = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
_VERTICES = 34962  # target of buffer views


def write_glb(
    path: Path,
    g: Gaussians,
    names: Mapping[int, str] | None = None,
    *,
    parents: Mapping[int, str] | None = None,
    antialiased: bool = False,
) -> None:
    """Write Gaussians as one primitive of a .glb, atomically, in float32.

    Args:
        path: The .glb to write.
        g: N Gaussians in COLMAP's axes, on any device; glTF's are left, up, front.
        names: Category names by label id.
        parents: Names of the categories that instances are of, by the instance's label id.
        antialiased: How the scene was trained.

    Raises:
        DataError: For NaN or Inf, or a quaternion of zeros.
    """
    g = g.detach().to("cpu")
    check_writable(g, str(path))
    columns = _columns(transformed(g, HALF_TURN))
    extras: dict[str, Any] = {ANTIALIASED: True} if antialiased else {}
    features: dict[str, Any] = {}
    if bool((g.label_ids >= 0).any()):
        ids = g.label_ids.numpy().astype(np.float32)[:, None]
        columns[FEATURES] = np.where(ids < 0, np.float32(UNLABELLED), ids)
        extras[EXTRAS] = as_document(g.label_ids, names or {}, parents or {}, runs=False)
        count = len(torch.unique(g.label_ids[g.label_ids >= 0]))
        features = {"label": "category", "attribute": 0, "featureCount": count, "nullFeatureId": UNLABELLED}
    content, views, accessors = bytearray(), list[dict[str, Any]](), list[dict[str, Any]]()
    for name, column in columns.items():
        views.append(
            {"buffer": 0, "byteOffset": len(content), "byteLength": column.nbytes, "target": _VERTICES}
        )
        accessors.append({"bufferView": len(accessors), "count": len(g), "type": _KINDS[column.shape[1]]})
        accessors[-1] |= {"componentType": 5126 if column.dtype == np.float32 else 5121}
        accessors[-1] |= {} if column.dtype == np.float32 else {"normalized": True}
        if name == "POSITION" and len(g):
            accessors[-1] |= {"min": column.min(0).tolist(), "max": column.max(0).tolist()}
        content += column.tobytes()
    splats = {"kernel": "ellipse", "colorSpace": COLOURS, "projection": "perspective"}
    primitive: dict[str, Any] = {"mode": 0, "attributes": {name: i for i, name in enumerate(columns)}}
    extensions: dict[str, Any] = {NAME: splats | {"sortingMethod": "cameraDistance"}}
    if features:
        extensions["EXT_mesh_features"] = {"featureIds": [features]}
    primitive["extensions"] = extensions
    primitive |= {"extras": extras} if extras else {}
    document = {
        "asset": {"version": "2.0", "generator": GENERATOR},
        "extensionsUsed": list(extensions), "scene": 0, "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}], "meshes": [{"primitives": [primitive]}],
        "buffers": [{"byteLength": len(content)}], "bufferViews": views, "accessors": accessors,
    }  # fmt: skip
    text = json.dumps(document, ensure_ascii=False).encode()
    text += b" " * (-len(text) % 4)
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        file.write(struct.pack("<4sII", b"glTF", 2, 28 + len(text) + len(content)))
        file.write(struct.pack("<I4s", len(text), b"JSON") + text)
        file.write(struct.pack("<I4s", len(content), b"BIN\0"))
        file.write(content)


def _columns(g: Gaussians) -> dict[str, np.ndarray]:
    """Attributes [N, width] of Gaussians in glTF's axes."""
    quats, opacities = torch.nn.functional.normalize(g.quats.double()), torch.sigmoid(g.logit_opacities)
    columns = {
        "POSITION": g.means,
        f"{NAME}:ROTATION": quats[:, [1, 2, 3, 0]].float(),
        f"{NAME}:SCALE": g.log_scales.exp(),
        f"{NAME}:OPACITY": opacities[:, None],
        f"{NAME}:SH_DEGREE_0_COEF_0": g.sh0[:, 0],
    }
    for degree in range(1, g.sh_degree + 1):
        for i in range(2 * degree + 1):
            columns[f"{NAME}:SH_DEGREE_{degree}_COEF_{i}"] = g.shN[:, degree * degree - 1 + i]
    rgb = sh0_to_rgb(g.sh0[:, 0]).clamp(0, 1)
    linear = torch.where(rgb > 0.04045, ((rgb + 0.055) / 1.055) ** 2.4, rgb / 12.92)  # of sRGB
    colour = (torch.cat([linear, opacities[:, None]], 1) * 255).round().to(torch.uint8)
    return {name: c.contiguous().numpy() for name, c in (columns | {"COLOR_0": colour}).items()}


WRITER = SplatWriter(
    lambda path, g, names, parents, antialiased: write_glb(
        path, g, names, parents=parents, antialiased=antialiased
    ),
    antialiases=False,
)
