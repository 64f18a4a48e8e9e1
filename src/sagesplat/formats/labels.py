"""Labels beside a splat file: FILE.labels.json.

    {"format": "sagesplat-labels", "version": 1, "names": {"62": "chair", "201": "chair 1"},
     "parents": {"201": "chair"}, "counts": {"201": 1200, "-1": 3}, "runs": [[201, 1200], [-1, 3]]}

`runs` are label ids and how many rows of the file in turn have them; without `runs` the labels are those of
the file itself, and this is a dictionary of their names. `parents` are the categories of instances, by id.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Int16
from torch import Tensor

from sagesplat.core.errors import DataError, short
from sagesplat.core.limits import AtLeast1, CategoryId, LabelId
from sagesplat.core.names import repaired
from sagesplat.formats.splat import Splat
from sagesplat.io.files import atomic_path, regular
from sagesplat.io.typed import parse_json_as

_FORMAT = "sagesplat-labels"
NO_PARENTS: Mapping[int, str] = MappingProxyType({})


def sidecar(path: Path) -> Path:
    """The file with the labels of a splat file."""
    return path.with_name(path.name + ".labels.json")


def write_labels(
    path: Path,
    label_ids: Int16[Tensor, " N"],
    names: Mapping[int, str],
    parents: Mapping[int, str] = NO_PARENTS,
    *,
    runs: bool = True,
) -> Path:
    """Write the labels of the rows of the splat file `path` beside it; the path of what was written.

    Without `runs` it is a dictionary of names for a file that has the labels itself.
    """
    content = as_json(label_ids, names, parents, runs=runs)
    with atomic_path(sidecar(path), nbytes=len(content)) as temporary:
        temporary.write_bytes(content)
    return sidecar(path)


def write_or_remove_labels(
    path: Path, label_ids: Int16[Tensor, " N"], names: Mapping[int, str], parents: Mapping[int, str]
) -> None:
    """Write the labels beside `path`; where no row has one, remove those of an earlier file."""
    if bool((label_ids >= 0).any()):
        write_labels(path, label_ids, names, parents)
    else:
        sidecar(path).unlink(missing_ok=True)


def as_json(
    label_ids: Int16[Tensor, " N"],
    names: Mapping[int, str],
    parents: Mapping[int, str] = NO_PARENTS,
    *,
    runs: bool = True,
) -> bytes:
    """The labels of rows, the names of those that occur, and the categories of the instances among them."""
    return json.dumps(as_document(label_ids, names, parents, runs=runs), ensure_ascii=False).encode()


def as_document(
    label_ids: Int16[Tensor, " N"],
    names: Mapping[int, str],
    parents: Mapping[int, str] = NO_PARENTS,
    *,
    runs: bool = True,
) -> dict[str, Any]:
    """What `as_json` writes."""
    labels, sizes = (v.tolist() for v in torch.unique_consecutive(label_ids, return_counts=True))
    counts: dict[int, int] = {}
    for label, size in zip(labels, sizes, strict=True):
        counts[label] = counts.get(label, 0) + size
    named = {i: repaired(names[i], f"category {i}") for i in sorted(counts) if i in names and i >= 0}
    document: dict[str, Any] = {"format": _FORMAT, "version": 1, "names": named, "counts": counts}
    if of := {i: repaired(parents[i], f"category of {i}") for i in named if i in parents}:
        document["parents"] = of
    if runs:
        document["runs"] = list(zip(labels, sizes, strict=True))
    return document


def with_labels(splat: Splat, path: Path) -> Splat:
    """The splat with the labels that are beside its file `path`, if any; DataError if they do not fit."""
    beside = sidecar(path)
    if not beside.exists():
        return splat
    try:
        return labelled(splat, regular(beside).read_bytes())
    except OSError as error:
        raise DataError(f"{beside}: cannot be read ({error.strerror}); delete it, or copy it again") from None
    except ValueError as error:
        raise DataError(
            f"{beside}: no labels of {path.name} ({short(error)}); delete it, or export the scene again"
        ) from None


@dataclass(frozen=True)
class _Document:
    format: Literal["sagesplat-labels"]
    version: Literal[1]
    names: dict[CategoryId, str]
    parents: dict[CategoryId, str] = field(default_factory=dict)
    runs: list[tuple[LabelId, AtLeast1]] | None = None


def labelled(splat: Splat, content: bytes) -> Splat:
    """The splat with the labels that `as_json` wrote; ValueError if they do not fit."""
    made, labels = parse_json_as(content, _Document), splat.gaussians.label_ids
    if made.runs is not None:
        if sum(size for _, size in made.runs) != len(labels):
            raise ValueError(f"labels of other than its {len(labels)} rows")
        ids, sizes = (np.array([run[i] for run in made.runs], np.int64) for i in (0, 1))
        labels = torch.from_numpy(np.repeat(ids, sizes).astype(np.int16))
    names, parents = (
        {label: repaired(name, f"category {label}") for label, name in given.items()}
        for given in (made.names, made.parents)
    )
    g = replace(splat.gaussians, label_ids=labels)
    return replace(splat, gaussians=g, names=splat.names | names, parents=splat.parents | parents)
