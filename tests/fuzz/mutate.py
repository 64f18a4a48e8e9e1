"""Damages files at random, also inside what is compressed or has checksums (zip, gzip, PNG, JSON).

Not more than a few kilobytes larger than what it was given.
"""

import gzip
import io
import json
import re
import struct
import warnings
import zipfile
import zlib
from collections.abc import Callable, Sequence
from functools import cache
from random import Random
from typing import Any

INTEGERS = (
    0, 1, -1, 2, 127, 255, 2**15, 2**16 - 1, 2**31 - 1, -(2**31), 2**32 - 1, 2**53, 2**63 - 1, 2**64 - 1,
)  # fmt: skip
FLOATS = (float("nan"), float("inf"), float("-inf"), 1e300, 1e-300, -0.0, 3e38, 1e9)
WORDS = (
    b"-1 0 2147483647 9223372036854775807 99999999999999999999999999 1e999 -1e39 nan inf 0x1 1_0 "
    b'null true [] {} "" "\\ud800" "a\\nb" 1.5 ../../x /dev/zero a.b.c NaN -Infinity'
).split(b" ")
NODES: tuple[Any, ...] = (
    None, True, 0, -1, 1.5, 2**31, 2**63, 10**400, 1e308, float("nan"), float("inf"), "", "x", "1", "-1",
    "a\nb", "\x00", "\ud800", "../../x", "/dev/zero", "nan", "x" * 300,
    [], [[]], {}, {"x": 1}, [1, [2]], ["x", None],
)  # fmt: skip
SHAPES = ("()", "(0,)", "(1000000000,)", "(-1,)", "(2, 2)", "(9223372036854775807, 2)", "(1e9,)")
DTYPES = ("<f4", "<f8", ">i2", "|O", "|S0", "<U9", "|b1", "<c16", "<i8", "<M8[s]", "|V8")
MAGIC = {b"PK\x03\x04": "zip", b"\x1f\x8b": "gzip", b"\x89PNG": "png"}
_WORD = re.compile(rb"[-+.\w]+")
MOST = 20_000  # bytes that files grow to


def mutate(content: bytes, others: Sequence[bytes], rng: Random, most: int = MOST) -> bytes:
    """A damaged copy of a file, of at most `most` bytes; `others` are files that parts may come from."""
    for _ in range(rng.choice((1, 1, 1, 2, 3, 8))):
        content = _once(content, others, rng)
    return content[:most]


def _once(content: bytes, others: Sequence[bytes], rng: Random) -> bytes:
    kind = next((kind for magic, kind in MAGIC.items() if content.startswith(magic)), "")
    inside: dict[str, Callable[[bytes, Random], bytes]] = {"zip": _zip, "gzip": _gzip, "png": _png}
    if kind and rng.random() < 0.8:
        try:
            return inside[kind](content, rng)
        except Exception:  # it is damaged already, in whatever way
            pass
    if content[:1] in (b"{", b"[") and rng.random() < 0.7:
        try:
            return _json(content, rng)
        except (ValueError, RecursionError):
            pass
    if rng.random() < 0.1 and others:
        return _splice(content, rng.choice(others), rng)
    return rng.choice(BYTES)(content, rng)


def _flip(content: bytes, rng: Random) -> bytes:
    data = bytearray(content)
    for _ in range(rng.choice((1, 2, 8))):
        if data:
            data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    return bytes(data)


def _truncate(content: bytes, rng: Random) -> bytes:
    return content[: rng.randrange(len(content) + 1)]


def _remove(content: bytes, rng: Random) -> bytes:
    start, end = _range(content, rng)
    return content[:start] + content[end:]


