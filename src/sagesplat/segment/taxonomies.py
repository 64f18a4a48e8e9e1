"""What the classes of common training sets are in COCO panoptic, which scenes are labelled with."""

import tomllib
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Literal, get_args

from sagesplat.core.errors import LabelError
from sagesplat.segment import coco

Source = Literal["coco", "coco-stuff", "ade20k", "cityscapes"]
SOURCES: tuple[Source, ...] = get_args(Source)
_KNOWN_SHARE = 0.8  # of a network's classes; the rest may be "background" and the like


def vocabulary(source: Source) -> tuple[str, ...]:
    """The names of a training set's classes, in the order of a network's outputs.

    `coco`: the 133 categories of COCO panoptic; `coco-stuff`: the 171 of COCO-Stuff 164k; `ade20k`: the 150
    of SceneParse150; `cityscapes`: the 19 train ids. LabelError for another source.
    """
    return tuple(_first(name) for name in _classes(source))


def to_coco(names: Sequence[str], source: Source | None = None) -> list[int | None]:
    """The COCO panoptic id of each class, None where there is no such category or the name is unknown.

    Case, "_", "-" and spaces do not matter; of "building, edifice" the first name counts. Without a `source`
    the one that fits all names best decides (see `guess_source`), else for each name the first that has it.
    COCO-Stuff's classes are merged and removed as COCO panoptic does it (cocodataset.org/#panoptic-eval).
    LabelError for another source.
    """
    source = source or guess_source(names)
    tables = [_table(s) for s in ([source] if source else SOURCES)]
    return [next((t[key] for t in tables if key in t), None) for key in map(_key, names)]


def guess_source(names: Sequence[str]) -> Source | None:
    """The training set whose classes these are; None where fewer than 4 in 5 names are those of one set.

    Names that several sets know as well as each other speak for the first of `SOURCES`.
    """
    keys = {_key(name) for name in names}
    known = {source: len(keys & _table(source).keys()) for source in SOURCES}
    best = max(SOURCES, key=known.__getitem__)
    return best if keys and known[best] >= _KNOWN_SHARE * len(keys) else None


@cache
def _table(source: Source) -> dict[str, int | None]:
    """Normalised name -> COCO panoptic id. A class's own name comes before the same synonym of another."""
    ids = {name: label_id for label_id, name in coco.NAMES.items()} | {"": None}
    classes = _classes(source)
    table = {_key(name): ids[target] for name, target in classes.items()}
    for name, target in classes.items():
        for synonym in name.split(",")[1:]:
            table.setdefault(_key(synonym), ids[target])
    return table


@cache
def _vocabularies() -> dict[str, dict[str, str]]:
    path = Path(__file__).with_name("vocabularies.toml")
    return tomllib.loads(path.read_text(encoding="utf-8")) | {"coco": {n: n for n in coco.NAMES.values()}}


def _classes(source: Source) -> dict[str, str]:
    """Name with synonyms -> COCO panoptic's name or "", in class-index order."""
    if source not in SOURCES:
        raise LabelError(f"vocabulary {source!r} is not known; use one of {', '.join(SOURCES)}")
    return _vocabularies()[source]


def _first(name: str) -> str:
    return name.partition(",")[0].strip()


def _key(name: str) -> str:
    return " ".join(_first(name).lower().replace("_", " ").replace("-", " ").split())
