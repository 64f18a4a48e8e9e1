"""`sagesplat view`: a bundle, or a run's bundle, in the browser of this machine or of a headset."""

import errno
import os
import socket
import ssl
import sys
import threading
import webbrowser
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sagesplat.errors import BackendUnavailable, RunError, SageError
from sagesplat.events import Emit, Warned
from sagesplat.files import read_json
from sagesplat.run_dir import FORMAT, RunDir

if TYPE_CHECKING:
    import uvicorn

    from sagesplat.http_files import Site
    from sagesplat.job import Job

MANIFEST = "manifest.json"
PORT = 8000
_TRIED = 100  # ports from PORT on, where none is asked for
_EVERY = 2.0  # seconds between two looks at a training
_NO_SERVER = "showing a bundle needs starlette and uvicorn; pip install 'sagesplat[view]'"
_MAKE_IT = "make one by `sagesplat bundle RUN OUT`"
_NOTHING_YET = "Nothing has been trained yet."


@dataclass(frozen=True)
class View:
    """A server that holds its port and answers once it runs; a context manager that gives the port back."""

    urls: tuple[str, ...]
    hint: str  # what a headset needs
    _server: "uvicorn.Server"
    _listener: socket.socket
    _keep: Callable[[threading.Event], None] | None  # the site up to date

    def run(self, browser: bool = True) -> None:
        """Serve until Ctrl-C or `stop`, quietly; opens the browser where there is a display."""
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


def view(
    path: Path,
    emit: Emit,
    *,
    port: int | None = None,
    host: str | None = None,
    ssl_certfile: Path | None = None,
    ssl_keyfile: Path | None = None,
    follow: bool = False,
) -> View:
    """A server for a bundle, or for a run folder, whose bundle is made if it is missing or out of date.

    Without a host only this machine gets in, under its own names; without a port the first free one from
    8000 on is taken. With `follow` the run's training is shown as it goes on, then its bundle. SageError: a
    folder that is neither, a run that is not ready, a port or certificate of no use, no extra `view`.
    """
    try:
        from sagesplat import http_files
    except ImportError:
        raise BackendUnavailable(_NO_SERVER) from None
    _check_certificate(ssl_certfile, ssl_keyfile)
    site = http_files.Site(local=host is None)
    listener = bind(host or "127.0.0.1", port)  # first: making a bundle takes its time
    try:
        keep = _fill(site, path, emit, follow)
    except BaseException:
        listener.close()
        raise
    server = http_files.make_server(site, ssl_certfile, ssl_keyfile)
    secure = ssl_certfile is not None
    urls = _urls(listener, secure)
    return View(urls, _hint(urls, secure, host), server, listener, keep)


def _fill(site: "Site", path: Path, emit: Emit, follow: bool) -> Callable[[threading.Event], None] | None:
    """Put what is at `path` into a site; returns what keeps it up to date, if anything does."""
    if is_bundle(path):
        if follow:
            raise RunError(f"{path}: a bundle does not change; leave out --follow, or give the run folder")
        site.folder = path
        return None
    job = _open_run(path, emit)
    if not follow:
        site.folder = run_bundle(job)
        return None
    site.note = _NOTHING_YET
    return lambda stop: _follow(job, site, stop)


def is_bundle(path: Path) -> bool:
    """Whether a folder is a bundle that can be shown; RunError for one that cannot, or for no folder."""
    if not path.is_dir():
        raise RunError(f"{path}: no such folder")
    if not (path / MANIFEST).exists():
        return False
    manifest = read_json(path / MANIFEST)
    if not isinstance(manifest, dict) or manifest.get("format") != "sagesplat-bundle":
        raise RunError(f"{path / MANIFEST}: not of a sagesplat bundle; {_MAKE_IT}")
    if not (path / "index.html").exists():
        raise RunError(f"{path}: a bundle without a viewer (no index.html); {_MAKE_IT}")
    return True


def run_bundle(job: "Job") -> Path:
    """The bundle of a finished run, made unless it is there and of what the run holds now."""
    from sagesplat.bundling import bundle

    folder = job.run.path / "bundle"
    if not _is_finished(job.run):
        raise RunError(
            f"{job.run.path}: not finished; do `sagesplat run`, or add --follow to see its training"
        )
    if not _is_current(job.run, folder):
        bundle(job, folder)
    return folder


def bind(host: str, port: int | None) -> socket.socket:
    """A socket on a port (0: any), or on the first free one from 8000 on; RunError where that cannot be."""
    if port is not None and not 0 <= port < 2**16:
        raise RunError(f"--port {port} is impossible; choose 1024 to 65535")
    ports = range(PORT, PORT + _TRIED) if port is None else [port]
    for number in ports:
        listener = None
        try:
            family, *_, address = socket.getaddrinfo(host, number, type=socket.SOCK_STREAM)[0]
            listener = socket.socket(family, socket.SOCK_STREAM)
            if os.name == "posix":  # elsewhere it would share a port in use
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


