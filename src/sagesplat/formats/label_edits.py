"""labels.edit.json: what somebody changed about the categories of a run, as the viewer writes it.

An ordered list of operations on categories by their names. A split names Gaussians by their rank in the order
of the run's ladder, in runs of (first rank, number), by the run's own categories: earlier operations of the
list do not move them. docs/formats.md specifies the file.
"""

import hashlib
import json
import os
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sagesplat.core.errors import LabelError, short
from sagesplat.core.names import RULE, checked
from sagesplat.io.files import loads_json, regular

if TYPE_CHECKING:  # loads torch, which `view` does without
    from sagesplat.formats.increments import Increment

FILE = "labels.edit.json"
FORMAT, VERSION = "sagesplat-label-edits", 1
MAX_BYTES = 64 * 2**20
MAX_WEIGHT = 1e6
_CURE = "save it again in the viewer"
Runs = tuple[tuple[int, int], ...]  # first rank and number of consecutive ones, ascending


@dataclass(frozen=True)
class Rename:
    """A category gets another name."""

    category: str
    to: str


@dataclass(frozen=True)
class Merge:
    """A category becomes part of another one."""

    category: str
    into: str


@dataclass(frozen=True)
class Split:
    """Some Gaussians of a category become one of their own."""

    category: str
    to: str
    gaussians: dict[str, Runs]  # ranks by category of the run as it was


@dataclass(frozen=True)
class Hide:
    """A category is shown or not when a viewer opens the scene."""

    category: str
    hidden: bool


@dataclass(frozen=True)
class Weigh:
    """The weight of a category in plans within a budget."""

    category: str
    weight: float


@dataclass(frozen=True)
class Full:
    """A category is always shown in full, whatever a plan says."""

    category: str
    always: bool


Operation = Rename | Merge | Split | Hide | Weigh | Full


@dataclass(frozen=True)
class LabelEdits:
    """The content of labels.edit.json."""

    ladder: str  # `ladder_hash` of the run that the edits are of
    operations: tuple[Operation, ...]


def parse_edits(content: bytes, name: str = FILE) -> LabelEdits:
    """The edits in a file's bytes.

    Raises:
        LabelError: In one line, for a file that is damaged, of another format or of a later version, and for
            an operation that cannot be: an unknown one, a name that is none, an empty selection.
    """
    try:
        document = loads_json(content) if len(content) <= MAX_BYTES else None
    except (ValueError, RecursionError):
        document = None
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        raise LabelError(f"{name}: not label edits (format {FORMAT}), or damaged; {_CURE}")
    version = document.get("version")
    if type(version) is not int or version < 1:
        raise LabelError(f"{name}: of version {short(repr(version))}, which there is not; {_CURE}")
    if version > VERSION:
        raise LabelError(f"{name}: of version {version}, this sagesplat reads up to {VERSION}; update it")
    ladder, listed = document.get("ladder"), document.get("operations")
    if not isinstance(ladder, str) or not re.fullmatch("[0-9a-f]{64}", ladder):
        raise LabelError(f"{name}: does not say which run it is of; {_CURE}")
    if not isinstance(listed, list):
        raise LabelError(f"{name}: has no list of operations; {_CURE}")
    found = []
    for number, entry in enumerate(listed, 1):
        try:
            found.append(_operation(entry))
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            why = f"no {error.args[0]}" if isinstance(error, KeyError) else str(error)
            raise LabelError(f"{name}: operation {number}: {why}") from None
    return LabelEdits(ladder, tuple(found))


def read_edits(path: Path) -> LabelEdits:
    """The edits in a file; LabelError as of `parse_edits`, and for a file that cannot be read."""
    try:
        with regular(path).open("rb") as file:
            size = os.fstat(file.fileno()).st_size  # read(n) takes n bytes of memory, whatever there is
            content = file.read(min(size, MAX_BYTES) + 1)
    except OSError as error:
        raise LabelError(f"{path}: cannot be read ({error.strerror}); {_CURE}") from None
    return parse_edits(content, str(path))


