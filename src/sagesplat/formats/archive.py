"""ZIP archives with one splat in them, such as a .ssog (streamed SOG in one file) or a zipped PLY.

What belongs to the splat is unpacked into a temporary folder: within bounds, and nothing outside of it.
"""

import zipfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory

from sagesplat.core.errors import DataError, short
from sagesplat.formats.labels import sidecar
from sagesplat.formats.lod_meta import LOD_META
from sagesplat.formats.offsets import beside as offset_beside
from sagesplat.formats.sog import META
from sagesplat.io.files import loads_json

_SUFFIXES = (".ply", ".spz", ".sog", ".splat", ".glb", ".gltf")
_DESCRIPTIONS = (LOD_META, META)  # of splats in several files
_MOST = 100_000  # members
_EXPANDS, _FREE = 64, 2**26  # times its size, and bytes, that an archive may unpack to
_PIECE = 2**20  # bytes
_DESCRIBES, _HEADER = 2**24, 2**16  # bytes of a meta.json, and of a PLY's header, that are looked at
_OF_SPLATS = (b"scale_0", b"packed_position")  # properties that PLY of points do not have


@contextmanager
def unpacked(path: Path) -> Iterator[Path]:
    """The splat to read: `path` itself, or of an archive the one in it, as long as the context lasts.

    A SOG in one file (.sog) is read as it is. DataError for an archive without a splat, with several, or that
    unpacks to too much; errors inside the context name the archive in place of the temporary folder.
    """
    try:
        with path.open("rb") as file:
            packed = file.read(4) == b"PK\x03\x04"
        names = _names(path) if packed else []
    except OSError:
        names = []  # the reader says what is wrong
    if not names or names == [META]:
        yield path
        return
    with TemporaryDirectory() as folder:
        try:
            yield _extract(path, names[0], Path(folder))
        except DataError as error:
            raise DataError(str(error).replace(f"{folder}/", f"{path}: ")) from None


def _names(path: Path) -> list[str]:
    """The name of the splat in an archive, in a list."""
    try:
        with zipfile.ZipFile(path) as archive:
            inside = [info.filename for info in archive.infolist() if _counts(info)]
            if len(inside) > _MOST:
                raise DataError(f"{path}: {len(inside):,} files in it; unpack it, and give the splat")
            found = _splats(archive, inside)
            if len(found) > 1:
                found = [name for name in found if not _is_points(archive, name)] or found
    except DataError:
        raise
    except Exception as error:  # zipfile and zlib raise errors of many kinds for damaged files
        raise DataError(f"{path}: a damaged archive ({short(error)}); copy it again") from None
    if not found:
        raise DataError(f"{path}: an archive without a splat in it; give a splat file")
    if len(found) > 1:
        more = f" and {len(found) - 4} more" if len(found) > 4 else ""
        listed = ", ".join(map(short, found[:4]))
        raise DataError(f"{path}: {len(found)} splats in it ({listed}{more}); unpack it, and give one")
    return found


def _counts(info: zipfile.ZipInfo) -> bool:
    """Whether a member is a file that people put there, and not one of macOS's or outside of the archive."""
    parts = PurePosixPath(info.filename).parts
    hidden = any(part.startswith(".") or part == "__MACOSX" for part in parts)
    outside = "\\" in info.filename or info.filename.startswith("/") or "\0" in info.filename
    return not (info.is_dir() or hidden or outside or ".." in parts)


def _splats(archive: zipfile.ZipFile, names: Sequence[str]) -> list[str]:
    """Of the names of files those of splats, without the parts of others."""
    found = [name for name in names if PurePosixPath(name).name == LOD_META]
    folders = [PurePosixPath(name).parent for name in found]
    rest = [name for name in names if not any(PurePosixPath(name).is_relative_to(at) for at in folders)]
    found += [name for name in rest if PurePosixPath(name).name == META and _is_sog(archive, name)]
    return sorted(found + [name for name in rest if PurePosixPath(name).suffix.lower() in _SUFFIXES])


def _is_sog(archive: zipfile.ZipFile, name: str) -> bool:
    """Whether a meta.json describes a SOG."""
    with archive.open(name) as file:
        try:
            document = loads_json(file.read(_DESCRIBES))
        except ValueError:
            return False
    return isinstance(document, dict) and "means" in document


def _is_points(archive: zipfile.ZipFile, name: str) -> bool:
    """Whether a PLY is not of Gaussians, such as the points of a capture that lies beside its splat."""
    if not name.lower().endswith(".ply"):
        return False
    with archive.open(name) as file:
        head, ended, _ = file.read(_HEADER).partition(b"end_header")
    return bool(ended) and head.startswith(b"ply") and not any(word in head for word in _OF_SPLATS)


def _extract(path: Path, name: str, folder: Path) -> Path:
    """Unpack a splat and what belongs to it; the path of what was unpacked."""
    left = max(_FREE, _EXPANDS * path.stat().st_size)
    above = PurePosixPath(name).parent
    whole = PurePosixPath(name).name in _DESCRIPTIONS or name.lower().endswith(".gltf")
    wanted = {name, sidecar(Path(name)).as_posix(), offset_beside(Path(name)).as_posix()}
    try:
        with zipfile.ZipFile(path) as archive:
            for info in archive.infolist():
                inside = PurePosixPath(info.filename).is_relative_to(above) if whole else False
                if not _counts(info) or not (inside or info.filename in wanted):
                    continue
                target = folder / info.filename
                target.parent.mkdir(parents=True, exist_ok=True)
                with archive.open(info) as packed, target.open("wb") as file:
                    while content := packed.read(_PIECE):
                        left -= len(content)
                        if left < 0:
                            raise DataError(f"{path}: unpacks to too much; unpack it, and give the splat")
                        file.write(content)
    except DataError:
        raise
    except OSError as error:
        reason = error.strerror or short(error)
        raise DataError(f"{path}: cannot be unpacked ({reason}); unpack it, and give the splat") from None
    except Exception as error:  # zipfile and zlib raise errors of many kinds for damaged files
        raise DataError(f"{path}: a damaged archive ({short(error)}); copy it again") from None
    return folder / name
