"""What the viewer's site answers and what it refuses."""

import gzip
import shutil
import socket
from collections.abc import Iterator
from pathlib import Path

import browser
import pytest

pytest.importorskip("starlette", reason="needs the extra `view`")
pytest.importorskip("uvicorn", reason="needs the extra `view`")
from test_viewer_server import ask, running, viewing, write_files

from sagesplat.stages.view import show
from sagesplat.viewer import site
from sagesplat.viewer.hosts import Hosts

CHUNK, STREAM = "chunks/grass-01-0123456789ab.spz", "chunks/grass-0123456789ab.sgst"
VIEWER = {
    "index.html": (b"<!doctype html><title>viewer</title>" + b"<p>text" * 500, "text/html; charset=utf-8"),
    "assets/index-CmV_C-3Q.js": (b"export const a = 1\n" * 300, "text/javascript; charset=utf-8"),
    "assets/look-1a2b3c4d.css": (b"a{}", "text/css; charset=utf-8"),
    "assets/icon-1a2b3c4d.svg": (b"<svg/>", "image/svg+xml"),
    "assets/sort-1a2b3c4d.wasm": (b"\0asm", "application/wasm"),
}
DATA = {
    "manifest.json": (b'{"format": "sagesplat-bundle", "labels": []}', "application/json"),
    "promises-0123456789ab.json": (b"[" + b"0.5," * 900 + b"1]", "application/json"),
    "scene-0123456789ab.pack": (bytes(1000), "application/octet-stream"),
    CHUNK: (bytes(range(256)) * 1000, "application/octet-stream"),
    STREAM: (b"SGST" + bytes(range(100)), "application/octet-stream"),
}
FILES = {name: content for name, (content, _) in {**VIEWER, **DATA}.items()}


@pytest.fixture(scope="module")
def bundle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bundle from a stranger, with ways out of its folder."""
    folder = write_files(
        tmp_path_factory.mktemp("served") / "bundle", {name: content for name, (content, _) in DATA.items()}
    )
    secret = folder.parent / "secret.txt"
    write_files(folder.parent, {"secret.txt": b"secret", "bundle-other/secret.txt": b"secret"})
    write_files(folder, {".hidden": b"secret", ".hidden.json": b"secret", "chunks/.a/b.json": b"secret"})
    (folder / "chunks" / "leads-out.spz").symlink_to(secret)
    (folder / "out").symlink_to(folder.parent)
    (folder / "circle.spz").symlink_to(folder / "circle.spz")
    (folder / "inside.spz").symlink_to(folder / CHUNK)
    return folder


@pytest.fixture(scope="module")
def viewer(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A built viewer."""
    return write_files(
        tmp_path_factory.mktemp("viewer"), {name: content for name, (content, _) in VIEWER.items()}
    )


@pytest.fixture(scope="module")
def port(bundle: Path, viewer: Path) -> Iterator[int]:
    with running(site.Site(bundle, viewer=viewer)) as port:
        yield port


def test_files_come_whole_with_their_media_type_and_the_headers_that_protect(port: int):
    for name, (content, kind) in {**VIEWER, **DATA, "": VIEWER["index.html"]}.items():
        status, headers, body = ask(port, "/" + name)
        assert (status, body, headers["content-type"]) == (200, content, kind)
        assert int(headers["content-length"]) == len(body)
        assert not {"content-encoding", "server"} & set(headers)
        assert {name: headers[name] for name in site.HEADERS} == site.HEADERS
        hashed = name.startswith(("chunks/", "assets/", "promises-", "scene-"))
        kept = "public, max-age=31536000, immutable" if hashed else "no-cache"
        assert headers["cache-control"] == kept
        assert ask(port, "/" + name, "HEAD")[::2] == (200, b"")
    policy = dict(part.split(" ", 1) for part in site.HEADERS["content-security-policy"].split("; "))
    assert (policy["default-src"], policy["script-src"]) == ("'none'", "'self' 'wasm-unsafe-eval'")


