"""Reads and writes splat files in the formats of `registry`; docs/formats.md has the table."""

import stat
from collections.abc import Collection, Mapping
from dataclasses import replace
from pathlib import Path
from typing import BinaryIO

from sagesplat.core.errors import DataError
from sagesplat.core.gaussians import Gaussians
from sagesplat.core.geometry import NO_OFFSET, Position
from sagesplat.formats.archive import unpacked
from sagesplat.formats.labels import with_labels
from sagesplat.formats.offsets import with_offset, write_offset
from sagesplat.formats.registry import READERS, WRITERS
from sagesplat.formats.splat import (
    Frame,
    ReadOptions,
    Splat,
    SplatReader,
    SplatWriter,
    WriteScene,
    cleaned,
    near_origin,
)
from sagesplat.io.files import loads_json

__all__ = ["Splat", "num_lods", "read_splat", "scene_writer", "write_splat", "writer_of"]


def read_splat(path: Path | str, lod: int = 0, *, spz_axes: Frame = "rub") -> Splat:
    """Read a splat of any format that is known, without the Gaussians that cannot be drawn.

    The content tells the format, not the name; only .splat, which has no header, needs its suffix. Labels
    come from the file or from a sidecar beside it (`formats/labels.py`).

    Args:
        path: The file, or the folder of a SOG (`meta.json`) or a streamed one (`lod-meta.json`), or a ZIP
            archive with one splat in it, such as a .ssog.
        lod: The level of a streamed SOG; 0 is the finest, and the only one of other formats.
        spz_axes: The axes of SPZ files that do not say theirs. The format's own are right, up, back;
            PlayCanvas's tools write those of PLY, "rdf".

    Returns:
        Gaussians in COLMAP's axes as INRIA's PLY has them, with what was left out by reason. Where they are
        far from the origin an offset was subtracted from their positions: `Splat.offset`.

    Raises:
        DataError: If there is no such file or level, its format is not known, or it is damaged; or if no
            Gaussian is left.

    Example:
        >>> import tempfile, torch
        >>> from pathlib import Path
        >>> from sagesplat import Gaussians, write_ply
        >>> from sagesplat.formats.splats import read_splat
        >>> z = torch.zeros
        >>> ids = torch.zeros(5, dtype=torch.int16)
        >>> g = Gaussians(z(5, 3), z(5, 4), z(5, 3), z(5), z(5, 1, 3), z(5, 3, 3), ids)
        >>> g.quats[1:, 0] = 1
        >>> path = Path(tempfile.mkdtemp()) / "scene.sog"  # the name does not matter
        >>> write_ply(path, g, {0: "tree"})
        >>> splat = read_splat(path)
        >>> splat.kind, len(splat.gaussians), splat.dropped, splat.names
        ('PLY', 4, {'a rotation of zeros': 1}, {0: 'tree'})
    """
    path = Path(path)
    with unpacked(path) as inside:
        file, kind, reader = _found(inside)
        if lod and reader.num_lods is None:
            raise DataError(f"{file}: {kind} has one level; read level 0")
        splat = reader.read(file, ReadOptions(lod=lod, spz_axes=spz_axes))
        splat = cleaned(with_offset(with_labels(splat, file), file), str(file))
        if inside != path:
            splat = with_labels(replace(splat, kind=f"{splat.kind} in a ZIP"), path)
            splat = with_offset(splat, path)
    return near_origin(splat)


def num_lods(path: Path) -> int:
    """How many levels of detail a splat file, folder or archive has: 1, but of a streamed SOG."""
    with unpacked(path) as inside:
        file, _, reader = _found(inside)
        return reader.num_lods(file) if reader.num_lods else 1


