"""Unless CHECK_SHAPES=0, checks jaxtyping's shapes and dtypes while tests run; import it before sagesplat.

Checked are all modules that use jaxtyping, but for `EXCEPT` and those with kernels: a wrapper would change
what is compiled. Only arrays are checked: what tests pass instead of other classes is their affair. What
was right once is not looked at again: shapes and dtypes decide.
"""

import inspect
import os
import re
from collections.abc import Callable, Iterable
from contextlib import nullcontext
from functools import wraps
from pathlib import Path
from types import UnionType
from typing import Any, Union, get_args, get_origin

import jaxtyping
from jaxtyping import AbstractArray, install_import_hook

SOURCE = Path(__file__).parents[1] / "src" / "sagesplat"
KERNELS = re.compile(r"\b(jit|intrinsic|triton)\b")
EXCEPT = {
    "sagesplat.adapt.allocate", "sagesplat.adapt.viewpoint",  # their tests pass lists as arrays
    "sagesplat.demo.world",  # `demo.raycast` compiles a function of it
}  # fmt: skip

_NO_AXES = nullcontext()
_MISSING = object()


def check(function: Callable[..., Any], *, axes: Any = _NO_AXES) -> Callable[..., Any]:
    """Check the arrays among the arguments and in the result: a type checker for `jaxtyping.jaxtyped`.

    `axes`: context in which axes of one name have one length.
    """
    signature = inspect.signature(function)
    hints = [
        (place, name, p.annotation, fits)
        for place, (name, p) in enumerate(signature.parameters.items())
        if (fits := checker(p.annotation))
    ]
    of_result = checker(signature.return_annotation)
    if not hints and of_result is None:
        return function

    fine: set[Any] = set()  # forms of arguments and results that were right

    def refuse(what: object) -> None:
        raise jaxtyping.TypeCheckError(f"{function.__qualname__}: {what}")  # type: ignore

    @wraps(function)
    def wrapper(*args: Any, **kwargs: Any) -> Any:
        if jaxtyping.config.jaxtyping_disable:
            return function(*args, **kwargs)
        given = [
            (value, name, hint, fits)
            for place, name, hint, fits in hints
            if (value := args[place] if place < len(args) else kwargs.get(name, _MISSING)) is not _MISSING
        ]

        def check_given() -> None:
            for value, name, hint, fits in given:
                if not fits(value):
                    refuse(f"{name} is not {hint}")

        form = tuple((name, _form(value)) for value, name, _, _ in given)
        if form not in fine:
            with axes:
                check_given()
            fine.add(form)
        found = function(*args, **kwargs)
        if of_result and (form, _form(found)) not in fine:
            with axes:
                check_given()  # whose axes are those of the result
                if not of_result(found):
                    refuse(f"the result is not {signature.return_annotation}")
            fine.add((form, _form(found)))
        return found

    return wrapper


def _form(value: Any) -> Any:
    """All of a value that a check depends on."""
    if isinstance(value, tuple | list):
        return tuple(map(_form, value))
    if isinstance(value, dict):
        return tuple(map(_form, value.values()))
    shape = getattr(value, "shape", None)
    return type(value) if shape is None else (type(value), getattr(value, "dtype", None), tuple(shape))


def decorator(*, typechecker: Callable[..., Any]) -> Callable[..., Any]:
    """What the import hook puts on functions and classes.

    jaxtyping's own binds the arguments of every function three times, whether it has arrays or not: that
    took a third of the time of tests that make runs.
    """
    of_class, axes = _of_jaxtyping(typechecker=typechecker), _of_jaxtyping("context")  # has no state

    def decorate(decorated: Any) -> Any:
        if inspect.isfunction(decorated):
            return check(decorated, axes=axes)
        return of_class(decorated)

    return decorate


def checker(hint: Any) -> Callable[[Any], bool] | None:
    """Tells whether a value has the shapes and dtypes of a hint; None for a hint without arrays."""
    if not _has_arrays(hint):
        return None
    origin, inner = get_origin(hint), get_args(hint)
    parts = [checker(one) for one in inner if not isinstance(one, list)]
    if origin in (Union, UnionType):
        optional = type(None) in inner
        known = [part or _anything for part, one in zip(parts, inner, strict=True) if one is not type(None)]
        return lambda value: optional if value is None else any(part(value) for part in known)
    if origin is tuple and Ellipsis not in inner:
        each = [part or _anything for part in parts]
        return lambda value: len(value) == len(each) and all(map(lambda f, v: f(v), each, value))
    if origin in (tuple, list):
        return lambda value: all(map(parts[0] or _anything, value))
    if origin is dict:
        return lambda value: all(map(parts[1] or _anything, value.values()))
    return (lambda value: isinstance(value, hint)) if inspect.isclass(hint) else _anything


def _anything(_value: Any) -> bool:
    return True


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


_of_jaxtyping: Any = jaxtyping.jaxtyped

if os.environ.get("CHECK_SHAPES", "1") != "0":
    jaxtyping.jaxtyped = decorator  # pyright: ignore[reportAttributeAccessIssue]
    _finder: Any = install_import_hook("sagesplat", "shapes.check").hook
    _finder.should_instrument = checked_modules().__contains__  # by whole name; its own rule goes by prefix
