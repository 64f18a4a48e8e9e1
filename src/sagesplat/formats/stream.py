"""`sagesplat-stream`: the nested levels of one cell as coded bytes that can be cut after any level.

A header of 44 bytes, then the levels: the number of their Gaussians, the number of their bytes, with two
opacities the weight of the second one, and their columns of integers, coded by an adaptive rANS. The second
opacities of levels of weight 0 come with the first level that needs them.
A file has the streams of all cells of a category, one after the other; none of them needs another one.
docs/formats.md specifies all of it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from sagesplat.core.errors import DataError, short
from sagesplat.core.gaussians import Gaussians
from sagesplat.core.second_opacity import SecondOpacities, blended
from sagesplat.formats.splat import check_writable
from sagesplat.formats.stream_columns import (
    AXIS_BITS,
    Columns,
    Layout,
    code_columns,
    code_seconds,
    joined,
    new_tables,
)
from sagesplat.formats.stream_header import (
    SIZE,
    Header,
    OtherVersionError,
    Precision,
    header_of,
    logits_of,
    opacities_of,
    quantised,
    read_header,
    restored,
    turned_round,
)
from sagesplat.formats.stream_palette import Palette, palette_end, read_palette
from sagesplat.kernels.rans import Coder, Reader, Tables, Writer

MAX_COUNT = 10_000_000  # Gaussians of a stream
_MAX_LEVELS = 255
_FARTHEST = 1e17  # positions, world units
_PER_BYTE = 128  # Gaussians in a byte, at most: what the least frequencies of the tables allow is 97
_SMALLEST, _LARGEST = 5, 11  # log2 of the Gaussians of a block


@dataclass(frozen=True, eq=False)
class Encoded:
    """A coded stream of nested levels."""

    content: bytes
    ends: tuple[int, ...]  # bytes up to the end of each level
    sizes: tuple[int, ...]  # Gaussians up to the end of each level
    weights: tuple[float, ...]  # of the second opacities at each level; none without them
    rows: Int64[np.ndarray, " M"]  # of the Gaussians that were given, in the stream's order


@dataclass(frozen=True, eq=False)
class Decoded:
    """What a stream, or its first levels, holds."""

    gaussians: Gaussians  # with their first opacities
    second: SecondOpacities | None  # and the weights of these levels, where there are two
    ends: tuple[int, ...]  # bytes up to the end of each level
    sizes: tuple[int, ...]  # Gaussians up to the end of each level
    antialiased: bool  # how the scene was trained
    start: int = 0  # its first byte

    def shown(self) -> Gaussians:
        """The Gaussians with their opacities at the newest of these levels."""
        if self.second is None or not self.sizes:
            return self.gaussians
        weight = _weights(self.second)[-1]
        logits = blended(self.gaussians.logit_opacities, self.second.logits, weight)
        return replace(self.gaussians, logit_opacities=logits)


def encode_stream(
    g: Gaussians,
    sizes: Sequence[int],
    *,
    second: SecondOpacities | None = None,
    precision: Precision = Precision(),
    palette: Palette | None = None,
    antialiased: bool = False,
    name: str = "stream",
) -> Encoded:
    """Encode the nested levels of N Gaussians in COLMAP's axes; labels are left out.

    The Gaussians of a level come in another order. Those that are hardly to be seen at any level are left out
    (`Precision.least`). The same input gives the same bytes.

    Args:
        g: The Gaussians of one cell in the order of their levels, on any device.
        sizes: The number of Gaussians up to the end of each level, ascending, the last one N.
        second: Their second opacities, with the weights of this one cell, which are rounded to 1/255. At
            levels of weight 1 they are the only ones. Levels that show the same Gaussians get one weight,
            that of the last.
        precision: Steps of quantisation. Finer ones than a model was trained with waste bytes.
        palette: Of the file, which has the rows of all these harmonics. None: each is coded by itself.
        antialiased: How the scene was trained; a flag for viewers.
        name: What errors call the stream.

    Returns:
        The bytes, where each level ends in them, and which Gaussians they hold.

    Raises:
        DataError: For NaN or Inf, a quaternion of zeros, or too many Gaussians.
        ValueError: For sizes that are no levels of N Gaussians, second opacities of others, or a palette of
            other harmonics.

    Example:
        >>> import torch
        >>> from sagesplat import Gaussians
        >>> from sagesplat.formats.stream import decode_stream, encode_stream
        >>> z = torch.zeros
        >>> ids = torch.zeros(5, dtype=torch.int16)
        >>> g = Gaussians(z(5, 3), z(5, 4) + 1, z(5, 3), z(5), z(5, 1, 3), z(5, 3, 3), ids)
        >>> coded = encode_stream(g, [2, 5])
        >>> len(decode_stream(coded.content[: coded.ends[0]]).gaussians)
        2
    """
    g = g.detach().to("cpu")
    _check(name, g, sizes, second)
    weights, seconds = [255] * len(sizes), g.logit_opacities
    if second:
        weights, seconds = [round(255 * w) for w in _weights(second)], second.logits.detach().to("cpu")
    most = opacities_of(_most(g.logit_opacities, seconds, sizes, weights), precision.opacity)
    rows = np.flatnonzero(most > precision.least)
    g, seconds = turned_round(g.select(torch.from_numpy(rows))), seconds[torch.from_numpy(rows)]
    made = header_of(
        g, len(sizes), precision, antialiased=antialiased, two_opacities=second is not None,
        palette=palette is not None,
    )  # fmt: skip
    header = read_header(made.pack())
    columns = quantised(g, seconds, header, precision.sh_range)
    if palette:
        _check_palette(header, palette)
        columns = replace(columns, entries=palette.entries(columns.harmonics))
    ends = np.searchsorted(rows, sizes)
    weights = [weights[np.searchsorted(ends, end, "right") - 1] for end in ends]
    one = np.repeat(weights, np.diff(ends, prepend=0)) == 255
    columns = replace(columns, opacities=np.where(one, columns.seconds, columns.opacities))
    tables, content, cuts, order = Tables(new_tables(header.layout)), header.pack(), [], []
    deferred_opacities: list[Columns] = []
    for weight, (low, high) in zip(weights, pairwise((0, *ends.tolist())), strict=True):
        order.append(low + np.argsort(columns.positions[low:high], kind="stable"))
        some, payload = columns.rows(order[-1]), b""
        if high > low:
            writer = Writer(tables)
            if weight:
                _code_deferred(writer, header.layout, deferred_opacities, given=True)
            _code_level(writer, header.layout, low, high - low, 0 < weight < 255, some)
            deferred_opacities = [] if weight else [*deferred_opacities, some]
            payload = writer.payload()
        content += _leb128(high - low) + _leb128(len(payload))
        content += bytes([weight] if second else []) + payload
        cuts.append(len(content))
    return Encoded(
        content, tuple(cuts), tuple(ends.tolist()), tuple(w / 255 for w in weights if second),
        rows[np.concatenate(order)],
    )  # fmt: skip


def _weights(second: SecondOpacities) -> tuple[float, ...]:
    """Of each level; ValueError for those of several categories."""
    if len(second.weights) != 1:
        raise ValueError(f"weights of {len(second.weights)} cells; a stream has one")
    (weights,) = second.weights.values()
    return weights


def _most(
    first: Tensor, second: Tensor, sizes: Sequence[int], weights: Sequence[int]
) -> Float64[Tensor, " N"]:
    """Logits of the largest opacities that Gaussians have at any level, from their own one on."""
    own = torch.from_numpy(np.repeat(np.array(weights) / 255, np.diff(sizes, prepend=0)))
    return torch.maximum(*(blended(first.double(), second.double(), w) for w in (own, weights[-1] / 255)))


def decode_stream(
    content: bytes,
    levels: int | None = None,
    *,
    palette: Palette | None = None,
    label_id: int = -1,
    name: str = "stream",
) -> Decoded:
    """Decode the first `levels` levels of a stream, or all that are there.

    Memory stays within what the levels announce, and that within what their bytes can hold.

    Args:
        content: The bytes, up to the end of any level.
        levels: How many levels to decode, at least 1. None: those that `content` has.
        palette: Of the file, if it has one.
        label_id: What all Gaussians get.
        name: What errors call the stream.

    Returns:
        The Gaussians in COLMAP's axes, float32 on the CPU. `encode_stream` shows an example.

    Raises:
        DataError: For another format or version, a damaged stream, one that is cut within a level, or one
            that ends before the level `levels`.
    """
    try:
        header = read_header(content)
        if levels is not None and not 1 <= levels <= header.levels:
            raise ValueError(f"level {levels} of {header.levels}")
        if header.palette:
            _check_palette(header, palette)
        tables, at, parts, weights = Tables(new_tables(header.layout)), SIZE, [], []
        ends, sizes = [], [0]
        deferred_opacities = 0  # parts from this one on are still without second opacities
        while len(sizes) <= (levels or header.levels):
            if levels is None and at == len(content):
                break
            count, nbytes, at = _read_sizes(content, at, header)
            weights += content[at - 1 : at] if header.two_opacities else [255]
            if nbytes > len(content) - at or count > min(MAX_COUNT - sizes[-1], _PER_BYTE * nbytes):
                raise ValueError(f"{count} Gaussians in {nbytes} of {len(content) - at} bytes")
            reader = _reader(tables, content[at : at + nbytes], count)
            if reader:
                if weights[-1]:
                    without = parts[deferred_opacities:]
                    parts[deferred_opacities:] = _code_deferred(reader, header.layout, without, given=False)
                two = 0 < weights[-1] < 255
                parts += _code_level(reader, header.layout, sizes[-1], count, two, None)
                deferred_opacities = len(parts) if weights[-1] else deferred_opacities
                reader.finish()
            at += nbytes
            ends.append(at)
            sizes.append(sizes[-1] + count)
        if len(sizes) == header.levels + 1 and at != len(content):
            raise ValueError(f"{len(content) - at} bytes after the last level")
        columns, second = joined(parts, header.layout), None
        if header.palette and palette:
            columns = replace(columns, harmonics=palette.taken(columns.entries))
    except ValueError as error:
        raise _damaged(name, error) from None
    if header.two_opacities:
        logits = logits_of(columns.seconds, header.opacity_step)
        second = SecondOpacities(logits, {label_id: tuple(w / 255 for w in weights)})
    g = restored(columns, header, label_id)
    return Decoded(g, second, tuple(ends), tuple(sizes[1:]), header.antialiased)


def starts_of_streams(content: bytes, *, name: str = "streams") -> list[int]:
    """The first byte of each of the streams that lie one after the other, of which the last may be cut off.

    A palette may be before them.

    DataError for another format or version, or damage.
    """
    starts = []
    try:
        at = palette_end(content)
        while at < len(content):
            starts.append(at)
            header = read_header(content[at : at + SIZE])
            at += SIZE
            for _ in range(header.levels):
                if at < len(content):
                    _, nbytes, at = _read_sizes(content, at, header)
                    at += nbytes
    except ValueError as error:
        raise _damaged(name, error) from None
    return starts


def end_of_palette(content: bytes, *, name: str = "streams") -> int:
    """Where the palette ends that a file of streams begins with, 0 without one; DataError for damage."""
    try:
        return palette_end(content)
    except ValueError as error:
        raise _damaged(name, error) from None


def palette_of(content: bytes, *, name: str = "streams") -> Palette | None:
    """The palette that a file of streams begins with, if there is one; DataError for damage."""
    try:
        return read_palette(content)
    except ValueError as error:
        raise _damaged(name, error) from None


def _check_palette(header: Header, palette: Palette | None) -> None:
    """ValueError unless a stream's harmonics can be rows of this palette."""
    if palette is None:
        raise ValueError("no palette")
    if (palette.sh_degree, palette.sh_bits) != (header.sh_degree, header.sh_bits):
        raise ValueError("a palette of other harmonics")


