"""Writes splat files for other viewers, in the format that the file's name says."""

from collections.abc import Mapping
from pathlib import Path

from sagesplat.core.errors import DataError
from sagesplat.core.gaussians import Gaussians
from sagesplat.formats.labels import sidecar, write_labels
from sagesplat.formats.lod_meta import LOD_META
from sagesplat.formats.ply import write_ply
from sagesplat.formats.sog_write import write_sog
from sagesplat.formats.spz import write_spz

_SUFFIXES = (".ply", ".spz", ".sog")


def written_as(path: Path) -> str:
    """The suffix that says the format, or `lod-meta.json`; DataError for a name that says none."""
    suffix = path.suffix.lower()
    if path.name != LOD_META and suffix not in _SUFFIXES:
        known = ", ".join(_SUFFIXES)
        raise DataError(f"{path}: its name says no format that is written; use {known} or {LOD_META}")
    return LOD_META if path.name == LOD_META else suffix


def write_splat(
    path: Path,
    g: Gaussians,
    names: Mapping[int, str] | None = None,
    *,
    parents: Mapping[int, str] | None = None,
    antialiased: bool = False,
) -> None:
    """Write Gaussians as .ply, .spz (version 4) or .sog, by the suffix, with their labels and `names`.

    `parents` are the names of the categories that instances are of, by label id; a PLY with some gets a
    dictionary beside it too, as many tools drop the comments of its header. `read_splat` finds all of it
    again. DataError for another suffix, and what the formats cannot hold.
    """
    match written_as(path):
        case ".ply":
            write_ply(path, g, names, parents=parents, antialiased=antialiased)
            if parents:
                write_labels(path, g.label_ids, names or {}, parents, runs=False)
            else:
                sidecar(path).unlink(missing_ok=True)  # of an earlier file
        case ".spz":
            write_spz(path, g, version=4, names=names or {}, parents=parents, antialiased=antialiased)
        case ".sog":
            write_sog(path, g, names, parents=parents, antialiased=antialiased)
        case _:
            raise DataError(f"{path}: {LOD_META} holds several levels; use `write_lod_meta`")
