"""Shows a bundle, or makes one from a run and shows it, in a browser here or in a headset."""

import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sagesplat.core.errors import BackendUnavailable, RunError, SageError
from sagesplat.core.events import Emit, Noted, Warned
from sagesplat.core.extras import install
from sagesplat.core.names import visible
from sagesplat.formats.label_edits import FILE
from sagesplat.io.files import read_json
from sagesplat.io.lock import FILE as LOCK
from sagesplat.io.typed import known_json
from sagesplat.run.records import check_format
from sagesplat.run.run_dir import RunDir, check_links, how_to_begin
from sagesplat.viewer.built import check_viewer, package_viewer
from sagesplat.viewer.hosts import Hosts, is_loopback
from sagesplat.viewer.server import (
    MANIFEST,
    View,
    bind,
    check_certificate,
    connection_hint,
    make_server,
    urls_of,
)

if TYPE_CHECKING:
    from sagesplat.run.job import Job
    from sagesplat.viewer.site import Site

_EVERY = 2.0  # seconds between two looks at a training
_MAKE_IT = "make one by `sagesplat bundle RUN OUT`"
_NOTHING_YET = "Nothing has been trained yet."


def show(
    path: Path,
    emit: Emit,
    *,
    port: int | None = None,
    host: str | None = None,
    ssl_certfile: Path | None = None,
    ssl_keyfile: Path | None = None,
    follow: bool = False,
    edit: bool = False,
) -> View:
    """A server for a bundle, or for a run folder, whose bundle is made if it is missing or out of date.

    The viewer is this package's; of a bundle only the data is served. Without a host only this machine gets
    in; without a port the first free one from 8000 on is taken. With `follow` the run's training is shown as
    it goes on, then its bundle. With `edit` the page can write RUN/labels.edit.json: only this machine's, and
    by the token in the address. SageError: a folder that is neither, a run that is not ready, a port or
    certificate of no use, no extra `view`, no built viewer.
    """
    try:
        import uvicorn  # noqa: F401

        from sagesplat.viewer.edit_endpoint import EditEndpoint
        from sagesplat.viewer.site import Site
    except ImportError:
        raise BackendUnavailable(
            f"showing a bundle needs starlette and uvicorn; {install('sagesplat[view]')}"
        ) from None
    check_certificate(ssl_certfile, ssl_keyfile)
    if edit:
        _check_edit(path, host, follow)
    check_viewer(package_viewer())
    editing = EditEndpoint(path / FILE, lambda: _ladder_of(site.folder)) if edit else None
    hosts = Hosts(host, certificate=ssl_certfile is not None)
    site = Site(hosts=hosts, routes=(editing.route,) if editing else ())
    listener = bind(host or "127.0.0.1", port)  # first: making a bundle takes its time
    try:
        keep = _fill(site, path, emit, follow)
    except BaseException:
        listener.close()
        raise
    server = make_server(site, ssl_certfile, ssl_keyfile)
    secure = ssl_certfile is not None
    urls = urls_of(listener, secure)
    if editing:
        urls = tuple(f"{url}#edit={editing.token}" for url in urls)
    return View(urls, connection_hint(urls, secure, host), server, listener, keep)


def _check_edit(path: Path, host: str | None, follow: bool) -> None:
    """RunError where labels cannot be edited."""
    if host is not None and not is_loopback(host):
        raise RunError(f"--host {host}: labels are edited on this machine only; leave out --host or --edit")
    if follow:
        raise RunError(f"{path}: labels are edited when training has ended; leave out --follow or --edit")
    if is_bundle(path):
        raise RunError(f"{path}: a bundle; give its run folder to --edit, or save the edits as a download")


def _ladder_of(folder: Path | None) -> str:
    """The hash of the levels that a bundle shows."""
    manifest: Any = read_json(folder / MANIFEST) if folder else None
    return str(manifest.get("ladder", "")) if isinstance(manifest, dict) else ""


def _fill(site: "Site", path: Path, emit: Emit, follow: bool) -> Callable[[threading.Event], None] | None:
    """Put what is at `path` into a site; returns what keeps it up to date, if anything does."""
    if follow and _begins(path):
        site.note = _NOTHING_YET
        emit(Noted(f"{path}: no run yet; it is shown once it has read its photos"))
        return lambda stop: _await(path, emit, site, stop)
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


def _begins(path: Path) -> bool:
    """Whether a run may be about to begin: its folder is not there yet, or locked before there is a scene."""
    if not path.exists():
        return path.absolute().parent.is_dir()
    return (path / LOCK).exists() and not RunDir(path).scene.exists() and not (path / MANIFEST).exists()


