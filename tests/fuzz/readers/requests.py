"""What browsers ask of the server for bundles, and what is typed at the command line."""

import asyncio
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import h11

from sagesplat.cli import parse
from sagesplat.cli.base import COMMANDS
from sagesplat.formats.label_edits import FILE, LabelEdits, Rename, dump_edits
from sagesplat.viewer.edit_endpoint import EditEndpoint
from sagesplat.viewer.site import Site
from tests.fuzz.hostile import Reader

_TOKEN = "a-token"
SECRET = b"not in the folder that is served"


def _requests(folder: Path, size: int) -> list[bytes]:
    site = folder / "site"
    (site / "chunks").mkdir(parents=True, exist_ok=True)
    (folder / "secret.txt").write_bytes(SECRET)
    (folder / "viewer").mkdir(exist_ok=True)
    (folder / "viewer/index.html").write_text("<title>x</title>")
    (site / "chunks/a.spz").write_bytes(b"abc" * 99)
    (site / ".hidden").write_bytes(SECRET)
    if not (site / "link").exists():
        (site / "link").symlink_to(folder)
    head = "Host: localhost:8000\r\nAccept-Encoding: gzip, br;q=0.5\r\n" + "X-Y: z\r\n" * (size - 1)
    return [
        f'GET /index.html HTTP/1.1\r\n{head}If-None-Match: W/"a"\r\n\r\n'.encode(),
        f'GET /chunks/a.spz HTTP/1.1\r\n{head}Range: bytes=1-4,7-\r\nIf-Range: "x"\r\n\r\n'.encode(),
        f"HEAD /../link/%2e%2e/secret.txt?x=/.hidden HTTP/1.1\r\n{head}\r\n".encode(),
    ]


@cache
def _loop() -> asyncio.AbstractEventLoop:
    return asyncio.new_event_loop()


def _answer(folder: Path, content: bytes) -> None:
    """Answer a request as uvicorn hands it over; AssertionError where what is outside the folder gets out."""
    connection = h11.Connection(h11.SERVER)
    try:
        connection.receive_data(content)
        asked = connection.next_event()
    except h11.RemoteProtocolError:
        return  # uvicorn answers 400 itself
    if not isinstance(asked, h11.Request):
        return
    path, _, query = asked.target.partition(b"?")
    scope = {
        "type": "http", "method": asked.method.decode(), "path": unquote(path.decode("ascii")),
        "raw_path": path, "query_string": query, "headers": list(asked.headers), "http_version": "1.1",
        "scheme": "http", "root_path": "", "client": ("127.0.0.1", 9), "server": ("127.0.0.1", 8000),
    }  # fmt: skip
    sent: list[Any] = []

    async def receive() -> Any:
        await asyncio.Event().wait()  # nothing comes after a request, and the other side stays

    async def send(message: Any) -> None:
        sent.append(message)

    _loop().run_until_complete(Site(folder / "site", viewer=folder / "viewer")(scope, receive, send))
    assert sent[0]["status"] in (200, 206, 304, 400, 403, 404, 405, 416), sent[0]
    assert not any(SECRET[:9] in message.get("body", b"") for message in sent)


def _edit_requests(folder: Path, size: int) -> list[bytes]:
    (folder / FILE).write_bytes(b"{}")
    body = dump_edits(LabelEdits("0" * 64, (Rename("sky", "heaven"),) * size))
    head = f"Host: localhost:8000\r\nOrigin: http://localhost:8000\r\nX-Sagesplat-Token: {_TOKEN}\r\n"
    return [
        f"GET /{FILE} HTTP/1.1\r\n{head}\r\n".encode(),
        f"PUT /{FILE} HTTP/1.1\r\n{head}Content-Length: {len(body)}\r\n\r\n".encode() + body,
    ]


def _answer_edit(folder: Path, content: bytes) -> None:
    """A request that reads or writes edits of labels; AssertionError where it gets by without the token."""
    head, _, body = content.partition(b"\r\n\r\n")
    lines = [line.split(b":", 1) for line in head.split(b"\r\n")[1:]]
    headers = [(line[0].strip().lower(), line[1].strip()) for line in lines if len(line) == 2]
    scope = {
        "type": "http", "method": head.split(b" ", 1)[0].decode("latin-1"), "path": f"/{FILE}",
        "headers": headers, "scheme": "http", "client": ("127.0.0.1", 9),
    }  # fmt: skip
    sent: list[Any] = []

    async def receive() -> Any:
        return {"type": "http.request", "body": body}

    async def send(message: Any) -> None:
        sent.append(message)

    edits = EditEndpoint(folder / FILE, lambda: "0" * 64)
    edits.token = _TOKEN
    site = Site(folder, viewer=folder, routes=(edits.route,))
    before = (folder / FILE).read_bytes()
    _loop().run_until_complete(site(scope, receive, send))
    (folder / FILE).write_bytes(before)
    if (b"x-sagesplat-token", _TOKEN.encode()) not in headers:
        other = scope["method"] not in ("GET", "HEAD", "PUT")  # which nobody is answered, with a token or not
        assert sent[0]["status"] == 403 or (other and sent[0]["status"] == 405), sent[0]


def _words(folder: Path, size: int) -> list[bytes]:
    return ["\n".join(["run", "SCENE", "RUN", *["--target-ssim", "0.5"] * size]).encode(),
            b"plan\nRUN\n--target-ssim\n0.9\n--ladder\nsnapshots"]  # fmt: skip


def _parse(folder: Path, content: bytes) -> None:
    """Words of a command line, one on each line, as `main` reads them."""
    name, *words = content.decode("utf-8", "surrogateescape").replace("\0", "").split("\n")
    if name in COMMANDS and not {"-h", "--help", "--help-all"} & set(words):
        with suppress(OSError):  # `main` makes a line of what the system says
            parse.arguments(name, COMMANDS[name], words)


READERS = (
    Reader("request", ".http", _requests, _answer, 300),
    Reader("edit-request", ".http", _edit_requests, _answer_edit, 300),
    Reader("command-line", ".txt", _words, _parse, 300),
)
