"""How the columns of integers of a coded stream are coded: in what order, and by which tables.

The same functions write and read: a writer gets columns, a reader returns what it reads. The table of a
symbol may depend on what was coded before it. docs/formats.md specifies the columns.
"""

from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Int64

from sagesplat.core.sh import BASES
from sagesplat.kernels.rans import BITS, Coder

AXIS_BITS = 17  # of a position: a Morton code has 51, which a float64 holds
ROTATIONS = (4, 6, 8, 11, 16, 23, 32, 45, 64, 90, 127)  # steps from 0 to sqrt(1/2), by class
LARGEST = 2**18 - 1  # magnitude of a value; differences of two have 20 bits
_ESCAPE_BITS = 20
_OFFSET = 1 << (_ESCAPE_BITS - 1)
_SCALES, _COLOURS, _HARMONICS = 128, 160, 32  # symbols, the last of which is an escape
_SCALE, _COLOUR, _HARMONIC = 64, 80, 15  # symbol of 0
_ROTATION = ROTATIONS[-1]
_GAPS = 3 * AXIS_BITS + 1
PALETTE_BITS = 16  # of a row's number
_OPACITIES = 256
_CLASSES = 4  # of first opacities: rows of the table of second ones
_PEAK = 512
_FLAT = 128
_LIKELY = 64  # count of an opacity that is not the largest


@dataclass(frozen=True)
class Columns:
    """N Gaussians as integers; SH coefficients of degree 0 to 3."""

    positions: Int64[np.ndarray, " N"]  # Morton codes, ascending
    opacities: Int64[np.ndarray, " N"]  # the first ones, or the only ones: these are at least 1
    seconds: Int64[np.ndarray, " N"]  # the same where there is one
    scales: Int64[np.ndarray, "N 3"]  # descending
    rotations: Int64[np.ndarray, "N 3"]  # x y z
    colours: Int64[np.ndarray, "N 3"]  # red, green, blue
    harmonics: Int64[np.ndarray, "N K 3"]
    entries: Int64[np.ndarray, " N"]  # rows of the palette, if there is one; harmonics are then not coded

    def rows(self, rows: slice | np.ndarray) -> "Columns":
        """Some of the Gaussians."""
        return Columns(**{f.name: getattr(self, f.name)[rows] for f in fields(self)})


