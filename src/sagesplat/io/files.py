"""Atomic files and folders, JSON files, and the cache folder."""

import errno
import json
import math
import os
import shutil
import stat
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from sagesplat.core.errors import RunError, SageError, short
from sagesplat.io.lock import alone

_FULL = {errno.ENOSPC: "the disk is full", errno.EDQUOT: "the quota is used up"}
_LEFT = 2**16  # bytes; a disk with less is full, where an error has no number of its own
CURES = {
    errno.EROFS: "choose a place that can be written",
    errno.EACCES: "check its rights, or choose another place",
    errno.EPERM: "check its rights, or choose another place",
    errno.EFBIG: "raise the limit of files (ulimit -f), or choose another disk",
    errno.ENAMETOOLONG: "choose a shorter path",
    errno.EEXIST: "a folder is needed there; choose another place",
    errno.ENOTDIR: "a folder is needed there; choose another place",
    errno.EMFILE: "raise the limit of open files (ulimit -n)",
}
_TEMPORARY = "tmp-"  # in the names of incomplete files and folders
_STEM = 50  # characters of a file's name in that of the incomplete one, which is longer
_MB = 10**6


def cache_folder() -> Path:
    """The cache shared by all runs: $SAGESPLAT_CACHE, $XDG_CACHE_HOME/sagesplat, or ~/.cache/sagesplat."""
    default = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "sagesplat"
    return Path(os.environ.get("SAGESPLAT_CACHE") or default)


@contextmanager
def atomic_path(path: Path, *, nbytes: int = 0, sync: bool = True) -> Iterator[Path]:
    """A temporary path beside `path`, which replaces it when the block ends without an error.

    After a crash or a power cut, `path` has either its old content or all of the new content. With
    `sync=False` that holds for power cuts only after `sync_files`, which is cheaper for many small files.
    `nbytes`: expected size, for the message about a full disk. RunError if the disk is full. No temporary
    file is left behind.
    """
    with named_full_disk(path, nbytes):
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            handle, name = tempfile.mkstemp(
                dir=path.parent, prefix=f".{path.stem[:_STEM]}.{_TEMPORARY}", suffix=path.suffix
            )
        except OSError as error:
            error.filename = str(path)  # the temporary file's name says nothing
            raise
        os.close(handle)
        temporary = Path(name)
        try:
            temporary.chmod(0o644)
            yield temporary
            if sync:
                sync_files([temporary])  # before the rename: some file systems write names before content
            temporary.replace(path)
            if sync:
                _sync_folder(path.parent)
        except OSError as error:
            if _number(error, path.parent) in _FULL:
                nbytes = max(nbytes, _size(path), _size(temporary) + _MB)
                temporary.unlink(missing_ok=True)
                raise _full(path, error, nbytes) from error
            if error.filename is None and error.errno is not None:
                error.filename = str(path)  # writing says what is wrong, but not with which file
            raise
        finally:
            temporary.unlink(missing_ok=True)


@contextmanager
def named_full_disk(path: Path, nbytes: int = 0) -> Iterator[None]:
    """RunError if the disk is full in the block, which writes about `nbytes` to `path`."""
    try:
        yield
    except OSError as error:
        if _number(error, path.parent) in _FULL:
            raise _full(path, error, nbytes) from error
        raise


def _number(error: OSError, folder: Path) -> int | None:
    """The number of an error while `folder` was written to; of one without a number, that of a full disk."""
    if error.errno is None:
        with suppress(OSError):
            if shutil.disk_usage(folder).free < _LEFT:
                return errno.ENOSPC
    return error.errno


def _full(path: Path, error: OSError, nbytes: int) -> RunError:
    free, number = 0, _number(error, path.parent) or errno.ENOSPC
    with suppress(OSError):
        if number == errno.ENOSPC:  # what a quota leaves cannot be queried portably
            free = shutil.disk_usage(path.parent).free
    megabytes = max(1, math.ceil((nbytes - free) / _MB))
    return RunError(
        f"{path}: no space left, {_FULL[number]}; free {megabytes:,} MB and run the same command "
        "again (nothing was lost)"
    )


def unwritable(path: Path, error: OSError) -> str:
    """The line for a file or folder that cannot be written: the path, why, and what to do."""
    number = _number(error, path.parent)
    reason = _FULL.get(number or 0) or error.strerror or short(error) or type(error).__name__
    cure = "free some space" if number in _FULL else CURES.get(number or 0, "choose another place")
    return f"{path}: cannot be written ({reason}); {cure}"


