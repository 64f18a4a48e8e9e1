"""Files written whole or not at all, and the cache's folder."""

import errno
import json
import math
import os
import shutil
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from sagesplat.core.errors import RunError, short

_FULL = {errno.ENOSPC: "the disk is full", errno.EDQUOT: "the quota is used up"}
_TEMPORARY = "tmp-"  # in the names of files that are not complete yet
_MB = 10**6


def cache_folder() -> Path:
    """$SAGESPLAT_CACHE, or $XDG_CACHE_HOME/sagesplat, or ~/.cache/sagesplat: what every run may share."""
    default = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "sagesplat"
    return Path(os.environ.get("SAGESPLAT_CACHE") or default)


@contextmanager
def atomic_path(path: Path, *, nbytes: int = 0, sync: bool = True) -> Iterator[Path]:
    """A temporary path beside `path` that takes its place when the block ends without an error.

    After a crash or a power cut `path` has its old content or all of the new one. `sync=False`: the promise
    holds for power cuts only after `sync_files`, which is cheaper for many small files. `nbytes`: expected
    size, for the message of a full disk. Raises RunError where the disk is full; nothing is left behind.
    """
    with named_full_disk(path, nbytes):
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(
            dir=path.parent, prefix=f".{path.stem}.{_TEMPORARY}", suffix=path.suffix
        )
        os.close(handle)
        temporary = Path(name)
        try:
            temporary.chmod(0o644)
            yield temporary
            if sync:
                sync_files([temporary])  # before the new name is there: some disks write names first
            temporary.replace(path)
            if sync:
                _sync_folder(path.parent)
        except OSError as error:
            if error.errno in _FULL:
                nbytes = max(nbytes, _size(path), _size(temporary) + _MB)
                temporary.unlink(missing_ok=True)
                raise _full(path, error, nbytes) from error
            raise
        finally:
            temporary.unlink(missing_ok=True)


@contextmanager
def named_full_disk(path: Path, nbytes: int = 0) -> Iterator[None]:
    """RunError in one line where the block, which writes `nbytes` to `path`, finds the disk full."""
    try:
        yield
    except OSError as error:
        if error.errno in _FULL:
            raise _full(path, error, nbytes) from error
        raise


def _full(path: Path, error: OSError, nbytes: int) -> RunError:
    free = 0
    with suppress(OSError):
        if error.errno == errno.ENOSPC:  # what a quota leaves is not asked for so easily
            free = shutil.disk_usage(path.parent).free
    megabytes = max(1, math.ceil((nbytes - free) / _MB))
    return RunError(
        f"{path}: no space left, {_FULL[error.errno or 0]}; free {megabytes:,} MB and run the same command "
        "again (nothing was lost)"
    )


def _size(path: Path) -> int:
    return path.stat().st_size if path.exists() else 0


def sync_files(paths: Iterable[Path]) -> None:
    """Wait until the content of files is on the disk. Their names take `sync_changed`, or `atomic_path`."""
    for path in paths:
        handle = os.open(path, os.O_RDWR if os.name == "nt" else os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def _sync_folder(path: Path) -> None:
    if os.name != "nt":  # which knows no such thing
        sync_files([path])


def sync_changed(folder: Path, since: float) -> None:
    """Wait until everything in a folder that changed since a time (seconds since 1970) is on the disk."""
    for root, _, names in os.walk(folder):
        changed = [path for path in (Path(root, n) for n in names) if _changed(path) >= since]
        sync_files(changed)
        if _changed(Path(root)) >= since:
            _sync_folder(Path(root))


def _changed(path: Path) -> float:
    """When a file was written, or got its name; never, where it is no file or folder any more."""
    try:
        found = path.stat()
    except FileNotFoundError:
        return 0.0
    return max(found.st_mtime, found.st_ctime) if path.is_file() or path.is_dir() else 0.0


def remove_temporary(folder: Path, but: str = "") -> None:
    """Remove what a killed process began to write below `folder`, where nobody else may be writing.

    `but`: leave alone folders of `folder` whose names begin with this, and what is to take their place.
    """
    for path in list(folder.rglob(f".*.{_TEMPORARY}*")):
        if but and path.relative_to(folder).parts[0].removeprefix(".").startswith(but):
            continue
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)


def link(path: Path, target: Path) -> None:
    """A hard link, which takes no room, or a copy where the file system has none."""
    target.parent.mkdir(parents=True, exist_ok=True)
    target.unlink(missing_ok=True)
    try:
        os.link(path, target)
    except OSError:
        with atomic_path(target) as temporary:
            shutil.copy2(path, temporary)


@contextmanager
def atomic_folder(path: Path) -> Iterator[Path]:
    """A new folder beside `path` that takes its place when the block ends without an error.

    Its files are on the disk then: they wait for it once, together. The earlier folder is removed only after
    that: where the block or the swap fails, it is at `path`; where the process is killed in the middle of the
    swap, it lies beside `path` and the next writer puts it back. One writer at a time. Raises RunError where
    the disk is full.
    """
    fresh, earlier = (path.with_name(f".{path.name}.{end}") for end in (f"{_TEMPORARY}new", "earlier"))
    with named_full_disk(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        if earlier.exists() and not path.exists():  # a writer was killed in the middle of the swap
            earlier.rename(path)
        for left in (fresh, earlier):
            shutil.rmtree(left, ignore_errors=True)
        try:
            fresh.mkdir()
            fresh.chmod(0o755)
            yield fresh
            sync_changed(fresh, 0)
            _swap(fresh, path, earlier)
        finally:
            shutil.rmtree(fresh, ignore_errors=True)


def _swap(fresh: Path, path: Path, earlier: Path) -> None:
    """Put `fresh` in the place of `path`, which is `earlier` meanwhile and comes back if that fails."""
    replaces = path.exists()
    if replaces:
        path.rename(earlier)
    try:
        fresh.rename(path)
    except BaseException:
        if replaces:
            earlier.rename(path)
        raise
    _sync_folder(path.parent)
    shutil.rmtree(earlier, ignore_errors=True)


def write_text(path: Path, text: str) -> None:
    """Replace a text file atomically."""
    content = text.encode()
    with atomic_path(path, nbytes=len(content)) as temporary:
        temporary.write_bytes(content)


def write_json(path: Path, value: Any) -> None:
    """Replace a JSON file atomically (keys in the order given)."""
    write_text(path, json.dumps(value, indent=1) + "\n")


def read_json(path: Path) -> Any:
    """A JSON file, or a RunError of one line. Memory: up to 64 bytes for each of the file's."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise RunError(f"{path}: no such file") from None
    except RecursionError:
        raise RunError(f"{path}: not readable as JSON (nested too deeply)") from None
    except (OSError, ValueError) as error:
        raise RunError(f"{path}: not readable as JSON ({short(error)})") from error
