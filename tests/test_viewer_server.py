"""The viewer's server: what it answers, what it refuses, and which bundle of a run it shows."""

import gzip
import hashlib
import http.client
import json
import shutil
import socket
import ssl
import subprocess
import sys
import threading
import time
import types
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path

import browser
import pytest

from benchmarks.server import measure
from sagesplat.core.errors import BackendUnavailable, RunError, SageError
from sagesplat.run.records import FORMAT
from sagesplat.stages import view as stages_view
from sagesplat.stages.view import show
from sagesplat.viewer import server

pytest.importorskip("starlette", reason="needs the extra `view`")
pytest.importorskip("uvicorn", reason="needs the extra `view`")
from sagesplat.viewer import connections, site
from sagesplat.viewer.hosts import Hosts

CHUNK = "chunks/grass-01-0123456789ab.spz"
STREAM = "chunks/grass-0123456789ab.sgst"
PROMISES = "promises-0123456789ab.json"
FILES = {
    "manifest.json": b'{"format": "sagesplat-bundle", "labels": []}',
    "index.html": b"<!doctype html><title>viewer</title>" + b"<p>text" * 500,
    CHUNK: bytes(range(256)) * 1000,
    STREAM: b"SGST" + bytes(range(100)),
    "scene-0123456789ab.pack": bytes(1000),
    PROMISES: b"[" + b"0.5," * 900 + b"1]",
    "assets/index-CmV_C-3Q.js": b"export const a = 1\n" * 300,
    "assets/look-1a2b3c4d.css": b"a{}",
    "assets/icon-1a2b3c4d.svg": b"<svg/>",
    "assets/sort-1a2b3c4d.wasm": b"\0asm",
    "LICENSES.txt": b"Apache-2.0",
}
OF_VIEWER = [name for name in FILES if name.startswith(("index.html", "assets/"))]
Answer = tuple[int, dict[str, str], bytes]


def write_bundle(folder: Path, contents: dict[str, bytes] = FILES) -> Path:
    for name, content in contents.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    return folder


@contextmanager
def running(served: site.Site, **certificate: Path) -> Iterator[int]:
    listener = server.bind("127.0.0.1", 0)
    serving = connections.make_server(served, **certificate)
    thread = threading.Thread(target=serving.run, args=([listener],))
    port = listener.getsockname()[1]
    thread.start()
    try:
        yield port
    finally:
        serving.should_exit = True
        thread.join(10)
        listener.close()
        assert not thread.is_alive()


@contextmanager
def viewing(view: server.View, browser: bool = False) -> Iterator[int]:
    """The port of a view that runs."""
    thread = threading.Thread(target=view.run, args=(browser,))
    with view:
        thread.start()
        try:
            yield int(view.urls[0].rpartition(":")[2].strip("/"))
        finally:
            view.stop()
            thread.join(10)
            assert not thread.is_alive()


def received(connection: socket.socket) -> int:
    """Bytes that come until the other side hangs up, however it does."""
    connection.settimeout(10)
    count = 0
    try:
        while piece := connection.recv(1 << 20):
            count += len(piece)
    except ConnectionResetError:
        pass
    return count


def ask(port: int, target: str, method: str = "GET", **headers: str) -> Answer:
    """One request; the target goes out as it is. Underscores of header names are dashes."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
    try:
        connection.putrequest(method, target, skip_host="host" in headers, skip_accept_encoding=True)
        for name, value in headers.items():
            connection.putheader(name.replace("_", "-"), value)
        connection.endheaders()
        response = connection.getresponse()
        return response.status, {k.lower(): v for k, v in response.getheaders()}, response.read()
    finally:
        connection.close()


@pytest.fixture(scope="module")
def bundle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("served") / "bundle"
    write_bundle(folder, {name: FILES[name] for name in FILES if name not in OF_VIEWER})
    secret = folder.parent / "secret.txt"
    secret.write_text("secret")
    (folder.parent / "bundle-other").mkdir()
    (folder.parent / "bundle-other" / "secret.txt").write_text("secret")
    (folder / ".hidden").write_text("secret")
    (folder / "chunks" / "leads-out.spz").symlink_to(secret)
    (folder / "out").symlink_to(folder.parent)
    (folder / "circle").symlink_to(folder / "circle")
    (folder / "inside.spz").symlink_to(folder / CHUNK)
    return folder


@pytest.fixture(scope="module")
def viewer(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A built viewer."""
    return write_bundle(tmp_path_factory.mktemp("viewer"), {name: FILES[name] for name in OF_VIEWER})