@dataclass(frozen=True)
class Layout:
    """What the header says of how columns are coded."""

    sh_degree: int
    opacities: int  # the largest
    two_opacities: bool
    rotation_origin: int
    rotation_spread: int
    palette: bool = False

    def classes(self, scales: Int64[np.ndarray, "N 3"]) -> Int64[np.ndarray, " N"]:
        """Rows of ROTATIONS: a large or a thin Gaussian needs small steps."""
        size = 2 * scales[:, 0] - scales[:, 2] - self.rotation_origin
        return (size // self.rotation_spread).clip(0, len(ROTATIONS) - 1)


def joined(parts: list[Columns], layout: Layout) -> Columns:
    """Columns one after the other."""
    none = np.zeros((0, 3), np.int64)
    harmonics = np.zeros((0, 0 if layout.palette else BASES[layout.sh_degree], 3), np.int64)
    one = none[:, 0]
    parts = [Columns(one, one, one, none, none, none, harmonics, one), *parts]
    return Columns(
        **{f.name: np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(Columns)}
    )


def new_tables(layout: Layout) -> dict[str, np.ndarray]:
    """Counts that a stream begins with, by name: int [contexts, symbols]."""
    opacities = np.arange(_OPACITIES)
    possible = (opacities >= (not layout.two_opacities)) & (opacities <= layout.opacities)
    most = opacities == layout.opacities
    flat = np.where(possible, _LIKELY, 0)
    opaque = np.where(most, _PEAK, flat)  # many are opaque, above all those that stay so
    tables = {
        "gap": _peaked(_GAPS, 18, 3)[None],
        "opacity": opaque[None],
        "second opacity": np.stack([*[flat] * (_CLASSES - 1), opaque]),
        "scale": np.stack([_peaked(_SCALES, _SCALE, 5), *[_peaked(_SCALES, 5, 5)] * 2]),
        "rotation": np.stack([_within(steps) for steps in ROTATIONS]),
        "colour": np.stack([_peaked(_COLOURS, _COLOUR, 10), *[_peaked(_COLOURS, _COLOUR, 5)] * 2]),
    }
    if layout.palette:
        return tables | {"entry": _peaked(PALETTE_BITS + 1, PALETTE_BITS - 1, 1)[None]}
    return tables | harmonics_tables(layout.sh_degree)


def harmonics_tables(sh_degree: int) -> dict[str, np.ndarray]:
    """Those of `new_tables` that harmonics are coded by."""
    tables = {}
    for degree in range(1, sh_degree + 1):
        low, high = BASES[degree - 1 : degree + 1]
        tables[f"mask {degree}"] = np.stack([_few(high - low, max(4 - n, 2)) for n in range(low + 1)])
        for name, contexts in (("green", 1), ("red", 7), ("blue", 15)):
            tables[f"{name} {degree}"] = np.tile(_peaked(_HARMONICS, _HARMONIC, 0.5), (contexts, 1))
    return tables


def _peaked(symbols: int, likeliest: int, half: float) -> np.ndarray:
    """Counts that halve every `half` symbols to both sides, at least 1."""
    halvings = (np.abs(np.arange(symbols) - likeliest) / half).astype(np.int64)
    return np.maximum(_PEAK >> halvings.clip(max=30), 1)


def _within(steps: int) -> np.ndarray:
    """Equal counts of the values from -`steps` to `steps`, 0 beyond."""
    return np.where(np.abs(np.arange(2 * _ROTATION + 1) - _ROTATION) <= steps, _FLAT, 0)


def _few(bits: int, halvings: int) -> np.ndarray:
    """Counts of masks, halved as often for each bit that is set, at least 1."""
    ones = np.array([mask.bit_count() for mask in range(1 << bits)])
    return np.maximum(_PEAK >> halvings * ones, 1)


def code_columns(
    coder: Coder, layout: Layout, count: int, before: int, two: bool, given: Columns | None
) -> Columns:
    """Code the columns of `count` Gaussians; a reader is given none.

    `before`: the Morton code before them in the level, or 0. `two`: second opacities are among them.
    """
    zero = np.zeros(count, np.int64)
    wanted = None if given is None else np.diff(given.positions, prepend=before)
    gaps = _code_lengths(coder, "gap", zero, wanted)
    opacities = coder.symbols("opacity", zero, None if given is None else given.opacities)
    seconds = opacities
    if two:
        seconds = code_seconds(coder, layout, opacities, None if given is None else given.seconds)
    scales = _code_scales(coder, zero, None if given is None else given.scales)
    classes, rotations = layout.classes(scales), np.empty((count, 3), np.int64)
    for axis in range(3):
        wanted = None if given is None else given.rotations[:, axis] + _ROTATION
        rotations[:, axis] = coder.symbols("rotation", classes, wanted) - _ROTATION
    colours = _code_colours(coder, zero, None if given is None else given.colours)
    entries, harmonics = zero, np.zeros((count, 0, 3), np.int64)
    if layout.palette:
        entries = _code_lengths(coder, "entry", zero, None if given is None else given.entries)
    else:
        harmonics = code_harmonics(coder, layout.sh_degree, count, None if given is None else given.harmonics)
    return Columns(before + gaps.cumsum(), opacities, seconds, scales, rotations, colours, harmonics, entries)


def code_seconds(coder: Coder, layout: Layout, opacities: np.ndarray, given: np.ndarray | None) -> np.ndarray:
    """Code the second opacities of Gaussians by their first ones."""
    classes = opacities * _CLASSES // (layout.opacities + 1)
    return coder.symbols("second opacity", classes, given)


def _code_lengths(coder: Coder, name: str, zero: np.ndarray, given: np.ndarray | None) -> np.ndarray:
    """Numbers from 0 on: how many bits they have, then those below the highest."""
    lengths = None if given is None else np.frexp(given.astype(np.float64))[1].astype(np.int64)
    lengths = coder.symbols(name, zero, lengths)
    return code_bits(coder, np.minimum(lengths, 1), np.maximum(lengths - 1, 0), given)


def _code_scales(coder: Coder, zero: np.ndarray, given: np.ndarray | None) -> np.ndarray:
    """The largest, and how much smaller each of the others is than the one before it."""
    found, wanted = np.empty((len(zero), 3), np.int64), None
    for axis in range(3):
        if given is not None:
            wanted = given[:, axis - 1] - given[:, axis] if axis else given[:, 0]
        value = _code_values(coder, "scale", zero + axis, 0 if axis else _SCALE, _SCALES, wanted)
        found[:, axis] = found[:, axis - 1] - value if axis else value
    return found


def _code_colours(coder: Coder, zero: np.ndarray, given: np.ndarray | None) -> np.ndarray:
    """Green, then how much more red and blue are."""
    found = np.zeros((len(zero), 3), np.int64)
    for context, channel in enumerate((1, 0, 2)):
        wanted = None if given is None else given[:, channel] - found[:, 1]
        found[:, channel] = found[:, 1] + _code_values(
            coder, "colour", zero + context, _COLOUR, _COLOURS, wanted
        )
    return found


def code_harmonics(coder: Coder, sh_degree: int, count: int, given: np.ndarray | None) -> np.ndarray:
    """Code `count` rows of harmonics: by degree, which coefficients are not grey zeros, then their values."""
    found = np.zeros((count, BASES[sh_degree], 3), np.int64)
    before = np.zeros(count, np.int64)  # coefficients of lower degrees that are not zero
    for degree in range(1, sh_degree + 1):
        band = slice(BASES[degree - 1], BASES[degree])
        places = 1 << np.arange(band.stop - band.start)
        masks = None if given is None else given[:, band].any(2) @ places
        masks = coder.symbols(f"mask {degree}", before, masks)
        some = (masks[:, None] & places) > 0
        values = None if given is None else given[:, band][some]
        found[:, band][some] = _code_coefficients(coder, degree, int(some.sum()), values)
        before = before + some.sum(1)
    return found


def _code_coefficients(coder: Coder, degree: int, count: int, given: np.ndarray | None) -> np.ndarray:
    """Green, then how much more red and blue are, each by what was before it; int64 [count, 3]."""
    found = np.zeros((count, 3), np.int64)

    def code(name: str, contexts: np.ndarray, channel: int) -> np.ndarray:
        wanted = None if given is None else given[:, channel] - found[:, 1]
        return _code_values(coder, f"{name} {degree}", contexts, _HARMONIC, _HARMONICS, wanted)

    green = found[:, 1] = code("green", np.zeros(count, np.int64), 1)
    red = code("red", green.clip(-3, 3) + 3, 0)
    blue = code("blue", 3 * (green.clip(-2, 2) + 2) + red.clip(-1, 1) + 1, 2)
    found[:, 0], found[:, 2] = green + red, green + blue
    return found


def _code_values(
    coder: Coder, name: str, contexts: np.ndarray, zero: int, symbols: int, given: np.ndarray | None
) -> np.ndarray:
    """Values as symbols, 0 as the symbol `zero`; others as the last symbol and 20 bits after the column."""
    wanted, escape = None, symbols - 1
    if given is not None:
        wanted = np.where((given >= -zero) & (given < escape - zero), given + zero, escape)
    coded = coder.symbols(name, contexts, wanted)
    found, rare = coded - zero, np.flatnonzero(coded == escape)
    if len(rare):
        wide = None if given is None else given[rare] + _OFFSET
        widths = np.full(len(rare), _ESCAPE_BITS)
        found[rare] = code_bits(coder, np.zeros(len(rare), np.int64), widths, wide) - _OFFSET
    return found


def code_bits(coder: Coder, high: np.ndarray, widths: np.ndarray, given: np.ndarray | None) -> np.ndarray:
    """Code `high` with `widths` bits appended: for all values the highest 14 or fewer, then the next."""
    found, left = high, widths
    while left.any():
        now = np.minimum(left, BITS)
        left = left - now
        wanted = None if given is None else (given >> left) & ((1 << now) - 1)
        found = (found << now) | coder.bits(now, wanted)
    return found
