"""Downloads of single scenes, from a server on this machine, out of archives with the published layout."""

import errno
import io
import re
import stat
import subprocess
import sys
import threading
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import cache
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest

from sagesplat.core.errors import DataError, RunError
from sagesplat.download import remote_zip
from sagesplat.download.remote_zip import RemoteZip
from sagesplat.download.scenes import RemoteScene, download_scene, find_scene, read_registry

NAME = "mipnerf360/garden"


@dataclass
class Site:
    """What the server gives, how it misbehaves, and what was asked of it."""

    archive: bytes = b""
    base: str = ""
    code: int = 0  # answer with this instead
    failures: int = 1 << 30  # so many times, then properly
    ranges: bool = True
    cut: int | None = None  # bytes; the connection ends after so many of the archive have been sent
    location: str = ""
    content_range: str = "bytes {first}-{last}/{size}"
    silent: bool = False  # until the test is over
    over: threading.Event = field(default_factory=threading.Event)
    served: int = 0
    asked: list[tuple[int, int]] = field(default_factory=list)
    lock: threading.Lock = field(default_factory=threading.Lock)

    @property
    def url(self) -> str:
        return f"{self.base}/360_v2.zip"

    def answer(self, request: BaseHTTPRequestHandler) -> None:
        if self.silent:
            self.over.wait()
        size, match = len(self.archive), re.fullmatch(r"bytes=(\d+)-(\d+)", request.headers["Range"] or "")
        with self.lock:
            failing, self.failures = bool(self.code) and self.failures > 0, self.failures - 1
        if self.location and not request.path.startswith("/moved"):
            request.send_response(302)
            request.send_header("Location", self.location)
            request.end_headers()
        elif failing:
            request.send_error(self.code)
        elif not self.ranges or match is None:
            request.send_response(200)
            request.send_header("Accept-Ranges", "none")
            request.send_header("Content-Length", str(size))
            request.end_headers()
        else:
            first, last = int(match[1]), min(int(match[2]), size - 1)
            content = self.archive[first : last + 1]
            request.send_response(206)
            request.send_header("Content-Range", self.content_range.format(first=first, last=last, size=size))
            request.send_header("Content-Length", str(len(content)))
            request.end_headers()
            with self.lock:
                self.asked.append((first, last))
                content = content if self.cut is None else content[: max(0, self.cut - self.served)]
                self.served += len(content)
            request.wfile.write(content)


class Server(ThreadingHTTPServer):
    def handle_error(self, request, client_address):
        pass  # a client that hangs up is part of the tests


@pytest.fixture
def site(monkeypatch) -> Iterator[Site]:
    monkeypatch.setenv("no_proxy", "*")
    site = Site(ARCHIVE)

    class Handler(BaseHTTPRequestHandler):
        def log_message(self, format, *args):
            pass

        def do_GET(self):
            site.answer(self)

    with Server(("127.0.0.1", 0), Handler) as server:
        site.base = f"http://127.0.0.1:{server.server_port}"
        thread = threading.Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        yield site
        site.over.set()
        server.shutdown()
        thread.join()