@pytest.fixture(scope="module")
def port(bundle: Path, viewer: Path) -> Iterator[int]:
    with running(site.Site(bundle, viewer=viewer)) as port:
        yield port


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("", "text/html; charset=utf-8"),
        ("index.html", "text/html; charset=utf-8"),
        ("manifest.json", "application/json"),
        (PROMISES, "application/json"),
        (CHUNK, "application/octet-stream"),
        ("assets/index-CmV_C-3Q.js", "text/javascript; charset=utf-8"),
        ("assets/look-1a2b3c4d.css", "text/css; charset=utf-8"),
        ("assets/icon-1a2b3c4d.svg", "image/svg+xml"),
        ("assets/sort-1a2b3c4d.wasm", "application/wasm"),
        ("LICENSES.txt", "text/plain; charset=utf-8"),
    ],
)
def test_files_come_whole_with_their_media_type(port: int, name: str, kind: str):
    status, headers, body = ask(port, "/" + name)
    assert (status, body) == (200, FILES[name or "index.html"])
    assert headers["content-type"] == kind
    assert int(headers["content-length"]) == len(body)
    assert "content-encoding" not in headers
    assert "server" not in headers


def test_names_with_a_hash_are_kept_for_ever_and_others_asked_about(port: int):
    kept = "public, max-age=31536000, immutable"
    for name in FILES:
        hashed = name.startswith(("chunks/", "assets/", "promises-", "scene-"))
        assert ask(port, "/" + name)[1]["cache-control"] == (kept if hashed else "no-cache")
    assert ask(port, "/inside.spz")[1]["cache-control"] == "no-cache"
    assert ask(port, "/chunks/nothing-01-0123456789ab.spz")[1]["cache-control"] == "no-cache"


def test_an_etag_saves_the_second_download(port: int):
    for encoding in ("identity", "gzip"):
        _, headers, _ = ask(port, "/index.html", accept_encoding=encoding)
        for sent in (headers["etag"], f'"other", W/{headers["etag"]}', "*"):
            status, again, body = ask(port, "/index.html", accept_encoding=encoding, if_none_match=sent)
            assert (status, body, again["etag"]) == (304, b"", headers["etag"])
            assert again["cache-control"] == "no-cache"
            assert again["content-security-policy"] == site.HEADERS["content-security-policy"]
        assert ask(port, "/index.html", accept_encoding=encoding, if_none_match='"other"')[0] == 200


def test_text_is_packed_and_chunks_are_not(port: int):
    for name, content in FILES.items():
        _, plain, _ = ask(port, "/" + name)
        status, headers, body = ask(port, "/" + name, accept_encoding="br, gzip;q=0.8")
        assert (status, int(headers["content-length"])) == (200, len(body))
        if name.endswith((".sgst", ".spz", ".pack")):
            assert (body, headers.get("content-encoding"), headers.get("vary")) == (content, None, None)
        else:
            assert (gzip.decompress(body), headers["content-encoding"]) == (content, "gzip")
            assert headers["vary"] == plain["vary"] == "accept-encoding"
            assert headers["etag"] != plain["etag"]
    assert "content-encoding" not in ask(port, "/index.html", accept_encoding="gzip;q=0")[1]


def test_a_range(port: int):
    content = FILES[CHUNK]
    for asked, low, high in (("5-9", 5, 10), ("255990-", 255990, 256000), ("-7", 255993, 256000)):
        status, headers, body = ask(port, "/" + CHUNK, range=f"bytes={asked}")
        assert (status, body) == (206, content[low:high])
        assert headers["content-range"] == f"bytes {low}-{high - 1}/256000"
        assert headers["cache-control"].endswith("immutable")
    html = ask(port, "/index.html", range="bytes=0-3", accept_encoding="gzip")
    assert (html[0], html[2]) == (206, FILES["index.html"][:4])


def test_a_range_of_a_coded_stream(port: int):
    status, headers, body = ask(port, "/" + STREAM, range="bytes=44-59", accept_encoding="gzip")
    assert (status, body) == (206, FILES[STREAM][44:60])
    assert headers["content-range"] == "bytes 44-59/104"
    assert headers["content-type"] == "application/octet-stream"
    assert headers["cache-control"].endswith("immutable")
    assert ask(port, "/" + STREAM)[1]["accept-ranges"] == "bytes"


def test_several_ranges(port: int):
    status, headers, body = ask(port, "/" + CHUNK, range="bytes=0-3,10-12")
    assert (status, len(body)) == (206, int(headers["content-length"]))
    boundary = headers["content-type"].partition("multipart/byteranges; boundary=")[2].encode()
    parts = [part.partition(b"\r\n\r\n")[2] for part in body.split(b"--" + boundary)[1:3]]
    assert [part.removesuffix(b"\r\n") for part in parts] == [FILES[CHUNK][:4], FILES[CHUNK][10:13]]


def test_a_range_that_cannot_be(port: int):
    status, headers, _ = ask(port, "/" + CHUNK, range="bytes=256000-")
    assert (status, headers["content-range"], headers["cache-control"]) == (416, "bytes */256000", "no-cache")
    assert headers["x-content-type-options"] == "nosniff"
    assert ask(port, "/" + CHUNK, range="bytes=abc")[0] == 400


def test_an_outdated_range_gets_the_whole_file(port: int):
    assert ask(port, "/" + CHUNK, range="bytes=0-3", if_range='"other"')[2] == FILES[CHUNK]


