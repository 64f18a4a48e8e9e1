"""Memory that runs out, in whatever words: Python's, numpy's, torch's, onnxruntime's or the loader's."""

import ctypes
import errno
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from sagesplat.core.errors import OutOfMemory, SageError

_SAYS = (
    "DefaultCPUAllocator: ",  # torch, before "can't allocate memory" or "not enough memory"
    "bad_alloc",
    "bad allocation",
    "Failed to allocate memory",  # onnxruntime
    "failed to map segment from shared object",  # of a library that is imported
    "can't start new thread",
    "Cannot allocate memory",
    "error return without exception set",  # of an import that had no memory for its error
    "returned NULL without setting an exception",  # the same
)
MORE = (
    "close other programs, or let this one have more (ulimit -v, the container), then run the same command "
    "again to resume; --downscale 2 into another run folder needs less"
)


def ran_out(error: BaseException) -> bool:
    """Whether an error says that memory ran out, or came of one that does."""
    if isinstance(error, SageError):
        return False
    if isinstance(error, MemoryError) or getattr(error, "errno", None) == errno.ENOMEM:
        return True
    if any(says in str(error) for says in _SAYS):
        return True
    before = error.__cause__ or error.__context__
    return before is not None and ran_out(before)


@contextmanager
def named_memory(where: str) -> Iterator[None]:
    """OutOfMemory, with `where`, if memory runs out in the block."""
    try:
        yield
    except Exception as error:
        if ran_out(error):
            raise OutOfMemory(f"{where}: out of memory; {MORE}") from error
        raise


def return_freed() -> None:
    """Give freed memory back to the system: glibc keeps it, of a million Gaussians up to 0.9 GB."""
    if sys.platform == "linux" and (trim := getattr(ctypes.CDLL(None), "malloc_trim", None)):
        trim(0)
