"""Serves a bundle over HTTP to a browser on this machine; other web pages cannot read it."""

import re
from collections.abc import Container
from html import escape
from pathlib import Path, PurePath

from starlette.applications import Starlette
from starlette.datastructures import Headers, MutableHeaders
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.middleware.gzip import GZipMiddleware
from starlette.requests import Request
from starlette.responses import FileResponse, HTMLResponse, PlainTextResponse, Response
from starlette.routing import BaseRoute, Route
from starlette.staticfiles import StaticFiles
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
_BINARY = "application/octet-stream"
_TYPES = {
    ".css": "text/css; charset=utf-8",
    ".html": "text/html; charset=utf-8",
    ".ico": "image/x-icon",
    ".jpeg": "image/jpeg",
    ".jpg": "image/jpeg",
    ".js": "text/javascript; charset=utf-8",
    ".json": "application/json",
    ".md": "text/markdown; charset=utf-8",
    ".png": "image/png",
    ".svg": "image/svg+xml",
    ".txt": "text/plain; charset=utf-8",
    ".wasm": "application/wasm",
    ".webmanifest": "application/manifest+json",
    ".webp": "image/webp",
    ".woff2": "font/woff2",
}
# sent as they are, since they are coded already
_NOT_GZIPPED = (_BINARY, "image/jpeg", "image/png", "image/webp", "image/x-icon", "font/woff2")
# files of a bundle that are served: no browser runs them, whatever is in them
_DATA = {".jpeg", ".jpg", ".json", ".md", ".pack", ".ply", ".png", ".sgst", ".spz", ".txt", ".webp"}
_WAITING = "<!doctype html><title>sagesplat</title><p>{}</p><p>This page tries again by itself.</p>"
_WRONG_HOST = PlainTextResponse(
    "this server does not answer to this name; start it with --host to change that", 403
)


class Site:
    """An ASGI application that serves the viewer of this package with the data of a bundle.

    `folder`: the bundle, which may change at any time. Of it only files are sent that no browser runs: a page
    or a script of its own would act in the name of this machine. Without a folder every path answers 503 with
    `note`. Requests to names that are not in `hosts` are refused, which prevents DNS rebinding. `viewer`: the
    folder of the built viewer. `routes`: what is answered besides.
    """

    def __init__(
        self,
        folder: Path | None = None,
        *,
        hosts: Container[str] | None = None,
        note: str = "",
        viewer: Path | None = None,
        routes: tuple[BaseRoute, ...] = (),
    ):
        self.folder, self.note = folder, note
        self._hosts, self._viewer = hosts or Hosts(), viewer or package_viewer()
        gzip = Middleware(GZipMiddleware, compresslevel=4, exclude_content_types=_NOT_GZIPPED)
        self._app = Starlette(routes=[*routes, Route("/{path:path}", self._answer)], middleware=[gzip])
        self._app.router.redirect_slashes = False  # a path without any is no file

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request."""

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in {**HEADERS, "cache-control": "no-cache"}.items():
                    headers.setdefault(name, value)
            await send(message)

        known = Headers(scope=scope).get("host", "") in self._hosts
        await (self._app if known else _WRONG_HOST)(scope, receive, send_with_headers)

    async def _answer(self, request: Request) -> Response:
        folder = self.folder  # another may be shown from the next request on
        if folder is None:
            return HTMLResponse(_WAITING.format(escape(self.note)), 503, {"refresh": "2", "retry-after": "2"})
        viewer, data = (StaticFiles(directory=each, check_dir=False) for each in (self._viewer, folder))
        path = PurePath(viewer.get_path(request.scope))
        name = PAGE if path == PurePath(".") else path.as_posix()
        if name == PAGE and (folder / POSTER).is_file():
            return HTMLResponse(with_poster((self._viewer / PAGE).read_text(encoding="utf-8")))
        for files in (viewer, data) if _is_data(path) else (viewer,):
            try:
                response = await files.get_response(name, request.scope)
            except (HTTPException, OSError):  # there is none, or it was replaced meanwhile
                continue
            if isinstance(response, FileResponse):
                response.headers["content-type"] = _TYPES.get(PurePath(name).suffix.lower(), _BINARY)
            if _HASHED.fullmatch(name):
                response.headers["cache-control"] = _FOREVER
            return response
        return PlainTextResponse("no such file", 404)


def _is_data(path: PurePath) -> bool:
    """Whether a bundle's file of this path is served."""
    return path.suffix.lower() in _DATA and not any(part.startswith(".") for part in path.parts)