def test_refusals_have_the_headers_that_protect(port: int):
    for target, method, headers, status in (
        ("/nothing", "GET", {}, 404),
        ("/chunks/nothing-01-0123456789ab.spz", "GET", {}, 404),
        ("/", "GET", {"host": "evil.example"}, 403),
        ("/index.html", "POST", {}, 405),
        ("/manifest.json", "PUT", {}, 405),
        ("/index.html", "OPTIONS", {}, 405),
        ("/" + CHUNK, "GET", {"range": "bytes=256000-"}, 416),
    ):
        got, found, _ = ask(port, target, method, **headers)
        assert got == status
        assert {name: found[name] for name in site.HEADERS} == site.HEADERS
        assert status == 416 or found["cache-control"] == "no-cache"


def test_an_etag_saves_the_second_download(port: int):
    for encoding in ("identity", "gzip"):
        _, headers, _ = ask(port, "/index.html", accept_encoding=encoding)
        status, again, body = ask(
            port, "/index.html", accept_encoding=encoding, if_none_match=headers["etag"]
        )
        assert (status, body, again["etag"]) == (304, b"", headers["etag"])
        assert again["content-security-policy"] == site.HEADERS["content-security-policy"]
        assert ask(port, "/index.html", accept_encoding=encoding, if_none_match='"other"')[0] == 200


def test_text_is_gzipped_and_chunks_are_not(port: int):
    for name, (content, kind) in {**VIEWER, **DATA}.items():
        status, headers, body = ask(port, "/" + name, accept_encoding="br, gzip;q=0.8")
        assert status == 200
        if kind == "application/octet-stream":
            assert (body, headers.get("content-encoding")) == (content, None)
            assert int(headers["content-length"]) == len(content)
        elif len(content) > 1000:
            assert (gzip.decompress(body), headers["content-encoding"]) == (content, "gzip")
            assert "accept-encoding" in headers["vary"].lower()


def test_ranges(port: int):
    content = FILES[CHUNK]
    for asked, low, high in (("5-9", 5, 10), ("255990-", 255990, 256000), ("-7", 255993, 256000)):
        status, headers, body = ask(port, "/" + CHUNK, range=f"bytes={asked}", accept_encoding="gzip")
        assert (status, body) == (206, content[low:high])
        assert headers["content-range"] == f"bytes {low}-{high - 1}/256000"
        assert headers["cache-control"].endswith("immutable")
    assert ask(port, "/" + STREAM, range="bytes=44-59")[::2] == (206, FILES[STREAM][44:60])
    html = ask(port, "/index.html", range="bytes=0-3", accept_encoding="gzip")
    assert html[::2] == (206, FILES["index.html"][:4])
    status, headers, body = ask(port, "/" + CHUNK, range="bytes=0-3,10-12")
    boundary = headers["content-type"].partition("multipart/byteranges; boundary=")[2].encode()
    parts = [part.partition(b"\r\n\r\n")[2] for part in body.split(b"--" + boundary)[1:3]]
    assert [part.removesuffix(b"\r\n") for part in parts] == [content[:4], content[10:13]]
    assert ask(port, "/" + CHUNK, range="bytes=0-3", if_range='"other"')[2] == content
    assert ask(port, "/" + CHUNK, range="bytes=256000-")[1]["content-range"] == "bytes */256000"


ESCAPES = [
    "/../secret.txt", "/chunks/../../secret.txt", "/%2e%2e/secret.txt", "/%2E%2E%2Fsecret.txt",
    "/..%2fsecret.txt", "/%252e%252e/secret.txt", "/..\\secret.txt", "/..%5csecret.txt", "//etc/passwd",
    "/%c0%ae%c0%ae/secret.txt", "/....//secret.txt", "/..;/secret.txt", "/../bundle-other/secret.txt",
    "//secret.txt", "/%2fetc/passwd", "/file:///etc/passwd", "/C:/Windows/win.ini", "/index.html%00.json",
    "/index.html%0a", "/index.html::$DATA", "/.hidden", "/.hidden.json", "/chunks/.a/b.json", "/chunks",
    "/chunks/", "/chunks/leads-out.spz", "/out/secret.txt", "/out/bundle-other/secret.txt", "/circle.spz",
    "/%ff%fe", "?/../secret.txt", "http://127.0.0.1/../secret.txt", "/" + "a" * 5000, "/" + "a/" * 3000,
]  # fmt: skip


