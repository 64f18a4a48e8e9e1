"""Reads the splat files of other tools, whatever their format; docs/formats.md has the table."""

import stat
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import BinaryIO

from sagesplat.core.errors import DataError
from sagesplat.formats.compressed_ply import is_compressed, read_compressed_ply
from sagesplat.formats.dotsplat import read_dotsplat
from sagesplat.formats.gltf import read_gltf
from sagesplat.formats.labels import with_labels
from sagesplat.formats.lod_meta import LOD_META, count_levels, read_lod_meta
from sagesplat.formats.ply import read_ply_splat
from sagesplat.formats.sog import META, read_sog
from sagesplat.formats.splat import Splat, cleaned
from sagesplat.formats.spz import Frame, read_spz_splat
from sagesplat.io.files import loads_json
from sagesplat.io.ply_header import read_elements

__all__ = ["Splat", "num_lods", "read_splat"]

_KNOWN = "PLY, compressed PLY, SPZ, SOG, lod-meta.json, glTF, .splat"
_LOD = "streamed SOG"


def read_splat(path: Path | str, lod: int = 0, *, spz_axes: Frame = "rub") -> Splat:
    """Read a splat of any format that is known, without the Gaussians that cannot be drawn.

    The content tells the format, not the name; only .splat, which has no header, needs its suffix. Labels
    come from the file or from a sidecar beside it (`formats/labels.py`).

    Args:
        path: The file, or the folder of a SOG (`meta.json`) or a streamed one (`lod-meta.json`).
        lod: The level of a streamed SOG; 0 is the finest, and the only one of other formats.
        spz_axes: The axes of SPZ files that do not say theirs. The format's own are right, up, back;
            PlayCanvas's tools write those of PLY, "rdf".

    Returns:
        Gaussians in COLMAP's axes as INRIA's PLY has them, with what was left out by reason.

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
    path, kind = _found(path)
    if kind == _LOD:
        return cleaned(read_lod_meta(path, lod), str(path))
    if lod:
        raise DataError(f"{path}: {kind} has one level; read level 0")
    readers: dict[str, Callable[[Path], Splat]] = {
        "PLY": read_ply_splat,
        "compressed PLY": read_compressed_ply,
        "SPZ": partial(read_spz_splat, frame=spz_axes),
        "SOG": read_sog,
        "glTF": read_gltf,
        ".splat": read_dotsplat,
    }
    return cleaned(with_labels(readers[kind](path), path), str(path))


def num_lods(path: Path) -> int:
    """How many levels of detail a splat file or folder has: 1, but of a streamed SOG."""
    path, kind = _found(path)
    return count_levels(path) if kind == _LOD else 1


def _found(path: Path) -> tuple[Path, str]:
    """The file to read, which may be in the folder `path`, and its format; DataError if it has none."""
    try:
        if path.is_dir():
            inside = [path / name for name in (LOD_META, META) if (path / name).exists()]
            if not inside:
                raise DataError(f"{path}: a folder without {LOD_META} or {META}; give a splat file")
            path = inside[0]
        if not stat.S_ISREG(path.stat().st_mode):
            raise DataError(f"{path}: no regular file; give a splat file")
        with path.open("rb") as file:
            kind = _kind(path, file)
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror}); give a splat file") from None
    if kind is None:
        raise DataError(f"{path}: no splat format that is known; convert it to one of {_KNOWN}")
    return path, kind


def _kind(path: Path, file: BinaryIO) -> str | None:
    head = file.read(64)
    if head.startswith((b"\x1f\x8b", b"NGSP")):
        return "SPZ"
    if head.startswith(b"glTF"):
        return "glTF"
    if head.startswith(b"PK\x03\x04"):
        return "SOG"
    if head.startswith((b"ply\n", b"ply\r")):
        return _kind_of_ply(path, file)
    if head.removeprefix(b"\xef\xbb\xbf").lstrip().startswith(b"{"):
        return _kind_of_json(file)
    return ".splat" if path.suffix.lower() == ".splat" else None


def _kind_of_ply(path: Path, file: BinaryIO) -> str:
    file.seek(0)
    try:
        elements = read_elements(file)[1]
    except ValueError:
        return "PLY"  # its reader says what is wrong
    return "compressed PLY" if is_compressed(elements) else "PLY"


def _kind_of_json(file: BinaryIO) -> str | None:
    file.seek(0)
    try:
        document = loads_json(file.read())
    except ValueError:
        return None
    keys = set(document) if isinstance(document, dict) else set()
    known = {"lodLevels": _LOD, "means": "SOG", "asset": "glTF"}
    return next((kind for key, kind in known.items() if key in keys), None)
