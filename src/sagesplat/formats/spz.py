"""SPZ, compressed Gaussians for web viewers: versions 1, 2 (read only) to 4.

Niantic's format (MIT, github.com/nianticlabs/spz). Versions 1 to 3 are one gzip member, little endian: a
header of 16 bytes (magic, version, count as uint32; SH degree, fractional bits, flags, 0), then the
attributes, with these bytes per Gaussian. Version 4 packs them with zstd (`spz_container.py`).

    9    x y z, signed fixed point of 24 bits. Version 1: 6 bytes, half floats
    1    opacity times 255
    3    (0.15 sh0 + 0.5) 255
    3    (log scale + 10) 16
    4    rotation, uint32: 2 bits: index of the largest of x y z w, which is positive and omitted. A sign
         and 9 bits of each other: magnitude times 511 sqrt(2). Version 1, 2: 3 bytes, x y z with w >= 0
    3 K  128 + 128 times the SH coefficients, RGB last; of degree 4, too, which is read without its last

In `coarse` files values are multiples of larger steps than the format allows: they compress better.
"""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch

from sagesplat.core.errors import DataError, short
from sagesplat.core.gaussians import Gaussians
from sagesplat.core.sh import BASES, bases
from sagesplat.core.transform import transformed
from sagesplat.formats.labels import as_json, labelled
from sagesplat.formats.quantisation import (
    COLOUR_STEP,
    OTHERS,
    PER_COLOUR,
    PER_LOG_SCALE,
    SCALE_STEP,
    in_buckets,
    in_steps,
    largest_restored,
    logits_of_bytes,
)
from sagesplat.formats.splat import Frame, Splat, SplatReader, SplatWriter, check_writable
from sagesplat.formats.spz_container import (
    ANTIALIASED,
    MAGIC,
    MAX_BITS,
    MAX_COUNT,
    Packed,
    gzipped,
    unpacked,
    zstd_packed,
)
from sagesplat.io.files import atomic_path

SH_BITS = (5, 4)  # of degree 1, of degrees 2 and 3; as in the reference implementation
_LARGEST = 2**23 - 1  # magnitude of a fixed-point coordinate
_COARSE = 4, COLOUR_STEP, SCALE_STEP, 8  # steps of opacities, colours, scales and rotations
_SMALLER = 511 * 2**0.5  # a quaternion's second largest component is at most sqrt(1/2)
_LABELS = 0x53470001  # type of our extension: `formats/labels.py`
_AXES = 0xADBE0003  # type of Adobe's extension: its content is a row of _FRAMES
_FRAMES: tuple[Frame, ...] = ("rub", "ldb", "rdb", "lub", "rub", "ldf", "rdf", "luf", "ruf")
_AMBIGUOUS = (9, 10, 15, 16)  # axes that the format's library turns otherwise than their names say
_UNSURE = "its axes are read by their names; if it is upside down, adopt it with --up y"
_QUARTER_TURN = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # of axes 9 to 16, such as right, front, up


def write_spz(
    path: Path | str,
    g: Gaussians,
    *,
    antialiased: bool = False,
    frame: Frame = "rub",
    version: Literal[3, 4] = 3,
    names: Mapping[int, str] | None = None,
    parents: Mapping[int, str] | None = None,
) -> int:
    """Write an SPZ file atomically. Arguments and errors are those of `encode_spz`, which has more.

    DataError, too, where some Gaussians lie so far off that positions are rounded to more than the size of
    the others.

    Returns:
        The size of the file in bytes.
    """
    path = Path(path)
    check_writable(g, str(path))
    step, size = position_step(g)
    if step > size:
        raise DataError(
            f"{path}: positions reach {float(g.means.abs().max()):.3g}, so SPZ would round them to "
            f"{step:.2g}, more than the size of most Gaussians ({size:.2g}); write a .ply"
        )
    content = encode_spz(
        g, antialiased=antialiased, frame=frame, version=version, names=names, parents=parents, name=str(path)
    )
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)
    return len(content)


