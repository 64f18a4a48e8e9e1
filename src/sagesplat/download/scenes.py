"""Downloads scenes of public data sets: only the needed members of the official archives."""

import re
import stat
import threading
import time
import tomllib
import zlib
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import FIRST_EXCEPTION, CancelledError, ThreadPoolExecutor, wait
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from zipfile import ZIP_DEFLATED, ZIP_STORED, ZipInfo

from sagesplat.core.errors import DataError, RunError
from sagesplat.download.remote_zip import Member, RemoteZip
from sagesplat.io.files import atomic_path

REGISTRY = Path(__file__).with_name("scenes.toml")
THREADS = 4
MAX_RATIO = 1000  # of size to compressed size; photos and models are far below
OnProgress = Callable[[str, int, int], None]  # name of a file, bytes done, all bytes of the scene


@dataclass(frozen=True)
class RemoteScene:
    """A scene inside a published zip archive."""

    name: str  # "collection/scene"
    url: str  # of the archive
    folder: str  # of the scene, inside the archive
    scales: tuple[int, ...]  # 1 = images/, N = images_N/
    scale: int  # the scale at which papers evaluate
    photos: int
    limit: int  # bytes; an upper limit for the files of one scale
    archive_gb: float | None  # size of the whole archive, 10^9 bytes; None = unknown
    page: str  # URL of the data set's own page
    licence: str  # one line


Registry = Mapping[str, RemoteScene]


def read_registry() -> dict[str, RemoteScene]:
    """The scenes of scenes.toml, which documents its format, by name."""
    scenes = {}
    for collection, shared in tomllib.loads(REGISTRY.read_text(encoding="utf-8")).items():
        for archive in shared["archives"]:
            for scene in archive["scenes"]:
                name = f"{collection}/{scene['name']}"
                scenes[name] = RemoteScene(
                    name,
                    archive["url"],
                    scene.get("folder", scene["name"]),
                    tuple(shared["scales"]),
                    scene["scale"],
                    scene["photos"],
                    int(shared["limit_gb"] * 10**9),
                    archive.get("gb"),
                    shared["page"],
                    shared["licence"],
                )
    return scenes


def find_scene(name: str, registry: Registry | None = None) -> RemoteScene:
    """The scene with this name, of the registry or of another one. DataError if there is none."""
    scenes = read_registry() if registry is None else registry
    if name not in scenes:
        raise DataError(f"{name}: no such scene; take one of {', '.join(scenes)}")
    return scenes[name]


def download_scene(
    name: str,
    folder: Path,
    *,
    scale: int | None = None,
    on_progress: OnProgress | None = None,
    registry: Registry | None = None,
    sleep: Callable[[float], None] = time.sleep,
) -> Path:
    """Download e.g. `mipnerf360/garden` to `folder`/garden: photos of one scale, and sparse/0; the folder.

    `scale` 1 downloads images/, N images_N/, for loading with downscale N (default: the scale at which papers
    evaluate). Only these members of the archive are transferred, by HTTP range requests. Their size and
    CRC-32 are checked. Complete files are kept, so that a second call resumes an interrupted one.
    `on_progress` is called from several threads, one at a time. Raises DataError for an unknown name or
    scale, a failing server (after three tries with pauses by `sleep`) and an unexpected archive. Raises
    RunError if `folder` cannot be written.
    """
    scene = find_scene(name, registry)
    scale = scene.scale if scale is None else scale
    if scale not in scene.scales:
        known = ", ".join(map(str, scene.scales))
        raise DataError(f"{name}: no photos at scale {scale}; take one of {known}")
    target = folder / name.rpartition("/")[2]
    archive = RemoteZip(scene.url, sleep)
    members = _choose(scene, scale, archive.members())
    _fetch_all(archive, {target / inside: member for inside, member in members.items()}, on_progress)
    return target


def _choose(scene: RemoteScene, scale: int, members: Iterable[Member]) -> dict[str, Member]:
    """The members with the photos of a scale and the sparse model, by path in the scene's folder; checked."""
    photos = "images/" if scale == 1 else f"images_{scale}/"
    chosen: dict[str, Member] = {}
    for member in members:
        name = member.info.filename
        inside = name.removeprefix(f"{scene.folder}/")
        is_model = inside.startswith("sparse/0/") and inside.endswith(".bin")
        if inside == name or member.info.is_dir() or not (is_model or inside.startswith(photos)):
            continue
        if inside in chosen:
            raise DataError(f"{scene.url}: holds {name!r} twice; nothing was unpacked")
        _check(scene.url, inside, member.info)
        chosen[inside] = member
    for part in photos, "sparse/0/":
        if not any(inside.startswith(part) for inside in chosen):
            raise DataError(f"{scene.url}: holds no {scene.folder}/{part}; take another scale or scene")
    total = sum(member.info.file_size for member in chosen.values())
    if total > scene.limit:
        raise DataError(
            f"{scene.url}: {scene.folder} takes {total / 1e9:.3g} GB where {scene.limit / 1e9:.3g} GB is the "
            "most that it can; nothing was unpacked"
        )
    return chosen


def _check(url: str, inside: str, info: ZipInfo) -> None:
    """DataError for a member that could write outside its folder or fill the disk."""
    kind = stat.S_IFMT(info.external_attr >> 16)
    parts = inside.split("/")
    if any(part in ("", ".", "..") for part in parts) or re.search(r"[\\:\x00-\x1f]", inside):
        reason = "its name leaves the folder"
    elif kind not in (0, stat.S_IFREG):
        reason = "a link or device, not a file"
    elif info.flag_bits & 1 or info.compress_type not in (ZIP_STORED, ZIP_DEFLATED):
        reason = "encrypted, or compressed in an unusual way"
    elif info.file_size > MAX_RATIO * info.compress_size:
        reason = f"{info.file_size} bytes from {info.compress_size}"
    else:
        return
    raise DataError(f"{url}: {info.filename!r} is refused ({reason}); nothing was unpacked")


def _fetch_all(archive: RemoteZip, members: Mapping[Path, Member], on_progress: OnProgress | None) -> None:
    """Download several members at a time. The first error stops the others after their current block."""
    total = sum(member.info.file_size for member in members.values())
    lock, stop, done = threading.Lock(), threading.Event(), 0

    def fetch(path: Path, member: Member) -> None:
        def count(size: int) -> None:
            nonlocal done
            if stop.is_set():
                raise CancelledError
            with lock:
                done += size
                if on_progress is not None:
                    on_progress(path.name, done, total)

        try:
            if _is_complete(path, member.info):
                count(member.info.file_size)
            else:
                with (
                    atomic_path(path) as temporary,
                    temporary.open("wb") as file,
                    closing(archive.content(member)) as blocks,
                ):
                    for block in blocks:
                        file.write(block)
                        count(len(block))
        except OSError as error:
            reason = error.strerror or error
            raise RunError(f"{path}: cannot be written ({reason}); name another folder") from error

    with ThreadPoolExecutor(THREADS) as pool:
        futures = [pool.submit(fetch, path, member) for path, member in members.items()]
        try:
            finished, _ = wait(futures, return_when=FIRST_EXCEPTION)
        finally:
            stop.set()
            pool.shutdown(cancel_futures=True)
    for future in futures:
        if future in finished:
            future.result()


def _is_complete(path: Path, info: ZipInfo) -> bool:
    if not path.is_file() or path.stat().st_size != info.file_size:
        return False
    crc = 0
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            crc = zlib.crc32(block, crc)
    return crc == info.CRC