def has_display() -> bool:
    """Whether a browser window can open here."""
    if sys.platform in ("win32", "darwin"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def _open_run(path: Path, emit: Emit) -> "Job":
    """The run in a folder; RunError for a folder that is none, or of another format."""
    from sagesplat.job import Job

    run = RunDir(path)
    if not run.scene.exists():
        raise RunError(f"{path}: neither a bundle (no {MANIFEST}) nor a run folder (no scene.json)")
    made = read_json(run.provenance("scene")) if run.provenance("scene").exists() else {}
    found = made.get("format") if isinstance(made, dict) else None
    if found != FORMAT:
        raise RunError(f"{path}: a run folder of format {found}, this sagesplat reads {FORMAT}")
    return Job(run, emit)


def _is_finished(run: RunDir) -> bool:
    return run.promises.exists() and (run.chunks / "index.json").exists()


def _is_current(run: RunDir, folder: Path) -> bool:
    """Whether a bundle has the run's chunks, promises no older than the run's, and this package's viewer."""
    from sagesplat.bundling import package_viewer
    from sagesplat.output.bundle import has_viewer

    if not (folder / MANIFEST).exists():
        return False
    manifest: Any = read_json(folder / MANIFEST)
    try:
        held = {level["sha256"] for label in manifest["labels"] for level in label["levels"]}
    except (KeyError, TypeError):
        return False
    chunks = {chunk["sha256"] for chunk in read_json(run.chunks / "index.json")["chunks"]}
    older = (folder / MANIFEST).stat().st_mtime < run.promises.stat().st_mtime
    return held == chunks and not older and has_viewer(folder, package_viewer())


def _follow(job: "Job", site: "Site", stop: threading.Event) -> None:
    """Keep a site at the newest of a run, until its bundle is there."""
    told = ""
    while not stop.is_set():
        try:
            if _refresh(job, site):
                return
        except (SageError, OSError, ValueError) as error:  # of a moment, most often: training goes on
            if str(error) != told and any(job.run.levels.glob("*.npz")):
                told = site.note = str(error)
                job.emit(Warned(told))
        stop.wait(_EVERY)


def _refresh(job: "Job", site: "Site") -> bool:
    """Show the newest snapshot, or the bundle of a run that is finished: True for that."""
    from sagesplat.bundling import live_bundle

    if _is_finished(job.run):
        site.folder = run_bundle(replace(job))  # nothing remembered of a training that went on since
        return True
    folder = job.run.path / "bundle-live"
    live_bundle(job, folder)
    if (folder / MANIFEST).exists():
        site.folder = folder
    return False


def _check_certificate(certificate: Path | None, key: Path | None) -> None:
    if certificate is None and key is None:
        return
    if certificate is None:
        raise RunError(f"{key}: a key without its certificate; add --ssl-certfile")
    for path in filter(None, (certificate, key)):
        if not path.is_file():
            raise RunError(f"{path}: no such file; give a certificate and its key in PEM")
    try:
        # a password would be asked for on the terminal otherwise
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(certificate, key, password=lambda: "")
    except (ssl.SSLError, OSError, ValueError) as error:
        why = getattr(error, "reason", None) or error
        raise RunError(f"{certificate}: no certificate with its key (PEM, no password): {why}") from None


def _urls(listener: socket.socket, secure: bool) -> tuple[str, ...]:
    """Where a bound socket is found: the first for this machine."""
    host, port = listener.getsockname()[:2]
    hosts = [f"[{host}]" if ":" in host else host]
    if host in ("0.0.0.0", "::"):
        hosts = ["localhost", *filter(None, [_network_address()])]
    return tuple(f"http{'s' * secure}://{name}:{port}/" for name in hosts)


def _network_address() -> str | None:
    """This machine's address in its network. Nothing is sent: a datagram socket only looks up the route."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))
            return probe.getsockname()[0]
        except OSError:
            return None


def _hint(urls: tuple[str, ...], secure: bool, host: str | None) -> str:
    """One line: how a headset gets there, as browsers offer XR on localhost and https only."""
    if secure and host is not None:
        return f"headset: open {urls[-1]} there and accept the certificate"
    port = urls[0].rstrip("/").rpartition(":")[2]
    local = f"http{'s' * secure}://localhost:{port}/"
    cable = f"by cable `adb reverse tcp:{port} tcp:{port}`, then open {local} there"
    return f"headset: {cable}; by network --host 0.0.0.0 with --ssl-certfile and --ssl-keyfile"
