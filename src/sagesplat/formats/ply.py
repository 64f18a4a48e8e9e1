"""PLY files of Gaussians in INRIA's layout, which 3DGS viewers read, with the category as an extra property.

Per Gaussian, little endian float32: x y z, nx ny nz (zeros), f_dc_0..2, f_rest_0.. (all red coefficients,
then green, then blue), opacity (logit), scale_0..2 (natural log), rot_0..3 (wxyz); then `label` (int16).
"""

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch
from jaxtyping import Bool

from sagesplat import __version__
from sagesplat.core.errors import DataError, short
from sagesplat.core.gaussians import Gaussians
from sagesplat.core.geometry import NO_OFFSET, Position, offset_of
from sagesplat.core.names import repaired
from sagesplat.core.sh import BASES
from sagesplat.formats.labels import sidecar, write_labels
from sagesplat.formats.splat import Splat, SplatReader, SplatWriter
from sagesplat.io.files import atomic_path
from sagesplat.io.ply_header import read_header

_SOME = 2**16  # Gaussians that say how far from the origin doubles are
ROWS = 4096  # Gaussians per block, so that a block fits into the processor's cache


def write_ply(
    path: Path | str,
    gaussians: Gaussians,
    names: Mapping[int, str] | None = None,
    *,
    parents: Mapping[int, str] | None = None,
    antialiased: bool = False,
) -> None:
    """Write a labelled scene as a binary splat PLY in INRIA's layout, atomically.

    Every viewer of 3DGS reads it: the labels are one more property (`short label`) that others skip.

    Args:
        path: The .ply file; replaced if it is there.
        gaussians: N Gaussians on any device.
        names: Category names by label id; they go into the header as comments.
        parents: Names of the categories that instances are of, by the instance's label id; likewise.
        antialiased: Whether the scene was trained so; a comment as Brush writes it.

    Raises:
        OSError: If the file cannot be written.

    Example:
        >>> import tempfile, torch
        >>> from pathlib import Path
        >>> from sagesplat import Gaussians, read_ply, write_ply
        >>> z = torch.zeros
        >>> ids = torch.zeros(5, dtype=torch.int16)
        >>> g = Gaussians(z(5, 3), z(5, 4) + 1, z(5, 3), z(5), z(5, 1, 3), z(5, 3, 3), ids)
        >>> path = Path(tempfile.mkdtemp()) / "scene.ply"
        >>> write_ply(path, g, {0: "tree"})
        >>> len(read_ply(path)), read_ply(path).sh_degree
        (5, 1)
    """
    path = Path(path)
    parts = _matrices(gaussians)
    properties = _properties(gaussians.shN.shape[1])
    labels = gaussians.label_ids.cpu().numpy()
    dtype = np.dtype([("values", "<f4", len(properties)), ("label", "<i2")])
    comments = [f"sagesplat {__version__}"]
    comments += ["SplatRenderMode: mip"] if antialiased else []
    for word, by_id in (("label", names), ("parent", parents)):
        lines = sorted((by_id or {}).items())
        comments += [f"{word} {i} {' '.join(repaired(name, '?').split())}" for i, name in lines]
    header = ["ply", "format binary_little_endian 1.0", *(f"comment {line}" for line in comments)]
    header += [f"element vertex {len(gaussians)}", *(f"property float {name}" for name in properties)]
    header += ["property short label", "end_header", ""]
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        file.write("\n".join(header).encode())
        for start in range(0, len(gaussians), ROWS):
            rows = slice(start, start + ROWS)
            block: np.ndarray = np.empty(len(labels[rows]), dtype)
            block["values"] = np.concatenate([part[rows] for part in parts], axis=1)
            block["label"] = labels[rows]
            block.tofile(file)


def read_ply(path: Path | str) -> Gaussians:
    """Read the binary splat PLY of any tool.

    Args:
        path: The .ply file. Properties may come in any order; harmonics are of degree 0 to 3.

    Returns:
        The Gaussians, float32 on the CPU; label ids are -1 where the file has none.

    Raises:
        DataError: If a property is missing, the file is text, ends early, or holds NaN or Inf.

    Example:
        >>> from pathlib import Path
        >>> from sagesplat import read_ply
        >>> g = read_ply(Path("runs/garden/nested/composed.ply"))  # doctest: +SKIP
        >>> g.of_labels([184]).nbytes  # doctest: +SKIP
    """
    path = Path(path)
    columns, labels, wanted, _, offset = _read(path)
    if any(offset):
        columns[:3] += np.array(offset, np.float32)[:, None]
    _check_values(path, columns, wanted)
    return _gaussians(columns, labels)


