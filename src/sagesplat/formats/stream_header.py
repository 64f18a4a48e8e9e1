"""The header of a coded stream, and the steps by which it turns Gaussians into integers and back."""

import struct
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float32, Float64, Int64
from torch import Tensor

from sagesplat.core.gaussians import Gaussians, concat
from sagesplat.formats.quantisation import PER_COLOUR, logits_of_bytes
from sagesplat.formats.spz import flipped
from sagesplat.formats.stream_columns import AXIS_BITS, LARGEST, ROTATIONS, Columns, Layout

MAGIC, VERSION = b"SGST", 3
_HEADER = struct.Struct("<4sBBBBBBBBffffffhhhH")
SIZE = _HEADER.size
_ANTIALIASED, _TWO_OPACITIES, _PALETTE = 1, 2, 4  # flags
_FRAME = "rub"  # axes: right, up, back, as in SPZ
_CELLS = 2**AXIS_BITS
_SMALLEST = 2**-8  # step that a precision can ask for
_CLASS = 11 / 8  # natural log of what makes a rotation one class finer: of 2 log(largest) - log(smallest)
_MIDDLE = 6.5  # class of the median
_FARTHEST = 2**15 - 1  # magnitude of an origin
_COARSEST = 1 / 3  # step of positions, of the median of the middle standard deviations: 0.002 of SSIM
_ROUNDED = 2**17  # Gaussians at a time
_LONGEST_LOG = 40  # magnitude of a log scale
_SH_RANGE = 256.0  # magnitude of harmonics
_RANGE = 1e18  # magnitude of a position; its square is finite in float32
# by 3 times the first axis plus the second: the rotation wxyz that turns x and y to them or their opposites
_TURNS = np.zeros((9, 4))
_TURNS[[1, 2, 3, 5, 6, 7]] = np.array(
    [[1, 0, 0, 0], [0.5**0.5, 0.5**0.5, 0, 0], [0.5**0.5, 0, 0, 0.5**0.5],
     [0.5, 0.5, 0.5, 0.5], [0.5, -0.5, -0.5, -0.5], [0.5**0.5, 0, 0.5**0.5, 0]]
)  # fmt: skip


@dataclass(frozen=True)
class Precision:
    """How finely a stream keeps its Gaussians.

    Colours, log scales and harmonics are those that nested levels are trained with.
    """

    position: float = 1 / 6  # steps, of the median of the Gaussians' middle standard deviation
    opacity: int = 8  # steps of 1/255
    colour: float = 2.0  # steps of sh0, of SPZ's units (of a byte)
    log_scale: float = 1 / 8  # steps
    sh_bits: tuple[int, int] = (5, 4)  # steps of 2^(1 - bits): of degree 1, and of 2 and 3
    rotation: float = -0.75  # classes finer than usual; two halve the steps
    least: float = 0.75  # opacity, in its steps: what never has more is left out
    grid: "Grid | None" = None  # instead of `position` and `rotation`: that of streams which were decoded
    sh_range: float = 1.0  # harmonics beyond are cut, as in training

    def __post_init__(self) -> None:
        steps = (self.position, self.colour, self.log_scale)
        if min(steps) < _SMALLEST or max(steps) > 1 / _SMALLEST or not 1 <= self.opacity <= 255:
            raise ValueError(f"steps {steps} and {self.opacity}/255 of opacities are not in the format")
        if not all(1 <= bits <= 8 for bits in self.sh_bits) or abs(self.rotation) > 9:
            raise ValueError(f"{self.sh_bits} bits, {self.rotation} classes; 1 to 8 and -9 to 9 are there")
        if not 0 < self.sh_range <= _SH_RANGE:
            raise ValueError(f"harmonics up to {self.sh_range}; {_SH_RANGE} are in the format")
        if not 0.5 <= self.least <= 255:
            raise ValueError(f"opacities of {self.least} steps; from 0.5 on they are in the format")


# of Gaussians as they came in, ascending; harmonics need more bits where a picture shows them
AS_GIVEN = (
    Precision(position=1 / 12, opacity=3, log_scale=1 / 16, rotation=2.0, sh_range=_SH_RANGE),
    Precision(position=1 / 16, opacity=3, log_scale=1 / 12, rotation=0.5, sh_bits=(6, 6), sh_range=_SH_RANGE),
    Precision(
        position=1 / 16, opacity=2, log_scale=1 / 16, rotation=1.0, sh_bits=(7, 7), sh_range=_SH_RANGE,
        least=0.5,
    ),
    Precision(
        position=1 / 32, opacity=1, colour=1.0, log_scale=1 / 32, sh_bits=(8, 8), sh_range=_SH_RANGE,
        rotation=3.0, least=0.5,
    ),
)  # fmt: skip


