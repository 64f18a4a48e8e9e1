"""Writes streamed SOG, levels of detail for PlayCanvas's viewers; `lod_meta.py` has the layout."""

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32

from sagesplat.core.errors import DataError
from sagesplat.core.gaussians import Gaussians, relabelled
from sagesplat.formats.lod_meta import LOD_META
from sagesplat.formats.sog import META
from sagesplat.formats.sog_write import GENERATOR, archived, sog_files, sog_order, with_labels_beside
from sagesplat.formats.splat import SplatWriter
from sagesplat.io.files import atomic_folder

FILE = 2**15  # Gaussians in a file, unless a cell has more: viewers fetch whole files
_SIGMAS = 3  # that bounds enclose


def write_lod_meta(
    folder: Path,
    levels: Sequence[Gaussians],
    label_of: Mapping[int, int],
    names: Mapping[int, str] | None = None,
    *,
    parents: Mapping[int, str] | None = None,
    antialiased: bool = False,
    largest: int = FILE,
) -> int:
    """Write levels of detail as a streamed SOG: `lod-meta.json` and folders of images; `folder` is replaced.

    Each cell is a leaf of the tree, for which viewers choose a level; the cells of a category lie below a
    node of its name. Bounds hold all levels, because viewers cull by them. Labels are beside each file
    (`formats/labels.py`).

    Args:
        folder: Where to write.
        levels: Gaussians of each level, the finest first; on any device. Their label ids are cell ids.
        label_of: Label id by cell id.
        names: Category names by label id, for the tree and the sidecars.
        parents: Names of the categories that instances are of, by the instance's label id; for the sidecars.
        antialiased: How the scene was trained.
        largest: Gaussians in a file, unless a cell has more.

    Returns:
        The size of all files in bytes.

    Raises:
        DataError: For a level without Gaussians, and as in `write_sog`.
    """
    total = 0
    with atomic_folder(folder) as fresh:
        for name, content in _contents(
            str(folder), levels, label_of, names or {}, parents or {}, antialiased, largest
        ):
            (fresh / name).parent.mkdir(exist_ok=True)
            (fresh / name).write_bytes(content)
            total += len(content)
    return total


def write_ssog(
    path: Path,
    levels: Sequence[Gaussians],
    label_of: Mapping[int, int],
    names: Mapping[int, str] | None = None,
    *,
    parents: Mapping[int, str] | None = None,
    antialiased: bool = False,
) -> int:
    """Write levels of detail as a streamed SOG in one file: a ZIP of what `write_lod_meta` writes, stored.

    The same input gives the same bytes. Returns the size in bytes; other arguments and errors are those of
    `write_lod_meta`.
    """
    return archived(
        path, _contents(str(path), levels, label_of, names or {}, parents or {}, antialiased, FILE)
    )


def _contents(
    name: str,
    levels: Sequence[Gaussians],
    label_of: Mapping[int, int],
    names: Mapping[int, str],
    parents: Mapping[int, str],
    antialiased: bool,
    largest: int,
) -> Iterator[tuple[str, bytes]]:
    """Names and contents of all files, `lod-meta.json` last; errors call the scene `name`."""
    levels = [g.detach().to("cpu") for g in levels]
    if not levels or not all(map(len, levels)):
        raise DataError(f"{name}: a level without Gaussians; leave it out")
    cells = {cell for g in levels for cell in g.counts()}
    leaves: dict[int, dict[str, Any]] = {
        cell: {"lods": {}} for cell in sorted(cells, key=lambda cell: (label_of[cell], cell))
    }
    files: list[str] = []
    for lod, g in enumerate(levels):
        rows = _rows(g, leaves)
        _widen(leaves, _extents(g), rows)
        for number, part in enumerate(_files(rows, largest)):
            folder, first = f"{lod}_{number}", 0
            for cell in part:
                count = len(rows[cell])
                leaves[cell]["lods"][str(lod)] = {"file": len(files), "offset": first, "count": count}
                first += count
            inside = relabelled(g.select(torch.from_numpy(np.concatenate([rows[c] for c in part]))), label_of)
            made = sog_files(inside, name=f"{name}/{folder}", antialiased=antialiased)
            for file, content in with_labels_beside(made, inside, names, parents).items():
                yield f"{folder}/{file}", content
            files.append(f"{folder}/{META}")
    yield LOD_META, json.dumps(_document(levels, files, _tree(leaves, label_of, names))).encode()