@pytest.mark.parametrize("name", ["index.html", CHUNK])
@pytest.mark.parametrize("encoding", ["identity", "gzip"])
def test_head_is_get_without_the_content(port: int, name: str, encoding: str):
    status, headers, body = ask(port, "/" + name, "HEAD", accept_encoding=encoding)
    _, of_get, _ = ask(port, "/" + name, accept_encoding=encoding)
    assert (status, body) == (200, b"")
    assert headers | {"date": ""} == of_get | {"date": ""}


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "PATCH", "OPTIONS", "TRACE", "BREW"])
def test_nothing_but_reading(port: int, method: str):
    status, headers, _ = ask(port, "/index.html", method)
    assert (status, headers["allow"]) == (405, "GET, HEAD")


def test_every_answer_has_the_headers_that_protect(port: int):
    for target, status in (("/", 200), ("/nothing", 404), ("/" + CHUNK, 200)):
        got, headers, _ = ask(port, target)
        assert got == status
        assert {name: headers[name] for name in site.HEADERS} == site.HEADERS
    policy = dict(part.split(" ", 1) for part in headers["content-security-policy"].split("; "))
    assert (policy["default-src"], policy["script-src"]) == ("'none'", "'self' 'wasm-unsafe-eval'")
    assert "xr-spatial-tracking=(self)" in headers["permissions-policy"]


@pytest.mark.parametrize(
    "target",
    [
        "/../secret.txt",
        "/chunks/../../secret.txt",
        "/%2e%2e/secret.txt",
        "/%2E%2E%2Fsecret.txt",
        "/..%2fsecret.txt",
        "/.%2e/secret.txt",
        "/%252e%252e/secret.txt",
        "/..\\secret.txt",
        "/..%5csecret.txt",
        "/%c0%ae%c0%ae/secret.txt",
        "/%uff0e%uff0e/secret.txt",
        "/....//secret.txt",
        "/..;/secret.txt",
        "/../bundle-other/secret.txt",
        "//secret.txt",
        "//etc/passwd",
        "/%2fetc/passwd",
        "/etc/passwd",
        "/file:///etc/passwd",
        "/C:/Windows/win.ini",
        "/index.html%00.json",
        "/index.html/",
        "/index.html%0a",
        "/index.html::$DATA",
        "/./index.html",
        "/chunks/./../index.html",
        "/.hidden",
        "/chunks",
        "/chunks/",
        "/chunks/leads-out.spz",
        "/out/secret.txt",
        "/out/bundle/index.html",
        "/circle",
        "/" + "a" * 5000,
        "/" + "a/" * 3000,
        "/%ff%fe",
        "/?../secret.txt/../nothing",
        "http://127.0.0.1/../secret.txt",
    ],
)
def test_no_path_leads_out(port: int, target: str):
    status, _, body = ask(port, target)
    assert b"secret" not in body
    assert b"root:" not in body
    if target.startswith("/?"):
        assert (status, body) == (200, FILES["index.html"])
    elif target == "/out/bundle/index.html":  # by a way out and in again
        assert status in (200, 404)
    else:
        assert status == 404


def test_a_link_that_stays_inside_is_followed(port: int):
    assert ask(port, "/inside.spz")[2] == FILES[CHUNK]


@pytest.mark.parametrize(
    "host", ["localhost", "LOCALHOST:80", "127.0.0.1:8000", "[::1]:8000", "a.localhost."]
)
def test_this_machine_s_names_are_answered(port: int, host: str):
    assert ask(port, "/", host=host)[0] == 200


@pytest.mark.parametrize(
    "host",
    ["evil.example", "localhost.evil.example", "192.168.1.7:8000", "127.0.0.1.nip.io", "", "[::1", "::1x"],
)
def test_other_names_are_not(port: int, host: str):
    status, headers, body = ask(port, "/manifest.json", host=host)
    assert (status, b"--host" in body) == (403, True)
    assert headers["cache-control"] == "no-cache"


@pytest.mark.parametrize("listening", ["127.0.0.1", "localhost", "::1", "127.8.9.1"])
def test_a_host_that_is_this_machine_lets_no_other_name_in(listening: str, bundle: Path):
    names = Hosts(listening)
    assert ("localhost:80" in names, "127.0.0.1" in names) == (True, True)
    assert not [name for name in ("evil.example", "192.168.1.7", socket.gethostname()) if name in names]
    if listening == "127.0.0.1":
        with viewing(show(bundle, print, port=0, host=listening)) as port:
            assert ask(port, "/manifest.json", host="evil.example")[0] == 403
            assert ask(port, "/manifest.json")[0] == 200