@dataclass(frozen=True)
class Grid:
    """What a stream rounds positions and rotations to: the same again rounds to what is there."""

    step: float  # of positions, world units
    rotation_origin: int  # steps of log scales

    @classmethod
    def of(cls, header: "Header") -> "Grid":
        """That of a stream."""
        return cls(header.step, header.rotation_origin + header.scale_origin)


@dataclass(frozen=True)
class Header:
    """What a stream says of all its Gaussians."""

    antialiased: bool
    two_opacities: bool  # of each Gaussian, one for the low levels and one for the full model
    palette: bool  # harmonics are rows of the file's palette
    sh_degree: int
    levels: int
    opacity_step: int  # of 1/255
    sh_bits: tuple[int, int]
    rotation_spread: int
    origin: tuple[float, float, float]  # of positions, world units, right, up, back
    step: float  # of positions, world units
    scale_step: float
    colour_step: float
    scale_origin: int  # steps
    colour_origin: int  # steps
    rotation_origin: int

    @property
    def layout(self) -> Layout:
        """What it says of the columns."""
        opacities = -(-255 // self.opacity_step)
        return Layout(
            self.sh_degree, opacities, self.two_opacities, self.rotation_origin, self.rotation_spread,
            self.palette,
        )  # fmt: skip

    def pack(self) -> bytes:
        """Its bytes."""
        flags = _ANTIALIASED * self.antialiased | _TWO_OPACITIES * self.two_opacities
        flags |= _PALETTE * self.palette
        return _HEADER.pack(
            MAGIC, VERSION, flags, self.sh_degree, self.levels, self.opacity_step,
            *self.sh_bits, self.rotation_spread, *self.origin, self.step, self.scale_step, self.colour_step,
            self.scale_origin, self.colour_origin, self.rotation_origin, 0,
        )  # fmt: skip


class OtherVersionError(ValueError):
    """A stream that another version of sagesplat wrote."""


def read_header(content: bytes) -> Header:
    """The header that a stream begins with; ValueError for another format or damage.

    Raises `OtherVersionError` for another version.
    """
    if len(content) < SIZE or content[:4] != MAGIC:
        raise ValueError("not a sagesplat-stream")
    _, version, flags, degree, levels, opacity, low, high, spread, *rest = _HEADER.unpack_from(content)
    *origin, step, scale_step, colour_step, scales, colours, rotations, reserved = rest
    if version != VERSION:
        raise OtherVersionError(f"a stream of version {version}, and not {VERSION}")
    if flags & ~(_ANTIALIASED | _TWO_OPACITIES | _PALETTE) or reserved:
        raise ValueError(f"unknown flags {flags}")
    steps = np.array([step, scale_step, colour_step])
    reach = np.abs(origin) + step * _CELLS
    if not (steps >= 1e-18).all() or not (steps <= _RANGE).all() or not (reach <= _RANGE).all():
        raise ValueError("impossible steps")
    if degree > 3 or not levels or not opacity or not spread or not (1 <= low <= 8 and 1 <= high <= 8):
        raise ValueError(f"degree {degree}, {levels} levels, steps {opacity}, {low}, {high}, {spread}")
    if flags & _PALETTE and not degree:
        raise ValueError("a palette of no harmonics")
    return Header(
        bool(flags & _ANTIALIASED), bool(flags & _TWO_OPACITIES), bool(flags & _PALETTE), degree, levels,
        opacity, (low, high), spread, (origin[0], origin[1], origin[2]), step, scale_step, colour_step,
        scales, colours, rotations,
    )  # fmt: skip


def position_steps(g: Gaussians) -> tuple[float, float]:
    """Steps of positions: those that the Gaussians' box needs, and those that would be too large for most."""
    widest, middle = _steps(g.means.double().numpy(), np.sort(g.log_scales.double().numpy(), axis=1))
    return widest, _COARSEST * middle


def _steps(means: np.ndarray, logs: np.ndarray) -> tuple[float, float]:
    """The step that the box of these positions needs, and the median of the middle standard deviations."""
    middle = float(np.exp(np.median(logs[:, 1]).clip(-_LONGEST_LOG, _LONGEST_LOG)))
    return float((means - means.min(0)).max()) / (_CELLS - 2), middle


def header_of(
    g: Gaussians,
    levels: int,
    precision: Precision,
    *,
    antialiased: bool,
    two_opacities: bool,
    palette: bool = False,
) -> Header:
    """The header of a stream of these Gaussians, in right, up, back."""
    means, logs = g.means.double().numpy(), np.sort(g.log_scales.double().numpy(), axis=1)
    if not len(means):
        means, logs = np.zeros((1, 3)), np.zeros((1, 3))
    low = means.min(0)
    widest, middle = _steps(means, logs)
    scales = np.rint(logs.clip(-_LONGEST_LOG, _LONGEST_LOG) / precision.log_scale)
    colours = (g.sh0.double().numpy() * PER_COLOUR + 127.5) / precision.colour
    origin = int(np.median(scales[:, 2]))
    spread = int(np.clip(round(_CLASS / precision.log_scale), 1, 255))
    predicted = int(np.median(2 * scales[:, 2] - scales[:, 0])) - origin
    rotation_origin = predicted - round((_MIDDLE + precision.rotation) * spread)
    step = precision.position * middle
    if precision.grid:
        step, rotation_origin = precision.grid.step, precision.grid.rotation_origin - origin
    return Header(
        antialiased,
        two_opacities,
        palette,
        g.sh_degree,
        levels,
        precision.opacity,
        precision.sh_bits,
        spread,
        (float(low[0]), float(low[1]), float(low[2])),
        max(step, widest, 1e-18),
        precision.log_scale,
        precision.colour,
        origin,
        int(np.median(colours).clip(-_FARTHEST, _FARTHEST)) if len(g) else 0,
        int(np.clip(rotation_origin, -_FARTHEST, _FARTHEST)),
    )


def opacities_of(logits: Tensor, step: int) -> Float64[np.ndarray, " N"]:
    """Opacities in steps of `step` / 255, not rounded."""
    return torch.sigmoid(logits.double()).numpy() * (255 / step)


def logits_of(opacities: Int64[np.ndarray, " N"], step: int) -> Float32[Tensor, " N"]:
    """The logits of opacities in steps of `step` / 255."""
    return torch.from_numpy(logits_of_bytes(opacities * float(step)))


def quantised(g: Gaussians, seconds: Tensor, header: Header, sh_range: float) -> Columns:
    """The columns of Gaussians in right, up, back; `seconds`: logits of their second opacities.

    All coefficients are there, those of a palette's rows too.
    """
    cells = np.rint((g.means.double().numpy() - header.origin) / header.step).astype(np.int64)
    logs = g.log_scales.double().numpy().clip(-_LONGEST_LOG, _LONGEST_LOG)
    axes = np.argsort(-logs, axis=1, kind="stable")
    scales = np.rint(np.take_along_axis(logs, axes, 1) / header.scale_step).astype(np.int64)
    scales -= header.scale_origin
    steps = np.array(ROTATIONS)[header.layout.classes(scales)][:, None]
    xyz = _turned(g.quats.double().numpy(), axes)[:, 1:]
    colours = (g.sh0[:, 0].double().numpy() * PER_COLOUR + 127.5) / header.colour_step
    return Columns(
        spread_bits(cells.clip(0, _CELLS - 1)),
        np.rint(opacities_of(g.logit_opacities, header.opacity_step)).astype(np.int64),
        np.rint(opacities_of(seconds, header.opacity_step)).astype(np.int64),
        scales,
        np.rint(xyz * 2**0.5 * steps).astype(np.int64).clip(-steps, steps),
        (np.rint(colours) - header.colour_origin).clip(-LARGEST, LARGEST).astype(np.int64),
        harmonics_of(g.shN, header.sh_bits, sh_range),
        np.zeros(len(g), np.int64),
    )


def harmonics_of(shN: Tensor, sh_bits: tuple[int, int], sh_range: float) -> Int64[np.ndarray, "N K 3"]:
    """SH coefficients [N, K, 3] in steps, cut to `sh_range`."""
    values = shN.double().numpy().clip(-sh_range, sh_range)
    return np.rint(values / _sh_steps(values.shape[1], sh_bits)).astype(np.int64)


def restored(columns: Columns, header: Header, label_id: int) -> Gaussians:
    """Gaussians in COLMAP's axes from columns."""
    means = gathered_bits(columns.positions) * header.step + header.origin
    logs = (columns.scales + header.scale_origin) * header.scale_step
    steps = np.array(ROTATIONS)[header.layout.classes(columns.scales)]
    xyz = columns.rotations * (0.5**0.5 / steps[:, None])
    quats = np.column_stack([np.sqrt((1 - (xyz**2).sum(1)).clip(0)), xyz])
    sh0 = ((columns.colours + header.colour_origin) * header.colour_step - 127.5) / PER_COLOUR
    shN = columns.harmonics * _sh_steps(columns.harmonics.shape[1], header.sh_bits)
    means, quats, shN = flipped(*(a.astype(np.float32) for a in (means, quats, shN)), _FRAME)
    return Gaussians(
        means=torch.from_numpy(means),
        quats=torch.from_numpy(quats),
        log_scales=torch.from_numpy(logs.clip(-_LONGEST_LOG, _LONGEST_LOG).astype(np.float32)),
        logit_opacities=logits_of(columns.opacities, header.opacity_step),
        sh0=torch.from_numpy(sh0[:, None].astype(np.float32)),
        shN=torch.from_numpy(shN),
        label_ids=torch.full((len(means),), label_id, dtype=torch.int16),
    )


def rounded(g: Gaussians, precision: Precision) -> Gaussians:
    """N Gaussians on the CPU in COLMAP's axes, about as streams of them keep them; none is left out."""
    parts = []
    for first in range(0, len(g), _ROUNDED):  # integers take several times the memory
        part = turned_round(g.slices([slice(first, min(first + _ROUNDED, len(g)))]))
        header = header_of(part, 1, precision, antialiased=False, two_opacities=False)
        columns = quantised(part, part.logit_opacities, header, precision.sh_range)
        parts.append(replace(restored(columns, header, 0), label_ids=part.label_ids))
    return concat(parts)


def turned_round(g: Gaussians) -> Gaussians:
    """Gaussians in COLMAP's axes in right, up, back."""
    means, quats, shN = flipped(g.means.numpy(), g.quats.numpy(), g.shN.numpy(), _FRAME)
    tensors = {"means": means, "quats": quats, "shN": shN}
    return Gaussians(
        **{**g.parameters(), **{k: torch.from_numpy(v) for k, v in tensors.items()}}, label_ids=g.label_ids
    )


def _sh_steps(bases: int, sh_bits: tuple[int, int]) -> Float64[np.ndarray, "K 1"]:
    return np.repeat([2.0 ** (1 - bits) for bits in sh_bits], [3, 12])[:bases, None]


def _turned(quats: Float64[np.ndarray, "N 4"], axes: Int64[np.ndarray, "N 3"]) -> Float64[np.ndarray, "N 4"]:
    """The rotations wxyz of the same ellipsoids with their axes in the order `axes`.

    Half turns about its axes leave an ellipsoid as it is: of the four rotations the one with the largest w.
    """
    q = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    q = _product(q, _TURNS[3 * axes[:, 0] + axes[:, 1]])
    inverse = np.diag([1.0, -1, -1, -1])  # rows: 1, -i, -j, -k
    q = _product(q, inverse[np.abs(q).argmax(1)])
    return q * np.where(q[:, :1] < 0, -1, 1)


def _product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Hamilton products wxyz [N, 4]."""
    s, t, u, v = (a[:, i] for i in range(4))
    w, x, y, z = (b[:, i] for i in range(4))
    return np.stack(
        [
            s * w - t * x - u * y - v * z,
            s * x + t * w + u * z - v * y,
            s * y - t * z + u * w + v * x,
            s * z + t * y - u * x + v * w,
        ],
        axis=1,
    )


def spread_bits(cells: Int64[np.ndarray, "N 3"]) -> Int64[np.ndarray, " N"]:
    """Morton codes: bit b of axis a becomes bit 3 b + a."""
    codes = np.zeros(len(cells), np.int64)
    for bit in range(AXIS_BITS):
        for axis in range(3):
            codes |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    return codes


def gathered_bits(codes: Int64[np.ndarray, " N"]) -> Int64[np.ndarray, "N 3"]:
    """The cells of Morton codes."""
    cells = np.zeros((len(codes), 3), np.int64)
    for bit in range(AXIS_BITS):
        for axis in range(3):
            cells[:, axis] |= ((codes >> (3 * bit + axis)) & 1) << bit
    return cells