def read_ply_splat(path: Path) -> Splat:
    """Read the binary splat PLY of any tool as it is: with NaN, infinities and rotations of zeros, if any.

    Category names are those of comments such as `label 184 tree-merged`. DataError for other defects.
    """
    columns, labels, _, comments, offset = _read(path)
    names, parents = (_names(comments, word) for word in ("label", "parent"))
    g, antialiased = _gaussians(columns, labels), is_antialiased(comments)
    up = vertical_axis(comments)
    return Splat(g, "PLY", names, antialiased, parents=parents, offset=offset, up=up)


def select_ply(source: Path, target: Path, keep: Bool[np.ndarray, " N"]) -> None:
    """Write the rows of a binary splat PLY that `keep` selects: header and properties as they are.

    What follows the vertices is left out. DataError for a file that cannot be read as a splat, or has another
    number of rows.
    """
    try:
        with source.open("rb") as file:
            header = read_header(file)
            start = file.tell()
            file.seek(0)
            lines = file.read(start).splitlines(keepends=True)
            rows = np.fromfile(file, header.dtype, header.count)
    except (OSError, ValueError) as error:
        raise DataError(f"{source}: not readable as a PLY file ({short(error)}); give a splat .ply") from None
    if len(rows) != len(keep):
        raise DataError(f"{source}: {len(rows)} Gaussians, not {len(keep)}; it changed while it was read")
    with atomic_path(target) as temporary, temporary.open("wb") as file:
        file.writelines(_header_of(lines, int(keep.sum())))
        rows[keep].tofile(file)


def _header_of(lines: Iterable[bytes], count: int) -> Iterator[bytes]:
    """The lines of a header for another number of vertices, without the elements after them."""
    element = b""
    for line in lines:
        words = line.split()
        if words[:1] == [b"element"]:
            element = words[1]
            line = line.replace(words[2], str(count).encode()) if element == b"vertex" else line
        if element in (b"", b"vertex") or words[:1] == [b"end_header"]:
            yield line


def is_antialiased(comments: Iterable[str]) -> bool:
    """Whether comments of a PLY header say so, as Brush and Postshot write them; the last one counts."""
    said = False
    for comment in comments:
        match comment.lower().split():
            case ["splatrendermode:", mode]:
                said = mode == "mip"
            case ["antialiased", "0" | "1" as value]:
                said = value == "1"
    return said


def vertical_axis(comments: Iterable[str]) -> str:
    """Which way is up, where nerfstudio wrote it into the header; else "auto".

    Its exports are of a world whose z is up. Others, such as Brush, write `Vertical axis: y` for either sign.
    """
    words = [comment.lower() for comment in comments]
    written = any("nerfstudio" in word or "nerstudio" in word for word in words)  # it misspells itself
    return "z" if written and "vertical axis: z" in words else "auto"


def _names(comments: Iterable[str], word: str) -> dict[int, str]:
    """Names by label id, as `write_ply` writes them behind a word."""
    names = {}
    for comment in comments:
        match comment.split(maxsplit=2):
            case [first, label, name] if (
                first == word and label.isdecimal() and len(label) <= 5 and int(label) < 2**15
            ):
                names[int(label)] = repaired(name, f"category {label}")
    return names


def _read(path: Path) -> tuple[np.ndarray, np.ndarray, list[str], tuple[str, ...], Position]:
    """Float32 columns [P, N], labels [N], the columns' names, the header's comments, and an offset.

    The offset was subtracted from positions that are doubles.
    """
    try:
        with path.open("rb") as file:
            header = read_header(file)
            if not header.order:
                raise DataError(f"{path}: text PLY is not supported; save it as binary_little_endian")
            wanted = _wanted(path, header.dtype)
            columns, labels, offset = _read_body(path, file, header.dtype, header.count, wanted)
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror}); give a splat .ply") from None
    except ValueError as error:
        raise DataError(f"{path}: not readable as a PLY file ({short(error)}); give a splat .ply") from None
    if bad := int(np.count_nonzero((labels < -1) | (labels > 32767))):
        raise DataError(f"{path}: {bad} values of label are outside -1..32767; export the scene again")
    return columns, labels, wanted, header.comments, offset


