"""Every reader of files that a user may have from somebody else: a small valid file, and what is allowed.

`check` is the oracle of tests/test_hostile_input.py and of `python -m benchmarks fuzz`.
"""

import signal
import time
import tracemalloc
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType, TracebackType

from sagesplat.core.errors import SageError

MIB = 2**20
DEFLATE = 1032  # times its size is all that a deflate stream can hold
SECONDS = 5.0  # for a file of some kilobytes on a slow core
LONGEST = 3000  # characters of a message


@dataclass(frozen=True)
class Reader:
    """A reader of files, and the memory that it may take: `factor` times the file's size and `base`."""

    name: str
    suffix: str  # of its files
    make: Callable[[Path], list[bytes]]  # valid files; also puts beside them what the reader needs
    read: Callable[[Path, bytes], object]  # the folder that `make` was given, and a file's content
    factor: int
    base: int = MIB


@dataclass(frozen=True)
class Finding:
    """What a reader must not do."""

    kind: str  # where it happened and what, without numbers: equal for equal faults
    text: str


class Hang(BaseException):
    """Out of time; no reader catches it."""


def check(reader: Reader, folder: Path, content: bytes, *, measure: bool = True) -> Finding | None:
    """Read a file's content; a finding unless it is read, or refused by a SageError of one line, in bounds.

    Warnings are findings too. `measure`: compare the peak of memory with the bound, which takes time.
    """
    begin, finding = time.perf_counter(), None
    if measure:
        tracemalloc.start()
    try:
        with _limit(SECONDS), warnings.catch_warnings():
            warnings.simplefilter("error")
            reader.read(folder, content)
    except SageError as error:
        finding = _message(str(error))
    except (Exception, Hang) as error:
        what = f"{type(error).__name__} in {_place(error.__traceback__)}"
        finding = Finding(what, f"{what}: {str(error)[:200]}")
    finally:
        peak = tracemalloc.get_traced_memory()[1] if measure else 0
        tracemalloc.stop()
    bound = reader.factor * len(content) + reader.base
    if peak > bound:
        finding = finding or Finding(
            "memory", f"{peak:,} bytes for a file of {len(content):,}, not {bound:,}"
        )
    if (seconds := time.perf_counter() - begin) > SECONDS:
        finding = finding or Finding("time", f"{seconds:.1f} s for {len(content):,} bytes")
    return finding


def _message(text: str) -> Finding | None:
    try:
        text.encode()
    except UnicodeEncodeError:
        return Finding("message", f"cannot be printed: {text[:200]!r}")
    if len(text.splitlines()) != 1 or len(text) > LONGEST:
        return Finding("message", f"{len(text)} characters, not one line: {text[:200]!r}")
    return None


def _place(traceback: TracebackType | None) -> str:
    """The deepest line of the project."""
    place = "?"
    while traceback is not None:
        path = Path(traceback.tb_frame.f_code.co_filename)
        if "sagesplat" in path.parts:
            place = f"{path.name}:{traceback.tb_frame.f_code.co_name}"
        traceback = traceback.tb_next
    return place


@contextmanager
def _limit(seconds: float) -> Iterator[None]:
    """Raises Hang in the block when the time is up."""

    def ring(number: int, frame: FrameType | None) -> None:
        raise Hang(f"more than {seconds} s")

    before = signal.signal(signal.SIGALRM, ring)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
