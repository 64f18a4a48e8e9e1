"""Takes edits of labels from the viewer on this machine, and nothing else from anybody.

A page may write only with the token, which is in the address that the command prints: in its fragment, so
that no request carries it along. It comes in a header of its own, which a page of another site cannot send
without being asked for leave, and none is given.
"""

import hmac
import secrets
from collections.abc import Callable
from pathlib import Path

from starlette.datastructures import Headers
from starlette.responses import PlainTextResponse, Response
from starlette.types import Receive, Scope, Send

from sagesplat.core.errors import SageError
from sagesplat.formats.label_edits import FILE, MAX_BYTES, parse_edits
from sagesplat.io.files import write_text
from sagesplat.viewer.hosts import is_loopback
from sagesplat.viewer.site import HEADERS, Site

_TOKEN = "x-sagesplat-token"


class EditSite:
    """A `Site` that also reads and writes one file of label edits.

    `ladder`: hash of the levels that are shown (`ladder_hash`), asked for at each request. Edits of other
    levels are refused.
    """

    def __init__(self, site: Site, path: Path, ladder: Callable[[], str]):
        self.token = secrets.token_urlsafe(24)
        self._site, self._path, self._ladder = site, path, ladder

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request."""
        if scope["type"] != "http" or scope["path"] != f"/{FILE}":
            await self._site(scope, receive, send)
            return
        response = self._refusal(scope) or await self._answer(scope, receive)
        response.headers.update({**HEADERS, "cache-control": "no-store"})
        await response(scope, receive, send)

    def _refusal(self, scope: Scope) -> Response | None:
        """The answer to who may not read or write edits; None to who may."""
        headers, client = Headers(scope=scope), scope.get("client")
        host = headers.get("host", "")
        if not self._site.answers_to(host) or client is None or not is_loopback(client[0]):
            return PlainTextResponse("edits are taken from this machine only", 403)
        origin, site = headers.get("origin"), headers.get("sec-fetch-site", "same-origin")
        if origin not in (None, f"{scope['scheme']}://{host}") or site not in ("same-origin", "none"):
            return PlainTextResponse("edits are not taken from pages of other sites", 403)
        if not hmac.compare_digest(headers.get(_TOKEN, "").encode(), self.token.encode()):
            return PlainTextResponse(
                "not the token of this viewer; open the address that the command says", 403
            )
        if scope["method"] not in ("GET", "PUT"):
            return PlainTextResponse("only GET and PUT", 405, {"allow": "GET, PUT"})
        return None

    async def _answer(self, scope: Scope, receive: Receive) -> Response:
        if scope["method"] == "GET":
            if not self._path.is_file():
                return Response(status_code=204)
            return Response(self._path.read_bytes(), media_type="application/json")
        content = bytearray()
        while (message := await receive())["type"] == "http.request":
            content += message.get("body", b"")
            if len(content) > MAX_BYTES:
                return PlainTextResponse(f"edits of more than {MAX_BYTES >> 20} MiB; nothing was saved", 413)
            if not message.get("more_body"):
                return self._save(bytes(content))
        return PlainTextResponse("cut off; nothing was saved", 400)

    def _save(self, content: bytes) -> Response:
        try:
            if parse_edits(content).ladder != self._ladder():
                return PlainTextResponse("edits of another run; nothing was saved: reload the page", 409)
            write_text(self._path, content.decode())
        except SageError as error:
            return PlainTextResponse(f"nothing was saved: {error}", 422)
        except OSError as error:
            return PlainTextResponse(f"{self._path.name} cannot be written: {error.strerror}", 500)
        run = self._path.parent.name
        return PlainTextResponse(f"Saved; `sagesplat labels apply {run}` makes it so")