def _repeat(content: bytes, rng: Random) -> bytes:
    start, end = _range(content, rng)
    times = rng.choice((1, 2, 50, 1000))
    return content[:end] + (content[start:end] * times)[: MOST // 2] + content[end:]


def _number(content: bytes, rng: Random) -> bytes:
    """An integer or float of any width and byte order over what is there."""
    if rng.random() < 0.7:
        width, value = rng.choice((1, 2, 4, 8)), rng.choice(INTEGERS)
        field = (value % 2 ** (8 * width)).to_bytes(width, rng.choice(("little", "big")))
    else:
        field = struct.pack(rng.choice(("<f", "<d", ">f")), min(max(rng.choice(FLOATS), -3e38), 3e38))
        if rng.random() < 0.5:
            field = struct.pack("<d", rng.choice(FLOATS))
    at = rng.randrange(max(1, len(content) - len(field) + 1))
    return content[:at] + field + content[at + len(field) :]


def _word(content: bytes, rng: Random) -> bytes:
    """Another word or number in a text."""
    word = _WORD.search(content, rng.randrange(len(content) + 1)) or _WORD.search(content)
    if word is None:
        return content + rng.choice(WORDS)
    return content[: word.start()] + rng.choice(WORDS) + content[word.end() :]


def _line(content: bytes, rng: Random) -> bytes:
    """A line removed, repeated, moved, or made very long."""
    lines = content.split(b"\n")
    at = rng.randrange(len(lines))
    match rng.randrange(4):
        case 0:
            del lines[at]
        case 1:
            lines[at:at] = [lines[at]] * rng.choice((1, 3, 300))
        case 2:
            lines.insert(rng.randrange(len(lines)), lines.pop(at))
        case _:
            lines[at] = lines[at] + rng.choice((b"1", b" 1", b"[", b".a", b",", b"\0")) * rng.choice(
                (1, 5, 4000)
            )
    return b"\n".join(lines)


def _splice(content: bytes, other: bytes, rng: Random) -> bytes:
    return content[: rng.randrange(len(content) + 1)] + other[rng.randrange(len(other) + 1) :]


BYTES = (_flip, _truncate, _remove, _repeat, _number, _number, _word, _word, _line)


def _range(content: bytes, rng: Random) -> tuple[int, int]:
    start = rng.randrange(len(content) + 1)
    return start, min(len(content), start + rng.choice((1, 4, 8, 30, 300)))


def _gzip(content: bytes, rng: Random) -> bytes:
    if rng.random() < 0.01:
        return gzip.compress(gzip.decompress(content) + bytes(rng.choice((10**4, 10**6))), 1, mtime=0)
    return gzip.compress(rng.choice(BYTES)(gzip.decompress(content), rng), 1, mtime=0)


@cache
def _zeros(count: int) -> bytes:
    return zlib.compress(bytes(count))


def _png(content: bytes, rng: Random) -> bytes:
    """Chunks removed, repeated or changed, with their checksums put right."""
    chunks, at = [], 8
    while at + 12 <= len(content):
        (length,) = struct.unpack(">I", content[at : at + 4])
        chunks.append((content[at + 4 : at + 8], content[at + 8 : at + 8 + length]))
        at += 12 + length
    row = rng.randrange(len(chunks))
    name, body = chunks[row]
    match rng.randrange(5):
        case 0:
            del chunks[row]
        case 1:
            chunks.insert(rng.randrange(len(chunks) + 1), (name, body))
        case 2:  # another picture in the same chunk
            packed = _zeros(rng.choice((0, 5, 9, 10**6)))
            chunks[row] = (name, packed if name == b"IDAT" else rng.choice(BYTES)(body, rng))
        case 3:
            extra = rng.choice((b"tEXt", b"zTXt", b"iCCP", b"PLTE", b"tRNS", b"acTL", b"fdAT", b"eXIf"))
            chunks.insert(1, (extra, b"k\0\0" + _zeros(10**5)))
        case _:
            chunks[row] = (name, _number(body, rng))
    parts = [struct.pack(">I", len(b)) + n + b + struct.pack(">I", zlib.crc32(n + b)) for n, b in chunks]
    return content[:8] + b"".join(parts)


def _zip(content: bytes, rng: Random) -> bytes:
    """Members removed, renamed, repeated or changed, with their checksums put right."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        members = [(info.filename, archive.read(info)) for info in archive.infolist()]
    row = rng.randrange(len(members))
    name, body = members[row]
    match rng.randrange(7):
        case 0:
            del members[row]
        case 1:
            members[row] = (rng.choice(members)[0], body)
        case 2:
            members[row] = (_text(name, rng), body)
        case 3:
            members.append((name + "2", body))
        case 4:
            members[row] = (name, rng.choice(BYTES)(body, rng))
        case _:
            members[row] = (name, _array(body, rng))
    file, packing = io.BytesIO(), rng.choice((zipfile.ZIP_STORED, zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))
    with warnings.catch_warnings(action="ignore"), zipfile.ZipFile(file, "w", packing) as archive:
        for number, (name, body) in enumerate(members):
            archive.writestr(zipfile.ZipInfo(name or f"{number}"), body, packing)
    return file.getvalue()


def _text(name: str, rng: Random) -> str:
    changed = rng.choice(
        (name + "x", "9/" + name, name.upper(), name.replace("2/", "99999/"), "x/" + name, "\0")
    )
    return changed.replace("2/", "-7/") if rng.random() < 0.3 else changed


def _array(body: bytes, rng: Random) -> bytes:
    """Another shape, type, content or header of an array in numpy's format, of a length that fits or not."""
    (length,) = struct.unpack("<H", body[8:10])
    header, values = body[10 : 10 + length].decode("latin1").rstrip(), body[10 + length :]
    match rng.randrange(6):
        case 0:
            header = re.sub(r"\([^)]*\)", rng.choice(SHAPES), header)
        case 1:
            header = re.sub(r"'[<>|]\w+'", repr(rng.choice(DTYPES)), header)
        case 2:  # more axes, or a transposed one
            shape = re.search(r"\(([^)]*)\)", header)
            axes = [a.strip() for a in shape[1].split(",") if a.strip()] if shape else []
            axes = rng.choice((axes[::-1], ["1", *axes], axes[:1], ["0", *axes], [*axes, "0"]))
            header = re.sub(r"\([^)]*\)", f"({', '.join(axes)}{',' * (len(axes) == 1)})", header)
        case 3:
            values = rng.choice((_number, _flip, _truncate, _repeat))(values, rng)
        case 4:
            header = rng.choice(("{", "(" * 300, "-" * 3000 + "1", "[" * 90 + "]" * 90, header + ", 1", ""))
        case _:
            values = bytes(rng.choice((len(values), 10**4, 10**6)))
    header += " " * (-(len(header) + 11) % 64) + "\n"
    return body[:8] + struct.pack("<H", len(header)) + header.encode("latin1") + values


def _json(content: bytes, rng: Random) -> bytes:
    """Another value, type or length somewhere in a document."""
    document = [json.loads(content)]
    holder, key = _place(document, rng)
    match rng.randrange(6):
        case 0 if isinstance(holder, dict):
            del holder[key]
        case 1 if isinstance(holder, dict):
            holder[rng.choice(("x", "-1", "1e9", "a\nb", "99999999999999999999"))] = holder[key]
        case 2 if isinstance(holder, list) and holder is not document:
            holder[key:key] = [holder[key]] * rng.choice((1, 2, 100))
        case 3:
            holder[key] = [holder[key]]
        case _:
            holder[key] = rng.choice(NODES)
    return json.dumps(document[0]).encode()


def _place(holder: Any, rng: Random) -> tuple[Any, Any]:
    """A list or an object below a node that holds something, and a key of it."""
    while True:
        key = rng.choice(list(holder)) if isinstance(holder, dict) else rng.randrange(len(holder))
        below = holder[key]
        if not isinstance(below, dict | list) or not below or rng.random() < 0.2:
            return holder, key
        holder = below
