"""Takes edits of labels from the viewer on this machine, and nothing else from anybody.

A page may write only with the token, which is in the address that the command prints: in its fragment, so
that no request carries it along. It comes in a header of its own, which a page of another site cannot send
without being asked for leave, and none is given.
"""

import hmac
import secrets
import shlex
from collections.abc import Callable
from pathlib import Path

from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import Route

from sagesplat.core.errors import SageError
from sagesplat.formats.label_edits import FILE, MAX_BYTES, parse_edits
from sagesplat.io.files import write_text
from sagesplat.viewer.hosts import is_loopback

_TOKEN = "x-sagesplat-token"


class EditEndpoint:
    """Reads and writes one file of label edits; `route` is for a `Site` that answers this machine only.

    `ladder`: hash of the levels that are shown (`ladder_hash`), asked for at each request. Edits of other
    levels are refused.
    """

    def __init__(self, path: Path, ladder: Callable[[], str]):
        self.token = secrets.token_urlsafe(24)
        self.route = Route(f"/{FILE}", self._answer, methods=["GET", "PUT"])
        self._path, self._ladder = path, ladder

    async def _answer(self, request: Request) -> Response:
        response = self._refusal(request) or await self._allowed(request)
        response.headers["cache-control"] = "no-store"
        return response

    def _refusal(self, request: Request) -> Response | None:
        """The answer to who may not read or write edits; None to who may."""
        headers, client = request.headers, request.client
        if client is None or not is_loopback(client.host):
            return PlainTextResponse("edits are taken from this machine only", 403)
        own = f"{request.scope['scheme']}://{headers.get('host', '')}"
        origin, site = headers.get("origin"), headers.get("sec-fetch-site", "same-origin")
        if origin not in (None, own) or site not in ("same-origin", "none"):
            return PlainTextResponse("edits are not taken from pages of other sites", 403)
        if not hmac.compare_digest(headers.get(_TOKEN, "").encode(), self.token.encode()):
            return PlainTextResponse(
                "not the token of this viewer; open the address that the command says", 403
            )
        return None

    async def _allowed(self, request: Request) -> Response:
        if request.method != "PUT":
            if not self._path.is_file():
                return Response(status_code=204)
            return Response(self._path.read_bytes(), media_type="application/json")
        content = bytearray()
        async for piece in request.stream():
            content += piece
            if len(content) > MAX_BYTES:
                return PlainTextResponse(f"edits of more than {MAX_BYTES >> 20} MiB; nothing was saved", 413)
        return self._save(bytes(content))

    def _save(self, content: bytes) -> Response:
        try:
            if parse_edits(content).ladder != self._ladder():
                return PlainTextResponse("edits of another run; nothing was saved: reload the page", 409)
            write_text(self._path, content.decode())
        except SageError as error:
            return PlainTextResponse(f"nothing was saved: {error}", 422)
        except OSError as error:
            return PlainTextResponse(f"{self._path.name} cannot be written: {error.strerror}", 500)
        run = shlex.quote(str(self._path.parent))
        return PlainTextResponse(f"Saved; `sagesplat labels apply {run}` makes it so")