def encode_spz(
    g: Gaussians,
    *,
    antialiased: bool = False,
    fractional_bits: int | None = None,
    sh_bits: tuple[int, int] = SH_BITS,
    coarse: bool = False,
    frame: Frame = "rub",
    version: Literal[3, 4] = 3,
    names: Mapping[int, str] | None = None,
    parents: Mapping[int, str] | None = None,
    name: str = "SPZ",
) -> bytes:
    """Encode N Gaussians in COLMAP's axes as SPZ (Niantic).

    Opacities are rounded to 1/255, log scales to 1/16 within [-10, 5.94], sh0 to 0.026 within [-3.33, 3.33],
    harmonics to 2^(1 - bits) within [-1, 1). Rows keep their order. Values outside are clipped. Harmonics of
    zero stay zero. The same input gives the same bytes.

    Args:
        g: The Gaussians, on any device.
        antialiased: How the scene was trained; a flag for viewers.
        fractional_bits: Positions are rounded to 2^-bits world units. None: to at most an eighth of the size
            of nine in ten Gaussians, or what the extent allows.
        sh_bits: Bits, 1 to 8, of the harmonics of degree 1 and of those above. Fewer give a smaller file.
        coarse: Larger steps: positions to half of that size, opacities to 4/255, log scales to 1/8, sh0 to
            0.052, rotations to about half a degree. A tenth smaller, for 0.0008 to 0.0017 of SSIM on
            `garden`.
        frame: Axes to write: "rub" (right, up, back: SPZ's own) or "rdf" (right, down, front: COLMAP's).
        version: 3 (gzip), which all readers take, or 4 (zstd), a twentieth smaller, which Spark 2.2 does not.
        names: Category names by label id; with them the labels are kept as an extension record, which other
            readers skip.
        parents: Names of the categories that instances are of, by the instance's label id; likewise.
        name: What errors call the file.

    Returns:
        The file's content.

    Raises:
        DataError: For NaN or Inf, a quaternion of zeros, too many Gaussians, or positions that do not fit.

    Example:
        >>> import torch
        >>> from sagesplat import Gaussians
        >>> from sagesplat.formats.spz import decode_spz, encode_spz
        >>> z = torch.zeros
        >>> ids = torch.zeros(5, dtype=torch.int16)
        >>> g = Gaussians(z(5, 3), z(5, 4) + 1, z(5, 3), z(5), z(5, 1, 3), z(5, 3, 3), ids)
        >>> content = encode_spz(g)
        >>> len(content) < 150, len(decode_spz(content, label_id=184))
        (True, 5)
    """
    g = g.detach().to("cpu")
    if len(g) > MAX_COUNT:
        raise DataError(f"{name}: {len(g)} Gaussians; SPZ readers take {MAX_COUNT}, write several files")
    check_writable(g, name)
    means, quats, harmonics = flipped(g.means.numpy(), g.quats.numpy(), g.shN.numpy(), frame)
    bits = _fractional_bits(name, means, g.log_scales.numpy(), fractional_bits, coarse)
    opacity_step, colour_step, scale_step, rotation_step = _COARSE if coarse else (1, 1, 1, 1)
    fixed = np.rint(means.astype(np.float64) * 2.0**bits).astype("<i4")
    attributes = [
        fixed[..., None].view(np.uint8)[..., :3],
        _bytes(torch.sigmoid(g.logit_opacities) * 255, opacity_step),
        _bytes(g.sh0 * PER_COLOUR + 127.5, colour_step),
        _bytes((g.log_scales + 10) * PER_LOG_SCALE, scale_step),
        _pack_rotations(quats, rotation_step),
        _bytes(128 + 128 * in_buckets(torch.from_numpy(harmonics), sh_bits)),
    ]
    flags = ANTIALIASED if antialiased else 0
    records = {} if names is None else {_LABELS: as_json(g.label_ids, names, parents or {})}
    if version == 4 and frame != "rub":
        records[_AXES] = _FRAMES.index(frame, 1).to_bytes(4, "little")
    pack = gzipped if version == 3 else zstd_packed
    return pack(len(g), g.sh_degree, bits, flags, attributes, records)


def position_step(g: Gaussians) -> tuple[float, float]:
    """The finest step that SPZ has for these positions, and the size of nine in ten Gaussians or more."""
    if not len(g):
        return 0.0, 0.0
    extent = max(float(g.means.abs().max()), 2.0**-MAX_BITS)
    size = 2.0 ** -_enough_bits(g.log_scales.detach().cpu().numpy(), 1, least=-MAX_BITS)
    return 2.0 ** -min(int(np.floor(np.log2(_LARGEST / extent))), MAX_BITS), size


