"""labels.edit.json: what somebody changed about the categories of a run, as the viewer writes it.

An ordered list of operations on categories by their names. A split names Gaussians by their rank in the order
of the run's ladder, in runs of (first rank, number), by the run's own categories: earlier operations of the
list do not move them. docs/formats.md specifies the file.
"""

import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from msgspec import Meta

from sagesplat.core.errors import LabelError, short
from sagesplat.core.limits import AtLeast1, Sha256
from sagesplat.core.names import RULE, checked
from sagesplat.io.files import regular
from sagesplat.io.typed import convert_as, parse_json_as, refused

if TYPE_CHECKING:  # loads torch, which `view` does without
    from sagesplat.formats.increments import Increment

FILE = "labels.edit.json"
FORMAT, VERSION = "sagesplat-label-edits", 1
MAX_BYTES = 64 * 2**20
MAX_WEIGHT = 1e6
_CURE = "save it again in the viewer"
_Rank = Annotated[int, Meta(ge=0, lt=2**31)]
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
    weight: Annotated[float, Meta(ge=0, le=MAX_WEIGHT)]


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


@dataclass(frozen=True)
class _Document:
    format: Literal["sagesplat-label-edits"]
    version: AtLeast1
    ladder: Sha256
    operations: list[dict[str, Any]]


def parse_edits(content: bytes, name: str = FILE) -> LabelEdits:
    """The edits in a file's bytes.

    Raises:
        LabelError: In one line, for a file that is damaged, of another format or of a later version, and for
            an operation that cannot be: an unknown one, a name that is none, an empty selection.
    """
    with refused(name, f"label edits (format {FORMAT}), or damaged", _CURE, LabelError):
        if len(content) > MAX_BYTES:
            raise ValueError(f"{len(content)} bytes")
        document = parse_json_as(content, _Document)
    if document.version > VERSION:
        raise LabelError(
            f"{name}: of version {document.version}, this sagesplat reads up to {VERSION}; update it"
        )
    found = []
    for number, entry in enumerate(document.operations, 1):
        try:
            found.append(_operation(entry))
        except ValueError as error:
            raise LabelError(f"{name}: operation {number}: {error}") from None
    return LabelEdits(document.ladder, tuple(found))


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
    listed: list[dict[str, Any]] = [
        {"op": type(one).__name__.lower(), **vars(one)} for one in edits.operations
    ]
    for entry in listed:
        if "gaussians" in entry:
            runs = entry["gaussians"].items()
            entry["gaussians"] = {label: [n for run in some for n in run] for label, some in runs}
    document = {"format": FORMAT, "version": VERSION, "ladder": edits.ladder, "operations": listed}
    return (json.dumps(document, ensure_ascii=False, indent=1) + "\n").encode()


def ranks_of(runs: Runs) -> np.ndarray:
    """The ranks in runs of them, int64, ascending."""
    return np.concatenate([np.arange(first, first + count) for first, count in runs])


@dataclass(frozen=True)
class _Split(Split):
    """As it is in the file: of each run its first rank and its number, one after the other."""

    gaussians: dict[str, list[_Rank]]  # type: ignore


_KINDS: dict[str, type[Operation]] = {
    "rename": Rename, "merge": Merge, "split": _Split, "hide": Hide, "weigh": Weigh, "full": Full,
}  # fmt: skip


def _operation(entry: dict[str, Any]) -> Operation:
    kind = entry.get("op")
    if not isinstance(kind, str) or kind not in _KINDS:
        raise ValueError(f"{kind!r:.60} is not known; there are {', '.join(_KINDS)}")
    made = convert_as(entry, _KINDS[kind])
    names = {key: _name(key, getattr(made, key)) for key in ("category", "to", "into") if hasattr(made, key)}
    if isinstance(made, _Split):
        runs = {label: _runs(numbers) for label, numbers in made.gaussians.items() if numbers}
        if not runs:
            raise ValueError("an empty selection; select something to split off")
        return Split(names["category"], names["to"], runs)
    return replace(made, **names)


def _name(key: str, name: str) -> str:
    """A name in an operation: the rules are those of `core.names`, and of the viewer's `core/names.ts`."""
    try:
        return checked(name)
    except ValueError as error:
        raise ValueError(f"{key} {short(repr(name))}: {error}; {RULE}") from None


def _runs(numbers: list[int]) -> Runs:
    if len(numbers) % 2:
        raise ValueError("gaussians are no runs of ranks: first, number, first, number, ...")
    runs = tuple(zip(numbers[::2], numbers[1::2], strict=True))
    starts, ends = [first for first, _ in runs], [first + count for first, count in runs]
    if any(count < 1 for _, count in runs) or any(s < e for s, e in zip(starts[1:], ends, strict=False)):
        raise ValueError("runs of ranks that are empty, or do not rise")
    return runs


def ladder_hash(increments: Sequence["Increment"], names: Mapping[int, str]) -> str:
    """What tells the levels of one run from another: SHA-256 of all increments and category names."""
    listed = [[one.label_id, names[one.label_id], one.level, one.count, one.sha256] for one in increments]
    return hashlib.sha256(json.dumps(sorted(listed)).encode()).hexdigest()
