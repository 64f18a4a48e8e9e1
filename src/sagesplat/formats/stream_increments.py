"""Increments of nested levels as coded streams: one file for each category.

A cell has a stream for each set of Gaussians that replaces the one below it, and one where none does. The
first levels of all cells come before what replaces them, so that a viewer gets them in one piece.
"""

import hashlib
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Int64, Integer

from sagesplat.core.gaussians import Gaussians, concat
from sagesplat.core.names import slugs
from sagesplat.core.second_opacity import SecondOpacities
from sagesplat.formats.increments import (
    GPU_BYTES,
    STREAM,
    Increment,
    as_increment,
    by_file,
    streams_of,
    write_index,
)
from sagesplat.formats.levels import starts_of
from sagesplat.formats.ply import put_ply
from sagesplat.formats.stream import Encoded, encode_stream
from sagesplat.formats.stream_header import Grid, Precision, harmonics_of, position_steps, turned_round
from sagesplat.formats.stream_palette import Palette
from sagesplat.io.files import atomic_folder
from sagesplat.kernels.threads import side_by_side


@dataclass(frozen=True, eq=False)
class Streams:
    """Increments as coded streams, and which Gaussians these hold."""

    increments: list[Increment]
    sizes: dict[int, tuple[int, ...]]  # by cell id, Gaussians up to the end of each level
    rows: Int64[np.ndarray, " M"]  # of the Gaussians that were given, in the order of the increments


@dataclass(frozen=True, eq=False)
class _Set:
    """Levels of a cell that are prefixes of one sequence of Gaussians, which replaces what is below."""

    cell: int
    level: int  # the first of them
    rows: Int64[np.ndarray, " N"]  # of the Gaussians that were given
    sizes: tuple[int, ...]  # of these, up to the end of each level
    increments: tuple[Increment, ...] = ()  # once it is written


def write_streams(
    folder: Path,
    g: Gaussians,
    sizes: Mapping[int, Sequence[int]],
    names: dict[int, str],
    *,
    label_of: Mapping[int, int],
    second: SecondOpacities | None = None,
    replaces: Mapping[int, Collection[int]] | None = None,
    last: Precision | None = Precision(),
    antialiased: bool = False,
    grids: Mapping[int, Grid] | None = None,
) -> Streams:
    """Write the increments of nested levels as a file of coded streams for each category, and their index.

    `folder` is replaced. `sizes`, `names`, `label_of` and `replaces` as in `write_increments`. `second`:
    second opacities of the Gaussians, with weights of all cells, where no level replaces. `last`: how finely
    the levels are kept from the last one on that replaces; None: exactly, as a PLY file each. `grids`: by
    cell id, of Gaussians that were decoded before, what they are rounded to already.

    Where the levels that are kept so finely share rows of harmonics, the file of a category begins with their
    palette, if that takes fewer bytes.

    What is hardly to be seen is left out (see `encode_stream`, whose errors are raised), and with it a cell
    or category that has nothing else. With `replaces`, a Gaussian of each set stays; and sets are PLY files
    where some Gaussians lie so far off that a stream's steps of positions would be too large for most.

    ValueError for levels that cannot replace.
    """
    labels = sorted({label_of[cell] for cell in sizes})
    stems = slugs({label: names.get(label, str(label)) for label in labels})
    cells, bits = g.label_ids.cpu().numpy(), GPU_BYTES[g.sh_degree]
    made = list[_Set]()
    with atomic_folder(folder) as fresh:
        for label in labels:
            mine, stem = list[_Set](), stems[label]
            sets = _sets(cells, sizes, replaces, [c for c in sizes if label_of[c] == label])
            far = {one: replaces and np.greater(*position_steps(_of(g, one))) for one, _ in sets}
            finest = [one for one, is_last in sets if is_last and not far[one]]
            palette = _palette(g, finest, last) if last and replaces else None
            content = palette.encoded() if palette else b""
            encode = partial(
                _encoded, g=g, last=last, replaces=bool(replaces), second=second, grids=grids or {},
                palette=palette, antialiased=antialiased, name=stem,
            )  # fmt: skip
            streams = [(one, is_last) for one, is_last in sets if not far[one] and (last or not is_last)]
            coded_of = dict(zip((one for one, _ in streams), side_by_side(encode, streams), strict=True))
            for one, _ in sets:
                coded = coded_of.get(one)
                if coded is None:
                    mine.append(_in_files(fresh, _of(g, one), one, label, stem, antialiased))
                elif len(coded.rows):
                    ranges = _ranges(label, one, f"{stem}{STREAM}", len(content), coded, bits)
                    mine.append(replace(one, rows=one.rows[coded.rows], sizes=coded.sizes, increments=ranges))
                    content += coded.content
            if any(one.increments and one.increments[0].format == "stream" for one in mine):
                uri = f"{stems[label]}-{hashlib.sha256(content).hexdigest()[:12]}{STREAM}"
                (fresh / uri).write_bytes(content)
                mine = [replace(one, increments=_named(one.increments, uri)) for one in mine]
            made += sorted(mine, key=lambda one: one.cell)
        written = [increment for one in made for increment in one.increments]
        write_index(fresh, written)
    left = dict[int, tuple[int, ...]]()
    for one in made:
        below = left.get(one.cell, ())
        left[one.cell] = below + tuple(end + (below[-1] if below else 0) for end in one.sizes)
    return Streams(written, left, np.concatenate([np.arange(0), *(one.rows for one in made)]))


