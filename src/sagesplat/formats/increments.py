"""Increments of nested levels: the Gaussians that a level of a cell adds to the level below it.

A cell is a category, or a part of one in space. Increments are ranges of coded streams, which are in one file
for each category, or files of their own (SPZ, PLY). A level may replace those below it (`refine: REPLACE`, as
in 3D Tiles): a cell then shows the increments from the newest such level on, and not the ones below. A coded
stream begins with each of these, so that none needs the bytes of what it replaces.
"""

import hashlib
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from itertools import groupby, pairwise
from operator import itemgetter
from pathlib import Path
from typing import Literal

import numpy as np
import torch

from sagesplat.core.errors import DataError, short
from sagesplat.core.gaussians import Gaussians, concat
from sagesplat.core.limits import AtLeast1, Count, LabelId, Sha256, Share
from sagesplat.core.names import slugs
from sagesplat.formats.levels import starts_of
from sagesplat.formats.ply import put_ply, read_ply
from sagesplat.formats.spz import SH_BITS, encode_spz, position_step, read_spz
from sagesplat.formats.stream import Decoded, decode_stream, palette_of, starts_of_streams
from sagesplat.io.files import atomic_folder, write_json
from sagesplat.io.typed import read_json_as
from sagesplat.kernels.threads import side_by_side

