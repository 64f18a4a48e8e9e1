"""Locks, so that only one process writes into a run folder or a bundle; released when the process ends."""

import errno
import json
import os
import socket
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import msgspec

from sagesplat.core.errors import RunError

FILE = ".lock"
_BUSY = (errno.EWOULDBLOCK, errno.EACCES, errno.EDEADLK)  # errors of flock and msvcrt for a lock that is held
_AGAIN = 0.5  # seconds between two tries
_held: dict[Path, list[int]] = {}  # folder -> [open file, number of times this process has entered]
_guard = threading.Lock()


@contextmanager
def locked(folder: Path, wait: float = 0.0) -> Iterator[None]:
    """Hold the lock of `folder` (created if missing) during the block; the lock is re-entrant.

    RunError, with the name of the process that holds it, if it cannot be had within `wait` seconds. The file
    FOLDER/.lock remains; the lock itself is released when the process ends, even by a kill.
    """
    key, end = folder.resolve(), time.monotonic() + wait
    while not _entered(folder, key, last=time.monotonic() >= end):
        time.sleep(_AGAIN)
    try:
        yield
    finally:
        with _guard:
            _held[key][1] -= 1
            if not _held[key][1]:
                os.close(_held.pop(key)[0])


@contextmanager
def alone(path: Path, wait: float = 0.0) -> Iterator[None]:
    """Be the only one, process or thread, that replaces `path` this way, whose folder exists.

    RunError, with the name of who does, if that is another one for more than `wait` seconds. The lock is
    a file beside `path` and is removed afterwards. On disks without locks nothing is checked.
    """
    file, end = path.with_name(f".{path.name}{FILE}"), time.monotonic() + wait
    handle = None
    while handle is None:
        try:
            handle = _exclusive(file)
        except BlockingIOError:
            if time.monotonic() >= end:
                raise RunError(f"{path}: {_holder(file)} writes there; wait for it or stop it") from None
            time.sleep(_AGAIN)
    try:
        yield
    finally:
        with suppress(OSError):  # Windows removes no open files
            file.unlink()  # while it is locked: who opened it meanwhile sees that it is gone (`_exclusive`)
        os.close(handle)


def _exclusive(file: Path) -> int | None:
    """The open and locked file; None where it was removed meanwhile. BlockingIOError where it is locked."""
    handle = os.open(file, os.O_RDWR | os.O_CREAT, 0o644)
    try:
        _take(handle)
    except OSError as error:
        if error.errno in _BUSY:
            os.close(handle)
            raise BlockingIOError from None
    with suppress(OSError):
        if os.path.samestat(os.fstat(handle), file.stat()):
            _describe(handle)
            return handle
    os.close(handle)
    return None


def _entered(folder: Path, key: Path, last: bool) -> bool:
    """Whether this process holds the lock now; RunError if it does not and this was the `last` try."""
    with _guard:
        if key not in _held:
            try:
                _held[key] = [_open(folder), 0]
            except RunError:
                if last:
                    raise
                return False
        _held[key][1] += 1
        return True


def _open(folder: Path) -> int:
    """The open lock file, locked, with this process's description in it."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / FILE
    handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
    try:
        _take(handle)
    except OSError as error:
        os.close(handle)
        if error.errno in _BUSY:
            raise RunError(f"{folder}: {_holder(path)} works on it; wait for it or stop it") from None
        raise RunError(
            f"{path}: cannot be locked ({error.strerror}); choose a run folder on another disk"
        ) from None
    _describe(handle)
    return handle


def _describe(handle: int) -> None:
    """Write into a lock's file who holds it."""
    command = " ".join([Path(sys.argv[0]).name, *sys.argv[1:]])
    now = datetime.now().astimezone().isoformat(" ", "seconds")
    ourselves = {"pid": os.getpid(), "host": socket.gethostname(), "command": command, "since": now}
    with suppress(OSError):  # e.g. a full disk: the lock holds without the description
        os.ftruncate(handle, 0)
        os.write(handle, json.dumps(ourselves).encode())


def _take(handle: int) -> None:
    """Lock a file; OSError immediately if it is locked."""
    if sys.platform == "win32":
        import msvcrt

        os.lseek(handle, 1 << 30, os.SEEK_SET)  # others can still read the bytes before
        msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)
        os.lseek(handle, 0, os.SEEK_SET)
    else:
        import fcntl

        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)


@dataclass(frozen=True)
class _Holder:
    """Who holds a lock, as written into its file."""

    pid: int
    host: str
    command: str
    since: str


def _holder(path: Path) -> str:
    """A description of the process that holds the lock."""
    try:
        holder = msgspec.convert(json.loads(path.read_text(encoding="utf-8")), _Holder)
    except (OSError, ValueError, RecursionError):  # it has not written its description yet
        return "another process"
    return f"process {holder.pid} on {holder.host} (`{holder.command}`, since {holder.since})"
