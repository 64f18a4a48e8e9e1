"""Which category each instance is of, by their names: parents.json of a run, `parents` of other files.

{"format": "sagesplat-parents", "version": 1, "parents": {"chair 1": "chair", "chair 2": "chair"}}
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

from sagesplat.core.errors import RunError
from sagesplat.core.names import checked
from sagesplat.io.files import write_json
from sagesplat.io.typed import read_json_as, refused

_CURE = "delete it, and run `sagesplat instances` again with --force"


def write_parents(path: Path, parents: Mapping[str, str]) -> None:
    """Write parents.json; none: remove it."""
    if parents:
        write_json(path, asdict(_Parents("sagesplat-parents", 1, dict(sorted(parents.items())))))
    else:
        path.unlink(missing_ok=True)


@dataclass(frozen=True)
class _Parents:
    format: Literal["sagesplat-parents"]
    version: Literal[1]
    parents: dict[str, str]


def read_parents(path: Path) -> dict[str, str]:
    """The category of each instance; empty where there is no such file. RunError for a damaged one."""
    if not path.exists():
        return {}
    what = "the categories of instances"
    made = read_json_as(path, _Parents, what, _CURE, RunError)
    with refused(path, what, _CURE, RunError):
        found = {checked(name): checked(parent) for name, parent in made.parents.items()}
        for name, parent in found.items():
            if parent in found:
                raise ValueError(f"{name!r:.60} is of {parent!r:.60}, which is an instance itself")
    return found


def with_instances(names: Mapping[int, str], parents: Mapping[str, str], wanted: str) -> list[int]:
    """Ids of a category or an instance, and of the instances of the category; empty for no such name.

    `parents` by the names of instances.
    """
    return [i for i, name in names.items() if wanted in (name, parents.get(name))]