FileFormat = Literal["spz", "ply"]  # of a file that is one increment
Format = Literal["stream", "spz", "ply"]
Refine = Literal["ADD", "REPLACE"]
INDEX = "index.json"
# of hashes in a manifest: 48 bits of a file; 16 of a range, as decoding tells most damage of a stream, but
# not that of bits without a model
DIGITS = 12
DIGITS_OF_RANGE = 4
STREAM = ".sgst"
_FORMATS: dict[str, Format] = {STREAM: "stream", ".ply": "ply"}  # by suffix; all others are SPZ
_FINE_BITS = 8, 8  # of SH coefficients
_CURE = "delete that folder and run `sagesplat nest` again"
_FILE_NAME = re.compile(r"(?!\.)[A-Za-z0-9_.-]{1,200}")
# per Gaussian in the viewer's textures, by SH degree, while a scene grows at most: its words and its entry in
# the table, with room for half as many more; its place in the order, and what Spark 2.2 draws from, twice
GPU_BYTES = tuple(3 * (words + 8) // 2 + 4 + 2 * 36 for words in (16, 24, 40, 56))


@dataclass(frozen=True)
class Increment:
    """The Gaussians that a level of a cell adds to the level below it, or replaces it by, as bytes."""

    label_id: LabelId  # of its category
    cell: LabelId
    level: AtLeast1
    uri: str  # a file name in the folder of the index; its name holds a hash, so it can be cached for ever
    count: AtLeast1  # Gaussians
    nbytes: AtLeast1
    gpu_bytes: AtLeast1
    sha256: Sha256
    refine: Refine = "ADD"  # REPLACE: instead of all increments of lower levels
    offset: Count = 0  # its first byte in the file, which has all coded streams of a category
    weight: Share | None = None  # of second opacities where this is the newest level; None: there are none

    def __post_init__(self) -> None:
        if not _FILE_NAME.fullmatch(self.uri):
            raise ValueError(f"{short(repr(self.uri))} is no file name of an increment")
        if self.offset and self.format != "stream":
            raise ValueError(f"offset {self.offset} in a file of its own")

    @property
    def format(self) -> Format:
        """Of the file, by its name."""
        return _FORMATS.get(Path(self.uri).suffix, "spz")


def increments(g: Gaussians, sizes: Mapping[int, Sequence[int]]) -> list[tuple[int, int, np.ndarray]]:
    """(cell id, level, added rows) of every level that adds Gaussians.

    `sizes`: by cell id, which `g.label_ids` are, the number of Gaussians in each level.
    """
    cells, added = g.label_ids.numpy(), []
    for cell in sorted(sizes):
        rows = np.flatnonzero(cells == cell)
        for level, (low, high) in enumerate(pairwise((0, *sizes[cell])), 1):
            if high > low:
                added.append((cell, level, rows[low:high]))
    return added


def write_increments(
    folder: Path,
    g: Gaussians,
    sizes: Mapping[int, Sequence[int]],
    names: dict[int, str],
    *,
    label_of: Mapping[int, int],
    replaces: Mapping[int, Collection[int]] | None = None,
    kind: FileFormat | Callable[[int, int], FileFormat] = "spz",
    fine: Collection[int] = (),
    antialiased: bool = False,
) -> list[Increment]:
    """Write the increments of nested levels as files, and their index; `folder` is replaced.

    `sizes`: by cell id, which `g.label_ids` are, the rows up to the end of each level. `names`: label id ->
    category. `label_of`: cell id -> label id. `replaces`: by cell id, the levels that replace those below
    (`formats.levels.starts_of`). `kind`: of all files, or of a cell id and level. `antialiased` as in
    `encode_spz`; the levels `fine` are rounded by the smallest steps of the format. Where SPZ's steps of
    positions are larger than most Gaussians, a file is a PLY.

    ValueError for levels that cannot replace.
    """
    replaces, written = replaces or {}, []
    for cell, levels in replaces.items():
        starts_of(sizes[cell], levels)  # what cannot replace is an error, not an increment lost
    kind_of = kind if callable(kind) else lambda cell, level: kind
    stems = slugs({cell: names.get(label, str(label)) for cell, label in label_of.items()})
    with atomic_folder(folder) as fresh:
        for cell, level, rows in increments(g, sizes):
            part = g.select(torch.from_numpy(rows))
            suffix = kind_of(cell, level)
            if suffix == "spz" and np.greater(*position_step(part)):
                suffix = "ply"  # some lie so far off that SPZ's steps are larger than the others
            temporary = fresh / f"increment.{suffix}"
            if suffix == "spz":
                bits = _FINE_BITS if level in fine else SH_BITS
                temporary.write_bytes(
                    encode_spz(part, sh_bits=bits, coarse=level not in fine, antialiased=antialiased)
                )
            else:
                put_ply(temporary, part, antialiased=antialiased)
            one = as_increment(temporary, part, label_of[cell], cell, level, stems[cell])
            written.append(replace(one, refine="REPLACE" if level in replaces.get(cell, ()) else "ADD"))
        write_index(fresh, written)
    return written


def as_increment(
    temporary: Path, part: Gaussians, label_id: int, cell: int, level: int, stem: str
) -> Increment:
    """The increment of a file that holds `part`, which gets a name with its hash."""
    content = temporary.read_bytes()
    digest = hashlib.sha256(content).hexdigest()
    uri = f"{stem}-{level:02d}-{digest[:12]}{temporary.suffix}"
    temporary.rename(temporary.with_name(uri))
    gpu = len(part) * GPU_BYTES[part.sh_degree]
    return Increment(label_id, cell, level, uri, len(part), len(content), gpu, digest)


def write_index(folder: Path, written: Sequence[Increment]) -> None:
    """Write the index; of an increment what is as by default is left out."""
    formats = sorted({one.format for one in written}, reverse=True)
    defaults = {field.name: field.default for field in fields(Increment)}
    chunks = [{k: v for k, v in asdict(one).items() if v != defaults[k]} for one in written]
    write_json(folder / INDEX, {"format": "+".join(formats), "chunks": chunks})


@dataclass(frozen=True)
class _Index:
    chunks: list[Increment]


def read_index(folder: Path) -> list[Increment]:
    """The increments that `write_increments` listed; DataError for an invalid index."""
    return read_json_as(folder / INDEX, _Index, "an index of increments", _CURE).chunks


def read_increments(folder: Path, listed: Sequence[Increment], *, by_category: bool = False) -> Gaussians:
    """The Gaussians of increments, concatenated, as the newest of them shows each cell.

    Their `label_ids` are cell ids, or those of categories. DataError for a missing or damaged file.
    """

    def of_file(some: Sequence[Increment]) -> Gaussians:
        if some[0].format == "stream":
            found = [
                decoded.shown().slices([_rows(folder, decoded, one) for one in own])
                for decoded, own in streams_of(folder, some)
            ]
        else:
            found = [_read(folder, increment) for increment in some]
        part = concat(found)
        if by_category:
            part = replace(part, label_ids=torch.full_like(part.label_ids, some[0].label_id))
        return part

    parts = [of_file(some) for some in by_file(folder, listed)]
    return concat(parts) if len(parts) > 1 else parts[0]


def by_file(folder: Path, listed: Sequence[Increment]) -> list[list[Increment]]:
    """Increments that follow each other and are of one file; DataError without any."""
    if not listed:
        raise DataError(f"{folder}: no increments; {_CURE}")
    return [list(some) for _, some in groupby(listed, key=lambda one: one.uri)]


def streams_of(folder: Path, some: Sequence[Increment]) -> Iterator[tuple[Decoded, list[Increment]]]:
    """The streams that increments of one file are in, in their order, with the increments of each.

    A stream is decoded up to the newest of its increments; its `ends` are bytes of the file.
    """
    path = folder / some[0].uri
    try:
        content = path.read_bytes()
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror}); {_CURE}") from None
    starts = starts_of_streams(content, name=str(path))
    palette = palette_of(content, name=str(path))
    places = np.searchsorted(starts, [one.offset for one in some], "right") - 1
    groups = groupby(zip(places.tolist(), some, strict=True), key=itemgetter(0))
    streams = [(starts[place], [one for _, one in own]) for place, own in groups]

    def decoded_of(stream: tuple[int, list[Increment]]) -> Decoded:
        start, listed = stream
        end = max(one.offset + one.nbytes for one in listed)
        found = decode_stream(content[start:end], palette=palette, label_id=listed[0].cell, name=str(path))
        return replace(found, start=start, ends=tuple(start + at for at in found.ends))

    for decoded, (_, listed) in zip(side_by_side(decoded_of, streams), streams, strict=True):
        yield decoded, listed


