"""One process at a time writes into a run folder. A lock ends with its process, however that ends."""

import errno
import json
import os
import socket
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path

from sagesplat.core.errors import RunError

FILE = ".lock"
_BUSY = (errno.EWOULDBLOCK, errno.EACCES, errno.EDEADLK)  # of flock, and of msvcrt
_AGAIN = 0.5  # seconds between two tries
_held: dict[Path, list[int]] = {}  # the open file, and how often this process has entered a folder
_guard = threading.Lock()


@contextmanager
def locked(folder: Path, wait: float = 0.0) -> Iterator[None]:
    """Keep other processes from writing into `folder` (made if missing); this one may enter again.

    RunError names the process that has it, and still has it after `wait` seconds. Its file, FOLDER/.lock,
    stays; the lock goes with the process.
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


def _entered(folder: Path, key: Path, last: bool) -> bool:
    """Whether we have the lock now; RunError where not and this was the last try."""
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
    """The lock's file, locked and with our name in it."""
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
    with suppress(OSError):  # a full disk: the lock is what counts, not the name in it
        os.ftruncate(handle, 0)
        os.write(handle, json.dumps(_ourselves()).encode())
    return handle


def _take(handle: int) -> None:
    """Lock a file, or OSError at once."""
    if sys.platform == "win32":
        import msvcrt

        os.lseek(handle, 1 << 30, os.SEEK_SET)  # others may read what is before
        msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)
        os.lseek(handle, 0, os.SEEK_SET)
    else:
        import fcntl

        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)


def _ourselves() -> dict[str, str | int]:
    command = " ".join([Path(sys.argv[0]).name, *sys.argv[1:]])
    now = datetime.now().astimezone().isoformat(" ", "seconds")
    return {"pid": os.getpid(), "host": socket.gethostname(), "command": command, "since": now}


def _holder(path: Path) -> str:
    """Who has the lock, in words."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        who = f"process {found['pid']} on {found['host']}"
        return f"{who} (`{found['command']}`, since {found['since']})"
    except (OSError, ValueError, KeyError, TypeError):  # it has not written its name yet
        return "another process"
