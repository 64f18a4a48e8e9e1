"""Serves a bundle over HTTP to a browser on this machine; other web pages cannot read it."""

import gzip
import os
import re
import stat
import threading
from collections.abc import Container
from functools import lru_cache
from html import escape
from pathlib import Path, PurePosixPath

from anyio import create_task_group, to_thread
from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import FileResponse, HTMLResponse, PlainTextResponse, Response
from starlette.staticfiles import NotModifiedResponse
from starlette.types import Message, Receive, Scope, Send

from sagesplat.viewer.built import PAGE, POSTER, package_viewer, with_poster
from sagesplat.viewer.hosts import Hosts

HEADERS = {
    "content-security-policy": (
        "default-src 'none'; script-src 'self' 'wasm-unsafe-eval'; style-src 'self'; "
        "img-src 'self' data: blob:; connect-src 'self' data: blob:; worker-src blob:; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'self'"
    ),
    "cross-origin-embedder-policy": "require-corp",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "permissions-policy": (
        "xr-spatial-tracking=(self), gyroscope=(self), accelerometer=(self), magnetometer=(self), "
        "fullscreen=(self), camera=(), microphone=(), geolocation=()"
    ),
    "referrer-policy": "no-referrer",
    "x-content-type-options": "nosniff",
}
_FOREVER = "public, max-age=31536000, immutable"
_HASHED = re.compile(
    r"chunks/.+-[0-9a-f]{12}\.(sgst|spz|ply)|scene-[0-9a-f]{12}\.pack|promises-[0-9a-f]{12}\.json|assets/.+-[\w-]{8}\.\w+"
)
# set here, as the system's table differs between machines
_TYPES = {
    ".css": "text/css; charset=utf-8",
    ".html": "text/html; charset=utf-8",
    ".ico": "image/x-icon",
    ".jpeg": "image/jpeg",
    ".jpg": "image/jpeg",
    ".js": "text/javascript; charset=utf-8",
    ".json": "application/json",
    ".md": "text/markdown; charset=utf-8",
    ".pack": "application/octet-stream",
    ".png": "image/png",
    ".svg": "image/svg+xml",
    ".txt": "text/plain; charset=utf-8",
    ".wasm": "application/wasm",
    ".webmanifest": "application/manifest+json",
    ".webp": "image/webp",
    ".woff2": "font/woff2",
}
_PACKED = (".css", ".html", ".js", ".json", ".svg", ".txt", ".wasm")  # sent with gzip
_MOST_PACKED = 16 * 2**20  # bytes of a file that is packed in memory
_packing = threading.Lock()
_PIECE = 64 * 1024  # bytes that are sent at once
_TLS_PIECE = 32 * 1024  # the same of a file over TLS, which keeps three copies for a slow reader
# of a bundle: what no browser runs, whatever is in it
_DATA = {".jpeg", ".jpg", ".json", ".md", ".pack", ".ply", ".png", ".sgst", ".spz", ".txt", ".webp"}
_WAITING = "<!doctype html><title>sagesplat</title><p>{}</p><p>This page tries again by itself.</p>"


