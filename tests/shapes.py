"""Unless CHECK_SHAPES=0, checks jaxtyping's shapes and dtypes while tests run; import it before sagesplat.

Checked are all modules that use jaxtyping, but for `EXCEPT` and those with kernels: a wrapper would change
what is compiled. Only arrays are checked: what tests pass instead of other classes is their affair.
"""

import inspect
import os
import re
from collections.abc import Callable, Iterable
from functools import wraps
from pathlib import Path
from types import UnionType
from typing import Any, Union, get_args, get_origin

from jaxtyping import AbstractArray, install_import_hook

SOURCE = Path(__file__).parents[1] / "src" / "sagesplat"
KERNELS = re.compile(r"\b(jit|intrinsic|triton)\b")
EXCEPT = {
    "sagesplat.adapt.allocate", "sagesplat.adapt.viewpoint",  # their tests pass lists as arrays
    "sagesplat.demo.world",  # `demo.raycast` compiles a function of it
}  # fmt: skip


def check(function: Callable[..., Any]) -> Callable[..., Any]:
    """Check the arrays among the arguments and in the result: a type checker for `jaxtyping.jaxtyped`."""
    signature = inspect.signature(function)
    hints = {name: p.annotation for name, p in signature.parameters.items() if _has_arrays(p.annotation)}
    result = signature.return_annotation

    @wraps(function)
    def wrapper(*args: Any, **kwargs: Any) -> Any:
        given = signature.bind(*args, **kwargs).arguments
        for name, hint in hints.items():
            if name in given and not fits(given[name], hint):
                raise TypeError(f"{name} is not {hint}")
        found = function(*args, **kwargs)
        if _has_arrays(result) and not fits(found, result):
            raise TypeError(f"the result is not {result}")
        return found

    return wrapper if hints or _has_arrays(result) else function


def fits(value: Any, hint: Any) -> bool:
    """Whether a value has the shapes and dtypes of a hint, whose parts without arrays are not checked."""
    origin, inner = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        return any(value is None if h is type(None) else fits(value, h) for h in inner)
    if not _has_arrays(hint):
        return True
    if origin is tuple and Ellipsis not in inner:
        return len(value) == len(inner) and all(map(fits, value, inner))
    if origin in (tuple, list):
        return all(fits(part, inner[0]) for part in value)
    if origin is dict:
        return all(fits(part, inner[1]) for part in value.values())
    return not inspect.isclass(hint) or isinstance(value, hint)


def _has_arrays(hint: Any) -> bool:
    if inspect.isclass(hint) and issubclass(hint, AbstractArray):
        return True
    return any(_has_arrays(inner) for inner in _parts(hint))


def _parts(hint: Any) -> Iterable[Any]:
    return (inner for inner in get_args(hint) if not isinstance(inner, list))


def checked_modules() -> set[str]:
    """Names of the modules that use jaxtyping and hold no kernels."""
    found = set()
    for path in SOURCE.rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        if "from jaxtyping import" in text and not KERNELS.search(text):
            parts = path.relative_to(SOURCE.parent).with_suffix("").parts
            found.add(".".join(parts[:-1] if parts[-1] == "__init__" else parts))
    return found - EXCEPT


if os.environ.get("CHECK_SHAPES", "1") != "0":
    _finder: Any = install_import_hook("sagesplat", "shapes.check").hook
    _finder.should_instrument = checked_modules().__contains__  # by whole name; its own rule goes by prefix
