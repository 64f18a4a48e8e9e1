"""Memory that runs out is one line, whoever says so; what is freed goes back."""

import errno
import platform
import resource
from pathlib import Path

import numpy as np
import pytest

from sagesplat.core.errors import LabelError, OutOfMemory
from sagesplat.core.memory import named_memory, ran_out, return_freed


def caused(cause: BaseException) -> Exception:
    """An error of a library that hides the cause."""
    try:
        raise ValueError("cannot compile") from cause
    except ValueError as error:
        return error


# as seen under `ulimit -v`, and of onnxruntime
OUT = [
    MemoryError(),
    OSError(errno.ENOMEM, "Cannot allocate memory"),
    RuntimeError(
        "[enforce fail at alloc_cpu.cpp:127] err == 0. DefaultCPUAllocator: can't allocate memory: you tried "
        "to allocate 479160 bytes. Error code 12 (Cannot allocate memory)"
    ),
    ImportError("libtorch_cpu.so: failed to map segment from shared object"),
    RuntimeError("can't start new thread"),
    Exception("[ONNXRuntimeError] : 6 : RUNTIME_EXCEPTION : std::bad_alloc"),
    Exception("Failed to allocate memory for requested buffer of size 4294967296"),
    SystemError("error return without exception set"),
    SystemError("<function _find_and_load> returned NULL without setting an exception"),
    caused(MemoryError()),
]


@pytest.mark.parametrize("error", OUT, ids=str)
def test_it_is_one_line_with_a_cure(error: Exception) -> None:
    assert ran_out(error)
    with pytest.raises(OutOfMemory) as caught, named_memory("run: nest"):
        raise error
    line = str(caught.value)
    assert line.startswith("run: nest: out of memory; close other programs, or let this one have more")
    assert "\n" not in line


@pytest.mark.parametrize("error", [RuntimeError("CUDA error"), LabelError("bad_alloc"), OSError(28, "full")])
def test_other_errors_stay_what_they_are(error: Exception, tmp_path: Path) -> None:
    assert not ran_out(error)
    with pytest.raises(type(error)), named_memory("run"):
        raise error


@pytest.mark.skipif("glibc" not in platform.libc_ver(), reason="other libraries keep less of what is freed")
def test_freed_memory_goes_back_to_the_system():
    def resident() -> int:
        return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()

    blocks = [np.ones(8000) for _ in range(2000)]  # 128 MB, each too small to be mapped by itself
    last = blocks[-1]  # keeps the others from the end of the heap, which is given back by itself
    del blocks
    before = resident()
    return_freed()
    assert before - resident() > 50e6
    assert last[0] == 1