def _document(levels: Sequence[Gaussians], files: list[str], tree: dict[str, Any]) -> dict[str, Any]:
    counts = [len(g) for g in levels]
    document = {"version": 1, "asset": {"generator": GENERATOR}, "count": sum(counts), "counts": counts}
    return document | {"lodLevels": len(levels), "filenames": files, "tree": tree}


def _rows(g: Gaussians, leaves: Mapping[int, object]) -> dict[int, np.ndarray]:
    """Rows of each cell that a level has, in Morton order; cells in the order of the leaves."""
    order = sog_order(g)
    ids = g.label_ids.numpy()[order]
    firsts, ends = (np.searchsorted(ids, list(leaves), side) for side in ("left", "right"))
    found = zip(leaves, firsts, ends, strict=True)
    return {cell: order[first:end] for cell, first, end in found if end > first}


def _files(rows: Mapping[int, np.ndarray], largest: int) -> list[list[int]]:
    """The cells of each file of a level: in turn, as many as fit."""
    files: list[list[int]] = []
    count = largest
    for cell, own in rows.items():
        if count + len(own) > largest:
            files.append([])
            count = 0
        files[-1].append(cell)
        count += len(own)
    return files


def _extents(g: Gaussians) -> Float32[np.ndarray, "2 N 3"]:
    """Lowest and highest corner of each Gaussian."""
    w, x, y, z = torch.nn.functional.normalize(g.quats, dim=1).unbind(1)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    )
    variances = torch.exp(2 * g.log_scales.clamp(max=40))
    reach = [_SIGMAS * sum(r * r * v for r, v in zip(row, variances.T, strict=True)) ** 0.5 for row in rows]
    return torch.stack([g.means - torch.stack(reach, 1), g.means + torch.stack(reach, 1)]).numpy()


def _widen(
    leaves: Mapping[int, dict[str, Any]],
    extents: Float32[np.ndarray, "2 N 3"],
    rows: Mapping[int, np.ndarray],
) -> None:
    """Set `bound` of the leaves so that it holds what they had before and the Gaussians of another level."""
    for cell, own in rows.items():
        added = {"min": extents[0, own].min(0).tolist(), "max": extents[1, own].max(0).tolist()}
        earlier = leaves[cell].get("bound", added)
        leaves[cell]["bound"] = _around([earlier, added])


def _around(bounds: Sequence[Mapping[str, list[float]]]) -> dict[str, list[float]]:
    """The bound of several, in the seven digits that the format has."""
    low = np.min([bound["min"] for bound in bounds], axis=0)
    high = np.max([bound["max"] for bound in bounds], axis=0)
    return {
        "min": [float(f"{value:.7g}") for value in low], "max": [float(f"{value:.7g}") for value in high]
    }  # fmt: skip


def _tree(
    leaves: Mapping[int, dict[str, Any]], label_of: Mapping[int, int], names: Mapping[int, str]
) -> dict[str, Any]:
    """The root: a node for each category, with its cells below it."""
    below: dict[int, list[dict[str, Any]]] = {}
    for cell, leaf in leaves.items():
        below.setdefault(label_of[cell], []).append(leaf)
    nodes: list[dict[str, Any]] = []
    for label, children in below.items():
        named = {"name": names[label]} if label in names else {}
        nodes.append(named | {"bound": _around([leaf["bound"] for leaf in children]), "children": children})
    return {"bound": _around([node["bound"] for node in nodes]), "children": nodes}


WRITER = SplatWriter(
    write_levels=lambda path, levels, label_of, names, parents, antialiased: write_lod_meta(
        path.parent, levels, label_of, names, parents=parents, antialiased=antialiased
    )
)
SSOG_WRITER = SplatWriter(
    write_levels=lambda path, levels, label_of, names, parents, antialiased: write_ssog(
        path, levels, label_of, names, parents=parents, antialiased=antialiased
    )
)