def _damaged(name: str, error: ValueError) -> DataError:
    if isinstance(error, OtherVersionError):
        return DataError(
            f"{name}: {error}; use the version of sagesplat that wrote it, or delete its folder and repeat "
            "the run from `sagesplat nest RUN` on"
        )
    return DataError(f"{name}: a damaged stream ({short(error)}); copy it again")


def _check(name: str, g: Gaussians, sizes: Sequence[int], second: SecondOpacities | None) -> None:
    if not 1 <= len(sizes) <= _MAX_LEVELS or list(sizes) != sorted(sizes) or sizes[0] < 0:
        raise ValueError(f"{len(sizes)} levels; 1 to {_MAX_LEVELS} ascending sizes are needed")
    if sizes[-1] != len(g):
        raise ValueError(f"levels of {sizes[-1]} Gaussians, of {len(g)}")
    if len(g) > MAX_COUNT:
        raise DataError(f"{name}: {len(g)} Gaussians; a stream holds {MAX_COUNT}, write several")
    if second and (len(second.logits) != len(g) or len(_weights(second)) != len(sizes)):
        raise ValueError(f"{len(second.logits)} second opacities of {len(g)} Gaussians, or other levels")
    check_writable(g, name)
    if second and not torch.isfinite(second.logits).all():
        raise DataError(f"{name}: second opacities are NaN or infinite; train the scene again")
    if float(g.means.abs().max() if len(g) else 0) > _FARTHEST:
        raise DataError(f"{name}: positions beyond {_FARTHEST:.0e} units; scale the scene down")