def read_spz(path: Path | str, label_id: int = -1, *, frame: Frame = "rub") -> Gaussians:
    """Read an SPZ file, version 1 to 4: `decode_spz` of its content. DataError where it cannot be read."""
    path = Path(path)
    return decode_spz(_content(path), label_id, frame=frame, name=str(path))


def decode_spz(content: bytes, label_id: int = -1, *, frame: Frame = "rub", name: str = "SPZ") -> Gaussians:
    """Decode SPZ version 1 to 4 into N Gaussians in COLMAP's axes, without harmonics of degree 4.

    Opacities of 0 and 255 become those a quarter of a step further inside, so that their logits are finite.
    Memory stays within what the header promises, and the promise within what `content` can hold.

    Args:
        content: The file's bytes.
        label_id: Category of all Gaussians: SPZ holds no labels.
        frame: Axes that the file has: "rub" (SPZ's own) or "rdf" (COLMAP's).
        name: What errors call the file.

    Returns:
        The Gaussians, float32 on the CPU. `encode_spz` shows an example.

    Raises:
        DataError: For another format or version, or a file that is damaged, cut off or too long.
    """
    return _gaussians(unpacked(name, content), label_id, frame)


def read_spz_splat(path: Path, *, frame: Frame = "rub") -> Splat:
    """Read an SPZ file of any version with what it says of itself; DataError where it cannot be read.

    Axes are those that version 4's extension of Adobe says, else those of `frame`.
    """
    content = _content(path)
    packed = unpacked(str(path), content)
    turned, value = False, 0
    if (axes := packed.extensions.get(_AXES)) is not None:
        value = int.from_bytes(axes, "little")
        if len(axes) != 4 or value > 16:
            raise DataError(f"{path}: axes of an unknown order ({value}); save it with axes right, up, back")
        turned = value > 8  # z is up or down; after a quarter turn y is
        frame = _FRAMES[(value - 9 ^ 6) + 1 if turned else value]
    g = _gaussians(packed, -1, frame, turned=turned)
    notes = ["harmonics of degree 4 are left out; degrees 0 to 3 are kept"] * (packed.degree > 3)
    notes += [_UNSURE] * (turned and value in _AMBIGUOUS)
    splat = Splat(g, f"SPZ {packed.version}", antialiased=packed.antialiased, notes=tuple(notes))
    try:
        return labelled(splat, packed.extensions[_LABELS]) if _LABELS in packed.extensions else splat
    except ValueError as error:
        raise DataError(f"{path}: damaged labels ({short(error)}); export the scene again") from None


def _content(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror}); give an .spz") from None