def _encoded(
    of: tuple[_Set, bool],
    *,
    g: Gaussians,
    last: Precision | None,
    replaces: bool,
    second: SecondOpacities | None,
    grids: Mapping[int, Grid],
    palette: Palette | None,
    antialiased: bool,
    name: str,
) -> Encoded:
    """A set, which may be its cell's last, as a stream."""
    one, is_last = of
    precision = last if is_last and last else Precision()
    part = _with_one_seen(_of(g, one), one.sizes[0], precision) if replaces else _of(g, one)
    own = second and SecondOpacities(second.logits[one.rows], {one.cell: second.weights[one.cell]})
    return encode_stream(
        part, one.sizes, second=own, antialiased=antialiased, name=name,
        palette=palette if is_last else None, precision=replace(precision, grid=grids.get(one.cell)),
    )  # fmt: skip


def _of(g: Gaussians, one: _Set) -> Gaussians:
    """The Gaussians of a set; without a copy where they follow each other, as they do in a ladder."""
    rows = one.rows
    if len(rows) and rows[-1] - rows[0] + 1 == len(rows):
        return Gaussians(**{f.name: getattr(g, f.name)[rows[0] : rows[-1] + 1] for f in fields(g)})
    return g.select(torch.from_numpy(rows))


def _palette(g: Gaussians, sets: Sequence[_Set], precision: Precision) -> Palette | None:
    """That of the harmonics of sets, if they are better coded by one."""
    parts = [
        harmonics_of(turned_round(_of(g, one)).shN, precision.sh_bits, precision.sh_range) for one in sets
    ]
    return Palette.of(np.concatenate(parts), precision.sh_bits) if parts else None


def _sets(
    cells: Integer[np.ndarray, " N"],
    sizes: Mapping[int, Sequence[int]],
    replaces: Mapping[int, Collection[int]] | None,
    wanted: Sequence[int],
) -> list[tuple[_Set, bool]]:
    """The sets of some cells, the lowest of all cells first, and whether a set is its cell's last.

    `cells`: of all Gaussians. ValueError for levels that cannot replace.
    """
    found = list[tuple[int, _Set, bool]]()
    for cell in sorted(wanted):
        rows, ends = np.flatnonzero(cells == cell), sizes[cell]
        firsts = [1, *sorted((replaces or {}).get(cell, ()))]
        starts_of(ends, firsts[1:])
        for number, (first, after) in enumerate(pairwise([*firsts, len(ends) + 1])):
            start = ends[first - 2] if number else 0
            own = tuple(end - start for end in ends[first - 1 : after - 1])
            one = _Set(cell, first, rows[start : start + own[-1]], own)
            found.append((number, one, first == firsts[-1]))
    return [(one, is_last) for _, one, is_last in sorted(found, key=lambda of: (of[0], of[1].cell))]


def _with_one_seen(g: Gaussians, first: int, precision: Precision) -> Gaussians:
    """The Gaussians with the most opaque of the `first` ones opaque enough for a stream to keep it."""
    logits = g.logit_opacities.clone()
    row = int(logits[: max(first, 1)].argmax())
    least = min((precision.least + 1) * precision.opacity / 255, 0.9)
    logits[row] = max(float(logits[row]), math.log(least / (1 - least)))
    return replace(g, logit_opacities=logits)


def _in_files(folder: Path, g: Gaussians, one: _Set, label: int, stem: str, antialiased: bool) -> _Set:
    """The set of these Gaussians with its increments, each of which is written as a PLY."""
    written = list[Increment]()
    for level, (low, high) in enumerate(pairwise((0, *one.sizes)), one.level):
        if high > low:
            part, temporary = g.slices([slice(low, high)]), folder / "increment.ply"
            put_ply(temporary, part, antialiased=antialiased)
            written.append(as_increment(temporary, part, label, one.cell, level, f"{stem}-{one.cell}"))
    return replace(one, increments=_replacing(written, one.level))


def _ranges(
    label: int, one: _Set, uri: str, start: int, coded: Encoded, gpu_bytes: int
) -> tuple[Increment, ...]:
    """The increments of a set's stream, which begins at the byte `start` of its file.

    The bytes of a level without Gaussians belong to the next, or the last.
    """
    counts = np.diff(coded.sizes, prepend=0).tolist()
    levels = [i for i, count in enumerate(counts) if count]
    cuts = [0, *(coded.ends[i] for i in levels[:-1]), len(coded.content)]
    ranges = [
        Increment(
            label, one.cell, one.level + i, uri, counts[i], high - low, counts[i] * gpu_bytes,
            hashlib.sha256(coded.content[low:high]).hexdigest(),
            offset=start + low, weight=coded.weights[i] if coded.weights else None,
        )
        for i, (low, high) in zip(levels, pairwise(cuts), strict=True)
    ]  # fmt: skip
    return _replacing(ranges, one.level)


def _replacing(increments: Sequence[Increment], level: int) -> tuple[Increment, ...]:
    """Increments of a set from `level` on, the first of which replaces what is below it."""
    return tuple(replace(one, refine="REPLACE") if one.level == level > 1 else one for one in increments)


def _named(increments: Sequence[Increment], uri: str) -> tuple[Increment, ...]:
    """Increments with the name of the file that holds the streams among them."""
    return tuple(replace(one, uri=uri) if one.format == "stream" else one for one in increments)


def read_streams(folder: Path, listed: Sequence[Increment]) -> tuple[Gaussians, SecondOpacities | None]:
    """What increments hold that all are streams: Gaussians, and their second opacities if they have some.

    `label_ids` and weights are by cell. DataError for a missing or damaged file.
    """
    found = [stream for some in by_file(folder, listed) for stream, _ in streams_of(folder, some)]
    g, seconds = concat([one.gaussians for one in found]), [one.second for one in found if one.second]
    if not seconds:
        return g, None
    weights = {cell: of_levels for one in seconds for cell, of_levels in one.weights.items()}
    return g, SecondOpacities(torch.cat([one.logits for one in seconds]), weights)