def _reader(tables: Tables, payload: bytes, count: int) -> Reader | None:
    """Of a level of `count` Gaussians; None where it has none. ValueError for damaged bytes."""
    if not count and payload:
        raise ValueError(f"{len(payload)} bytes of no Gaussians")
    return Reader(tables, payload) if count else None


def _code_deferred(coder: Coder, layout: Layout, parts: list[Columns], *, given: bool) -> list[Columns]:
    """Code second opacities of Gaussians whose other columns were sent before; the parts with them."""
    if not parts:
        return []
    firsts = np.concatenate([part.opacities for part in parts])
    wanted = np.concatenate([part.seconds for part in parts]) if given else None
    found, at = np.empty_like(firsts), 0
    while at < len(firsts):
        piece = slice(at, at + min(_left(at), len(firsts) - at))
        found[piece] = code_seconds(coder, layout, firsts[piece], None if wanted is None else wanted[piece])
        coder.end_block()
        at = piece.stop
    ends = np.cumsum([len(part.opacities) for part in parts])
    return [replace(part, seconds=own) for part, own in zip(parts, np.split(found, ends[:-1]), strict=True)]


def _code_level(
    coder: Coder, layout: Layout, done: int, count: int, two: bool, given: Columns | None
) -> list[Columns]:
    """Code `count` Gaussians after `done` ones: up to the end of a block, or what the level has of it."""
    parts, before, at = [], 0, 0
    while at < count:
        left = _left(done)
        now = min(left, count - at)
        some = None if given is None else given.rows(slice(at, at + now))
        parts.append(code_columns(coder, layout, now, before, two, some))
        if now == left:
            coder.end_block()
        before, at, done = int(parts[-1].positions[-1]), at + now, done + now
        if before >> 3 * AXIS_BITS:
            raise ValueError("a position outside the grid")
    return parts


def _left(done: int) -> int:
    """Gaussians until the block ends, after `done` of them."""
    size = 1 << min(max((done >> 1).bit_length() - 1, _SMALLEST), _LARGEST)
    return size - done % size


def _leb128(value: int) -> bytes:
    """Seven bits a byte, the lowest first; all bytes but the last have the highest bit set."""
    content = bytearray()
    while value > 127:
        content.append(value & 127 | 128)
        value >>= 7
    return bytes([*content, value])


def _read_sizes(content: bytes, at: int, header: Header) -> tuple[int, int, int]:
    """Gaussians of a level, bytes of its payload, where that begins; ValueError where they are missing."""
    count, at = _read_leb128(content, at)
    nbytes, at = _read_leb128(content, at)
    return count, nbytes, at + header.two_opacities


def _read_leb128(content: bytes, at: int) -> tuple[int, int]:
    """A number of at most 28 bits, and where it ends; ValueError where there is none."""
    value = 0
    for i in range(4):
        if at + i >= len(content):
            break
        byte = content[at + i]
        value |= (byte & 127) << 7 * i
        if byte < 128:
            return value, at + i + 1
    raise ValueError("no number of Gaussians or bytes")
