"""What a reader of foreign bytes must not do, and the check of it; tests/fuzz/readers lists the readers.

`check` is the oracle of tests/test_hostile_input.py and of `python -m tests.fuzz`.

Honest memory is the peak that a reader takes for a valid file of some ten kilobytes or more, for each byte
of it. A damaged file may take `ALLOWED` times that for each of its bytes, and the reader's `base`. Two peaks
count: what Python and numpy allocate (tracemalloc, which takes time), and how far the process grows
(Linux: always; it sees decoders in C, but only what is beyond `GROWTH`).
"""

import os
import resource
import signal
import time
import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from types import FrameType, TracebackType
from unicodedata import category

from sagesplat.core.errors import SageError

MIB = 2**20
SECONDS = 5.0  # for a file of some kilobytes on a slow core
LONGEST = 3000  # characters of a message
ALLOWED = 4  # times the honest memory
GROWTH = 8 * MIB  # of the process: heaps grow in steps, and libraries keep pools


@dataclass(frozen=True)
class Reader:
    """A reader of bytes that may come from anybody.

    `make` gets an existing folder and a size. It returns valid files: of a few hundred bytes for size 1,
    larger for `large`, where the first one is as compressible as files of its kind get. It also puts beside
    them what the reader needs.
    """

    name: str
    suffix: str  # of its files
    make: Callable[[Path, int], list[bytes]]
    read: Callable[[Path, bytes], object]  # the folder that `make` was given, and a file's content
    large: int = 300  # size of the file whose memory is the honest one
    base: int = MIB  # bytes that the smallest file may take


@dataclass(frozen=True)
class Finding:
    """What a reader must not do."""

    kind: str  # where it happened and what, without numbers: equal for equal faults
    text: str


class Hang(BaseException):
    """Out of time; no reader catches it."""


def honest_memory(reader: Reader, folder: Path) -> tuple[float, bytes]:
    """Bytes of memory that a reader takes for each byte of a large valid file, and that file.

    `folder` is an empty one.
    """
    reader.read(folder, reader.make(folder, 1)[0])  # what is loaded once does not count
    content = reader.make(folder, reader.large)[0]
    with _peak() as peak:
        reader.read(folder, content)
    return peak() / len(content), content


@contextmanager
def _peak() -> Iterator[Callable[[], int]]:
    """A function that says, after the block, how many bytes Python allocated in it at most."""
    peak = 0
    tracemalloc.start()
    try:
        yield lambda: peak
    finally:
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()


class _Process:
    """How far this process has grown since `reset`: Linux keeps its peak, and can be told to forget it."""

    def __init__(self) -> None:
        self._handle = -1
        with suppress(OSError):
            self._handle = os.open("/proc/self/clear_refs", os.O_WRONLY)
        self._before = 0

    def reset(self) -> None:
        if self._handle >= 0:
            os.pwrite(self._handle, b"5", 0)
            self._before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss

    def growth(self) -> int:
        """Bytes; 0 where the system does not say."""
        if self._handle < 0:
            return 0
        return 1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - self._before)


_process, _begun = _Process(), 0.0


@contextmanager
def watchdog() -> Iterator[None]:
    """In the block, `check` ends what takes longer than `SECONDS`; call it in the main thread."""
    before = signal.signal(signal.SIGALRM, _ring)
    signal.setitimer(signal.ITIMER_REAL, 0.25, 0.25)  # one timer for all: setting it costs a system call
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def _ring(number: int, frame: FrameType | None) -> None:
    if _begun and time.perf_counter() - _begun > SECONDS:
        raise Hang(f"more than {SECONDS} s")


def check(
    reader: Reader, folder: Path, content: bytes, honest: float, *, measure: bool = True
) -> Finding | None:
    """Read a file's content; a finding unless it is read, or refused by a SageError of one line, in bounds.

    Warnings are findings where they are errors, and hangs are ended where `watchdog` is on. `honest`: bytes
    of memory for each byte of a valid file. `measure`: look at Python's memory too.
    """
    bound = round(ALLOWED * honest * len(content)) + reader.base
    _process.reset()
    if measure:
        with _peak() as peak:
            finding, seconds = _read(reader, folder, content)
        if peak() > bound:
            finding = finding or _too_much(peak(), content, bound)
    else:
        finding, seconds = _read(reader, folder, content)
    if _process.growth() > bound + GROWTH:
        finding = finding or _too_much(_process.growth(), content, bound + GROWTH)
    if seconds > SECONDS:
        finding = finding or Finding("time", f"{seconds:.1f} s for {len(content):,} bytes")
    return finding


def _too_much(peak: int, content: bytes, bound: int) -> Finding:
    return Finding("memory", f"{peak:,} bytes for a file of {len(content):,}, not {bound:,}")


def _read(reader: Reader, folder: Path, content: bytes) -> tuple[Finding | None, float]:
    """What is wrong with how a content is read, memory aside; and the seconds."""
    global _begun
    finding, begun = None, time.perf_counter()
    try:
        _begun = begun
        reader.read(folder, content)
        _begun = 0.0
    except SageError as error:
        _begun = 0.0
        finding = _message(str(error))
    except (Exception, Hang) as error:
        _begun = 0.0
        what = f"{type(error).__name__} in {_place(error.__traceback__)}"
        finding = Finding(what, f"{what}: {str(error)[:200]}")
    return finding, time.perf_counter() - begun


def _message(text: str) -> Finding | None:
    plain = text.isprintable() or all(c.isprintable() or category(c) == "Zs" for c in text)
    if plain and text and len(text) <= LONGEST:
        return None
    what = f"{len(text)} characters" if plain else "characters that are not to be printed"
    return Finding("message", f"{what}, not one line: {text[:200]!r}")


def _place(traceback: TracebackType | None) -> str:
    """The deepest line of the project."""
    place = "?"
    while traceback is not None:
        path = Path(traceback.tb_frame.f_code.co_filename)
        if "sagesplat" in path.parts:
            place = f"{path.name}:{traceback.tb_frame.f_code.co_name}"
        traceback = traceback.tb_next
    return place
