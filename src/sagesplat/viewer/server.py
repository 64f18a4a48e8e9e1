"""The server for bundles: port, TLS, and how a headset connects."""

import errno
import logging
import os
import socket
import ssl
import sys
import threading
import webbrowser
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from sagesplat.core.errors import RunError

if TYPE_CHECKING:
    import uvicorn
    from starlette.types import ASGIApp


MANIFEST = "manifest.json"
PORT = 8000
_TRIED = 100  # ports from PORT on, if none is given
_MOST = 2500  # connections; while there are more, requests get 503
# Seconds until an idle connection is closed. The end of an answer to a slow reader may be on its way so long.
_KEEP_ALIVE = 60


@dataclass(frozen=True)
class View:
    """A server with a bound port, which answers after `run`; a context manager that releases the port."""

    urls: tuple[str, ...]
    hint: str  # one line: how a headset connects
    _server: "uvicorn.Server"
    _listener: socket.socket
    _keep: Callable[[threading.Event], None] | None  # keeps the site up to date until the event

    def run(self, browser: bool = True) -> None:
        """Serve until Ctrl-C or `stop`; opens a browser if there is a display."""
        stop = threading.Event()
        if self._keep:
            threading.Thread(target=self._keep, args=(stop,), daemon=True).start()
        if browser and has_display():
            threading.Thread(target=webbrowser.open, args=(self.urls[0],), daemon=True).start()
        with suppress(KeyboardInterrupt):
            self._server.run([self._listener])
        stop.set()

    def stop(self) -> None:
        """End `run`, from any thread."""
        self._server.should_exit = True

    def __enter__(self) -> "View":
        return self

    def __exit__(self, *exception: object) -> None:
        self._listener.close()


def bind(host: str, port: int | None) -> socket.socket:
    """A listening socket on `port` (0: any free one; None: the first free one from 8000). Raises RunError."""
    if port is not None and not 0 <= port < 2**16:
        raise RunError(f"--port {port} is impossible; choose 1024 to 65535")
    ports = range(PORT, PORT + _TRIED) if port is None else [port]
    for number in ports:
        listener = None
        try:
            family, *_, address = socket.getaddrinfo(host, number, type=socket.SOCK_STREAM)[0]
            listener = socket.socket(family, socket.SOCK_STREAM)
            if os.name == "posix":  # on Windows it would share a port in use
                listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.bind(address)
            listener.listen(1024)
            return listener
        except OSError as error:
            if listener:
                listener.close()
            if error.errno != errno.EADDRINUSE:
                raise RunError(f"{host}:{number}: cannot listen ({error}); change --host or --port") from None
    if port is None:
        raise RunError(f"ports {ports[0]} to {ports[-1]} are all taken; choose another by --port")
    raise RunError(f"port {port} is taken; choose another --port, or leave it out")


def make_server(app: "ASGIApp", certificate: Path | None = None, key: Path | None = None) -> "uvicorn.Server":
    """A silent server for `app`, to be `run` on sockets; https with a certificate."""
    import uvicorn

    logging.getLogger("asyncio").setLevel(logging.CRITICAL)  # strangers can make connections fail at will
    config = uvicorn.Config(
        app, http="h11", ws="none", lifespan="off", log_config=None, log_level="critical", access_log=False,
        server_header=False, proxy_headers=False, limit_concurrency=_MOST, timeout_keep_alive=_KEEP_ALIVE,
        timeout_graceful_shutdown=1, ssl_certfile=certificate, ssl_keyfile=key,
    )  # fmt: skip
    return uvicorn.Server(config)


def has_display() -> bool:
    """Whether a browser window can open here."""
    if sys.platform in ("win32", "darwin"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def check_certificate(certificate: Path | None, key: Path | None) -> None:
    """RunError unless these are a certificate and its key, or neither is given."""
    if certificate is None and key is None:
        return
    if certificate is None:
        raise RunError(f"{key}: a key without its certificate; add --ssl-certfile")
    for path in filter(None, (certificate, key)):
        if not path.is_file():
            raise RunError(f"{path}: no such file; give a certificate and its key in PEM")
    try:
        # else OpenSSL would ask for a password on the terminal
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(certificate, key, password=lambda: "")
    except (ssl.SSLError, OSError, ValueError) as error:
        why = getattr(error, "reason", None) or error
        raise RunError(f"{certificate}: no certificate with its key (PEM, no password): {why}") from None


def urls_of(listener: socket.socket, secure: bool) -> tuple[str, ...]:
    """URLs of a bound socket; the first is for this machine."""
    host, port = listener.getsockname()[:2]
    hosts = [f"[{host}]" if ":" in host else host]
    if host in ("0.0.0.0", "::"):
        hosts = ["localhost", *filter(None, [_network_address()])]
    return tuple(f"http{'s' * secure}://{name}:{port}/" for name in hosts)


def _network_address() -> str | None:
    """This machine's network address. Nothing is sent: connecting a UDP socket only looks up the route."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))
            return probe.getsockname()[0]
        except OSError:
            return None


def connection_hint(urls: tuple[str, ...], secure: bool, host: str | None) -> str:
    """One line: how a headset connects. Browsers offer WebXR on localhost and https only."""
    if secure and host is not None:
        return f"headset: open {urls[-1]} there and accept the certificate"
    port = urlsplit(urls[0]).port
    local = f"http{'s' * secure}://localhost:{port}/"
    cable = f"by cable `adb reverse tcp:{port} tcp:{port}`, then open {local} there"
    return f"headset: {cable}; by network --host 0.0.0.0 with --ssl-certfile and --ssl-keyfile"