def _size(path: Path) -> int:
    return path.stat().st_size if path.exists() else 0


def sync_files(paths: Iterable[Path]) -> None:
    """Flush the content of files to disk. Their names are flushed by `sync_changed` and `atomic_path`."""
    for path in paths:
        handle = os.open(path, os.O_RDWR if os.name == "nt" else os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def _sync_folder(path: Path) -> None:
    if os.name != "nt":  # Windows cannot flush folders
        sync_files([path])


def sync_changed(folder: Path, since: float) -> None:
    """Flush to disk everything in a folder that changed since a time (seconds since 1970)."""
    for root, _, names in os.walk(folder):
        changed = [path for path in (Path(root, n) for n in names) if _changed(path) >= since]
        sync_files(changed)
        if _changed(Path(root)) >= since:
            _sync_folder(Path(root))


def _changed(path: Path) -> float:
    """Time of a file's last change of content or name, seconds since 1970; 0 if it no longer exists."""
    try:
        status = path.stat()
    except FileNotFoundError:
        return 0.0
    return max(status.st_mtime, status.st_ctime) if path.is_file() or path.is_dir() else 0.0


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
    """Make `target` a hard link to `path`, or a copy if the file system has no hard links."""
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
    swap, it lies beside `path` and the next writer puts it back. Raises RunError where the disk is full, or
    another process or thread writes to `path` this way.
    """
    fresh, earlier = (path.with_name(f".{path.name}.{end}") for end in (f"{_TEMPORARY}new", "earlier"))
    with named_full_disk(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        with alone(path):
            if earlier.exists() and not path.exists():  # a writer was killed in the middle of the swap
                earlier.rename(path)
            for left in (fresh, earlier):
                shutil.rmtree(left, ignore_errors=True)
            try:
                with named_full_disk(path):  # before what was written is removed
                    fresh.mkdir()
                    fresh.chmod(0o755)
                    yield fresh
                    sync_changed(fresh, 0)
                    _swap(fresh, path, earlier)
            finally:
                shutil.rmtree(fresh, ignore_errors=True)


def _swap(fresh: Path, path: Path, earlier: Path) -> None:
    """Put `fresh` in the place of `path`, which is `earlier` meanwhile and comes back if that fails."""
    try:
        if path.exists():
            path.rename(earlier)
        fresh.rename(path)
    except BaseException:
        if earlier.exists() and not path.exists():
            earlier.rename(path)
        raise
    _sync_folder(path.parent)
    shutil.rmtree(earlier, ignore_errors=True)


def write_text(path: Path, text: str) -> None:
    """Replace a text file atomically; escapes are written for what is not UTF-8, as in some paths."""
    content = text.encode("utf-8", "backslashreplace")
    with atomic_path(path, nbytes=len(content)) as temporary:
        temporary.write_bytes(content)


def write_json(path: Path, value: Any) -> None:
    """Replace a JSON file atomically; keys keep their order."""
    write_text(path, json.dumps(value, indent=1) + "\n")


def read_json(path: Path, cure: str = "", error: type[SageError] = RunError) -> Any:
    """The content of a JSON file; `error` if it is unreadable, with a `cure`. Memory: 64 bytes per byte."""
    cure = cure and f"; {cure}"
    try:
        return json.loads(decoded(path.read_bytes()))
    except FileNotFoundError:
        raise error(f"{path}: no such file{cure}") from None
    except RecursionError:
        raise error(f"{path}: not readable as JSON (nested too deeply){cure}") from None
    except (OSError, ValueError) as reason:
        raise error(f"{path}: not readable as JSON ({short(reason)}){cure}") from reason


def decoded(content: bytes, errors: str = "strict") -> str:
    """A text file of any machine: with or without a byte order mark, which Windows puts before UTF-8 and -16.

    `errors`: what becomes of bytes that are not UTF-8, as in `bytes.decode`.
    """
    if content[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return content.decode("utf-16")
    return content.removeprefix(b"\xef\xbb\xbf").decode("utf-8", errors)


def regular(path: Path) -> Path:
    """The path of a file that can be read to its end, unlike a pipe or a device; OSError for others."""
    if not stat.S_ISREG(path.stat().st_mode):
        raise OSError(errno.EINVAL, "no regular file", str(path))
    return path


def loads_json(content: bytes | str) -> Any:
    """The value of JSON in UTF-8, also with a byte order mark. ValueError if it is none."""
    try:
        return json.loads(content if isinstance(content, str) else content.decode("utf-8-sig"))
    except RecursionError:
        raise ValueError("JSON that is nested too deeply") from None
