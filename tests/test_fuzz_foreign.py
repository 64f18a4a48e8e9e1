"""Every function that reads bytes is run by a reader of the fuzzer's list, or is an exception."""

import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

import pytest

from tests.fuzz.foreign import EXCEPTIONS, MACHINE, OURS, PACKAGE, readers_in
from tests.fuzz.readers import READERS


@contextmanager
def recorded() -> Iterator[set[tuple[str, str]]]:
    """(file, qualified name) of the Python functions that are called in the block, in all threads."""
    called: set[tuple[str, str]] = set()

    def note(frame: FrameType, event: str, argument: Any) -> None:
        if event == "call":
            called.add((frame.f_code.co_filename, frame.f_code.co_qualname))

    threading.setprofile(note)
    sys.setprofile(note)
    try:
        yield called
    finally:
        sys.setprofile(None)
        threading.setprofile(None)  # type: ignore[arg-type]


def in_package(called: set[tuple[str, str]]) -> set[str]:
    """Names like those of `readers_in`."""
    names = set()
    for file, name in called:
        if Path(file).is_relative_to(PACKAGE):
            module = ".".join(Path(file).relative_to(PACKAGE).with_suffix("").parts)
            names.add(f"{module}:{name.replace('<locals>.', '')}")
    return names


@pytest.fixture(scope="module")
def run_by_readers(tmp_path_factory: pytest.TempPathFactory) -> set[str]:
    """Every function of the package that is run when each reader of the list reads a valid file."""
    files = []
    for reader in READERS:
        folder = tmp_path_factory.mktemp(reader.name)
        files += [(reader, folder, content) for content in reader.make(folder, 1)]
    with recorded() as called:
        for reader, folder, content in files:
            reader.read(folder, content)
    return in_package(called)


@pytest.fixture(scope="module")
def reading() -> list[tuple[str, str, int]]:
    """All of the package's source is parsed for it."""
    return list(readers_in())


def test_every_function_that_reads_is_fuzzed_or_an_exception(
    run_by_readers: set[str], reading: list[tuple[str, str, int]]
):
    missing = [
        f"{name} reads (line {line}: {call}), and no reader of tests/fuzz/readers runs it: add one "
        "there that does, or its name and a reason to EXCEPTIONS in tests/fuzz/foreign.py"
        for name, call, line in reading
        if name not in run_by_readers and name not in EXCEPTIONS
    ]
    assert not missing, "\n".join(missing)


def test_exceptions_are_needed(run_by_readers: set[str], reading: list[tuple[str, str, int]]):
    """An exception for a function that is gone, reads no more, or is run by a reader, is to be removed.

    What is the package's own may be run besides, or not, as some of it is read once in a process.
    """
    names = {name for name, _, _ in reading}
    foreign = {name for name, reason in EXCEPTIONS.items() if reason not in (OURS, MACHINE)}
    assert sorted(EXCEPTIONS.keys() - names) == []
    assert sorted(foreign & run_by_readers) == []
