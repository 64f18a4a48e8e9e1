"""Finds the files of photos by the names that models, transforms files and lists give them.

Other tools, other disks and other people write them differently: with backslashes, capitals, accents as
characters of their own, the folder in front, the path of another machine, without or with another suffix.
"""

import os
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path, PurePosixPath

from sagesplat.core.errors import short
from sagesplat.core.names import check_photo, collision_key, composed

# Their content decides how they are read (`io.pictures`).
PHOTOS = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp", ".avif", ".heic", ".heif"})
# of photos that were exported as others
_RAW = frozenset({".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2", ".gpr"})
_DEEPEST, _MOST = 8, 10**5  # folders below each other, and in all
PHOTO_FOLDERS = ("images", "input")  # 3DGS's own scripts read photos from input/
# Folders beside photos begin so: of smaller copies, masks, depths.
NOT_PHOTOS = ("images_", "mask", "depth", "normal", "semantic", "sparse", "distorted", "confidence", "thumb")
_SAME = {".jpeg": ".jpg", ".tiff": ".tif", ".heif": ".heic"}


@dataclass(frozen=True)
class Found:
    """The photos of a folder that names were found for."""

    folder: Path
    names: Sequence[str]  # as written
    files: dict[str, str]  # name as written -> path below the folder, as on the disk
    prefix: str = ""  # of all names: folders above the folder

    @property
    def missing(self) -> list[str]:
        """Names without a file."""
        return [name for name in self.names if name not in self.files]

    @cached_property
    def written_differently(self) -> str:
        """One line on the names that are not those of the files; empty where all are.

        A bare name, without folder and suffix, is that of any picture of this name.
        """
        changed = [
            (name, file)
            for name, file in self.files.items()
            if name.removeprefix("./") != self.prefix + file and name != PurePosixPath(file).stem
        ]
        if not changed:
            return ""
        name, file = changed[0]
        of = "one photo is" if len(changed) == 1 else f"{len(changed)} of {len(self.names)} photos are"
        accents = ", with accents in another form of Unicode" if composed(name) == composed(file) else ""
        return f"{of} written differently in the poses: {short(repr(name))} is {short(repr(file))}{accents}"


class PhotoFolder:
    """The photos below a folder. The disk is searched only for names that are not there as they are."""

    def __init__(self, folder: Path, *, all_folders: bool = False):
        """`all_folders`: look in those of masks and smaller copies, too."""
        self.folder = folder
        self._skipped = () if all_folders else NOT_PHOTOS

    def find(self, names: Sequence[str]) -> Found:
        """The files that the names mean.

        A name is taken as it is, where there is such a file. Others are compared without regard to case,
        form of Unicode, separators and `..`; then with another suffix of a picture; then by as many folders
        as both have at the end; last by the name alone, in folders of which no photo is known. A file that
        two names would mean, and a name that would mean two files, are not matched.
        """
        found = {name: file for name in dict.fromkeys(names) if (file := self._exact(name)) is not None}
        rest = [name for name in dict.fromkeys(names) if name not in found]
        if rest:
            self._match(rest, found)
        return Found(self.folder, names, {name: found[name] for name in names if name in found})

    def _exact(self, name: str) -> str | None:
        below = plain(name)
        if not below or below.startswith("/") or ".." in below.split("/"):
            return None
        there = os.path.isfile(self.folder / below)  # False for impossible names
        return below if there and usable(below) else None

    def _match(self, rest: list[str], found: dict[str, str]) -> None:
        """Add matches of names that are no files to `found`, the most certain first."""
        taken = set(found.values())
        by_stem: dict[str, list[_Name]] = defaultdict(list)
        for file in self.files:
            if file.written not in taken:
                by_stem[file.parts[-1]].append(file)
        waiting = [_Name.of(name) for name in rest]
        homes = {_Name.of(name).parts[:-1] for name in found}  # folders as written whose photos are known
        for rule in (_same_path, _same_tail, _same_stem):
            known = {_Name.of(file).parts[:-1] for file in taken if rule is _same_stem}
            for same_suffix in (True, False):
                wanted: dict[str, list[_Name]] = defaultdict(list)
                for name in waiting:
                    if rule is not _same_path and name.parts[:-1] in homes:
                        continue  # the others of its folder are where they were: this one is gone
                    files = [f for f in by_stem[name.parts[-1]] if f.written not in taken]
                    files = [f for f in files if f.suffix == name.suffix or not same_suffix]
                    files = [f for f in files if f.parts[:-1] not in known]
                    if len(best := rule(name, files)) == 1:
                        wanted[best[0].written].append(name)
                sure = {name.written: file for file, (name, *more) in wanted.items() if not more}
                found |= sure
                taken |= set(sure.values())
                waiting = [name for name in waiting if name.written not in sure]
                if rule is _same_path:
                    homes |= {_Name.of(name).parts[:-1] for name in sure}

    @cached_property
    def files(self) -> "list[_Name]":
        """Photos below the folder, without hidden ones and folders of masks, depths and smaller copies."""
        return [_Name.of(name) for name in sorted(_walk(self.folder, "", 0, self._skipped, set()))]