def test_names_that_are_answered_where_others_were_let_in(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(socket, "gethostname", lambda: "Desk.lan")
    everybody, one = Hosts("0.0.0.0"), Hosts("splats.example")
    for name in ("192.168.1.7:8000", "[2001:db8::1]:8000", "desk.lan", "desk.local:8000", "localhost"):
        assert name in everybody
        assert name in one
    assert ("splats.example:80" in one, "splats.example" in everybody) == (True, False)
    for name in ("evil.example", "192.168.1.7.nip.io", "evil.local", "", "a@b"):
        assert name not in everybody
        assert name not in one
    assert "evil.example" in Hosts("0.0.0.0", certificate=True)  # its name is in the certificate
    assert "evil.example" not in Hosts("127.0.0.1", certificate=True)


ACTS = ("evil.html", "evil.js", "sw.js", "evil.mjs", "evil.svg", "evil.wasm", "evil.xhtml", "evil.css")
ACTS += ("chunks/evil.html", "assets/index-CmV_C-3Q.mjs", "evil.webmanifest", "evil.xml", "evil.pdf", "evil")


def test_of_a_bundle_nothing_that_acts_is_served(bundle: Path, tmp_path: Path):
    folder = Path(shutil.copytree(bundle, tmp_path / "bundle", symlinks=True))
    write_bundle(
        folder, dict.fromkeys(ACTS, b"evil") | {"index.html": b"evil", "assets/a-12345678.js": b"evil"}
    )
    write_bundle(
        folder, {"manifest.json.txt": b"<script>1</script>", "chunks/page.JSON": b"<script>1</script>"}
    )
    with viewing(show(folder, print, port=0)) as port:
        for name in ACTS:
            assert ask(port, "/" + name)[0] == 404
        assert ask(port, "/assets/a-12345678.js")[0] == 404
        assert b"evil" not in ask(port, "/")[2]
        for name, kind in (
            ("manifest.json.txt", "text/plain; charset=utf-8"),
            ("chunks/page.JSON", "application/json"),
        ):
            status, headers, _ = ask(port, "/" + name)
            assert (status, headers["content-type"]) == (200, kind)
            assert headers["x-content-type-options"] == "nosniff"


def test_the_page_shows_the_bundle_s_poster(bundle: Path, viewer: Path, tmp_path: Path):
    page = b"<!doctype html><body><!-- poster --></body>"
    own = write_bundle(tmp_path / "viewer", {"index.html": page})
    folder = write_bundle(tmp_path / "bundle", {"manifest.json": FILES["manifest.json"]})
    with running(site.Site(folder, viewer=own)) as port:
        _, headers, body = ask(port, "/")
        assert body == page
        (folder / "poster.jpg").write_bytes(b"jpeg")
        status, again, body = ask(port, "/", if_none_match=headers["etag"])
        assert (status, b'src="poster.jpg"' in body, int(again["content-length"])) == (200, True, len(body))
        assert ask(port, "/", if_none_match=again["etag"])[0] == 304
        assert gzip.decompress(ask(port, "/", accept_encoding="gzip")[2]) == body
        assert ask(port, "/poster.jpg")[1]["content-type"] == "image/jpeg"


def test_two_hundred_at_once(port: int):
    def fetch(index: int) -> bool:
        name = list(FILES)[index % len(FILES)]
        return hashlib.sha256(ask(port, "/" + name)[2]).digest() == hashlib.sha256(FILES[name]).digest()

    with ThreadPoolExecutor(200) as pool:
        assert all(pool.map(fetch, range(200)))


def test_what_does_not_move_is_dropped_and_blocks_nobody(
    bundle: Path, viewer: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(connections, "PATIENCE", 0.4)
    monkeypatch.setattr(connections, "_EVERY", 0.1)
    (bundle / "large.spz").write_bytes(bytes(30_000_000))
    with running(site.Site(bundle, viewer=viewer)) as port:
        half, stopped, silent = (socket.create_connection(("127.0.0.1", port)) for _ in range(3))
        half.sendall(b"GET / HTTP/1.1\r\nHost: local")
        stopped.sendall(b"GET /large.spz HTTP/1.1\r\nHost: localhost\r\n\r\n")
        begin = time.perf_counter()
        assert ask(port, "/" + CHUNK)[2] == FILES[CHUNK]
        assert time.perf_counter() - begin < 2
        assert received(half) == received(silent) == 0
        time.sleep(1.2)
        assert 0 < received(stopped) < 30_000_000
        for connection in (half, silent, stopped):
            connection.close()


def slow(port: int, window: int) -> socket.socket:
    """A connection of small buffers that asked for large.spz."""
    connection = socket.socket()
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, window)
    connection.connect(("127.0.0.1", port))
    connection.sendall(b"GET /large.spz HTTP/1.1\r\nHost: localhost\r\n\r\n")
    return connection


@pytest.mark.parametrize("tell", [True, False])
def test_a_download_that_moves_is_never_cut(
    tell: bool, bundle: Path, viewer: Path, monkeypatch: pytest.MonkeyPatch
):
    """At full speed its buffer is as full as before at every look; slowly read, it moves in lumps."""
    monkeypatch.setattr(connections, "PATIENCE", 0.5)
    monkeypatch.setattr(connections, "_EVERY", 0.1)
    if not tell:  # as on systems that do not say what has arrived
        monkeypatch.setattr(connections, "_acknowledged", lambda sock: 0)
    size = 2_500_000
    (bundle / "large.spz").write_bytes(bytes(size))
    with running(site.Site(bundle, viewer=viewer)) as port, slow(port, 4096) as connection:
        connection.settimeout(5)
        got, begin = 0, time.monotonic()
        while time.monotonic() - begin < 2.0:
            got += len(connection.recv(2048 if tell else 65536))
            time.sleep(0.02)
        assert 0 < got < size
        while got < size + 200:
            piece = connection.recv(1 << 20)
            if not piece:
                break
            got += len(piece)
        assert got > size


def test_a_request_has_its_time_however_it_trickles(
    bundle: Path, viewer: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(connections, "PATIENCE", 0.5)
    monkeypatch.setattr(connections, "_EVERY", 0.1)
    with (
        running(site.Site(bundle, viewer=viewer)) as port,
        socket.create_connection(("127.0.0.1", port)) as connection,
    ):
        begin = time.monotonic()
        with suppress(ConnectionError):
            while time.monotonic() - begin < 5:
                connection.sendall(b"G")
                time.sleep(0.02)
        assert time.monotonic() - begin < 2


def test_who_leaves_stops_the_reading_of_the_file(bundle: Path, viewer: Path):
    with (bundle / "endless.spz").open("wb") as file:
        file.truncate(2**40)
    listener = server.bind("127.0.0.1", 0)
    serving = connections.make_server(site.Site(bundle, viewer=viewer))
    thread = threading.Thread(target=serving.run, args=([listener],))
    thread.start()
    try:
        with socket.create_connection(listener.getsockname()) as connection:
            connection.sendall(b"GET /endless.spz HTTP/1.1\r\nHost: localhost\r\n\r\n")
            assert connection.recv(1000)
            wait_for(lambda: len(serving.server_state.tasks) == 1)
        wait_for(lambda: not serving.server_state.tasks, 2)
        wait_for(lambda: not len(serving.room), 2)
    finally:
        serving.should_exit = True
        thread.join(10)
        listener.close()
        (bundle / "endless.spz").unlink()


def test_when_it_is_full_the_longest_idle_of_the_largest_crowd_goes(
    bundle: Path, viewer: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(connections, "MOST", 40)
    with running(site.Site(bundle, viewer=viewer)) as port:
        other = socket.create_connection(("127.0.0.1", port), source_address=("127.0.0.77", 0))
        idle = [socket.create_connection(("127.0.0.1", port)) for _ in range(120)]
        assert ask(port, "/" + CHUNK)[2] == FILES[CHUNK]
        time.sleep(0.1)
        for connection in idle[:60]:
            assert received(connection) == 0  # closed, the oldest first
        for connection in (other, idle[-1]):
            connection.sendall(b"GET /LICENSES.txt HTTP/1.0\r\nHost: localhost\r\n\r\n")
            assert received(connection) > 100
        for connection in (other, *idle):
            connection.close()


def test_connections_are_as_many_as_files_can_be_open(monkeypatch: pytest.MonkeyPatch):
    resource = pytest.importorskip("resource")
    infinite = resource.RLIM_INFINITY
    limits = [(1024, 4096), (1024, 1024), (256, 256), (infinite, infinite), (64, 64)]
    monkeypatch.setattr(connections, "MOST", 512)
    found = []
    for limit in limits:
        now = [limit]
        monkeypatch.setattr(resource, "getrlimit", lambda _, now=now: now[-1])
        monkeypatch.setattr(resource, "setrlimit", lambda _, new, now=now: now.append(new))
        found.append((connections.capacity(), now[-1]))
    raised = [(1088, 4096), *limits[1:]]
    assert found == list(zip((512, 480, 96, 512, 8), raised, strict=True))


def test_addresses_that_count_as_one():
    peer = connections._peer
    assert peer("::ffff:10.0.0.1") == peer("10.0.0.1") != peer("10.0.0.2")
    assert peer("2001:db8:1:2::1") == peer("2001:db8:1:2:ffff::9%eth0") != peer("2001:db8:1:3::1")


def test_rubbish_is_refused_and_the_server_goes_on(port: int):
    for rubbish in (
        b"\x16\x03\x01\x02\x00\x01",
        b"GET\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: a\r\n" + b"x" * 70000,
    ):
        with socket.create_connection(("127.0.0.1", port), timeout=5) as connection:
            connection.sendall(rubbish + b"\r\n\r\n")
            assert received(connection) < 1000
    assert ask(port, "/")[0] == 200


@pytest.fixture(scope="module")
def pem(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A certificate for localhost, and its key."""
    if not shutil.which("openssl"):
        pytest.skip("needs openssl to make a certificate")
    folder = tmp_path_factory.mktemp("certificate")
    certificate, key = folder / "cert.pem", folder / "key.pem"
    subprocess.run(
        [
            "openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "2",
            "-subj", "/CN=localhost", "-addext", "subjectAltName=DNS:localhost",
            "-keyout", key, "-out", certificate,
        ],
        check=True, capture_output=True,
    )  # fmt: skip
    return certificate, key


def test_a_handshake_that_does_not_come_is_cut_and_nothing_is_printed(
    bundle: Path, viewer: Path, pem: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch, capfd
):
    monkeypatch.setattr(connections, "HANDSHAKE", 0.5)
    monkeypatch.setattr(connections, "MOST", 40)
    context = ssl.create_default_context(cafile=str(pem[0]))
    with running(site.Site(bundle, viewer=viewer), certificate=pem[0], key=pem[1]) as port:
        silent = [socket.create_connection(("127.0.0.1", port)) for _ in range(100)]
        for number, connection in enumerate(silent):
            with suppress(OSError):  # dropped for later ones
                connection.sendall((b"", b"GET / HTTP/1.1\r\n\r\n", b"\x16\x03\x01\x02\x00\x01")[number % 3])
        connection = http.client.HTTPSConnection("localhost", port, context=context, timeout=10)
        connection.request("GET", "/" + CHUNK)
        assert connection.getresponse().read() == FILES[CHUNK]
        connection.close()
        begin = time.monotonic()
        for connection in silent:
            received(connection)  # ends
            connection.close()
        assert time.monotonic() - begin < 3
    assert capfd.readouterr() == ("", "")


def test_a_certificate_makes_it_https(bundle: Path, tmp_path: Path, pem: tuple[Path, Path]):
    certificate, key = pem
    context = ssl.create_default_context(cafile=str(certificate))
    view = show(bundle, print, port=0, ssl_certfile=certificate, ssl_keyfile=key)
    assert view.urls[0].startswith("https://127.0.0.1:")
    with viewing(view) as port:
        connection = http.client.HTTPSConnection("localhost", port, context=context, timeout=10)
        connection.request("GET", "/manifest.json")
        assert connection.getresponse().read() == FILES["manifest.json"]
        connection.close()
    with pytest.raises(RunError, match=r"cert.pem: no certificate with its key"):
        show(bundle, print, port=0, ssl_certfile=certificate)
    with pytest.raises(RunError, match=r"key.pem: a key without its certificate; add --ssl-certfile"):
        show(bundle, print, port=0, ssl_keyfile=key)
    with pytest.raises(RunError, match=r"none.pem: no such file"):
        show(bundle, print, port=0, ssl_certfile=tmp_path / "none.pem")


def test_a_bundle_is_shown(bundle: Path, monkeypatch: pytest.MonkeyPatch):
    opened: list[str] = []
    monkeypatch.setattr(server, "has_display", lambda: True)
    monkeypatch.setattr(server.webbrowser, "open", opened.append)
    view = show(bundle, print, port=0)
    with viewing(view, browser=True) as port:
        assert f"adb reverse tcp:{port} tcp:{port}" in view.hint
        wait_for(lambda: opened == list(view.urls))
        assert ask(port, "/manifest.json")[2] == FILES["manifest.json"]


def wait_for(what, seconds: float = 8.0) -> None:
    end = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < end
        time.sleep(0.02)


def test_ctrl_c_ends_it_quietly(bundle: Path):
    code = (
        "import signal, sys, threading, time; from pathlib import Path\n"
        "from sagesplat.stages.view import show\n"
        f"view = show(Path({str(bundle)!r}), print, port=0)\n"
        "threading.Timer(0.5, signal.raise_signal, [signal.SIGINT]).start()\n"
        "with view: view.run(browser=False)\n"
        "print('ended')"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=30, check=True
    )
    assert (done.stdout, done.stderr) == ("ended\n", "")


def test_ports():
    first = server.bind("127.0.0.1", 0)
    taken = first.getsockname()[1]
    with (
        first,
        pytest.raises(RunError, match=f"^port {taken} is taken; choose another --port, or leave it out$"),
    ):
        server.bind("127.0.0.1", taken)
    with server.bind("127.0.0.1", None) as one, server.bind("127.0.0.1", None) as two:
        assert 8000 <= one.getsockname()[1] < two.getsockname()[1] < 8100


@pytest.mark.parametrize("port", [-1, 70000])
def test_a_port_that_cannot_be(port: int):
    with pytest.raises(RunError, match=f"^--port {port} is impossible; choose 1024 to 65535$"):
        server.bind("127.0.0.1", port)


@pytest.mark.parametrize("host", ["no-such-host.invalid", "192.0.2.1"])
def test_where_nothing_can_listen(host: str):
    with pytest.raises(RunError, match=rf"^{host}:0: cannot listen \(.*\); change --host or --port$"):
        server.bind(host, 0)


def test_all_ports_taken(monkeypatch: pytest.MonkeyPatch):
    with server.bind("127.0.0.1", 0) as first:
        monkeypatch.setattr(server, "PORT", first.getsockname()[1])
        monkeypatch.setattr(server, "_TRIED", 1)
        with pytest.raises(RunError, match=r"are all taken; choose another by --port$"):
            server.bind("127.0.0.1", None)


def test_open_to_the_network(bundle: Path):
    with show(bundle, print, port=0, host="0.0.0.0") as view:
        assert view.urls[0].startswith("http://localhost:")
        assert "--ssl-certfile" in view.hint


def test_without_the_extra(bundle: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delitem(sys.modules, "sagesplat.viewer.site")
    monkeypatch.delattr("sagesplat.viewer.site")
    monkeypatch.setitem(sys.modules, "starlette.responses", None)
    with pytest.raises(BackendUnavailable, match=r"pip install 'sagesplat\[view\]'$"):
        show(bundle, print)


@pytest.mark.parametrize(
    ("contents", "message"),
    [
        ({}, r"neither a bundle \(no manifest.json\) nor a run folder"),
        ({"manifest.json": b"{"}, r"manifest.json: not readable as JSON"),
        ({"manifest.json": b"[]"}, r"manifest.json: not of a sagesplat bundle"),
        ({"manifest.json": b'{"format": "other"}'}, r"manifest.json: not of a sagesplat bundle"),
        (
            {"scene.json": b"{}"},
            r"a run folder of format None, this sagesplat \(.*\) reads 3; run again into a new",
        ),
        ({"scene.json": b"{}", "provenance/scene.json": b'{"format": 1}'}, r"a run folder of format 1, this"),
        (
            {"scene.json": b"{}", "provenance/scene.json": json.dumps({"format": FORMAT}).encode()},
            r"not finished; run `sagesplat run` again, or add --follow",
        ),
    ],
)
def test_other_folders(
    tmp_path: Path, contents: dict[str, bytes], message: str, monkeypatch: pytest.MonkeyPatch
):
    for name in ("bundle", "live_bundle"):
        unused = types.ModuleType(f"sagesplat.stages.{name}")
        setattr(unused, name, None)
        monkeypatch.setitem(sys.modules, unused.__name__, unused)
    with pytest.raises(SageError, match=message) as caught:
        show(write_bundle(tmp_path / "folder", contents) if contents else tmp_path, print, port=0)
    assert "\n" not in str(caught.value)


def test_no_folder(tmp_path: Path):
    with pytest.raises(RunError, match="no such folder"):
        show(tmp_path / "none", print)


def test_a_bundle_cannot_be_followed(bundle: Path):
    with pytest.raises(RunError, match="a bundle does not change; leave out --follow"):
        show(bundle, print, port=0, follow=True)


class Bundling(types.ModuleType):
    """In place of sagesplat.stages.bundle and live_bundle: writes what it is told to."""

    def __init__(self) -> None:
        super().__init__("sagesplat.stages.bundle")
        self.made = 0
        self.live: bytes | None = None
        self.trouble = ""
        self.viewer: dict[str, bytes] = {}

    def bundle(self, job, out: Path) -> None:
        self.made += 1
        levels = [
            {"sha256": c["sha256"]}
            for c in json.loads((job.run.increments / "index.json").read_text())["chunks"]
        ]
        manifest = {
            "format": "sagesplat-bundle", "live": False, "labels": [{"levels": levels}], "ladder": "aa",
        }  # fmt: skip
        page = self.viewer["index.html"].replace(
            b"<!-- poster -->", b'<img id="poster" src="poster.jpg" alt="" />'
        )
        write_bundle(out, {"manifest.json": json.dumps(manifest).encode(), "index.html": page})

    def live_bundle(self, job, folder: Path) -> bool:
        if self.trouble:
            raise RunError(self.trouble)
        if self.live is None:
            return False
        written = folder / "manifest.json"
        if written.exists() and written.read_bytes() == self.live:  # as the real one
            return False
        write_bundle(folder, {"manifest.json": self.live})
        return True


@pytest.fixture
def bundling(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Bundling:
    fake, package = Bundling(), tmp_path / "package"
    fake.viewer = {"index.html": b"one <!-- poster -->"}
    write_bundle(package / "viewer" / "static", fake.viewer)
    for name in ("bundle", "live_bundle"):
        monkeypatch.setitem(sys.modules, f"sagesplat.stages.{name}", fake)
    built = package / "viewer" / "static"
    monkeypatch.setattr(stages_view, "package_viewer", lambda: built)
    monkeypatch.setattr(site, "package_viewer", lambda: built)
    monkeypatch.setattr(stages_view, "_EVERY", 0.05)
    return fake


def write_run(folder: Path, chunks: bool = True) -> Path:
    contents = {"scene.json": b"{}", "provenance/scene.json": json.dumps({"format": FORMAT}).encode()}
    if chunks:
        contents["nested/increments/index.json"] = b'{"chunks": [{"sha256": "aa"}, {"sha256": "bb"}]}'
        contents["nested/promises.json"] = contents["nested/fidelity.json"] = b"{}"
    return write_bundle(folder, contents)


def test_a_run_s_bundle_is_made_once(tmp_path: Path, bundling: Bundling):
    run = write_run(tmp_path / "run")
    for _ in range(2):
        with show(run, print, port=0):
            pass
        assert bundling.made == 1


def test_a_newer_viewer_needs_no_new_bundle(tmp_path: Path, bundling: Bundling):
    run = write_run(tmp_path / "run")
    with show(run, print, port=0):
        pass
    write_bundle(tmp_path / "package" / "viewer" / "static", {"index.html": b"two <!-- poster -->"})
    with viewing(show(run, print, port=0)) as port:
        assert ask(port, "/")[2].startswith(b"two")
    assert bundling.made == 1


@pytest.mark.parametrize("change", ["chunks", "promises", "fidelity", "plan", "manifest"])
def test_and_again_when_it_is_out_of_date(tmp_path: Path, bundling: Bundling, change: str):
    run = write_run(tmp_path / "run")
    with show(run, print, port=0):
        pass
    if change == "chunks":
        (run / "nested/increments/index.json").write_text('{"chunks": [{"sha256": "aa"}]}')
    elif change in ("promises", "fidelity", "plan"):
        time.sleep(0.02)
        (run / f"nested/{change}.json").write_text("{ }")
    else:
        (run / "bundle/manifest.json").write_text('{"format": "sagesplat-bundle", "labels": [1]}')
    for _ in range(2):
        with show(run, print, port=0):
            pass
        assert bundling.made == 2


def test_training_is_followed_to_its_end(tmp_path: Path, bundling: Bundling):
    run, events = write_run(tmp_path / "run", chunks=False), []
    view = show(run, events.append, port=0, follow=True)
    with viewing(view) as port:
        status, headers, body = ask(port, "/")
        assert (status, headers["refresh"], b"Nothing has been trained yet" in body) == (503, "2", True)
        assert ask(port, "/manifest.json")[0] == 503

        for live in (b'{"live": 1}', b'{"live": 2}'):
            bundling.live = live
            wait_for(lambda live=live: ask(port, "/manifest.json")[2] == live)
        tag = ask(port, "/manifest.json")[1]["etag"]
        assert ask(port, "/manifest.json", if_none_match=tag)[0] == 304

        write_bundle(run / "levels", {"000100.npz": b""})
        bundling.trouble = "a level that is being written"
        wait_for(lambda: len(events) > 0)
        time.sleep(0.2)
        assert [event.text for event in events] == ["a level that is being written"]  # said once
        assert ask(port, "/manifest.json")[2] == b'{"live": 2}'

        write_run(run)
        wait_for(lambda: b'"live": false' in ask(port, "/manifest.json", if_none_match=tag)[2])
        assert ask(port, "/")[2].startswith(b"one")
        assert bundling.made == 1


PAGE = b"""<!doctype html><title>page</title><link rel=stylesheet href=assets/look-1a2b3c4d.css>
<script type=module src=assets/page.js></script><script>window.inline = true</script>"""
SCRIPT = b"""
const found = {}
const fetched = async (url) => { try { await (await fetch(url)).text(); return true } catch { return false } }
found.own = await fetched("manifest.json")
found.data = await fetched("data:,a")
found.foreign = await fetched(`http://localhost:${+location.port}/manifest.json`)
await WebAssembly.compile(new Uint8Array([0, 97, 115, 109, 1, 0, 0, 0])).then(() => { found.wasm = true })
const worker = new Worker(URL.createObjectURL(new Blob(["postMessage(self.crossOriginIsolated)"])))
found.worker = await new Promise((done) => { worker.onmessage = (event) => done(event.data) })
found.inline = window.inline === true
found.isolated = crossOriginIsolated
found.subtle = !!crypto.subtle
found.webgl = !!document.createElement("canvas").getContext("webgl2")
found.xr = document.featurePolicy?.allowsFeature("xr-spatial-tracking")
window.found = found
"""


@pytest.mark.skipif(browser.missing() is not None, reason=str(browser.missing()))
def test_a_browser_lets_the_viewer_do_what_it_needs_and_no_more(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    folder = write_bundle(tmp_path, {**FILES, "index.html": PAGE, "assets/page.js": SCRIPT})
    monkeypatch.setattr(site, "package_viewer", lambda: folder)
    with (
        viewing(show(folder, print, port=0)) as port,
        browser.open_page(f"http://127.0.0.1:{port}/") as opened,
    ):
        found = opened.wait_for("window.found")
    blocked = {"foreign": False, "inline": False}
    allowed = ("own", "data", "wasm", "worker", "isolated", "subtle", "webgl", "xr")
    assert found == blocked | dict.fromkeys(allowed, True)
    for directive in ("script-src", "connect-src"):
        assert any(directive in text for text in opened.violations)
    assert opened.errors == []


@pytest.mark.parametrize("tls", [False, True])
def test_honest_clients_finish_among_idle_and_slow_ones(tls: bool):
    """`python -m benchmarks server` in small."""
    if sys.platform != "linux" or not shutil.which("openssl"):
        pytest.skip("needs /proc and openssl")
    found = measure(60, 60, 10, tls, files=2)
    assert found["finished"] == 10
    assert found["server_rss_mb"] < 150
    assert found["terminal_lines"] == 3