def _gaussians(packed: Packed, label_id: int, frame: Frame, *, turned: bool = False) -> Gaussians:
    positions, alphas, colours, scales, rotations, harmonics = packed.attributes
    count = len(positions)
    if packed.version == 1:
        means = np.ascontiguousarray(positions).view("<f2").astype(np.float32)
    else:
        means = (_fixed(positions) * 2.0**-packed.bits).astype(np.float32)
    quats = _first_three(rotations) if packed.version < 3 else _unpack_rotations(rotations)
    shN = harmonics.reshape(count, harmonics.shape[1] // 3, 3)[:, : BASES[-1]]
    g = Gaussians(
        means=torch.from_numpy(means),
        quats=torch.from_numpy(quats),
        log_scales=torch.from_numpy(scales / np.float32(PER_LOG_SCALE) - 10),
        logit_opacities=torch.from_numpy(logits_of_bytes(alphas[:, 0])),
        sh0=torch.from_numpy(((colours[:, None] - 127.5) / PER_COLOUR).astype(np.float32)),
        shN=torch.from_numpy((shN.astype(np.float32) - 128) / 128),
        label_ids=torch.full((count,), label_id, dtype=torch.int16),
    )
    if turned:
        g = transformed(g, _QUARTER_TURN)
    means, quats, shN = flipped(g.means.numpy(), g.quats.numpy(), g.shN.numpy(), frame)
    return replace(g, means=torch.from_numpy(means), quats=torch.from_numpy(quats), shN=torch.from_numpy(shN))


def _fractional_bits(
    name: str, means: np.ndarray, log_scales: np.ndarray, wanted: int | None, coarse: bool
) -> int:
    extent = float(np.abs(means).max(initial=2.0**-MAX_BITS))
    most = min(int(np.floor(np.log2(_LARGEST / extent))), MAX_BITS)
    if most < 0:
        raise DataError(f"{name}: positions reach {extent:.3g}, SPZ holds {_LARGEST}; scale the scene down")
    if wanted is None:
        return min(most, _enough_bits(log_scales, 2 if coarse else 8))
    if not 0 <= wanted <= most:
        raise DataError(f"{name}: {wanted} fractional bits; positions up to {extent:.3g} allow 0 to {most}")
    return wanted


def _enough_bits(log_scales: np.ndarray, parts: int, least: int = 1) -> int:
    """Fractional bits of a step of 1/`parts` of the middle axis of 90 % of the Gaussians; `least` or more."""
    if not len(log_scales):
        return 1
    small = float(np.quantile(np.sort(log_scales.astype(np.float64), axis=1)[:, 1], 0.1))
    return max(least, int(np.ceil(np.log2(parts) - small / np.log(2))))


def flipped(
    means: np.ndarray, quats: np.ndarray, harmonics: np.ndarray, frame: Frame
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Means [N, 3], quaternions wxyz [N, 4] and SH coefficients [N, K, 3] between COLMAP's and other axes."""
    x, y, z = (1 if axis in "rdf" else -1 for axis in frame)
    if (x, y, z) == (1, 1, 1):
        return means, quats, harmonics
    rotation = np.array([1, y * z, x * z, x * y], np.float32)
    signs = np.sign(np.divide(bases(3 * x, 4 * y, 5 * z), bases(3, 4, 5)))[1:, None].astype(np.float32)
    return means * np.array([x, y, z], np.float32), quats * rotation, harmonics * signs[: harmonics.shape[1]]


def _bytes(values: torch.Tensor, step: int = 1) -> np.ndarray:
    return in_steps(values.double(), step).clamp(0, 255).numpy().astype(np.uint8)


def _pack_rotations(quats: np.ndarray, step: int) -> np.ndarray:
    """Packed quaternions, uint32 [N], from wxyz [N, 4] of any length."""
    q = np.roll(quats.astype(np.float64), -1, axis=1)
    largest = np.abs(q).argmax(1)
    q /= (np.linalg.norm(q, axis=1) * np.sign(q[np.arange(len(q)), largest]))[:, None]
    others = np.take_along_axis(q, OTHERS[largest], axis=1)
    sizes = (np.rint(np.abs(others) * (_SMALLER / step)) * step).clip(0, 512 - step).astype(np.uint32)
    fields = sizes | ((others < 0) & (sizes > 0)).astype(np.uint32) << 9
    packed = largest.astype(np.uint32) << 30
    packed |= fields[:, 0] << 20 | fields[:, 1] << 10 | fields[:, 2]
    return packed.astype("<u4")


def _unpack_rotations(packed: np.ndarray) -> np.ndarray:
    """Quaternions wxyz float32 [N, 4] from version 3's bytes [N, 4]."""
    fields = np.ascontiguousarray(packed).view("<u4") >> np.array([20, 10, 0], np.uint32)
    others = np.where(fields & 512, -1.0, 1.0) * (fields & 511) / _SMALLER
    return np.roll(largest_restored(packed[:, 3] >> 6, others), 1, axis=1).astype(np.float32)


def _first_three(packed: np.ndarray) -> np.ndarray:
    """Quaternions wxyz float32 [N, 4] from version 2's bytes [N, 3]."""
    xyz = packed / 127.5 - 1
    w = np.sqrt((1 - (xyz**2).sum(1, keepdims=True)).clip(0))
    return np.concatenate([w, xyz], axis=1).astype(np.float32)


def _fixed(positions: np.ndarray) -> np.ndarray:
    """Signed 24-bit little-endian integers [N, 3] from bytes [N, 9]."""
    wide = np.zeros((len(positions), 3, 4), np.uint8)
    wide[..., 1:] = positions.reshape(-1, 3, 3)
    return wide.view("<i4")[..., 0] >> 8


READER = SplatReader(
    lambda path, options: read_spz_splat(path, frame=options.spz_axes), magic=(b"\x1f\x8b", MAGIC)
)
WRITER = SplatWriter(
    lambda path, g, names, parents, antialiased: write_spz(
        path, g, names=names, parents=parents, antialiased=antialiased
    )
)
