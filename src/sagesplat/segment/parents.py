"""Which category each instance is of, by their names: parents.json of a run, `parents` of other files.

{"format": "sagesplat-parents", "version": 1, "parents": {"chair 1": "chair", "chair 2": "chair"}}
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sagesplat.core.errors import RunError, short
from sagesplat.core.names import checked
from sagesplat.core.typed import fits
from sagesplat.io.files import read_json, write_json
from sagesplat.segment.block_categories import category_of

_FORMAT = "sagesplat-parents"
_CURE = "delete it, and run `sagesplat instances` again with --force"


def write_parents(path: Path, parents: Mapping[str, str]) -> None:
    """Write parents.json; none: remove it."""
    if parents:
        write_json(path, {"format": _FORMAT, "version": 1, "parents": dict(sorted(parents.items()))})
    else:
        path.unlink(missing_ok=True)


def read_parents(path: Path) -> dict[str, str]:
    """The category of each instance; empty where there is no such file. RunError for a damaged one."""
    if not path.exists():
        return {}
    made: Any = read_json(path, _CURE)
    if not isinstance(made, dict) or (made.get("format"), made.get("version")) != (_FORMAT, 1):
        raise RunError(f"{path}: not the categories of instances; {_CURE}")
    try:
        return checked_parents(made.get("parents"))
    except ValueError as error:
        raise RunError(f"{path}: {short(error)}; {_CURE}") from None


def checked_parents(parents: Any) -> dict[str, str]:
    """Names of instances and of their categories, which are no instances; ValueError for others."""
    if not fits(parents, dict[str, str]):
        raise ValueError("parents that are no names by names")
    found = {checked(name): checked(parent) for name, parent in parents.items()}
    for name, parent in found.items():
        if parent in found:
            raise ValueError(f"{name!r:.60} is of {parent!r:.60}, which is an instance itself")
    return found


def with_instances(names: Mapping[int, str], parents: Mapping[str, str], wanted: str) -> list[int]:
    """Ids of a category or an instance, of the instances of the category, and of all their blocks.

    `parents` by the names of instances, with their block or without. Empty for no such name.
    """
    found = []
    for i, name in names.items():
        of = name, parents.get(name, parents.get(category_of(name), name))
        if wanted in (*of, *map(category_of, of)):
            found.append(i)
    return found
