"""The levels that are measured: files of splats, streamed SOG, bundles and run folders."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import torch
from msgspec import Meta

from sagesplat.core.errors import DataError, RunError
from sagesplat.core.gaussians import Gaussians
from sagesplat.core.geometry import NO_OFFSET, Position
from sagesplat.core.limits import AtLeast1, Count, LabelId, Share
from sagesplat.core.names import repaired
from sagesplat.formats.increments import (
    INDEX,
    Increment,
    Refine,
    ranges_of,
    read_increments,
    read_index,
    shown,
)
from sagesplat.formats.lod_meta import LOD_META, level_files
from sagesplat.formats.sog import META
from sagesplat.formats.splat import cleaned
from sagesplat.formats.splats import Splat, num_lods, read_splat
from sagesplat.io.typed import convert_as, read_json_as, refused
from sagesplat.run.capture import read_capture
from sagesplat.run.records import settings_of
from sagesplat.run.run_dir import RunDir
from sagesplat.segment.display_names import titles
from sagesplat.segment.masks import Taxonomy
from sagesplat.viewer.bundle import MANIFEST, is_bundle

_BUNDLE_CURE = "make it again with `sagesplat bundle`"


@dataclass(frozen=True)
class Level:
    """A level of detail of a scene."""

    name: str
    series: str  # what it is a level of: curves connect these
    nbytes: int  # of the files that hold it
    load: Callable[[], Splat]


def levels_of(path: Path) -> list[Level]:
    """The levels at a path, the finest first; a file of one splat is one level.

    `path`: a splat file of any format, a folder or lod-meta.json of streamed SOG, a bundle, or a finished run
    folder. Level k of a bundle or a run is level k of every category. DataError where there is none.
    """
    name = repaired(path.name or path.resolve().name)
    if path.is_dir() and is_bundle(path):
        return _of_bundle(path, name)
    if (path / "provenance").is_dir():
        return _of_run(path, name)
    if path.is_dir() and not any((path / name).exists() for name in (LOD_META, META)):
        raise DataError(f"{path}: neither a run, a bundle nor a splat; give one of these")
    count = num_lods(path)
    if count == 1:
        return [Level(name, "files", stored_bytes(path), partial(read_splat, path))]
    file = path / LOD_META if path.is_dir() else path
    if file.name != LOD_META:
        raise DataError(f"{path}: an archive of {count} levels; unpack it, and give its {LOD_META}")
    series = repaired(path.resolve().name if path.is_dir() else path.resolve().parent.name)
    return [
        Level(
            f"{series} level {lod}", series, sum(map(stored_bytes, level_files(file, lod))),
            partial(read_splat, path, lod),
        )
        for lod in range(count)
    ]  # fmt: skip


def level_of(g: Gaussians, number: int) -> Level:
    """Gaussians of a script as a level: its bytes are those of a PLY, 248 each."""
    name = f"level {number}" if number else "reference"
    return Level(name, "Gaussians", g.nbytes, lambda: cleaned(Splat(g.detach().to("cpu"), "Gaussians"), name))


def stored_bytes(path: Path) -> int:
    """Size of a splat file; of an unpacked SOG that of its folder's description and pictures."""
    file = path / META if path.is_dir() else path
    try:
        beside = file.parent.glob("*.webp") if file.name == META else ()
        return file.stat().st_size + sum(picture.stat().st_size for picture in beside)
    except OSError as error:
        raise DataError(f"{file}: cannot be read ({error.strerror}); copy it again") from None


def unique_names(levels: Sequence[Level], folders: Sequence[str]) -> list[str]:
    """Their names; of those that several have, with their folder, or else a number."""
    times = Counter(level.name for level in levels)
    names = [
        level.name if times[level.name] == 1 or not folder else f"{repaired(folder)}/{level.name}"
        for level, folder in zip(levels, folders, strict=True)
    ]
    times, seen = Counter(names), Counter[str]()
    for i, name in enumerate(names):
        seen[name] += 1
        names[i] = name if times[name] == 1 else f"{name} ({seen[name]})"
    return names