def _properties(bases: int) -> list[str]:
    """The float properties in INRIA's order, for `bases` SH coefficients beyond the constant one."""
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    names += [f"f_rest_{i}" for i in range(3 * bases)]
    return [*names, "opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]


def _matrices(gaussians: Gaussians) -> list[np.ndarray]:
    """Float matrices [N, *] whose concatenated columns are `_properties`."""
    g = gaussians.detach()
    count = len(g)
    parts = [g.means, torch.zeros_like(g.means), g.sh0.reshape(count, 3)]
    parts += [g.shN.transpose(1, 2).reshape(count, 3 * g.shN.shape[1])]
    parts += [g.logit_opacities[:, None], g.log_scales, g.quats]
    return [part.cpu().numpy() for part in parts]


def _gaussians(columns: np.ndarray, labels: np.ndarray) -> Gaussians:
    """Gaussians from float32 columns [P, N] in the order of `_properties`, without normals."""
    bases = (len(columns) - 14) // 3
    rest = columns[6:-8].reshape(3, bases, columns.shape[1])  # all red, all green, all blue

    def rows(part: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(np.ascontiguousarray(np.moveaxis(part, -1, 0)))

    return Gaussians(
        means=rows(columns[:3]),
        quats=rows(columns[-4:]),
        log_scales=rows(columns[-7:-4]),
        logit_opacities=rows(columns[-8]),
        sh0=rows(columns[None, 3:6]),
        shN=rows(rest.swapaxes(0, 1)),
        label_ids=torch.from_numpy(labels.astype(np.int16)),
    )


def _wanted(path: Path, dtype: np.dtype) -> list[str]:
    """The float properties to read, by the file's SH degree: `_properties` without normals."""
    present = set(dtype.names or ())
    rest = sum(name.startswith("f_rest_") for name in present)
    if rest % 3 or rest // 3 not in BASES:
        allowed = ", ".join(str(3 * bases) for bases in BASES)
        raise DataError(f"{path}: {rest} f_rest properties; degree 0 to 3 has one of {allowed}")
    wanted = [name for name in _properties(rest // 3) if name not in ("nx", "ny", "nz")]
    if missing := [name for name in wanted if name not in present]:
        named = ", ".join(missing[:4]) + (", ..." if len(missing) > 4 else "")
        raise DataError(f"{path}: {len(missing)} splat properties missing ({named}); give a 3DGS .ply")
    return wanted


def _read_body(
    path: Path, file: BinaryIO, dtype: np.dtype, count: int, wanted: list[str]
) -> tuple[np.ndarray, np.ndarray, Position]:
    """The wanted columns as float32 [P, N], the labels [N], and what was subtracted from the first three."""
    present = (path.stat().st_size - file.tell()) // dtype.itemsize
    if present < count:
        raise DataError(
            f"{path}: {count} Gaussians announced, {present} present; the file is truncated, copy it again"
        )
    columns = np.empty((len(wanted), count), np.float32)
    offset, start = NO_OFFSET, file.tell()
    if count and any(dtype[axis].itemsize == 8 for axis in "xyz"):
        some = np.memmap(file, dtype, "r", start, (count,))[:: count // _SOME + 1]
        offset = offset_of(np.stack([some[axis] for axis in "xyz"], axis=1))
        file.seek(start)
    by = dict(zip("xyz", offset, strict=True)) if any(offset) else {}
    labels = np.full(count, -1, np.int64)
    labelled = "label" in (dtype.names or ())
    for start in range(0, count, ROWS):
        rows = slice(start, min(start + ROWS, count))
        block = np.fromfile(file, dtype, rows.stop - start)
        with np.errstate(over="ignore"):  # a double too large for float32 is then reported as infinite
            for column, name in zip(columns, wanted, strict=True):
                column[rows] = block[name] - by[name] if name in by else block[name]
        if labelled:
            labels[rows] = _whole(block["label"])
    return columns, labels, offset


def _whole(labels: np.ndarray) -> np.ndarray:
    """Labels of any type as integers; -2, which is no label, for those that are no whole numbers.

    The largest value of an unsigned type is -1: tools that have no signed ones write it so.
    """
    if labels.dtype.kind == "u":
        return np.where(labels == np.iinfo(labels.dtype).max, -1, labels.astype(np.int64))
    if labels.dtype.kind == "i":
        return labels
    return np.where((np.abs(labels) < 2**15) & (labels == np.floor(labels)), labels, -2).astype(np.int64)


def _check_values(path: Path, columns: np.ndarray, wanted: list[str]) -> None:
    for column, name in zip(columns, wanted, strict=True):
        if bad := int(np.count_nonzero(~np.isfinite(column))):
            raise DataError(f"{path}: {bad} values of {name} are NaN or infinite; export the scene again")
    if bad := int(np.count_nonzero(~columns[-4:].any(axis=0))):
        raise DataError(
            f"{path}: {bad} Gaussians have a rotation (rot_0..3) of zeros; export the scene again"
        )


def _write_with_labels(
    path: Path, g: Gaussians, names: Mapping[int, str], parents: Mapping[int, str], antialiased: bool
) -> None:
    """Write a PLY; with `parents` a dictionary of labels too, as many tools drop the header's comments."""
    write_ply(path, g, names, parents=parents, antialiased=antialiased)
    if parents:
        write_labels(path, g.label_ids, names, parents, runs=False)
    else:
        sidecar(path).unlink(missing_ok=True)  # of an earlier file


READER = SplatReader(lambda path, _: read_ply_splat(path), magic=(b"ply\n", b"ply\r"))
WRITER = SplatWriter(_write_with_labels, antialiases=False)
