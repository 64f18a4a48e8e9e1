"""Labels beside a splat file of a format that holds none: FILE.labels.json.

    {"format": "sagesplat-labels", "version": 1, "names": {"184": "tree-merged"},
     "counts": {"184": 1200, "-1": 3}, "runs": [[184, 1200], [-1, 3]]}

`runs` are label ids and how many rows of the file in turn have them.
"""

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Int16
from torch import Tensor

from sagesplat.core.errors import DataError, short
from sagesplat.core.names import repaired
from sagesplat.formats.splat import Splat
from sagesplat.io.files import atomic_path, loads_json, regular

_FORMAT = "sagesplat-labels"


def sidecar(path: Path) -> Path:
    """The file with the labels of a splat file."""
    return path.with_name(path.name + ".labels.json")


def write_labels(path: Path, label_ids: Int16[Tensor, " N"], names: Mapping[int, str]) -> Path:
    """Write the labels of the rows of the splat file `path` beside it; the path of what was written."""
    content = as_json(label_ids, names)
    with atomic_path(sidecar(path), nbytes=len(content)) as temporary:
        temporary.write_bytes(content)
    return sidecar(path)


def as_json(label_ids: Int16[Tensor, " N"], names: Mapping[int, str]) -> bytes:
    """The labels of rows, and the names of those that occur."""
    labels, sizes = (v.tolist() for v in torch.unique_consecutive(label_ids, return_counts=True))
    counts: dict[int, int] = {}
    for label, size in zip(labels, sizes, strict=True):
        counts[label] = counts.get(label, 0) + size
    named = {i: repaired(names[i], f"category {i}") for i in sorted(counts) if i in names}
    runs = list(zip(labels, sizes, strict=True))
    document = {"format": _FORMAT, "version": 1, "names": named, "counts": counts, "runs": runs}
    return json.dumps(document, ensure_ascii=False).encode()


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


def labelled(splat: Splat, content: bytes) -> Splat:
    """The splat with the labels that `as_json` wrote; ValueError if they do not fit."""
    try:
        document = loads_json(content)
        if document["format"] != _FORMAT or document["version"] != 1:
            raise ValueError(f"format {document['format']!r:.40}, version {document['version']!r:.20}")
        labels = _labels(document["runs"], len(splat.gaussians))
        names = _names(document["names"])
    except (TypeError, KeyError, AttributeError) as error:
        raise ValueError(repr(error)) from None
    return replace(splat, gaussians=replace(splat.gaussians, label_ids=labels), names=splat.names | names)


def _labels(runs: Any, count: int) -> Int16[Tensor, " N"]:
    """Labels of `count` rows; ValueError unless `runs` are those of as many."""
    for run in runs:
        label, size = run
        if (
            type(label) is not int
            or type(size) is not int
            or not -1 <= label < 2**15
            or not 0 < size <= count
        ):
            raise ValueError(f"{run!r:.60} in place of a label and a number of rows")
    if sum(size for _, size in runs) != count:
        raise ValueError(f"labels of other than its {count} rows")
    labels, sizes = (np.array([run[i] for run in runs], np.int64) for i in (0, 1))
    return torch.from_numpy(np.repeat(labels, sizes).astype(np.int16))


def _names(names: Mapping[str, Any]) -> dict[int, str]:
    found = {int(label): repaired(name, f"category {label}") for label, name in names.items()}
    if not all(0 <= label < 2**15 for label in found):
        raise ValueError("names of no label ids")
    return found
