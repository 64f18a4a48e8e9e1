"""COCO panoptic: its 133 categories, and the segments that its JSON files describe."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from msgspec import Meta

from sagesplat.core.errors import LabelError, short
from sagesplat.core.names import check_photo
from sagesplat.io.files import read_json
from sagesplat.io.typed import convert_as, refused

_ROWS = [
    line.split(maxsplit=2)
    for line in Path(__file__).with_name("coco_panoptic.txt").read_text(encoding="utf-8").splitlines()
    if not line.startswith("#")
]
NAMES: dict[int, str] = {int(label_id): name for label_id, _, name in _ROWS}
COLORS: dict[int, tuple[int, int, int]] = {
    int(label_id): (int(color[:2], 16), int(color[2:4], 16), int(color[4:], 16))
    for label_id, color, _ in _ROWS
}


@dataclass(frozen=True, eq=False)
class Panoptic:
    """A JSON file in COCO's panoptic format with the PNG files that belong to it."""

    names: dict[int, str]  # category id -> name
    pngs: dict[str, Path]  # image name without suffix -> PNG; a pixel's segment is R + 256 G + 65536 B
    segments: dict[str, dict[int, int]]  # image name without suffix -> {segment id: category id}


@dataclass(frozen=True)
class _Category:
    id: int
    name: str


@dataclass(frozen=True)
class _Segment:
    id: Annotated[int, Meta(ge=0, lt=2**24)]  # R + 256 G + 65536 B
    category_id: int


@dataclass(frozen=True)
class _Annotation:
    file_name: str
    segments_info: list[_Segment]

    def __post_init__(self) -> None:
        check_photo(Path(self.file_name).as_posix())


@dataclass(frozen=True)
class _File:
    annotations: list[_Annotation]
    categories: list[_Category] = field(default_factory=list)


def read_panoptic(folder: Path) -> Panoptic | None:
    """The one panoptic JSON of a folder, with PNGs beside it or in a folder of the JSON's name.

    None where the folder holds no JSON with "annotations"; LabelError where it holds several or a
    damaged one.
    """
    found = []
    for path in sorted(folder.glob("*.json")):
        content = read_json(path, "repair or remove it", LabelError)
        if isinstance(content, dict) and "annotations" in content:
            found.append((path, content))
    if not found:
        return None
    if len(found) > 1:
        names = ", ".join(path.name for path, _ in found)
        raise LabelError(f"{folder}: several JSON files with annotations ({names}); leave one of them")
    path, content = found[0]
    with refused(path, "in COCO's panoptic format", "export the annotations again", LabelError):
        made = convert_as(content, _File, strict=False)
    beside = path.with_suffix("")
    names = {category.id: category.name for category in made.categories} or NAMES
    pngs, segments = {}, {}
    for annotation in made.annotations:
        file = Path(annotation.file_name)
        key = str(file.with_suffix(""))
        pngs[key] = (beside if beside.is_dir() else folder) / file
        segments[key] = {segment.id: segment.category_id for segment in annotation.segments_info}
    unnamed = sorted({c for of_image in segments.values() for c in of_image.values()} - set(names))
    if unnamed:
        raise LabelError(
            f'{path}: categories {short(unnamed[:5])} have no name; add them to its "categories"'
        )
    return Panoptic(names, pngs, segments)