@cache
def layout() -> dict[str, bytes]:
    """Members as they are published: 12 photos in four sizes, beside scenes that nobody asks for."""
    rng, files = np.random.default_rng(0), {}
    for scene in "bicycle", "garden", "room":
        for scale in 1, 2, 4, 8:
            photos = "images" if scale == 1 else f"images_{scale}"
            for i in range(12):
                files[f"{scene}/{photos}/DSC{i:05d}.JPG"] = rng.bytes(90_000 // scale**2)
        for model in "cameras", "images", "points3D":
            files[f"{scene}/sparse/0/{model}.bin"] = rng.bytes(500) * 100  # deflates
        files[f"{scene}/poses_bounds.npy"] = rng.bytes(2000)
    return files


def archive(files: dict[str, bytes] | None = None, change: Callable | None = None) -> bytes:
    """A zip of `files`, after `change` of each member's ZipInfo; photos are stored, models deflated."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as file:
        for folder in "garden/", "garden/images_4/":
            file.writestr(zipfile.ZipInfo(folder), b"")
        for name, content in (layout() if files is None else files).items():
            info = zipfile.ZipInfo(name)
            info.compress_type = zipfile.ZIP_STORED if name.endswith("JPG") else zipfile.ZIP_DEFLATED
            file.writestr(info, content)
        for info in file.filelist:
            if change is not None and not info.is_dir():
                change(info)
    return buffer.getvalue()


ARCHIVE = archive()


def registry(site: Site, **fields) -> dict[str, RemoteScene]:
    return {NAME: replace(find_scene(NAME), **({"url": site.url, "limit": 10**7} | fields))}


def fetch(site: Site, folder: Path, **options) -> Path:
    options = {"registry": registry(site), "sleep": lambda seconds: None} | options
    return download_scene(NAME, folder, **options)


def contents(folder: Path) -> dict[str, bytes]:
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def expected(photos: str = "images_4") -> dict[str, bytes]:
    keep = f"garden/{photos}/", "garden/sparse/"
    return {name: content for name, content in layout().items() if name.startswith(keep)}


def assert_one_line(error: BaseException, *parts: str) -> None:
    line = str(error)
    assert "\n" not in line
    assert len(line) < 500
    for part in parts:
        assert part in line


def refused(site: Site, folder: Path, *parts: str, **options) -> None:
    """The download fails in one line with these parts, and leaves no file that is not what was published."""
    with pytest.raises(DataError) as caught:
        fetch(site, folder, **options)
    assert_one_line(caught.value, *parts)
    assert contents(folder).items() <= expected().items()  # no halves, no temporary files


def no_sleep(seconds: float) -> None:
    raise AssertionError("tried again")


def test_one_size_of_one_scene_is_fetched(site, tmp_path):
    assert fetch(site, tmp_path) == tmp_path / "garden"
    assert contents(tmp_path) == expected()
    assert oct((tmp_path / "garden/images_4/DSC00000.JPG").stat().st_mode & 0o777) == "0o644"


def test_little_but_the_needed_members_is_transferred(site, tmp_path, monkeypatch):
    monkeypatch.setattr(remote_zip, "TAIL", 20_000)  # of a 5 MB archive, as 1 MiB is of 12 GB
    fetch(site, tmp_path)
    with zipfile.ZipFile(io.BytesIO(site.archive)) as file:
        needed = sum(file.getinfo(name).compress_size for name in expected())
        headers = 100 * len(expected())
    assert needed < site.served < needed + headers + 20_001
    assert site.served < len(site.archive) / 20
    assert len(site.asked) == 2 + len(expected())


@pytest.mark.parametrize("tail", [1, 100])
def test_a_directory_that_is_larger_than_the_tail(site, tmp_path, monkeypatch, tail):
    monkeypatch.setattr(remote_zip, "TAIL", tail)
    fetch(site, tmp_path)
    assert contents(tmp_path) == expected()


def test_zip64_and_archives_behind_other_bytes(site, tmp_path, monkeypatch):
    monkeypatch.setattr(zipfile, "ZIP64_LIMIT", 1000)  # as if the archive had more than 4 GB
    site.archive = archive()
    assert b"PK\6\6" in site.archive[-200:]
    monkeypatch.undo()
    monkeypatch.setenv("no_proxy", "*")
    fetch(site, tmp_path / "zip64")
    site.archive = b"#!/bin/sh\n" + ARCHIVE
    fetch(site, tmp_path / "behind")
    assert contents(tmp_path / "zip64") == contents(tmp_path / "behind") == expected()


def test_finished_files_are_kept(site, tmp_path):
    fetch(site, tmp_path)
    before = {p: p.stat().st_mtime_ns for p in tmp_path.rglob("*.*")}
    damaged = tmp_path / "garden/images_4/DSC00003.JPG"
    damaged.write_bytes(bytes(damaged.stat().st_size))  # the right size
    (tmp_path / "garden/sparse/0/images.bin").write_bytes(b"short")
    (tmp_path / "garden/images_4/DSC00004.JPG").unlink()
    (tmp_path / "garden/masks").mkdir()
    (tmp_path / "garden/masks/own.png").write_bytes(b"own")
    site.asked.clear()
    fetch(site, tmp_path)
    assert len(site.asked) == 2 + 3
    assert contents(tmp_path) == expected() | {"garden/masks/own.png": b"own"}
    changed = {p.name for p, mtime in before.items() if p.stat().st_mtime_ns != mtime}
    assert changed == {"DSC00003.JPG", "DSC00004.JPG", "images.bin"}


def test_a_cut_download_goes_on(site, tmp_path, monkeypatch):
    monkeypatch.setattr(remote_zip, "TAIL", 20_000)
    pauses = []
    for cut in 100, 30_000, 60_000:
        site.cut, site.served = cut, 0
        parts = site.url, "bytes early", "run it again: finished files are kept"
        refused(site, tmp_path, *parts, sleep=pauses.append)
    assert set(pauses) == {1.0, 5.0}
    kept = len(contents(tmp_path))
    assert kept > 0
    site.cut = None
    site.asked.clear()
    fetch(site, tmp_path)
    assert contents(tmp_path) == expected()
    assert len(site.asked) == 2 + len(expected()) - kept


def test_passing_faults_are_tried_again(site, tmp_path):
    site.code, site.failures = 503, 2
    pauses = []
    fetch(site, tmp_path, sleep=pauses.append)
    assert contents(tmp_path) == expected()
    assert pauses == [1.0, 5.0]


def test_a_broken_connection_goes_on_where_it_was(site, monkeypatch):
    monkeypatch.setattr(remote_zip, "BLOCK", 1000)
    remote = RemoteZip(site.url, lambda seconds: setattr(site, "cut", None))
    member = next(m for m in remote.members() if m.info.filename == "garden/images/DSC00005.JPG")
    site.asked.clear()
    site.cut = site.served + 40_000
    assert b"".join(remote.content(member)) == layout()["garden/images/DSC00005.JPG"]
    (first, last), (second, end) = site.asked
    assert first == member.info.header_offset
    assert (second, end) == (first + 40_000, last)


@pytest.mark.parametrize(
    ("answers", "says"),
    [
        ({"code": 403}, "HTTP Error 403"),
        ({"ranges": False}, "no range requests"),
        ({"location": "/360_v2.zip"}, "302"),
        ({"location": "file:///etc/passwd"}, "302"),
        ({"content_range": "bytes 0-0/*"}, ""),
        ({"content_range": "bytes {first}-{last}/17"}, ""),
        ({"archive": b"<html>Please log in</html>"}, ""),
        ({"archive": b"PK\5\6" + bytes(18)}, ""),
    ],
)
def test_a_server_that_does_not_serve_the_archive_is_asked_once(site, tmp_path, answers, says):
    vars(site).update(answers)
    refused(site, tmp_path, site.url, says, sleep=no_sleep)
    assert contents(tmp_path) == {}


def test_a_server_that_does_not_answer(tmp_path, site, monkeypatch):
    monkeypatch.setattr(remote_zip, "TIMEOUT", 0.05)
    site.silent = True
    pauses = []
    refused(site, tmp_path, site.url, "cannot be downloaded", "timed out", sleep=pauses.append)
    assert pauses == [1.0, 5.0]


def test_an_archive_that_changes_on_the_way(site, tmp_path):
    def replaced(name: str, done: int, total: int) -> None:
        site.archive = ARCHIVE + b"longer"

    refused(site, tmp_path, site.url, "were asked for", on_progress=replaced)


def test_a_wrong_checksum_names_the_file(site, tmp_path):
    at = site.archive.index(layout()["garden/images_4/DSC00007.JPG"])
    site.archive = site.archive[: at + 50] + b"xxxx" + site.archive[at + 54 :]
    refused(site, tmp_path, site.url, "garden/images_4/DSC00007.JPG is damaged", "CRC")
    assert "garden/images_4/DSC00007.JPG" not in contents(tmp_path)


@pytest.mark.parametrize(
    "name",
    ["garden/images_4/../../../evil.JPG", "garden/images_4/..\\evil.JPG", "garden/images_4/C:evil.JPG"],
)
def test_hostile_names_are_refused(site, tmp_path, name):
    site.archive = archive(layout() | {name: b"evil"})
    refused(site, tmp_path / "below", site.url, repr(name), "is refused", "leaves the folder")
    assert contents(tmp_path) == {}


def test_names_outside_the_scene_are_never_touched(site, tmp_path):
    site.archive = archive(
        layout() | {"/etc/evil": b"", "../evil": b"", "gardens/images_4/evil.JPG": b"", "garden": b""}
    )
    fetch(site, tmp_path)
    assert contents(tmp_path) == expected()


def lone(**fields: int) -> Callable[[zipfile.ZipInfo], None]:
    """Changes one photo's entry in the directory."""

    def change(info: zipfile.ZipInfo) -> None:
        if info.filename == "garden/images_4/DSC00002.JPG":
            for key, value in fields.items():
                setattr(info, key, value)

    return change


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lone(external_attr=(stat.S_IFLNK | 0o777) << 16), "a link or device"),
        (lone(compress_type=zipfile.ZIP_LZMA), "compressed in an unusual way"),
        (lone(file_size=2 * 10**9), "2000000000 bytes from 5625"),
    ],
)
def test_hostile_members_are_refused(site, tmp_path, change, reason):
    site.archive = archive(change=change)
    refused(site, tmp_path, site.url, "DSC00002.JPG' is refused", reason)
    assert contents(tmp_path) == {}