@pytest.mark.parametrize("target", ESCAPES)
def test_no_path_leads_out(port: int, target: str):
    status, _, body = ask(port, target)
    assert status == 404
    assert b"secret" not in body
    assert b"root:" not in body


def test_a_link_that_stays_inside_is_followed(port: int):
    assert ask(port, "/inside.spz")[2] == FILES[CHUNK]


def test_names_that_are_answered(port: int, monkeypatch: pytest.MonkeyPatch):
    for host in ("localhost", "LOCALHOST:80", "127.0.0.1:8000", "[::1]:8000", "a.localhost."):
        assert ask(port, "/", host=host)[0] == 200
    foreign = ("evil.example", "localhost.evil.example", "127.0.0.1.nip.io", "", "[::1", "::1x", "a@b")
    for host in (*foreign, "192.168.1.7:8000"):
        status, _, body = ask(port, "/manifest.json", host=host)
        assert (status, b"--host" in body) == (403, True)

    monkeypatch.setattr(socket, "gethostname", lambda: "Desk.lan")
    own = ("192.168.1.7:8000", "[2001:db8::1]:8000", "desk.lan", "desk.local:8000")
    everybody, one = Hosts("0.0.0.0"), Hosts("splats.example")
    for names in (everybody, one):
        assert [name for name in (*own, "localhost", *foreign) if name in names] == [*own, "localhost"]
    assert ("splats.example:80" in one, "splats.example" in everybody) == (True, False)
    assert "evil.example" in Hosts("0.0.0.0", certificate=True)  # its name is in the certificate
    for listening in ("127.0.0.1", "localhost", "::1", "127.8.9.1"):
        assert [name for name in (*own, *foreign) if name in Hosts(listening, certificate=True)] == []


def test_of_a_bundle_nothing_that_acts_is_served(bundle: Path, tmp_path: Path):
    folder = Path(shutil.copytree(bundle, tmp_path / "bundle", symlinks=True))
    endings = ("", ".html", ".js", ".mjs", ".svg", ".wasm", ".xhtml", ".css", ".xml", ".pdf")
    acts = [f"evil{ending}" for ending in endings]
    acts += ["chunks/evil.html", "assets/index-CmV_C-3Q.mjs", "evil.webmanifest", "assets/a-12345678.js"]
    write_files(folder, dict.fromkeys([*acts, "index.html"], b"evil"))
    write_files(folder, dict.fromkeys(["manifest.json.txt", "chunks/page.JSON"], b"<script>1</script>"))
    with viewing(show(folder, print, port=0)) as port:
        assert {ask(port, "/" + name)[0] for name in acts} == {404}
        assert b"evil" not in ask(port, "/")[2]
        kinds = [ask(port, name)[1]["content-type"] for name in ("/manifest.json.txt", "/chunks/page.JSON")]
        assert kinds == ["text/plain; charset=utf-8", "application/json"]


def test_the_page_shows_the_bundle_s_poster(tmp_path: Path):
    page = b"<!doctype html><body><!-- poster --></body>"
    own = write_files(tmp_path / "viewer", {"index.html": page})
    with running(site.Site(tmp_path, viewer=own)) as port:
        assert ask(port, "/")[2] == page
        (tmp_path / "poster.jpg").write_bytes(b"jpeg")
        status, headers, body = ask(port, "/")
        assert (status, b'src="poster.jpg"' in body, headers["cache-control"]) == (200, True, "no-cache")
        assert ask(port, "/poster.jpg")[1]["content-type"] == "image/jpeg"


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


@pytest.mark.slow
@pytest.mark.skipif(browser.missing() is not None, reason=str(browser.missing()))
def test_a_browser_lets_the_viewer_do_what_it_needs_and_no_more(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    folder = write_files(tmp_path, {**FILES, "index.html": PAGE, "assets/page.js": SCRIPT})
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
