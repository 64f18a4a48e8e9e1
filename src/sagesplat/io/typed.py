"""JSON and TOML as types: dataclasses whose fields are annotated with limits (`core.limits`).

A file is parsed by Python's own parsers, which take what other tools write (NaN, paths that are not UTF-8),
and then checked and converted by msgspec: it says where in the document something is wrong. Fields that a
type does not have are ignored.
"""

import math
import re
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import is_dataclass
from pathlib import Path
from typing import Any, TypeVar, get_args, get_type_hints

import msgspec

from sagesplat.core.errors import DataError, RunError, SageError, short
from sagesplat.core.limits import LARGEST, Number, NumberOrNaN
from sagesplat.io.files import loads_json, read_json

Kind = TypeVar("Kind")
_LONGEST_PATH = 4096  # characters
_MOST_DOTS = 64  # in a line of TOML: its parser keeps every prefix of a key of many parts


def read_json_as(
    path: Path, kind: type[Kind], what: str, cure: str, error: type[SageError] = DataError
) -> Kind:
    """The content of a JSON file, checked and converted.

    Args:
        path: The file.
        kind: Type of the content: a dataclass, `list[...]`, `dict[...]` and so on.
        what: What a file with other content is not, for the message: "the scene of a run".
        cure: What to do about it.
        error: What is raised, with one line: path, what is wrong, cure.
    """
    content = read_json(path, cure, error)
    with refused(path, what, cure, error):
        return convert_as(content, kind)


def known_json(path: Path, kind: type[Kind]) -> Kind | None:
    """The content of a JSON file of our own that may be missing, damaged or of another kind: None then."""
    try:
        return convert_as(read_json(path), kind)
    except (RunError, ValueError):
        return None


def parse_json_as(content: bytes | str, kind: type[Kind]) -> Kind:
    """The value of JSON in UTF-8, checked and converted; ValueError for anything else."""
    return convert_as(loads_json(content), kind)


def read_toml(path: Path, cure: str, *, most: int) -> dict[str, Any]:
    """The content of a TOML file of up to `most` characters. DataError as of `read_json_as`."""
    try:
        text = path.read_text(encoding="utf-8")
        dots = max(line.count(".") for line in text.split("\n"))
        if len(text) > most or dots > _MOST_DOTS:
            raise ValueError(f"{len(text)} characters, a line with {dots} dots: too many")
        return tomllib.loads(text)
    except (OSError, ValueError, RecursionError) as error:
        raise DataError(f"{path}: not readable as TOML ({short(error)}); {cure}") from None


def convert_as(value: Any, kind: type[Kind], *, strict: bool = True) -> Kind:
    """A value of parsed JSON or TOML, checked and converted; ValueError, which says where, for others.

    Without `strict`, numbers in quotes are numbers too, as some tools write them.
    """
    try:
        return msgspec.convert(value, kind, strict=strict, str_keys=True, dec_hook=_custom)
    except (msgspec.ValidationError, RecursionError) as error:
        raise ValueError(_plain_words(str(error))) from None


def to_plain(value: Any) -> Any:
    """What `json.dumps` can write: dicts and lists in place of dataclasses and arrays."""
    return msgspec.to_builtins(value, enc_hook=lambda other: other.tolist())


def refusal(value: Any, kind: Any) -> str:
    """What to choose in place of a setting that is not within the limits of its annotation; "": it is."""
    try:
        convert_as(value, kind)
    except ValueError as error:
        return f"choose {words}" if (words := _range(kind)) else str(error)
    return ""


def check_limits(settings: Any, prefix: str = "") -> None:
    """RunError, naming the option, where a dataclass of settings holds one that is not within its limits."""
    for name, kind in get_type_hints(type(settings), include_extras=True).items():
        value, option = getattr(settings, name), f"{prefix}{name}".replace("_", "-")
        if is_dataclass(value):
            check_limits(value, f"{option}.")
        elif cure := refusal(value, kind):
            raise RunError(impossible(f"--{option}", value, cure))


def impossible(option: str, value: Any, cure: str) -> str:
    """The line for an option whose value is not within its limits."""
    parts = [part for pair in value.items() for part in pair] if isinstance(value, dict) else value
    text = " ".join(map(str, parts)) if isinstance(parts, tuple | list) else str(parts)
    return f"{option} {short(text)} is impossible; {cure}"


def _range(kind: Any) -> str:
    """The limits in an annotation, in words; "" without any."""
    for part in get_args(kind):
        if isinstance(part, msgspec.Meta) and (low := part.ge if part.gt is None else part.gt) is not None:
            high = part.le if part.lt is None else part.lt
            begin = f"a number {'from' if part.gt is None else 'above'} {low:g}"
            if high is None or high >= LARGEST:
                return f"{begin} on"
            return f"{begin} {'to' if part.lt is None else 'to below'} {high:,}"
        if words := _range(part):
            return words
    return ""


@contextmanager
def refused(path: Path | str, what: str, cure: str, error: type[SageError] = DataError) -> Iterator[None]:
    """Turns a ValueError in the block into one line: the path, what it is not, why, and the cure."""
    try:
        yield
    except ValueError as reason:
        raise error(f"{path}: not {what} ({short(reason)}); {cure}") from None


def _plain_words(message: str) -> str:
    """msgspec's message without its marks: "Expected `int`, got `str` - at `$.levels[0]`"."""
    text, _, place = message.replace("`", "").partition(" - at ")
    place = re.sub(r"^\$\.?", "", place)
    return f"{place}: {text[:1].lower()}{text[1:]}" if place else text


def _custom(kind: Any, value: Any) -> Any:
    """A value of a type that JSON does not have: NaN, a path, or an array, whose shape is checked."""
    if kind is NumberOrNaN:
        return math.nan if value is None else msgspec.convert(value, Number)
    if kind is Path:
        if isinstance(value, Path):
            return value
        fine = isinstance(value, str) and len(value) <= _LONGEST_PATH and not any(ord(c) < 32 for c in value)
        if not fine:
            raise ValueError(f"{short(repr(value))} is no path")
        return Path(value)
    import numpy as np  # the command line checks its options without arrays

    try:
        with np.errstate(over="ignore"):
            array = np.array(value, np.dtype(kind.dtypes[-1]))
    except (TypeError, OverflowError) as error:
        raise ValueError(str(error)) from None
    if not isinstance(array, kind):
        raise ValueError(f"an array of shape {array.shape}, not {kind.dim_str}")
    if not np.isfinite(array).all():
        raise ValueError("numbers that are not finite")
    return array