def _found(path: Path) -> tuple[Path, str, SplatReader]:
    """The file to read, which may be in the folder `path`, and its format; DataError if it has none."""
    try:
        if path.is_dir():
            names = [reader.in_folder for reader in READERS.values() if reader.in_folder]
            inside = [path / name for name in names if (path / name).exists()]
            if not inside:
                raise DataError(f"{path}: a folder without {' or '.join(names)}; give a splat file")
            path = inside[0]
        if not stat.S_ISREG(path.stat().st_mode):
            raise DataError(f"{path}: no regular file; give a splat file")
        with path.open("rb") as file:
            keys = _json_keys(file)
            kinds = [kind for kind, reader in READERS.items() if _recognises(reader, file, keys)]
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror}); give a splat file") from None
    kinds += [kind for kind, reader in READERS.items() if reader.suffix == path.suffix.lower()]
    if not kinds:
        raise DataError(f"{path}: no splat format that is known; convert it to one of {', '.join(READERS)}")
    return path, kinds[0], READERS[kinds[0]]


def _json_keys(file: BinaryIO) -> Collection[str]:
    """The keys of the object that a JSON file holds; none of another file."""
    file.seek(0)
    if not file.read(64).removeprefix(b"\xef\xbb\xbf").lstrip().startswith(b"{"):
        return ()
    file.seek(0)
    try:
        document = loads_json(file.read())
    except ValueError:
        return ()
    return document.keys() if isinstance(document, dict) else ()


def _recognises(reader: SplatReader, file: BinaryIO, json_keys: Collection[str]) -> bool:
    file.seek(0)
    if file.read(64).startswith(reader.magic):
        file.seek(0)
        return reader.accepts is None or reader.accepts(file)
    return reader.json_key in json_keys


def writer_of(path: Path) -> SplatWriter:
    """How files of this name are written; DataError for a name that says no format."""
    suffixes = [name for name in WRITERS if name.startswith(".") and path.name.lower().endswith(name)]
    writer = WRITERS.get(path.name) or WRITERS.get(max(suffixes, key=len, default=""))
    if path.suffix.lower() in (".html", ".htm"):
        raise DataError(
            f"{path}: a page is no splat file; `sagesplat bundle RUN {path} --single-file` writes a page "
            "with the viewer in it"
        )
    if writer is None or not path.stem:
        raise DataError(f"{path}: its name says no format that is written; use {_listed(WRITERS)}")
    return writer


def write_splat(
    path: Path | str,
    gaussians: Gaussians,
    names: Mapping[int, str] | None = None,
    *,
    parents: Mapping[int, str] | None = None,
    antialiased: bool = False,
    offset: Position = NO_OFFSET,
) -> None:
    """Write Gaussians in the format that the suffix of a path says, with their labels; `read_splat` reads it.

    Args:
        path: A .ply, .compressed.ply, .spz, .sog, .glb, .splat or .rad; replaced if it is there.
        gaussians: N Gaussians on any device.
        names: Category names by label id. With the labels they go into the file where its format has a place
            for them, else into one beside it, PATH.labels.json.
        parents: Names of the categories that instances are of, by the instance's label id.
        antialiased: Whether the scene was trained so.
        offset: What is to be added to all positions for those of the capture, written beside the file.

    Raises:
        DataError: For another suffix, lod-meta.json and .ssog, which hold several levels, and what the format
            cannot hold.
        OSError: If a file cannot be written.

    Example:
        >>> import tempfile, torch
        >>> from pathlib import Path
        >>> from sagesplat import Gaussians, read_splat, write_splat
        >>> z = torch.zeros
        >>> ids = torch.zeros(5, dtype=torch.int16)
        >>> g = Gaussians(z(5, 3), z(5, 4) + 1, z(5, 3), z(5), z(5, 1, 3), z(5, 3, 3), ids)
        >>> path = Path(tempfile.mkdtemp()) / "scene.spz"
        >>> write_splat(path, g, {0: "tree"})
        >>> read_splat(path).names
        {0: 'tree'}
    """
    path = Path(path)
    scene_writer(path)(path, gaussians, names or {}, parents or {}, antialiased)
    write_offset(path, offset)


def scene_writer(path: Path) -> WriteScene:
    """What writes a scene to a file of this name; DataError unless the name is of a format of one scene."""
    write = writer_of(path).write
    if write is None:
        single = [name for name, writer in WRITERS.items() if writer.write]
        raise DataError(f"{path}: holds several levels; name a {_listed(single)}")
    return write


def _listed(names: Collection[str]) -> str:
    *first, last = names
    return f"{', '.join(first)} or {last}"