@pytest.mark.parametrize("fields", [{"file_size": 100}, {"header_offset": 5}, {"CRC": 1}])
def test_a_directory_that_lies_about_a_member(site, tmp_path, fields):
    site.archive = archive(change=lone(**fields))
    refused(site, tmp_path, "is damaged")
    assert "garden/images_4/DSC00002.JPG" not in contents(tmp_path)


def test_a_bomb_writes_no_more_than_it_lists(site, monkeypatch):
    """A member that inflates to a thousand times what the directory says."""
    files = layout() | {"garden/sparse/0/points3D.bin": bytes(10**7)}

    def small(info: zipfile.ZipInfo) -> None:
        if info.filename == "garden/sparse/0/points3D.bin":
            info.file_size = 1000

    site.archive = archive(files, small)
    remote = RemoteZip(site.url)
    member = next(m for m in remote.members() if m.info.filename == "garden/sparse/0/points3D.bin")
    blocks = remote.content(member)
    assert next(blocks) == bytes(1001)
    with pytest.raises(DataError, match="1001 bytes"):
        next(blocks)


def test_a_full_disk(site, tmp_path, monkeypatch):
    opened = Path.open

    class Full(io.BytesIO):
        def write(self, content):
            raise OSError(errno.ENOSPC, "No space left on device")

    def full(path: Path, mode: str = "r", *args, **kwargs):
        space = mode != "wb" or "DSC00009" not in path.name
        return opened(path, mode, *args, **kwargs) if space else Full()

    with monkeypatch.context() as patch:
        patch.setattr(Path, "open", full)
        with pytest.raises(RunError) as caught:
            fetch(site, tmp_path)
    assert_one_line(caught.value, "DSC00009.JPG", "the disk is full", "nothing was lost")
    fetch(site, tmp_path)
    assert contents(tmp_path) == expected()


