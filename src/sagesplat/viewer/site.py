"""Serves a folder over HTTP to a browser on this machine; other web pages cannot read it."""

import asyncio
import gzip
import os
import re
import stat
from collections.abc import MutableMapping
from functools import lru_cache
from html import escape
from ipaddress import ip_address
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import uvicorn
from anyio import to_thread
from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import FileResponse, HTMLResponse, PlainTextResponse, Response
from starlette.staticfiles import NotModifiedResponse
from starlette.types import Message, Receive, Scope, Send
from uvicorn.protocols.http.h11_impl import H11Protocol

MOST_CONNECTIONS = 400  # two file handles each stay below the usual limit of 1024
PATIENCE = 30.0  # seconds until an idle connection is closed
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
    r"chunks/.+-[0-9a-f]{12}\.(spz|ply)|scene-[0-9a-f]{12}\.pack|promises-[0-9a-f]{12}\.json|assets/.+-[\w-]{8}\.\w+"
)
# set here, as the system's table differs between machines
_TYPES = {
    ".css": "text/css; charset=utf-8",
    ".html": "text/html; charset=utf-8",
    ".ico": "image/x-icon",
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
_WAITING = "<!doctype html><title>sagesplat</title><p>{}</p><p>This page tries again by itself.</p>"


class Site:
    """An ASGI application that serves a folder.

    `folder` may change at any time. Without a folder every path answers 503 with `note`. With `local` only
    requests to local host names are answered, which prevents DNS rebinding.
    """

    def __init__(self, folder: Path | None = None, *, local: bool = True, note: str = ""):
        self.folder, self.local, self.note = folder, local, note

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request."""

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in {**HEADERS, "cache-control": "no-cache"}.items():
                    headers.setdefault(name, value)
            await send(message)

        response = await to_thread.run_sync(self._answer, scope)
        await response(scope, receive, send_with_headers)

    def _answer(self, scope: Scope) -> Response:
        headers = Headers(scope=scope)
        if self.local and not is_local(headers.get("host", "")):
            text = "this server answers to localhost only; start it with --host to change that"
            return PlainTextResponse(text, 403)
        if scope["method"] not in ("GET", "HEAD"):
            return PlainTextResponse("only GET and HEAD", 405, {"allow": "GET, HEAD"})
        if self.folder is None:
            return HTMLResponse(_WAITING.format(escape(self.note)), 503, {"refresh": "2", "retry-after": "2"})
        name = scope["path"].removeprefix("/") or "index.html"
        try:
            if path := find(self.folder, name):
                return _file(path, name, headers, scope["method"] == "HEAD")
        except OSError:  # replaced meanwhile
            pass
        return PlainTextResponse("no such file", 404)


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


def is_local(host: str) -> bool:
    """Whether a Host header names this machine: localhost or a loopback address, with or without a port."""
    try:
        name = urlsplit(f"//{host}").hostname or ""
        return name == "localhost" or name.endswith(".localhost") or ip_address(name).is_loopback
    except ValueError:
        return False


def _file(path: Path, name: str, request: Headers, head: bool) -> Response:
    """The response with a file: full, a range, gzipped, or 304 if the client has it."""
    status = path.stat()
    suffix = path.suffix.lower()
    headers = {
        "cache-control": _FOREVER if _HASHED.fullmatch(name) else "no-cache",
        "etag": f'"{status.st_mtime_ns:x}-{status.st_size:x}"',
    }
    packed = suffix in _PACKED and "range" not in request and _takes_gzip(request)
    if suffix in _PACKED:
        headers["vary"] = "accept-encoding"
    if packed:
        headers["etag"] = headers["etag"][:-1] + '-gz"'
    tags = [tag.strip().removeprefix("W/") for tag in request.get("if-none-match", "").split(",")]
    if headers["etag"] in tags or "*" in tags:
        return NotModifiedResponse(Headers(headers))
    kind = _TYPES.get(suffix, "application/octet-stream")
    if not packed:
        return FileResponse(path, headers=headers, media_type=kind, stat_result=status)
    body = _gzipped(path, status.st_mtime_ns)
    headers |= {"content-encoding": "gzip", "content-length": str(len(body))}
    return Response(b"" if head else body, headers=headers, media_type=kind)


def _takes_gzip(request: Headers) -> bool:
    accepted = [part.partition(";") for part in request.get("accept-encoding", "").lower().split(",")]
    return any(name.strip() == "gzip" and q.strip() not in ("q=0", "q=0.0") for name, _, q in accepted)


@lru_cache(maxsize=32)
def _gzipped(path: Path, _changed: int) -> bytes:
    return gzip.compress(path.read_bytes(), 6, mtime=0)


class _Connection(H11Protocol):
    """A connection that is closed when idle, e.g. after half a request; uvicorn itself waits for ever."""

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        if len(self.connections) > MOST_CONNECTIONS:
            transport.abort()
        self._watch = self.loop.call_later(PATIENCE, self._check, self._moved())

    def connection_lost(self, exc: Exception | None) -> None:
        self._watch.cancel()
        super().connection_lost(exc)

    def _moved(self) -> tuple[object, int]:
        return self.cycle, self.transport.get_write_buffer_size()

    def _check(self, before: tuple[object, int]) -> None:
        now = self._moved()
        if now == before:
            self.transport.abort()
        else:
            self._watch = self.loop.call_later(PATIENCE, self._check, now)


def make_server(site: Site, certificate: Path | None = None, key: Path | None = None) -> uvicorn.Server:
    """A silent server for `site`, to be `run` on sockets; https with a certificate."""
    settings: MutableMapping[str, Any] = {"ssl_certfile": certificate, "ssl_keyfile": key}
    config = uvicorn.Config(
        site, http=_Connection, ws="none", lifespan="off", log_config=None, log_level="critical",
        access_log=False, server_header=False, proxy_headers=False, timeout_graceful_shutdown=1, **settings,
    )  # fmt: skip
    return uvicorn.Server(config)