def _rows(folder: Path, decoded: Decoded, one: Increment) -> slice:
    """The rows of an increment in what its stream was decoded to."""
    at = dict(zip((decoded.start, *decoded.ends), (0, *decoded.sizes), strict=True))
    low, high = at.get(one.offset, -1), at.get(one.offset + one.nbytes, -1)
    if low < 0 or high - low != one.count:
        raise DataError(f"{folder / one.uri}: other levels than the index has; {_CURE}")
    return slice(low, high)


def _read(folder: Path, increment: Increment) -> Gaussians:
    if increment.format == "spz":
        return read_spz(folder / increment.uri, increment.cell)
    g = read_ply(folder / increment.uri)
    return replace(g, label_ids=torch.full_like(g.label_ids, increment.cell))


def shown(listed: Sequence[Increment], cell: int, level: int) -> list[Increment]:
    """The increments that make up a level of a cell, ascending: since the newest REPLACE."""
    mine = (c for c in listed if c.cell == cell and c.level <= level)
    return full_scene(sorted(mine, key=lambda c: c.level))


def full_scene(listed: Sequence[Increment]) -> list[Increment]:
    """The increments that make up the highest level of every cell, in their order."""
    newest: dict[int, int] = {}
    for one in listed:
        if one.refine == "REPLACE":
            newest[one.cell] = max(newest.get(one.cell, 0), one.level)
    return [one for one in listed if one.level >= newest.get(one.cell, 0)]


def ranges_of(files: Iterable[tuple[str, int, Sequence[int]]]) -> list[tuple[str, int, int]]:
    """File, first byte and bytes of each of a cell's levels in a manifest.

    `files`: of consecutive levels that touch, their file, its first byte of them, and the bytes of each.
    """
    return [
        (uri, offset + sum(sizes[:i]), nbytes)
        for uri, offset, sizes in files
        for i, nbytes in enumerate(sizes)
    ]


def totals(listed: Sequence[Increment], cells: Sequence[int], levels: int, what: str) -> np.ndarray:
    """Sums of a field over the increments that make up each level: int64 [C, K].

    Rows are `cells`, columns the levels 1 to K; `what` is count, nbytes or gpu_bytes. A file's palette is
    divided evenly among its cells, at the levels that need it: from the last that replaces those below on.
    DataError for an increment of another cell or level.
    """
    table, replaced = np.zeros((2, len(cells), levels), np.int64)
    row = {cell: i for i, cell in enumerate(cells)}
    for increment in listed:
        if increment.cell not in row or increment.level > levels:
            raise DataError(
                f"{increment.uri}: this run has no cell {increment.cell}, level {increment.level}; {_CURE}"
            )
        at = row[increment.cell], increment.level - 1
        table[at] += getattr(increment, what)
        replaced[at] |= increment.refine == "REPLACE"
    ends = table.cumsum(1)
    found = ends - np.maximum.accumulate(np.where(replaced, ends - table, 0), axis=1)
    if what == "nbytes":
        for of_file in _files(listed):
            among = sorted({row[increment.cell] for increment in of_file})
            share = -(-min(increment.offset for increment in of_file) // len(among))
            for at in among:
                found[at, np.flatnonzero(replaced[at]).max(initial=0) :] += share
    return found


def palettes_of(listed: Sequence[Increment]) -> dict[str, int]:
    """Bytes of the palette of each file that has one, by uri: what comes before its first increment."""
    found = {of_file[0].uri: min(one.offset for one in of_file) for of_file in _files(listed)}
    return {uri: nbytes for uri, nbytes in found.items() if nbytes}


def _files(listed: Sequence[Increment]) -> list[list[Increment]]:
    by_uri: dict[str, list[Increment]] = {}
    for increment in listed:
        by_uri.setdefault(increment.uri, []).append(increment)
    return list(by_uri.values())