@dataclass(frozen=True)
class _BundleLevels:
    """Consecutive levels of a cell in a bundle's manifest."""

    uri: Annotated[str, Meta(pattern="^chunks/")]
    bytes: list[AtLeast1]
    counts: list[AtLeast1]
    refine: Refine = "ADD"
    offset: Count = 0
    weights: list[Share] | None = None


@dataclass(frozen=True)
class _BundleCell:
    id: LabelId
    levels: list[_BundleLevels]

    def increments(self, label_id: int) -> list[Increment]:
        found: list[Increment] = []
        for some in self.levels:
            ranges = ranges_of([(some.uri.removeprefix("chunks/"), some.offset, some.bytes)])
            weights = some.weights or [None] * len(ranges)
            levels = zip(ranges, some.counts, weights, strict=True)
            for i, ((uri, offset, nbytes), count, weight) in enumerate(levels):
                found.append(
                    Increment(
                        label_id,
                        self.id,
                        len(found) + 1,
                        uri,
                        count,
                        nbytes,
                        gpu_bytes=count,
                        sha256="0" * 64,  # neither is asked for here
                        refine="ADD" if i else some.refine,
                        offset=offset,
                        weight=weight,
                    )
                )
        return found


@dataclass(frozen=True)
class _BundleLabel:
    id: LabelId
    title: str
    cells: list[_BundleCell]


@dataclass(frozen=True)
class _Bundle:
    labels: Annotated[list[_BundleLabel], Meta(max_length=2**15)]
    antialiased: Any = False


def _of_bundle(path: Path, name: str) -> list[Level]:
    file, what = path / MANIFEST, "a bundle of sagesplat"
    manifest = read_json_as(file, _Bundle, what, _BUNDLE_CURE)
    names = {label.id: repaired(label.title, "?") for label in manifest.labels}
    with refused(file, what, _BUNDLE_CURE):
        made = [
            asdict(one)
            for label in manifest.labels
            for cell in label.cells
            for one in cell.increments(label.id)
        ]
        listed = convert_as(made, list[Increment])
    return _of_chunks(path / "chunks", listed, names, name, manifest.antialiased is True)


def _of_run(path: Path, name: str) -> list[Level]:
    run = RunDir(path, "nested")
    if not (run.increments / INDEX).exists():
        raise RunError(f"{path}: a run without nested levels; finish it with `sagesplat run`")
    antialiased = bool(settings_of(run, "train")["antialiased"])
    folder = run.instances if run.has_instances else run.masks
    names = titles(Taxonomy.read(folder / "labels.json").names)
    offset = read_capture(run.scene).offset
    return _of_chunks(run.increments, read_index(run.increments), names, name, antialiased, offset)


def _of_chunks(
    folder: Path, listed: Sequence[Increment], names: dict[int, str], name: str, antialiased: bool,
    offset: Position = NO_OFFSET,
) -> list[Level]:  # fmt: skip
    label_of = {chunk.cell: chunk.label_id for chunk in sorted(listed, key=lambda one: one.cell)}
    if not label_of:
        raise DataError(f"{folder.parent}: no levels in it; {_BUNDLE_CURE}")
    levels = []
    for number in sorted({chunk.level for chunk in listed}, reverse=True):
        chunks = [chunk for cell in label_of for chunk in shown(listed, cell, number)]

        def load(chunks: Sequence[Increment] = chunks) -> Splat:
            g, table = read_increments(folder, chunks), torch.tensor(list(label_of.values()))
            rows = torch.searchsorted(torch.tensor(list(label_of)), g.label_ids.long())
            g = replace(g, label_ids=table[rows].to(g.label_ids.dtype))
            return Splat(g, "increments", names, antialiased, offset=offset)

        levels.append(Level(f"{name} level {number}", name, sum(chunk.nbytes for chunk in chunks), load))
    return levels
