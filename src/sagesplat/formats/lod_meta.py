"""Streamed SOG, PlayCanvas's levels of detail: `lod-meta.json` and a SOG scene for each part of each level.

    {"version": 1, "count": 364, "counts": [312, 52], "lodLevels": 2, "filenames": ["0_0/meta.json", ...],
     "environment": "env/meta.json", "tree": NODE}

Level 0 is the finest. A NODE of the tree has a `bound` and `children`, or it is a leaf: `lods` says for each
level which rows of which file are in it ({"0": {"file": 0, "offset": 0, "count": 312}, ...}). `environment`,
if it is there, is a SOG scene that is shown with every level, such as a sky. Writers of a time before had
null in its place, or `errors` of the leaves by level (`lodErrors`), which engines no longer use.
"""

from collections import defaultdict
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Annotated, Literal

import torch
from msgspec import Meta

from sagesplat.core.errors import DataError, short
from sagesplat.core.gaussians import concat
from sagesplat.formats.labels import with_labels
from sagesplat.formats.sog import read_sog
from sagesplat.formats.splat import Splat, SplatReader
from sagesplat.io.files import regular
from sagesplat.io.typed import parse_json_as, refused

LOD_META = "lod-meta.json"
_MOST_LEVELS = 100
_CURE = "copy its folder again"
_Number = Annotated[int, Meta(ge=0, lt=2**40)]

Slices = dict[int, list[tuple[int, int]]]  # by file: first row and number of rows of each leaf


def read_lod_meta(path: Path, lod: int = 0) -> Splat:
    """Read a level of a streamed SOG, with its environment, if it has one.

    Rows are in the order of the files. Labels come from the sidecars of the SOG scenes. DataError for another
    file, a level that it does not have, files outside of its folder, or rows that they do not have.
    """
    levels, files, environment, slices = _parsed(path, lod)
    if not 0 <= lod < levels:
        raise DataError(f"{path}: no level {lod}; it has 0 (the finest) to {levels - 1}")
    parts = []
    for file in sorted(slices):
        part = _read(path, files[file])
        rows, count = sorted(slices[file]), len(part.gaussians)
        ends = [0, *(offset + size for offset, size in rows)]
        if any(offset < end for (offset, _), end in zip(rows, ends, strict=False)) or ends[-1] > count:
            raise DataError(f"{path}: leaves that do not fit the {count} rows of {files[file]}; {_CURE}")
        taken = [torch.arange(offset, offset + size) for offset, size in rows]
        whole = sum(size for _, size in rows) == count
        parts.append(part if whole else replace(part, gaussians=part.gaussians.select(torch.cat(taken))))
    if environment is not None:
        parts.append(_read(path, environment))
    if not parts:
        raise DataError(f"{path}: level {lod} has no Gaussians; choose another one")
    names, parents = dict[int, str](), dict[int, str]()
    for part in parts:
        names |= part.names
        parents |= part.parents
    g = parts[0].gaussians if len(parts) == 1 else concat([part.gaussians for part in parts])
    antialiased = any(part.antialiased for part in parts)
    return Splat(g, f"streamed {parts[0].kind}", names, antialiased, parents=parents)


def count_levels(path: Path) -> int:
    """How many levels a streamed SOG has; DataError for another file."""
    return _parsed(path, 0)[0]


def level_files(path: Path, lod: int) -> list[Path]:
    """The SOG scenes (`meta.json`, or bundled files) of a level; DataError for a file without them."""
    _, files, environment, slices = _parsed(path, lod)
    names = [files[file] for file in sorted(slices)] + ([] if environment is None else [environment])
    return [_inside(path, name) for name in names]


def _read(path: Path, name: str) -> Splat:
    """A SOG scene of the folder; DataError for one outside of it."""
    file = _inside(path, name)
    return with_labels(read_sog(file), file)


def _inside(path: Path, name: str) -> Path:
    file = path.parent / name
    try:
        inside = file.resolve().is_relative_to(path.parent.resolve())
    except (OSError, RuntimeError):  # links that lead in a circle
        inside = False
    if PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts or "\\" in name or not inside:
        raise DataError(f"{path}: {short(name)} is not in its folder; {_CURE}")
    return file


@dataclass(frozen=True)
class _Rows:
    file: _Number
    offset: _Number
    count: _Number


@dataclass(frozen=True)
class _Node:
    children: "list[_Node] | None" = None
    lods: dict[str, _Rows | None] | None = None


@dataclass(frozen=True)
class _Meta:
    lodLevels: Annotated[int, Meta(ge=1, le=_MOST_LEVELS)]
    filenames: list[str]
    tree: _Node
    environment: str | None = None  # None or "": there is none
    version: Literal[1] = 1

    def __post_init__(self) -> None:
        for name in (*self.filenames, self.environment or "."):
            if not (0 < len(name) <= 1000 and name.isprintable()):
                raise ValueError(f"{short(repr(name))} is no file name")


def _parsed(path: Path, lod: int) -> tuple[int, list[str], str | None, Slices]:
    """Number of levels, file names, the environment's, and the rows of a level by file."""
    try:
        content = regular(path).read_bytes()
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror}); give a {LOD_META}") from None
    with refused(path, "a streamed SOG", _CURE):
        meta = parse_json_as(content, _Meta)
        slices = _slices(meta.tree, str(lod), len(meta.filenames))
    return meta.lodLevels, meta.filenames, meta.environment or None, slices


def _slices(tree: _Node, lod: str, files: int) -> Slices:
    found: Slices = defaultdict(list)
    nodes = [tree]
    while nodes:
        node = nodes.pop()
        nodes += node.children or []
        if (rows := (node.lods or {}).get(lod)) is None:
            continue
        if rows.file >= files:
            raise ValueError(f"rows of file {rows.file}, which is not listed")
        if rows.count:
            found[rows.file].append((rows.offset, rows.count))
    return found


READER = SplatReader(
    lambda path, options: read_lod_meta(path, options.lod),
    json_key="lodLevels",
    in_folder=LOD_META,
    num_lods=count_levels,
)
