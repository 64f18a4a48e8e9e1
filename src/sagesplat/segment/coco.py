"""COCO panoptic: its 133 categories, and the segments that its JSON files describe."""

from dataclasses import dataclass
from pathlib import Path

from sagesplat.core.errors import LabelError, RunError, short
from sagesplat.core.names import check_photo
from sagesplat.io.files import read_json

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


def read_panoptic(folder: Path) -> Panoptic | None:
    """The one panoptic JSON of a folder, with PNGs beside it or in a folder of the JSON's name.

    None where the folder holds no JSON with "annotations"; LabelError where it holds several or a
    damaged one.
    """
    found = []
    for path in sorted(folder.glob("*.json")):
        try:
            content = read_json(path)
        except RunError as error:
            raise LabelError(f"{error}; repair or remove it") from None
        if isinstance(content, dict) and "annotations" in content:
            found.append((path, content))
    if not found:
        return None
    if len(found) > 1:
        names = ", ".join(path.name for path, _ in found)
        raise LabelError(f"{folder}: several JSON files with annotations ({names}); leave one of them")
    path, content = found[0]
    beside = path.with_suffix("")
    pngs, segments = {}, {}
    try:
        names = {int(c["id"]): c["name"] for c in content.get("categories", [])} or NAMES
        for annotation in content["annotations"]:
            file = Path(annotation["file_name"])
            check_photo(file.as_posix())
            key = str(file.with_suffix(""))
            pngs[key] = (beside if beside.is_dir() else folder) / file
            segments[key] = {int(s["id"]): int(s["category_id"]) for s in annotation["segments_info"]}
    except (AttributeError, KeyError, TypeError, ValueError, OverflowError) as error:
        raise LabelError(
            f"{path}: not in COCO's panoptic format ({short(repr(error))}); export the annotations again"
        ) from None
    if any(not 0 <= segment < 2**24 for of_image in segments.values() for segment in of_image):
        raise LabelError(f"{path}: segment ids beyond R + 256 G + 65536 B; export the annotations again")
    unnamed = sorted({c for of_image in segments.values() for c in of_image.values()} - set(names))
    if unnamed:
        raise LabelError(
            f'{path}: categories {short(unnamed[:5])} have no name; add them to its "categories"'
        )
    return Panoptic(names, pngs, segments)
