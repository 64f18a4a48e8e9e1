"""Reads single members of a remote zip archive by HTTP range requests."""

import http.client
import re
import ssl
import struct
import time
import zlib
from collections.abc import Callable, Generator, Iterable
from contextlib import closing
from dataclasses import dataclass
from itertools import chain
from urllib.error import HTTPError, URLError
from urllib.request import Request, urlopen
from zipfile import ZIP_DEFLATED, BadZipFile, ZipFile, ZipInfo

from sagesplat.core.errors import DataError, short

TIMEOUT = 30  # seconds without data
PAUSES = (1.0, 5.0)  # seconds before the second and the third try
BLOCK = 1 << 16  # bytes
PIECE = 1 << 18  # bytes that are unpacked at once
TAIL = 1 << 20  # bytes at the end of an archive that usually contain its directory
MAX_DIRECTORY = 1 << 24  # bytes
HEADER = 30  # bytes of a member's local header, before name and extra field
AGAIN = "run it again: finished files are kept"
ELSEWHERE = f"{AGAIN}; or run it on another machine, and copy the folder"


@dataclass(frozen=True)
class Member:
    """A file in an archive."""

    info: ZipInfo
    stop: int  # end of its bytes in the archive


class RemoteZip:
    """A zip archive on a server that answers range requests.

    Every failure is a DataError. Requests with a possibly temporary fault are tried three times in all, with
    pauses by `sleep`.
    """

    def __init__(self, url: str, sleep: Callable[[float], None] = time.sleep):
        self.url, self._sleep = url, sleep
        self.size = 0  # bytes
        list(self._blocks(0, 1))  # the response contains the size
        # Read in one request: zipfile reads many small pieces.
        self._tail = b"".join(self._blocks(max(0, self.size - TAIL), self.size))
        self._position = 0

    def members(self) -> list[Member]:
        """All members, in the order of their position in the archive."""
        try:
            with ZipFile(self) as file:
                infos = sorted(file.infolist(), key=lambda info: info.header_offset)
                stops = [*(info.header_offset for info in infos), file.start_dir][1:]
            if infos and infos[0].header_offset < 0:
                raise BadZipFile("a member before its start")
        except (BadZipFile, NotImplementedError, ValueError, EOFError, struct.error) as error:
            raise DataError(f"{self.url}: not readable as a zip archive ({short(error)}); {AGAIN}") from None
        most = HEADER + 2 * 0xFFFF
        return [
            Member(info, min(stop, info.header_offset + most + info.compress_size))
            for info, stop in zip(infos, stops, strict=True)
        ]

    def content(self, member: Member) -> Generator[bytes]:
        """A member's content in blocks, by one request. Size and CRC-32 are checked at the end."""
        info, crc, size = member.info, 0, 0
        with closing(self._blocks(info.header_offset, member.stop)) as blocks:
            try:
                for block in _unpack(blocks, info):
                    crc, size = zlib.crc32(block, crc), size + len(block)
                    yield block
            except zlib.error as error:
                raise DataError(f"{self.url}: {short(info.filename)} is damaged ({error}); {AGAIN}") from None
        if (size, crc) != (info.file_size, info.CRC):
            raise DataError(
                f"{self.url}: {short(info.filename)} is damaged ({size} bytes with CRC {crc:08x} where "
                f"the archive lists {info.file_size} with {info.CRC:08x}); {AGAIN}"
            )

    def _blocks(self, start: int, stop: int) -> Generator[bytes]:
        """The archive's bytes from `start` to `stop`; resumes after a temporary fault."""
        for pause in (*PAUSES, None):
            if start >= stop:
                return
            try:
                with _get(self.url, start, stop) as response:
                    self._check_range(response.headers["Content-Range"] or "", start, stop)
                    while block := response.read(min(BLOCK, stop - start)):
                        start += len(block)
                        yield block
                if start < stop:
                    raise ConnectionError(f"the connection ended {stop - start} bytes early")
            except (OSError, ValueError, http.client.HTTPException) as error:  # ValueError: of redirects
                if isinstance(error, HTTPError):
                    error.close()
                if pause is None or not _is_temporary(error):
                    reason = short(error) or type(error).__name__
                    raise DataError(f"{self.url}: cannot be downloaded ({reason}); {ELSEWHERE}") from None
                self._sleep(pause)

    def _check_range(self, text: str, start: int, stop: int) -> None:
        match = re.fullmatch(r"bytes (\d{1,18})-(\d{1,18})/(\d{1,18})", text)
        first, last, size = map(int, match.groups()) if match else (-1, -1, 0)
        if (first, last) != (start, stop - 1) or size != (self.size or size):
            raise DataError(
                f"{self.url}: the server answers with {text!r} where bytes {start}-{stop - 1}/"
                f"{self.size or '(size)'} were asked for; {AGAIN}"
            )
        self.size = size

    def seek(self, offset: int, whence: int = 0) -> int:
        """The method of a binary file, for zipfile."""
        self._position = max(0, offset + (0, self._position, self.size)[whence])
        return self._position

    def tell(self) -> int:
        """The method of a binary file, for zipfile."""
        return self._position

    def read(self, count: int = -1) -> bytes:
        """The method of a binary file, for zipfile."""
        start = min(self._position, self.size)
        stop = self.size if count < 0 else min(self.size, start + count)
        if stop - start > MAX_DIRECTORY:
            raise BadZipFile(f"a directory of {stop - start} bytes")
        tail_start = self.size - len(self._tail)
        if start >= tail_start:
            data = self._tail[start - tail_start : stop - tail_start]
        else:
            data = b"".join(self._blocks(start, stop))
        self._position = stop
        return data