def is_bundle(path: Path) -> bool:
    """Whether a folder is a bundle that can be shown; RunError for one that cannot, or for no folder."""
    if not path.is_dir():
        cure = how_to_begin(path) if path.is_file() else "name a run folder or a bundle"
        raise RunError(f"{path}: no such folder; {cure}")
    if not (path / MANIFEST).exists():
        return False
    manifest = read_json(path / MANIFEST)
    if not isinstance(manifest, dict) or manifest.get("format") != "sagesplat-bundle":
        raise RunError(f"{path / MANIFEST}: not of a sagesplat bundle; {_MAKE_IT}")
    return True


def run_bundle(job: "Job") -> Path:
    """The bundle of a finished run, made unless it is there and of what the run holds now."""
    from sagesplat.stages.bundle import bundle

    folder = job.run.path / "bundle"
    if not is_finished(job.run):
        raise RunError(
            f"{job.run.path}: no finished nested levels; run `sagesplat run` again with --ladder nested, "
            "or add --follow"
        )
    if not _is_current(job.run, folder):
        bundle(job, folder)
    return folder


def _open_run(path: Path, emit: Emit) -> "Job":
    """The run in a folder; RunError for a folder that is none, or of another format."""
    from sagesplat.run.job import Job

    run = RunDir(path)
    if not run.scene.exists():
        cure = how_to_begin(path)
        raise RunError(f"{path}: neither a bundle (no {MANIFEST}) nor a run folder (no scene.json); {cure}")
    check_links(path)
    record = run.provenance("scene")
    made = read_json(record, "run `sagesplat run` with --force") if record.exists() else {}
    check_format(path, made if isinstance(made, dict) else {})
    return Job(run, emit)


def is_finished(run: RunDir) -> bool:
    """Whether a run has all that a bundle shows."""
    from sagesplat.stages.results import has_photos

    finished = all(path.exists() for path in (run.fidelity, run.increments / "index.json"))
    return finished and (run.promises.exists() or not has_photos(run))


@dataclass(frozen=True)
class _Chunk:
    uri: str


@dataclass(frozen=True)
class _Cell:
    levels: list[_Chunk]


@dataclass(frozen=True)
class _Label:
    cells: list[_Cell]


@dataclass(frozen=True)
class _Shown:
    """Of a manifest what says of which levels it is."""

    ladder: str
    labels: list[_Label]


@dataclass(frozen=True)
class _Chunks:
    chunks: list[_Chunk]


def _is_current(run: RunDir, folder: Path) -> bool:
    """Whether a bundle has the run's chunks, and promises and a target no older than the run's."""
    from sagesplat.formats.increments import INDEX

    if not (folder / MANIFEST).exists():
        return False
    manifest = known_json(folder / MANIFEST, _Shown)
    listed = known_json(run.increments / INDEX, _Chunks)
    if manifest is None or listed is None:  # `bundle` says what is wrong with the run
        return False
    held = {some.uri for label in manifest.labels for cell in label.cells for some in cell.levels}
    chunks = {f"chunks/{chunk.uri}" for chunk in listed.chunks}  # names of files hold their hashes
    made = (folder / MANIFEST).stat().st_mtime
    newer = (path for path in (run.fidelity, run.promises, run.plan) if path.exists())
    return held == chunks and all(path.stat().st_mtime <= made for path in newer)


def _await(path: Path, emit: Emit, site: "Site", stop: threading.Event) -> None:
    """Wait for a run's scene, then follow it."""
    while not RunDir(path).provenance("scene").exists():  # written after the scene
        if stop.wait(_EVERY):
            return
    try:
        job = _open_run(path, emit)
    except SageError as error:
        site.note = visible(str(error))
        emit(Warned(str(error)))
        return
    _follow(job, site, stop)


def _follow(job: "Job", site: "Site", stop: threading.Event) -> None:
    """Keep a site at the newest of a run, until its bundle is there."""
    told = ""
    while not stop.is_set():
        try:
            if _refresh(job, site):
                return
        except (SageError, OSError, ValueError) as error:  # of a moment, most often: training goes on
            if str(error) != told and any(job.run.levels.glob("*.npz")):
                told = str(error)
                site.note = visible(told)  # a page is UTF-8, and a path in an error need not be
                job.emit(Warned(told))
        stop.wait(_EVERY)


def _refresh(job: "Job", site: "Site") -> bool:
    """Show the newest level of a training, or the bundle of a run that is finished: True for that."""
    from sagesplat.stages.live_bundle import live_bundle

    if is_finished(job.run):
        site.folder = run_bundle(replace(job))  # nothing remembered of a training that went on since
        return True
    folder = job.run.path / "bundle-live"
    live_bundle(job, folder)
    if (folder / MANIFEST).exists():
        site.folder = folder
    return False
