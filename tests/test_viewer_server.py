"""The viewer's server: its port, its certificate, its end, and what it bears."""

import http.client
import shutil
import socket
import ssl
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from benchmarks.server import make_certificate, measure
from sagesplat.core.errors import RunError
from sagesplat.stages.view import show
from sagesplat.viewer import server
from sagesplat.viewer.server import connection_hint

pytest.importorskip("starlette", reason="needs the extra `view`")
pytest.importorskip("uvicorn", reason="needs the extra `view`")

MANIFEST = b'{"format": "sagesplat-bundle", "labels": []}'
Answer = tuple[int, dict[str, str], bytes]


def write_files(folder: Path, contents: dict[str, bytes]) -> Path:
    for name, content in contents.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    return folder


@contextmanager
def running(app: Any) -> Iterator[int]:
    """The port of a server for an application."""
    listener = server.bind("127.0.0.1", 0)
    urls = (f"http://127.0.0.1:{listener.getsockname()[1]}/",)
    with viewing(server.View(urls, "", server.make_server(app), listener, None)) as port:
        yield port


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
            thread.join(60)
            assert not thread.is_alive()


def ask(port: int, target: str, method: str = "GET", **headers: str) -> Answer:
    """One request; the target goes out as it is. Underscores of header names are dashes."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=60)
    try:
        connection.putrequest(method, target, skip_host="host" in headers, skip_accept_encoding=True)
        for name, value in headers.items():
            connection.putheader(name.replace("_", "-"), value)
        connection.endheaders()
        response = connection.getresponse()
        return response.status, {k.lower(): v for k, v in response.getheaders()}, response.read()
    finally:
        connection.close()


@pytest.fixture
def bundle(tmp_path: Path) -> Path:
    return write_files(tmp_path / "bundle", {"manifest.json": MANIFEST})


def test_without_a_host_only_this_machine_gets_in(bundle: Path):
    with show(bundle, print, port=0) as view:
        assert view._listener.getsockname()[0] == "127.0.0.1"
        assert view.urls[0].startswith("http://127.0.0.1:")
    with show(bundle, print, port=0, host="0.0.0.0") as view:
        assert view.urls[0].startswith("http://localhost:")
        assert "--ssl-certfile" in view.hint


def test_a_headset_is_told_the_port_alone():
    said = connection_hint(("http://localhost:8000/#edit=pKih",), secure=False, host=None)
    assert "`adb reverse tcp:8000 tcp:8000`, then open http://localhost:8000/ there" in said


def test_rubbish_is_refused_and_the_server_goes_on(bundle: Path):
    long = b"GET / HTTP/1.1\r\nHost: a\r\n" + b"x" * 70000
    with viewing(show(bundle, print, port=0)) as port:
        for rubbish in (b"\x16\x03\x01\x02\x00\x01", b"GET\r\n\r\n", long):
            with socket.create_connection(("127.0.0.1", port), timeout=60) as connection:
                connection.sendall(rubbish + b"\r\n\r\n")
                assert connection.recv(1000).startswith(b"HTTP/1.1 400")
        assert ask(port, "/manifest.json")[2] == MANIFEST


@pytest.mark.slow
@pytest.mark.parametrize("tls", [False, True])
def test_honest_clients_finish_among_idle_and_slow_ones(tls: bool):
    """`python -m benchmarks.server` in small."""
    if sys.platform != "linux" or not shutil.which("openssl"):
        pytest.skip("needs /proc and openssl")
    found = measure(60, 60, 10, tls, files=2)
    assert (found["finished"], found["terminal_lines"]) == (10, 3)


@pytest.mark.skipif(not shutil.which("openssl"), reason="needs openssl to make a certificate")
def test_a_certificate_makes_it_https(bundle: Path, tmp_path: Path):
    certificate, key = make_certificate(tmp_path)
    context = ssl.create_default_context(cafile=str(certificate))
    view = show(bundle, print, port=0, ssl_certfile=certificate, ssl_keyfile=key)
    assert view.urls[0].startswith("https://127.0.0.1:")
    with viewing(view) as port:
        connection = http.client.HTTPSConnection("localhost", port, context=context, timeout=60)
        connection.request("GET", "/manifest.json")
        assert connection.getresponse().read() == MANIFEST
        connection.close()
    with pytest.raises(RunError, match=r"cert.pem: no certificate with its key"):
        show(bundle, print, port=0, ssl_certfile=certificate)
    with pytest.raises(RunError, match=r"key.pem: a key without its certificate; add --ssl-certfile"):
        show(bundle, print, port=0, ssl_keyfile=key)
    with pytest.raises(RunError, match=r"none.pem: no such file"):
        show(bundle, print, port=0, ssl_certfile=tmp_path / "none.pem")


def test_ctrl_c_ends_it_quietly(bundle: Path):
    code = (
        "import http.client, signal, threading; from pathlib import Path\n"
        "from sagesplat.stages.view import show\n"
        "def stop():\n"
        "    connection = http.client.HTTPConnection(view.urls[0].split('/')[2])\n"
        "    connection.request('GET', '/')\n"
        "    connection.getresponse().read()\n"
        "    signal.raise_signal(signal.SIGINT)\n"
        f"view = show(Path({str(bundle)!r}), print, port=0)\n"
        "threading.Thread(target=stop).start()\n"
        "with view: view.run(browser=False)\n"
        "print('ended')"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("ended\n", "")


def test_ports(monkeypatch: pytest.MonkeyPatch):
    with server.bind("127.0.0.1", 0) as first:
        taken = first.getsockname()[1]
        with pytest.raises(
            RunError, match=f"^port {taken} is taken; choose another --port, or leave it out$"
        ):
            server.bind("127.0.0.1", taken)
        with server.bind("127.0.0.1", None) as one, server.bind("127.0.0.1", None) as two:
            assert 8000 <= one.getsockname()[1] < two.getsockname()[1] < 8100
        monkeypatch.setattr(server, "PORT", taken)
        monkeypatch.setattr(server, "_TRIED", 1)
        with pytest.raises(RunError, match=r"are all taken; choose another by --port$"):
            server.bind("127.0.0.1", None)
    for impossible in (-1, 70000):
        with pytest.raises(RunError, match=f"^--port {impossible} is impossible; choose 1024 to 65535$"):
            server.bind("127.0.0.1", impossible)
    for host in ("no-such-host.invalid", "192.0.2.1"):
        with pytest.raises(RunError, match=rf"^{host}:0: cannot listen \(.*\); change --host or --port$"):
            server.bind(host, 0)