def _get(url: str, start: int, stop: int) -> http.client.HTTPResponse:
    """The response to a range request. Raises OSError, HTTPException, and DataError if ranges are ignored."""
    # Some servers refuse Python's default user agent.
    headers = {"User-Agent": "sagesplat", "Range": f"bytes={start}-{stop - 1}"}
    response = urlopen(Request(url, headers=headers), timeout=TIMEOUT)
    if response.status == 206:
        return response
    with response:
        size = response.headers["Content-Length"] or ""
    full = f"all of its {int(size) / 1e9:.3g} GB" if re.fullmatch(r"\d{1,18}", size) else "the full file"
    raise DataError(
        f"{url}: the server does not send parts of the archive (no range requests), and {full} is more than "
        "needed; try without a proxy, or download and unpack it by hand"
    )


def _is_temporary(error: Exception) -> bool:
    """Whether a retry may succeed."""
    if isinstance(error, HTTPError):
        return error.code in (408, 425, 429, 500, 502, 503, 504)
    if isinstance(error, ValueError):  # an address that is none
        return False
    return not (isinstance(error, URLError) and isinstance(error.reason, ssl.SSLCertVerificationError))


def _unpack(blocks: Iterable[bytes], info: ZipInfo) -> Generator[bytes]:
    """A member's content, from its bytes including the header; at most one byte more than listed."""
    head, begin = b"", HEADER
    blocks = iter(blocks)
    for block in blocks:
        head += block
        if len(head) >= HEADER:
            # Name and extra field may have other lengths here than in the directory.
            begin = HEADER + sum(struct.unpack("<HH", head[26:HEADER]))
            if len(head) >= begin:
                break
    packed, room = info.compress_size, info.file_size + 1
    inflate = zlib.decompressobj(-zlib.MAX_WBITS) if info.compress_type == ZIP_DEFLATED else None
    for block in chain([head[begin:]], blocks):
        block = block[:packed]
        packed -= len(block)
        while block and room:  # in pieces: a block can unpack to a thousand times its size
            content = inflate.decompress(block, min(room, PIECE)) if inflate else block[:room]
            block = inflate.unconsumed_tail if inflate else b""
            room -= len(content)
            if content:
                yield content
            if inflate and inflate.eof:  # it would not take what follows
                return
        if not packed or not room:
            return