def dump_edits(edits: LabelEdits) -> bytes:
    """The bytes of a file of edits."""
    listed = [{"op": type(one).__name__.lower(), **vars(one)} for one in edits.operations]
    for entry in listed:
        if "gaussians" in entry:
            runs = entry["gaussians"].items()
            entry["gaussians"] = {label: [n for run in some for n in run] for label, some in runs}
    document = {"format": FORMAT, "version": VERSION, "ladder": edits.ladder, "operations": listed}
    return (json.dumps(document, ensure_ascii=False, indent=1) + "\n").encode()


def ranks_of(runs: Runs) -> np.ndarray:
    """The ranks in runs of them, int64, ascending."""
    return np.concatenate([np.arange(first, first + count) for first, count in runs])


def _operation(entry: Any) -> Operation:
    if not isinstance(entry, dict):
        raise ValueError(f"{entry!r:.60} is no operation")
    kind = entry.get("op")
    if not isinstance(kind, str) or kind not in _KINDS:
        raise ValueError(f"{kind!r:.60} is not known; there are {', '.join(_KINDS)}")
    return _KINDS[kind](entry)


def _name(entry: dict[str, Any], key: str) -> str:
    """A name in an operation: the rules are those of `core.names`, and of the viewer's `core/names.ts`."""
    name = entry[key]
    try:
        return checked(name)
    except ValueError as error:
        raise ValueError(f"{key} {short(repr(name))}: {error}; {RULE}") from None


def _flag(entry: dict[str, Any], key: str) -> bool:
    if type(entry[key]) is not bool:
        raise ValueError(f"{key} is {entry[key]!r:.60}, not true or false")
    return entry[key]


def _weight(entry: dict[str, Any]) -> float:
    weight = entry["weight"]
    if type(weight) not in (int, float) or not 0 <= weight <= MAX_WEIGHT:
        raise ValueError(f"weight {weight!r:.60} is impossible; give a number from 0 on, such as 2")
    return float(weight)


def _gaussians(entry: dict[str, Any]) -> dict[str, Runs]:
    given = entry["gaussians"]
    if not isinstance(given, dict):
        raise ValueError("gaussians are no lists of ranks by category")
    found = {label: _runs(numbers) for label, numbers in given.items()}
    if not any(found.values()):
        raise ValueError("an empty selection; select something to split off")
    return {label: runs for label, runs in found.items() if runs}


def _runs(numbers: Any) -> Runs:
    whole = isinstance(numbers, list) and all(type(n) is int and 0 <= n < 2**31 for n in numbers)
    if not whole or len(numbers) % 2:
        raise ValueError("gaussians are no runs of ranks: first, number, first, number, ...")
    runs = tuple(zip(numbers[::2], numbers[1::2], strict=True))
    ends = [first + count for first, count in runs]
    starts = [first for first, _ in runs]
    if any(count < 1 for _, count in runs) or any(s < e for s, e in zip(starts[1:], ends, strict=False)):
        raise ValueError("runs of ranks that are empty, or do not rise")
    return runs


_KINDS: dict[str, Callable[[dict[str, Any]], Operation]] = {
    "rename": lambda e: Rename(_name(e, "category"), _name(e, "to")),
    "merge": lambda e: Merge(_name(e, "category"), _name(e, "into")),
    "split": lambda e: Split(_name(e, "category"), _name(e, "to"), _gaussians(e)),
    "hide": lambda e: Hide(_name(e, "category"), _flag(e, "hidden")),
    "weigh": lambda e: Weigh(_name(e, "category"), _weight(e)),
    "full": lambda e: Full(_name(e, "category"), _flag(e, "always")),
}


def ladder_hash(increments: Sequence["Increment"], names: Mapping[int, str]) -> str:
    """What tells the levels of one run from another: SHA-256 of all increments and category names."""
    listed = [[one.label_id, names[one.label_id], one.level, one.count, one.sha256] for one in increments]
    return hashlib.sha256(json.dumps(sorted(listed)).encode()).hexdigest()
