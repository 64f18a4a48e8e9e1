"""Writes streamed SOG, levels of detail for PlayCanvas's viewers; `lod_meta.py` has the layout."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from sagesplat.core.errors import DataError
from sagesplat.core.gaussians import Gaussians
from sagesplat.formats.lod_meta import LOD_META
from sagesplat.formats.sog_write import GENERATOR, put_sog, sog_files, sog_order
from sagesplat.formats.splat import SplatWriter
from sagesplat.io.files import atomic_folder, write_json

LEAF = 2**17  # Gaussians of the finest level in a leaf, at most
FILE = 2**19  # in a file, unless a leaf has more
_SIGMAS = 3  # that bounds enclose


def write_lod_meta(
    folder: Path,
    levels: Sequence[Gaussians],
    names: Mapping[int, str] | None = None,
    *,
    parents: Mapping[int, str] | None = None,
    antialiased: bool = False,
    leaf: int = LEAF,
) -> int:
    """Write levels of detail as a streamed SOG: `lod-meta.json` and folders of images; `folder` is replaced.

    Space is halved across its longest side until a part has at most `leaf` Gaussians of the finest level.
    Viewers choose a level for each part. Labels are beside each file (`formats/labels.py`).

    Args:
        folder: Where to write.
        levels: Gaussians of each level, the finest first; on any device.
        names: Category names by label id, for the sidecars.
        parents: Names of the categories that instances are of, by the instance's label id; likewise.
        antialiased: How the scene was trained.
        leaf: Gaussians of the finest level in a part.

    Returns:
        The size of all files in bytes.

    Raises:
        DataError: For a level without Gaussians, and as in `write_sog`.
    """
    levels = [g.detach().to("cpu") for g in levels]
    if not levels or not all(map(len, levels)):
        raise DataError(f"{folder}: a level without Gaussians; leave it out")
    tree: dict[str, Any] = {}
    leaves: list[tuple[dict[str, Any], list[np.ndarray]]] = []
    _split(tree, [g.means.numpy() for g in levels], [np.arange(len(g)) for g in levels], leaf, leaves)
    files: list[str] = []
    with atomic_folder(folder) as fresh:
        for lod, g in enumerate(levels):
            for number, (part, rows) in enumerate(_files(g, lod, leaves)):
                name = f"{lod}_{number}"
                for entry in part:
                    entry["file"] = len(files)
                inside = g.select(torch.from_numpy(rows))
                (fresh / name).mkdir()
                made = sog_files(inside, name=f"{folder / name}", antialiased=antialiased)
                put_sog(fresh / name, made, inside, names or {}, parents or {})
                files.append(f"{name}/meta.json")
        _bounds(tree, [_extents(g) for g in levels], {id(node): rows for node, rows in leaves})
        write_json(fresh / LOD_META, _document(levels, files, tree))
        return sum(path.stat().st_size for path in fresh.rglob("*") if path.is_file())


def _document(levels: Sequence[Gaussians], files: list[str], tree: dict[str, Any]) -> dict[str, Any]:
    counts = [len(g) for g in levels]
    document = {"version": 1, "asset": {"generator": GENERATOR}, "count": sum(counts), "counts": counts}
    return document | {
        "lodLevels": len(levels), "lodErrors": False, "environment": None, "filenames": files, "tree": tree
    }  # fmt: skip


def _split(
    node: dict[str, Any],
    means: list[np.ndarray],
    rows: list[np.ndarray],
    leaf: int,
    leaves: list[tuple[dict[str, Any], list[np.ndarray]]],
) -> None:
    """Fill a node of the tree with children or `lods`; its rows of each level are appended to `leaves`."""
    points = means[0][rows[0]]
    extent = np.ptp(points, axis=0) if len(points) else np.zeros(3)
    axis = int(extent.argmax())
    if len(points) <= leaf or not extent[axis]:
        node["lods"] = {}
        leaves.append((node, rows))
        return
    middle = np.median(points[:, axis])
    node["children"] = []
    for low in (True, False):
        part = [r[(m[r, axis] < middle) == low] for m, r in zip(means, rows, strict=True)]
        if any(map(len, part)):
            node["children"].append({})
            _split(node["children"][-1], means, part, leaf, leaves)


def _files(
    g: Gaussians, lod: int, leaves: list[tuple[dict[str, Any], list[np.ndarray]]]
) -> list[tuple[list[dict[str, int]], np.ndarray]]:
    """For each file of a level, its entries, which are put into the leaves, and its rows."""
    files: list[tuple[list[dict[str, int]], list[np.ndarray]]] = []
    count = FILE + 1
    for node, rows_of in leaves:
        if not len(rows := rows_of[lod]):
            continue
        if count + len(rows) > FILE:
            files.append(([], []))
            count = 0
        entry = {"file": 0, "offset": count, "count": len(rows)}
        node["lods"][str(lod)] = entry
        files[-1][0].append(entry)
        files[-1][1].append(rows[sog_order(g.select(torch.from_numpy(rows)))])
        count += len(rows)
    return [(entries, np.concatenate(parts)) for entries, parts in files]


def _extents(g: Gaussians) -> np.ndarray:
    """Lowest and highest corner of each Gaussian, float32 [2, N, 3]."""
    w, x, y, z = torch.nn.functional.normalize(g.quats, dim=1).unbind(1)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    )
    variances = torch.exp(2 * g.log_scales.clamp(max=40))
    reach = [_SIGMAS * sum(r * r * v for r, v in zip(row, variances.T, strict=True)) ** 0.5 for row in rows]
    return torch.stack([g.means - torch.stack(reach, 1), g.means + torch.stack(reach, 1)]).numpy()


def _bounds(
    node: dict[str, Any], extents: list[np.ndarray], rows: dict[int, list[np.ndarray]]
) -> tuple[np.ndarray, np.ndarray]:
    """Set `bound` of a node and of all below it: the lowest and the highest corner."""
    if "children" in node:
        ends = [_bounds(child, extents, rows) for child in node["children"]]
        low, high = np.min([end[0] for end in ends], 0), np.max([end[1] for end in ends], 0)
    else:
        parts = [e[:, r] for e, r in zip(extents, rows[id(node)], strict=True) if len(r)]
        low, high = (end(np.concatenate([p[i] for p in parts]), 0) for i, end in ((0, np.min), (1, np.max)))
    node["bound"] = {"min": low.tolist(), "max": high.tolist()}
    return low, high


WRITER = SplatWriter(
    write_levels=lambda path, levels, names, parents, antialiased: write_lod_meta(
        path.parent, levels, names, parents=parents, antialiased=antialiased
    )
)
