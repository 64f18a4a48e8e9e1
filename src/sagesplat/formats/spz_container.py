"""What SPZ files wrap around the bytes of the attributes: gzip in versions 1 to 3, zstd in version 4.

Versions 1 to 3 may end with extension records, as version 4 has them.

Version 4, little endian: a header of 32 bytes (magic, version, count as uint32; SH degree, fractional bits,
flags, number of streams; offset of the table, uint32; 12 zeros), extension records (type and size as uint32,
content), the table (packed and unpacked size of each stream as uint64), and a zstd frame for each attribute.
"""

import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from sagesplat.core.errors import DataError, short

MAX_BITS = 24  # fractional bits; readers refuse more
MAX_COUNT = 10_000_000  # Gaussians; the reference implementation reads no more
MAGIC = b"NGSP"
HEADER = struct.Struct("<4sIIBBBB")
ANTIALIASED, _EXTENSIONS = 1, 2  # flags
_HEADER_4 = struct.Struct("<4sIIBBBBI12x")
_STREAM = struct.Struct("<QQ")
_RECORD = struct.Struct("<II")
_EXPANDS = 1032  # largest expansion ratio of a deflate stream; zstd's is not bounded, nor needed
_FREE = 2**16  # bytes that any version 4 may unpack to
_RECORDS = 16  # bytes for each Gaussian that records may have beyond: a label each, as JSON
_WINDOW = 2**27  # bytes that a zstd frame may look back, at most
_LEVEL = 12  # of zstd; 19 takes ten times as long for 3 % less


@dataclass(frozen=True)
class Packed:
    """The content of an SPZ file, unpacked."""

    version: int
    bits: int  # fractional bits of positions
    antialiased: bool
    attributes: list[
        np.ndarray
    ]  # uint8 [count, width]: positions, opacities, colours, scales, rotations, shN
    degree: int = 0  # of the harmonics, up to 4
    extensions: dict[int, bytes] = field(default_factory=dict)  # by type


def gzipped(
    count: int,
    degree: int,
    bits: int,
    flags: int,
    attributes: Sequence[np.ndarray],
    extensions: dict[int, bytes],
) -> bytes:
    """Version 3. The same input gives the same bytes."""
    flags |= _EXTENSIONS if extensions else 0
    packer = zlib.compressobj(9, zlib.DEFLATED, 31, 9, zlib.Z_FILTERED)  # 31: gzip, without a time stamp
    content = packer.compress(HEADER.pack(MAGIC, 3, count, degree, bits, flags, 0))
    for attribute in attributes:  # separate deflate blocks, each with its own codes: 5 % smaller
        content += packer.compress(attribute.tobytes()) + packer.flush(zlib.Z_BLOCK)
    return content + packer.compress(b"".join(_packed_records(extensions))) + packer.flush()


def _packed_records(extensions: dict[int, bytes]) -> list[bytes]:
    return [_RECORD.pack(kind, len(content)) + content for kind, content in extensions.items()]


def zstd_packed(
    count: int,
    degree: int,
    bits: int,
    flags: int,
    attributes: Sequence[np.ndarray],
    extensions: dict[int, bytes],
) -> bytes:
    """Version 4. The same input, and version of zstd, gives the same bytes."""
    import zstandard

    packer = zstandard.ZstdCompressor(level=_LEVEL)
    sizes = [attribute.nbytes for attribute in attributes if attribute.size]  # empty streams are left out
    streams = [packer.compress(attribute.tobytes()) for attribute in attributes if attribute.size]
    records = _packed_records(extensions)
    flags |= _EXTENSIONS if records else 0
    table = _HEADER_4.size + sum(map(len, records))
    header = _HEADER_4.pack(MAGIC, 4, count, degree, bits, flags, len(streams), table)
    entries = [_STREAM.pack(len(stream), size) for stream, size in zip(streams, sizes, strict=True)]
    return b"".join([header, *records, *entries, *streams])


def unpacked(name: str, content: bytes) -> Packed:
    """Unpack version 1 to 4; DataError, which calls the file `name`, where it is damaged.

    Memory stays within what the header promises, and the promise within what `content` can hold.
    """
    return _unpacked_4(name, content) if content.startswith(MAGIC) else _ungzipped(name, content)