class Site:
    """An ASGI application that serves the viewer of this package with the data of a bundle.

    `folder`: the bundle, which may change at any time. Of it only files are sent that no browser runs: a page
    or a script of its own would act in the name of this machine. Without a folder every path answers 503 with
    `note`. Requests to names that are not in `hosts` are refused, which prevents DNS rebinding. `viewer`: the
    folder of the built viewer.
    """

    def __init__(
        self,
        folder: Path | None = None,
        *,
        hosts: Container[str] | None = None,
        note: str = "",
        viewer: Path | None = None,
    ):
        self.folder, self.note = folder, note
        self._hosts, self._viewer = hosts or Hosts(), viewer or package_viewer()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request; stops when the other side is gone."""

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in {**HEADERS, "cache-control": "no-cache"}.items():
                    headers.setdefault(name, value)
            await send(message)

        async def respond() -> None:
            response = await to_thread.run_sync(self._answer, scope)
            if isinstance(response, FileResponse) and scope["scheme"] == "https":
                response.chunk_size = _TLS_PIECE
            await response(scope, receive, send_with_headers)
            group.cancel_scope.cancel()

        async with create_task_group() as group:
            group.start_soon(respond)
            while (await receive())["type"] != "http.disconnect":  # uvicorn itself would read on to the end
                pass
            group.cancel_scope.cancel()

    def answers_to(self, host: str) -> bool:
        """Whether a Host header names this server."""
        return host in self._hosts

    def _answer(self, scope: Scope) -> Response:
        headers = Headers(scope=scope)
        if not self.answers_to(headers.get("host", "")):
            text = "this server does not answer to this name; start it with --host to change that"
            return PlainTextResponse(text, 403)
        if scope["method"] not in ("GET", "HEAD"):
            return PlainTextResponse("only GET and HEAD", 405, {"allow": "GET, HEAD"})
        if self.folder is None:
            return HTMLResponse(_WAITING.format(escape(self.note)), 503, {"refresh": "2", "retry-after": "2"})
        name = scope["path"].removeprefix("/") or PAGE
        try:
            if path := self._find(self.folder, name):
                poster = name == PAGE and find(self.folder, POSTER) is not None
                return _file(path, name, headers, scope["method"] == "HEAD", poster)
        except OSError:  # replaced meanwhile
            pass
        return PlainTextResponse("no such file", 404)

    def _find(self, folder: Path, name: str) -> Path | None:
        """A file of the viewer, or else one of the data."""
        is_data = PurePosixPath(name).suffix.lower() in _DATA
        return find(self._viewer, name) or (find(folder, name) if is_data else None)


def find(folder: Path, name: str) -> Path | None:
    """The readable file inside a folder with this relative name; None if there is none."""
    parts = name.split("/")
    if any(part == "" or part.startswith(".") for part in parts) or re.search(r"[\\:\x00-\x1f]", name):
        return None
    try:
        root = folder.resolve()
        path = root.joinpath(*parts).resolve()  # also follows links, which may lead outside
        inside = path.is_relative_to(root) and stat.S_ISREG(path.stat().st_mode)
        return path if inside and os.access(path, os.R_OK) else None
    except (OSError, ValueError, RuntimeError):  # missing file, name too long or invalid, circular links
        return None


def _file(path: Path, name: str, request: Headers, head: bool, poster: bool) -> Response:
    """The response with a file: full, a range, gzipped, or 304 if the client has it."""
    status = path.stat()
    suffix = path.suffix.lower()
    headers = {
        "cache-control": _FOREVER if _HASHED.fullmatch(name) else "no-cache",
        "etag": f'"{status.st_mtime_ns:x}-{status.st_size:x}{"-poster" if poster else ""}"',
    }
    may_pack = suffix in _PACKED and status.st_size <= _MOST_PACKED
    packed = may_pack and "range" not in request and _takes_gzip(request)
    if may_pack:
        headers["vary"] = "accept-encoding"
    if packed:
        headers["etag"] = headers["etag"][:-1] + '-gz"'
    tags = [tag.strip().removeprefix("W/") for tag in request.get("if-none-match", "").split(",")]
    if headers["etag"] in tags or "*" in tags:
        return NotModifiedResponse(Headers(headers))
    kind = _TYPES.get(suffix, "application/octet-stream")
    if not packed and not poster:
        return FileResponse(path, headers=headers, media_type=kind, stat_result=status)
    with _packing:  # one at a time: those who wait find it packed
        body = _content(path, status.st_mtime_ns, packed, poster)
    headers |= {"content-encoding": "gzip"} if packed else {}
    return _Pieces(b"" if head else body, headers, kind, len(body))


class _Pieces(Response):
    """Bytes that many may be sent at once: each connection holds a copy of one piece only."""

    def __init__(self, body: bytes, headers: dict[str, str], kind: str, length: int):
        super().__init__(None, headers=headers | {"content-length": str(length)}, media_type=kind)
        self._content = memoryview(body)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request."""
        await send({"type": "http.response.start", "status": 200, "headers": self.raw_headers})
        for at in range(0, len(self._content), _PIECE):
            piece = bytes(self._content[at : at + _PIECE])
            await send({"type": "http.response.body", "body": piece, "more_body": True})
        await send({"type": "http.response.body", "body": b"", "more_body": False})


def _takes_gzip(request: Headers) -> bool:
    accepted = [part.partition(";") for part in request.get("accept-encoding", "").lower().split(",")]
    return any(name.strip() == "gzip" and q.strip() not in ("q=0", "q=0.0") for name, _, q in accepted)


@lru_cache(maxsize=16)
def _content(path: Path, _changed: int, packed: bool, poster: bool) -> bytes:
    """A file's bytes, as a page with a poster, with gzip."""
    body = path.read_bytes()
    if poster:
        body = with_poster(body.decode()).encode()
    return gzip.compress(body, 6, mtime=0) if packed else body
