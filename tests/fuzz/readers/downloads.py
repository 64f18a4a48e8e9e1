"""Readers of what servers answer to downloads: status, headers, redirects, lengths, bodies. No sockets.

A file holds the answers to one request after the other, with `BETWEEN` between them; the last one is given
again and again.
"""

import http.client
import io
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import patch
from urllib import request

import torch

from sagesplat.download import remote_zip, scenes, weights
from sagesplat.metrics import lpips
from tests.fuzz.hostile import MIB, Reader
from tests.fuzz.readers.networks import LAYOUT

BETWEEN = b"\n=====\n"
LIMIT = 10**6  # bytes that the scene's files may have


class _Socket:
    """A connection over which one answer has come."""

    def __init__(self, answer: bytes):
        self._answer = answer

    def sendall(self, data: bytes) -> None:
        pass

    def makefile(self, mode: str) -> io.BytesIO:
        return io.BytesIO(self._answer)

    def close(self) -> None:
        pass


class _Handler(request.HTTPHandler):
    """http: and https: of urllib, which gets the next answer for each request."""

    def __init__(self, content: bytes):
        super().__init__()
        self._answers = content.split(BETWEEN)

    def _open(self, asked: request.Request) -> Any:
        answers = self._answers

        class Connection(http.client.HTTPConnection):
            def connect(self) -> None:
                self.sock = _Socket(answers.pop(0) if len(answers) > 1 else answers[0])  # type: ignore[assignment]

        return self.do_open(Connection, asked)

    http_open = https_open = _open  # type: ignore


def _opener(content: bytes) -> Callable[..., Any]:
    """What `urlopen` is replaced by; it follows redirects as urllib does."""
    opener = request.OpenerDirector()
    for handler in (
        _Handler(content), request.HTTPDefaultErrorHandler(), request.HTTPRedirectHandler(),
        request.HTTPErrorProcessor(), request.UnknownHandler(),
    ):  # fmt: skip
        opener.add_handler(handler)
    return opener.open


def _answer(body: bytes, start: int = 0, total: int | None = None) -> bytes:
    """A whole file, or with `total` a part of one."""
    if total is None:
        return b"HTTP/1.1 200 OK\r\nContent-Length: %d\r\n\r\n" % len(body) + body
    span = (start, start + len(body) - 1, total)
    return b"HTTP/1.1 206 P\r\nContent-Range: bytes %d-%d/%d\r\n\r\n" % span + body


def _zip(size: int) -> tuple[bytes, list[tuple[int, int]]]:
    """An archive with a scene, and where its members begin and end."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("plot/images/a.txt", " ".join(map(str, range(30 * size))), zipfile.ZIP_DEFLATED)
        archive.writestr("plot/sparse/0/b.bin", "abc" * size)
        starts = [info.header_offset for info in archive.infolist()] + [archive.start_dir]
        stops = [
            info.header_offset + 30 + len(info.filename) + info.compress_size for info in archive.infolist()
        ]
    return file.getvalue(), list(zip(starts, stops, strict=False))


def _scene(folder: Path, size: int) -> list[bytes]:
    content, spans = _zip(size)
    parts = [(0, 1), (0, len(content)), *spans]
    answers = [_answer(content[a:b], a, len(content)) for a, b in parts]
    moved = b"HTTP/1.1 302 Found\r\nLocation: http://b.example/z\r\n\r\n"
    busy = b"HTTP/1.1 503 Busy\r\nRetry-After: 1\r\n\r\n"
    return [BETWEEN.join(answers), BETWEEN.join([moved, busy, *answers])]


def _read_scene(folder: Path, content: bytes) -> None:
    """Download a scene of two files, one after the other."""
    scene = scenes.RemoteScene("x/plot", "http://a.example/z", "plot", (1,), 1, 1, LIMIT, None, "", "")
    for old in (folder / "got").rglob("*.*"):
        old.unlink()
    with patch.object(remote_zip, "urlopen", _opener(content)), patch.object(scenes, "THREADS", 1):
        scenes.download_scene("x/plot", folder / "got", registry={"x/plot": scene}, sleep=lambda _: None)


class _Local(remote_zip.RemoteZip):
    """An archive that is here already."""

    def __init__(self, content: bytes):
        self.all = content
        self.url, self.size, self._position = "zip", len(content), 0
        self._tail = content[-remote_zip.TAIL :]

    def _blocks(self, start: int, stop: int):  # type: ignore[no-untyped-def]
        yield from (self.all[at : min(stop, at + 5000)] for at in range(start, stop, 5000))


def _read_archive(folder: Path, content: bytes) -> None:
    archive = _Local(content)
    for member in archive.members()[:5]:
        for _ in archive.content(member):
            pass


def _weights(folder: Path, size: int) -> list[bytes]:
    with patch.dict(lpips._LAYOUTS, {"alex": LAYOUT}):
        shapes = lpips.shapes("alex")
    heads = {f"{n}.model.1.weight": torch.ones(1, *s, 1, 1) for n, s in shapes.items() if n.startswith("lin")}
    backbone = {n.replace("conv", "features."): torch.ones(s) for n, s in shapes.items() if "conv" in n}
    answers = []
    for state in (heads, backbone):
        saved = io.BytesIO()
        torch.save(state, saved, _use_new_zipfile_serialization=False)
        answers.append(_answer(saved.getvalue()))
    return [BETWEEN.join(answers)]


def _read_weights(folder: Path, content: bytes) -> None:
    """Download LPIPS's weights; the hash is that of whatever comes, so that its content is read."""
    hashed = "published"
    source = weights.Source("http://a.example/b", hashed, tuple(range(5)), "http://a.example/h", hashed)
    fetch = weights._fetch
    with (
        patch.object(weights, "urlopen", _opener(content)),
        patch.object(weights, "_fetch", lambda *args: (fetch(*args), hashed)[1]),
        patch.dict(lpips._LAYOUTS, {"alex": LAYOUT}),
    ):
        weights._fetch_weights("alex", folder / "w.npz", source, None)


READERS = (
    Reader("zip", ".zip", lambda _, size: [_zip(size)[0]], _read_archive, 1000),
    Reader("http-scene", ".http", _scene, _read_scene, 1000, 4 * MIB),
    Reader("http-weights", ".http", _weights, _read_weights, 1, 4 * MIB),
)
