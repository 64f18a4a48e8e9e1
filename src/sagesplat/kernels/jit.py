"""`numba.njit` with a disk cache that notices changes outside of a kernel's own file.

numba recompiles a cached kernel when the file of that kernel changes, and not when a constant, a kernel or an
intrinsic of another file does: after an upgrade it would run old machine code without a word.
"""

import hashlib
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import lru_cache, partial
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any

import numba
import numpy as np
from numba.core.caching import FunctionCache

_CONSTANTS = (bool, int, float, complex, str, bytes, tuple, type, np.generic)


def njit(function: Callable[..., Any] | None = None, *, cache: bool = False, **options: Any) -> Any:
    """Compile a function with numba in nopython mode; a decorator with or without options.

    Args:
        function: A plain function without type annotations that matter.
        cache: Keep the machine code on disk. It is compiled again when the file of the kernel changes, or
            anything that the kernel uses from another file. Where no folder can be written, it is compiled
            in each process.
        options: Those of `numba.njit`.
    """
    if function is None:
        return partial(njit, cache=cache, **options)
    kernel: Any = numba.njit(nogil=True, **options)(function)  # see `kernels.threads`
    if cache:
        with suppress(RuntimeError):  # numba finds no folder that it can write
            setattr(kernel, "_cache", _KernelCache(function))  # noqa: B010 - of numba's dispatcher
    return kernel


class _KernelCache(FunctionCache):
    """numba's cache of one kernel; its entries are valid for one fingerprint of what the kernel uses."""

    _stamped = False

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        if not self._stamped:  # not when decorated: what a kernel uses may be defined below it
            file = self._cache_file
            file._source_stamp = file._source_stamp, fingerprint(self._py_func)
            self._stamped = True
        return super().load_overload(sig, target_context)


def fingerprint(function: Any) -> str:
    """SHA-256 of what a kernel's machine code follows from, besides numba and the processor.

    That is, of the kernel and all kernels that it calls: their files, the values of global constants that
    their code names, the files of the package's other functions, intrinsics and modules that it names, and
    the types that intrinsics are made for: a vector's is that of the machine, or `SAGESPLAT_LANES` wide.
    """
    return hashlib.sha256("\n".join(_used(function, set())).encode()).hexdigest()


def _used(function: Any, seen: set[Any]) -> Iterator[str]:
    if function in seen:
        return
    seen.add(function)
    yield from (_file_hash(name) for name in (function.__code__.co_filename, __file__))
    package = function.__module__.partition(".")[0]
    for name in sorted(_names(function.__code__)):
        value = function.__globals__.get(name)
        value = getattr(value, "py_func", value)  # of a kernel
        module = value.__name__ if isinstance(value, ModuleType) else getattr(value, "__module__", None)
        ours = isinstance(module, str) and module.partition(".")[0] == package
        if ours and isinstance(value, FunctionType):
            yield from _used(value, seen)
        elif isinstance(value, np.ndarray):
            yield f"{name} {value.dtype} {value.shape} {hashlib.sha256(value.tobytes()).hexdigest()}"
        elif isinstance(value, _CONSTANTS):
            yield f"{name} {value!r}"
        elif ours and (path := getattr(sys.modules.get(str(module)), "__file__", None)):
            yield _file_hash(path)
            cells = getattr(getattr(value, "_defn", None), "__closure__", None) or ()  # of an intrinsic
            kinds = [cell.cell_contents for cell in cells]
            yield from (f"{name} {kind}" for kind in kinds if isinstance(kind, numba.types.Type))


def _names(code: CodeType) -> set[str]:
    """Names of globals and attributes in a function's code, inner functions included."""
    inner = (_names(constant) for constant in code.co_consts if isinstance(constant, CodeType))
    return set(code.co_names).union(*inner)


@lru_cache
def _file_hash(path: str) -> str:
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()