@dataclass(frozen=True)
class _Name:
    """A name, and what is compared of it."""

    written: str
    parts: tuple[str, ...]  # the last without its suffix
    suffix: str  # empty where it has none of a picture

    @staticmethod
    def of(name: str) -> "_Name":
        parts = [part for part in collision_key(plain(name)).split("/") if part not in ("", "..")]
        stem, dot, suffix = (parts or [""])[-1].rpartition(".")
        if f".{suffix}" not in PHOTOS | _RAW or not stem:
            stem, suffix = (parts or [""])[-1], ""
        kind = f"{dot}{suffix}" if suffix else ""
        return _Name(name, (*parts[:-1], stem), _SAME.get(kind, kind))


def plain(name: str) -> str:
    """A path as written by any machine, with `/` between its parts and without needless ones.

    A `..` that follows a folder is taken away with it.
    """
    parts: list[str] = []
    for part in name.replace("\\", "/").split("/"):
        if part == ".." and parts and parts[-1] not in ("", ".."):
            parts.pop()
        elif part != "." and (part or not parts):
            parts.append(part)
    return "/".join(parts)


def usable(file: str) -> bool:
    """Whether a path below a folder is one that a photo may have (`names.check_photo`)."""
    try:
        check_photo(file)
    except ValueError:
        return False
    return True


def _same_path(name: _Name, files: list[_Name]) -> list[_Name]:
    return [file for file in files if file.parts == name.parts]


def _same_tail(name: _Name, files: list[_Name]) -> list[_Name]:
    """Files of whose paths one ends as the other does, from the first part of the shorter; the longest."""

    def shared(file: _Name) -> int:
        length = min(len(file.parts), len(name.parts))
        return length if file.parts[-length:] == name.parts[-length:] else 0

    most = max(map(shared, files), default=0)
    return [file for file in files if most and shared(file) == most]


def _same_stem(_name: _Name, files: list[_Name]) -> list[_Name]:
    return files


def folders_of(folder: Path) -> list[Path]:
    """Folders in a folder, by name, without hidden ones; none where it cannot be read."""
    try:
        with os.scandir(folder) as listing:
            return sorted(Path(entry.path) for entry in listing if entry.is_dir() and entry.name[0] != ".")
    except OSError:
        return []


def holds_photos(folder: Path) -> bool:
    """Whether a folder has a photo in it, whatever is in the folders below; not where it cannot be read."""
    try:
        with os.scandir(folder) as listing:
            return any(
                os.path.splitext(entry.name)[1].lower() in PHOTOS and entry.is_file() for entry in listing
            )
    except OSError:
        return False


def _walk(
    folder: Path, below: str, depth: int, skipped: tuple[str, ...], seen: set[tuple[int, int]]
) -> Iterator[str]:
    try:
        status = os.stat(folder)
        with os.scandir(folder) as listing:
            entries = sorted(listing, key=lambda entry: entry.name)
    except OSError:
        return
    if (status.st_dev, status.st_ino) in seen or depth > _DEEPEST or len(seen) > _MOST:
        return  # a link to a folder above
    seen.add((status.st_dev, status.st_ino))
    for entry in entries:
        name = entry.name
        if name.startswith("."):
            continue
        if entry.is_dir():
            if not (skipped and name.lower().startswith(skipped)):
                yield from _walk(folder / name, f"{below}{name}/", depth + 1, skipped, seen)
        elif PurePosixPath(name).suffix.lower() in PHOTOS and usable(f"{below}{name}"):
            yield below + name
