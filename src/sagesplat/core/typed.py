"""Checks values of JSON files against the annotations of dataclass fields, such as those of settings."""

import math
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

_MOST = 2**63  # what arrays and seeds can hold
_LONGEST = 4096  # characters of a text


@cache
def types_of(kind: type) -> Mapping[str, Any]:
    """The annotation of each field of a dataclass."""
    return get_type_hints(kind)


def check_fields(values: Mapping[str, Any], types: Mapping[str, Any]) -> None:
    """ValueError, naming the first of `values` that is not of its type; names without a type are left alone.

    Numbers have to be finite, integers at most 2**63, texts printable and at most 4096 characters. A list may
    stand for a tuple, a text for a path: JSON has neither.
    """
    for name, value in values.items():
        if name in types and not fits(value, types[name]):
            raise ValueError(f"{name} is {value!r:.60}")


def fits(value: Any, kind: Any) -> bool:
    """Whether a value of a JSON file is of a type: plain, Literal, tuple, list, dict, or a union of them."""
    origin, parts = get_origin(kind), get_args(kind)
    if origin in (Union, UnionType):
        return any(fits(value, part) for part in parts)
    if origin is Literal:
        return isinstance(value, str) and value in parts
    if origin in (tuple, list):
        if not isinstance(value, tuple | list):
            return False
        if origin is tuple and parts[-1] is not Ellipsis:
            return len(value) == len(parts) and all(map(fits, value, parts))
        return all(fits(entry, parts[0]) for entry in value)
    if origin is dict:
        return isinstance(value, dict) and all(
            fits(key, parts[0]) and fits(entry, parts[1]) for key, entry in value.items()
        )
    return _fits_plain(value, kind)


def _fits_plain(value: Any, kind: Any) -> bool:
    match value:
        case None:
            return kind in (None, NoneType)
        case bool():
            return kind is bool
        case int():
            return kind in (int, float) and abs(value) <= _MOST
        case float():
            return kind is float and math.isfinite(value)
        case str() if kind is Path:  # of any characters that a file system takes
            return len(value) <= _LONGEST and not any(ord(c) < 32 for c in value)
        case str():
            return kind is str and len(value) <= _LONGEST and value.isprintable()
    return False