def test_the_registry():
    scenes = list(read_registry().values())
    assert [scene.name for scene in scenes] == list(read_registry())
    for scene in scenes:
        assert scene.url.startswith("https://")
        assert scene.scale in scene.scales
        assert 10**9 <= scene.limit <= 12 * 10**9
        assert "https://" in scene.licence


def test_a_kill_between_members(site, tmp_path):
    """The process ends without a word; what was finished stays."""
    code = f"""if True:
        import os
        from dataclasses import replace
        from pathlib import Path
        from sagesplat.download.scenes import download_scene, find_scene

        def stop(name, done, total):
            if done > total / 2:
                os._exit(7)

        scene = replace(find_scene({NAME!r}), url={site.url!r})
        download_scene({NAME!r}, Path({str(tmp_path)!r}), registry={{scene.name: scene}}, on_progress=stop)
    """
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 7
    left = {name: content for name, content in contents(tmp_path).items() if "/." not in name}
    assert left.items() <= expected().items()
    assert 2 < len(left) < len(expected())
    site.asked.clear()
    fetch(site, tmp_path)
    late = len(site.asked) - (2 + len(expected()) - len(left))
    assert 0 <= late <= 4  # what the killed one asked for last may be answered after all
    assert contents(tmp_path).items() >= expected().items()


def test_what_an_archive_may_hold(site, tmp_path):
    with pytest.raises(DataError, match=r"takes 0.00\d+ GB where 0.0001 GB is the most"):
        fetch(site, tmp_path, registry=registry(site, limit=10**5))
    with pytest.raises(DataError, match="holds no garden/images_16/"):
        fetch(site, tmp_path, scale=16, registry=registry(site, scales=(16,)))
    with pytest.raises(DataError, match="holds no garden2/images_4/"):
        fetch(site, tmp_path, registry=registry(site, folder="garden2"))
    site.archive = archive({k: v for k, v in layout().items() if "sparse" not in k})
    with pytest.raises(DataError, match="holds no garden/sparse/0/"):
        fetch(site, tmp_path)
    with pytest.warns(UserWarning, match="Duplicate name"):
        site.archive = twice()
    with pytest.raises(DataError, match="twice"):
        fetch(site, tmp_path)
    assert contents(tmp_path) == {}


def twice() -> bytes:
    buffer = io.BytesIO()
    buffer.write(ARCHIVE)
    with zipfile.ZipFile(buffer, "a") as file:
        file.writestr("garden/images_4/DSC00001.JPG", b"another")
    return buffer.getvalue()


def test_names_and_scales_that_there_are_not(site, tmp_path):
    with pytest.raises(DataError) as caught:
        download_scene("mipnerf360/gardem", tmp_path)
    assert_one_line(caught.value, "mipnerf360/gardem: no such scene", "mipnerf360/garden, ", "db/playroom")
    for scale in 0, 3, -4:
        with pytest.raises(DataError) as caught:
            fetch(site, tmp_path, scale=scale)
        assert_one_line(caught.value, f"{NAME}: no photos at scale {scale}; take one of 1, 2, 4, 8")
    assert site.asked == []