def _ungzipped(name: str, content: bytes) -> Packed:
    unpacker = zlib.decompressobj(31)
    try:
        header = unpacker.decompress(content, HEADER.size)
        version, count, degree, bits, flags = _read_header(name, header)
        if version not in (1, 2, 3):
            raise DataError(f"{name}: SPZ version {version} is not supported; save it as version 3")
        if flags & ~(ANTIALIASED | _EXTENSIONS):  # an LOD tree changes the meaning of opacities
            raise DataError(f"{name}: an LOD tree (flags {flags}) is not supported; save it without")
        widths = _widths(version, degree)
        size = count * sum(widths)
        if count > MAX_COUNT or size > _EXPANDS * len(content):
            raise DataError(f"{name}: {count} Gaussians announced, more than fit; copy it again")
        more = _FREE + _RECORDS * count if flags & _EXTENSIONS else 0
        body = unpacker.decompress(unpacker.unconsumed_tail, size + more + 1)  # 1: to detect excess data
    except zlib.error as error:
        raise DataError(f"{name}: not gzip, or damaged ({error}); give an .spz of version 1 to 4") from None
    if not size <= len(body) <= size + more or not unpacker.eof or unpacker.unused_data:
        raise DataError(f"{name}: not the {count} Gaussians announced; the file is damaged, copy it again")
    try:
        extensions = _records(body[size:])
    except (struct.error, ValueError) as error:
        raise DataError(f"{name}: damaged ({short(error)}); copy it again") from None
    parts = np.split(np.frombuffer(body, np.uint8, size), count * np.cumsum(widths[:-1]))
    attributes = [part.reshape(count, width) for part, width in zip(parts, widths, strict=True)]
    return Packed(version, bits, bool(flags & ANTIALIASED), attributes, degree, extensions)


def _widths(version: int, degree: int) -> tuple[int, ...]:
    """Bytes of each attribute of a Gaussian."""
    return 6 if version == 1 else 9, 1, 3, 3, 3 if version < 3 else 4, 3 * degree * (degree + 2)


def _read_header(name: str, header: bytes) -> tuple[int, int, int, int, int]:
    """Version, count, SH degree, fractional bits and flags. DataError for an unsupported header."""
    if len(header) < HEADER.size or not header.startswith(MAGIC):
        cure = "unpack it with gunzip" if header.startswith(b"ply") else "give an .spz of version 1 to 4"
        raise DataError(f"{name}: not an SPZ file; {cure}")
    _, version, count, degree, bits, flags, _ = HEADER.unpack(header[: HEADER.size])
    if degree > 4 or bits > MAX_BITS:
        raise DataError(
            f"{name}: SH degree {degree}, {bits} fractional bits; at most 4 and {MAX_BITS} are supported"
        )
    return version, count, degree, bits, flags


def _unpacked_4(name: str, content: bytes) -> Packed:
    version, count, degree, bits, flags = _read_header(name, content)
    if version != 4 or flags & ~(ANTIALIASED | _EXTENSIONS):
        raise DataError(
            f"{name}: SPZ version {version}, flags {flags}, is not supported; save it without an LOD tree"
        )
    widths = _widths(version, degree)
    if count > MAX_COUNT or count * sum(widths) > max(_EXPANDS * len(content), _FREE):
        raise DataError(f"{name}: {count} Gaussians announced, more than fit; copy it again")
    try:
        *_, streams, table = _HEADER_4.unpack_from(content)
        extensions = _records(content[_HEADER_4.size : table]) if flags & _EXTENSIONS else {}
        parts = _streams(content, table, streams, [count * width for width in widths if count * width])
    except (struct.error, ValueError) as error:
        raise DataError(f"{name}: damaged ({short(error)}); copy it again") from None
    parts += [b""] * (len(widths) - len(parts))  # streams without content are left out
    attributes = [
        np.frombuffer(part, np.uint8).reshape(count, width) for part, width in zip(parts, widths, strict=True)
    ]
    return Packed(version, bits, bool(flags & ANTIALIASED), attributes, degree, extensions)


def _records(content: bytes) -> dict[int, bytes]:
    """Extension records by type; ValueError where they are cut off."""
    found, at = {}, 0
    while at < len(content):
        kind, size = _RECORD.unpack_from(content, at)
        at += _RECORD.size + size
        if at > len(content):
            raise ValueError("an extension is cut off")
        found.setdefault(kind, content[at - size : at])
    return found


def _streams(content: bytes, table: int, streams: int, sizes: Sequence[int]) -> list[bytes]:
    """The unpacked streams; ValueError unless they are of these sizes and end with the content."""
    import zstandard

    if streams != len(sizes) or table < _HEADER_4.size:
        raise ValueError(f"{streams} streams in place of {len(sizes)}")
    entries = [_STREAM.unpack_from(content, table + i * _STREAM.size) for i in range(streams)]
    at, parts = table + streams * _STREAM.size, []
    unpacker = zstandard.ZstdDecompressor(max_window_size=_WINDOW)
    for (packed, announced), size in zip(entries, sizes, strict=True):
        frame = content[at : at + packed]
        at += packed
        try:
            told = zstandard.frame_content_size(frame)  # -1: the frame does not say
            if len(frame) != packed:
                raise ValueError(f"{len(frame)} of {packed} bytes of a stream")
            if announced != size or told not in (-1, size):
                raise ValueError(f"a stream of {announced} bytes in place of {size}")
            part = unpacker.decompress(frame, max_output_size=size, allow_extra_data=False)
        except zstandard.ZstdError as error:
            raise ValueError(str(error)) from None
        if len(part) != size:
            raise ValueError(f"a stream of {len(part)} bytes in place of {size}")
        parts.append(part)
    if at != len(content):
        raise ValueError(f"{len(content) - at} bytes after the last stream")
    return parts
