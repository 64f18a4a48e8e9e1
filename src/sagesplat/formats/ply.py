"""PLY files of Gaussians in INRIA's layout, which 3DGS viewers read; categories are beside them, or inside.

Per Gaussian, little endian float32: x y z, nx ny nz (zeros), f_dc_0..2, f_rest_0..44 (all red coefficients,
then green, then blue), opacity (logit), scale_0..2 (natural log), rot_0..3 (wxyz). Many viewers rely on it:
on these 62 floats, and on `element vertex` in the third line.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int16

from sagesplat import __version__
from sagesplat.core.errors import DataError, short
from sagesplat.core.gaussians import Gaussians
from sagesplat.core.geometry import NO_OFFSET, Position, offset_of
from sagesplat.core.names import repaired
from sagesplat.core.sh import BASES, C0
from sagesplat.formats.labels import sidecar, with_labels, write_labels, write_or_remove_labels
from sagesplat.formats.splat import SOME, Splat, SplatReader, SplatWriter
from sagesplat.io.files import atomic_path
from sagesplat.io.ply_header import PlyHeader, read_header, read_vertices

ROWS = 4096  # Gaussians per block, so that a block fits into the processor's cache
_DEGREE_4 = 24  # coefficients beyond the constant one; ours end with degree 3
_FULL = {"f4": 1.0, "f8": 1.0, "u1": 255.0, "u2": 65535.0}  # largest value of a colour property, by type
_PLAIN = {"nx", "ny", "nz", "red", "green", "blue", "alpha", "label"}  # say nothing more of a Gaussian
_FILTERS = ("filter_3d", "filter_3d_0", "filter3d")  # of Mip-Splatting, and as others write it


def write_ply(
    path: Path | str,
    gaussians: Gaussians,
    names: Mapping[int, str] | None = None,
    *,
    parents: Mapping[int, str] | None = None,
    antialiased: bool = False,
    labels_inside: bool = False,
) -> None:
    """Write a labelled scene as a binary splat PLY in INRIA's layout, atomically.

    Every viewer of 3DGS reads it: 62 floats a row, with zeros for degrees that the scene does not have.
    Labels and names go into a file beside it, FILE.labels.json, if any row has a label; `read_ply` and
    `read_splat` find it there.

    Args:
        path: The .ply file; replaced if it is there.
        gaussians: N Gaussians on any device.
        names: Category names by label id.
        parents: Names of the categories that instances are of, by the instance's label id.
        antialiased: Whether the scene was trained so; a comment as Brush writes it.
        labels_inside: Labels are a property of the file (`short label`) and names comments in its header.
            Viewers that rely on the layout then show nothing, or noise.

    Raises:
        OSError: If a file cannot be written.

    Example:
        >>> import tempfile, torch
        >>> from pathlib import Path
        >>> from sagesplat import Gaussians, read_ply, write_ply
        >>> z = torch.zeros
        >>> ids = torch.zeros(5, dtype=torch.int16)
        >>> g = Gaussians(z(5, 3), z(5, 4) + 1, z(5, 3), z(5), z(5, 1, 3), z(5, 3, 3) + 1, ids)
        >>> path = Path(tempfile.mkdtemp()) / "scene.ply"
        >>> write_ply(path, g, {0: "tree"})
        >>> len(read_ply(path)), read_ply(path).sh_degree
        (5, 1)
    """
    path, names, parents = Path(path), names or {}, parents or {}
    labels = gaussians.label_ids.cpu()
    comments = ["SplatRenderMode: mip"] if antialiased else []
    with atomic_path(path) as temporary:
        if not labels_inside:
            _put(temporary, gaussians, BASES[-1], comments)
            write_or_remove_labels(path, labels, names, parents)
            return
        comments.insert(0, f"sagesplat {__version__}")
        for word, by_id in (("label", names), ("parent", parents)):
            lines = sorted(by_id.items())
            comments += [f"{word} {i} {' '.join(repaired(name, '?').split())}" for i, name in lines]
        _put(temporary, gaussians, gaussians.shN.shape[1], comments, labels)
        if parents:  # a dictionary of labels, too, as many tools drop the header's comments
            write_labels(path, labels, names, parents, runs=False)
        else:
            sidecar(path).unlink(missing_ok=True)  # of an earlier file


def put_ply(path: Path, g: Gaussians, *, antialiased: bool = False) -> None:
    """Write a PLY without labels, of the degree of `g`, in place."""
    _put(path, g, g.shN.shape[1], ["SplatRenderMode: mip"] if antialiased else [])


def _put(
    path: Path,
    g: Gaussians,
    bases: int,
    comments: Iterable[str],
    labels: Int16[torch.Tensor, " N"] | None = None,
) -> None:
    """Write a file with `bases` SH coefficients beyond the constant one, and a property `label` for `labels`.

    Comments come last: readers of a fixed layout expect the element in the third line.
    """
    parts, properties = _matrices(g, bases), _properties(bases)
    dtype = np.dtype([("values", "<f4", len(properties)), *([] if labels is None else [("label", "<i2")])])
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(g)}"]
    header += [f"property float {name}" for name in properties]
    header += [] if labels is None else ["property short label"]
    header += [*(f"comment {line}" for line in comments), "end_header", ""]
    with path.open("wb") as file:
        file.write("\n".join(header).encode())
        for start in range(0, len(g), ROWS):
            rows = slice(start, start + ROWS)
            block: np.ndarray = np.empty(len(parts[0][rows]), dtype)
            block["values"] = np.concatenate([part[rows] for part in parts], axis=1)
            if labels is not None:
                block["label"] = labels.numpy()[rows]
            block.tofile(file)


def read_ply(path: Path | str) -> Gaussians:
    """Read the splat PLY of any tool.

    Args:
        path: The .ply file. Properties may come in any order; harmonics are of degree 0 to 4, of which the
            last is left out, and so are degrees that are zero in all Gaussians.

    Returns:
        The Gaussians, float32 on the CPU; label ids, of the file or of FILE.labels.json beside it, are -1
        where there are none.

    Raises:
        DataError: If a property is missing, the file ends early, or holds NaN or Inf.

    Example:
        >>> from pathlib import Path
        >>> from sagesplat import read_ply
        >>> g = read_ply(Path("runs/garden/nested/composed.ply"))  # doctest: +SKIP
        >>> g.of_labels([184]).nbytes  # doctest: +SKIP
    """
    path = Path(path)
    table = _read(path)
    columns = table.columns
    if any(table.offset):
        columns[:3] += np.array(table.offset, np.float32)[:, None]
    _check_values(path, table)
    return with_labels(Splat(_gaussians(table), table.kind), path).gaussians


def read_ply_splat(path: Path) -> Splat:
    """Read the splat PLY of any tool as it is: with NaN, infinities and rotations of zeros, if any.

    Category names are those of comments such as `label 184 tree-merged`. Mip-Splatting's filter_3D becomes a
    part of the scales and opacities; `notes` say it, and what else was not read as it is. DataError for other
    defects.
    """
    table = _read(path)
    names, parents = (_names(table.comments, word) for word in ("label", "parent"))
    return Splat(
        _gaussians(table), table.kind, names, is_antialiased(table.comments), parents=parents,
        notes=tuple(table.notes), offset=table.offset, up=vertical_axis(table.comments),
    )  # fmt: skip


def select_ply(source: Path, target: Path, keep: Bool[np.ndarray, " N"]) -> None:
    """Write the rows of a binary splat PLY that `keep` selects: header and properties as they are.

    What follows the vertices is left out. DataError for a file that cannot be read as a splat, or has another
    number of rows.
    """
    try:
        with source.open("rb") as file:
            header, start = read_header(file), file.tell()
            file.seek(0)
            lines = list(_until_end(file))
            file.seek(start)
            rows = np.fromfile(file, header.dtype, header.count)
    except (OSError, ValueError) as error:
        raise DataError(f"{source}: not readable as a PLY file ({short(error)}); give a splat .ply") from None
    if len(rows) != len(keep):
        raise DataError(f"{source}: {len(rows)} Gaussians, not {len(keep)}; it changed while it was read")
    with atomic_path(target) as temporary, temporary.open("wb") as file:
        file.writelines(_header_of(lines, int(keep.sum())))
        rows[keep].tofile(file)


def _until_end(file: BinaryIO) -> Iterator[bytes]:
    for line in file:
        yield line
        if line.split()[:1] == [b"end_header"]:
            return


def _header_of(lines: Iterable[bytes], count: int) -> Iterator[bytes]:
    """The lines of a header for another number of vertices, without the other elements."""
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
    words = ["".join(comment.lower().split()) for comment in comments]
    written = any("nerfstudio" in word or "nerstudio" in word for word in words)  # it misspells itself
    return "z" if written and "verticalaxis:z" in words else "auto"


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


@dataclass(frozen=True)
class _Table:
    """What a file holds."""

    kind: str  # as in Splat
    columns: Float32[np.ndarray, "P N"]  # those of `names`
    labels: np.ndarray  # [N]
    names: list[str]  # in the order of `_properties`, without normals
    comments: tuple[str, ...]
    notes: list[str]  # as in Splat
    offset: Position  # likewise


def _read(path: Path) -> _Table:
    try:
        with path.open("rb") as file:
            header, notes = read_header(file), list[str]()
            wanted = _wanted(path, header.types, notes)
            smoothing = [name for name in header.types if name.lower() in _FILTERS][:1]
            _note_others(header.types.keys() - {*wanted, *smoothing} - _PLAIN, notes)
            columns, labels, offset = _read_body(path, file, header, wanted + smoothing)
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror}); give a splat .ply") from None
    except (ValueError, OverflowError) as error:
        raise DataError(f"{path}: not readable as a PLY file ({short(error)}); give a splat .ply") from None
    if bad := int(np.count_nonzero((labels < -1) | (labels > 32767))):
        raise DataError(f"{path}: {bad} values of label are outside -1..32767; export the scene again")
    if smoothing:
        columns[-8:-5], columns[-9] = _smoothed(columns[-9], columns[-8:-5], columns[-1])
        columns = columns[:-1]
        notes.append(f"{smoothing[0]} (Mip-Splatting) is a part of the scales and opacities now")
    if "red" in wanted:
        full = np.array([_FULL[header.types[name]] for name in wanted[3:6]])[:, None]
        columns[3:6] = (columns[3:6] / full - 0.5) / C0
        notes.append("colours are red, green and blue: it has no f_dc")
    kind = "PLY" if header.order else "text PLY"
    return _Table(kind, columns, labels, wanted, header.comments, notes, offset)


def _smoothed(
    logits: Float32[np.ndarray, " N"],
    log_scales: Float32[np.ndarray, "3 N"],
    width: Float32[np.ndarray, " N"],
) -> tuple[Float64[np.ndarray, "3 N"], Float64[np.ndarray, " N"]]:
    """Log scales and opacity logits after a Gaussian filter of standard deviation `width`, world units.

    Mip-Splatting (Yu et al. 2024, Eq. 9): the variances are added, and the opacity shrinks by the square root
    of the ratio of the determinants, so that the Gaussian keeps its integral.
    """
    before = log_scales.astype(np.float64)
    with np.errstate(all="ignore"):  # NaN and infinities stay such
        after = 0.5 * np.logaddexp(2 * before, 2 * np.log(np.abs(width.astype(np.float64))))
        log_share, o = (before - after).sum(0), logits.astype(np.float64)
        opacity, rest = 1 / (1 + np.exp(-o)), 1 / (1 + np.exp(o))
        share = np.exp(log_share)
        return after, np.log(opacity * share) - np.log(share * rest - np.expm1(log_share))


def _note_others(names: set[str], notes: list[str]) -> None:
    """Note the properties that are not read, a numbered family as one."""
    families: dict[str, list[str]] = {}
    for name in sorted(name for name in names if not name.startswith("f_rest_")):
        families.setdefault(name.rstrip("0123456789"), []).append(name)
    listed = [some[0] if len(some) == 1 else f"{family}* ({len(some)})" for family, some in families.items()]
    if listed:
        more = f" and {len(listed) - 8} more" if len(listed) > 8 else ""
        notes.append(f"properties that are not read: {', '.join(map(short, listed[:8]))}{more}")


def _properties(bases: int) -> list[str]:
    """The float properties in INRIA's order, for `bases` SH coefficients beyond the constant one."""
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    names += [f"f_rest_{i}" for i in range(3 * bases)]
    return [*names, "opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]


def _matrices(gaussians: Gaussians, bases: int) -> list[np.ndarray]:
    """Float matrices [N, *] whose concatenated columns are `_properties`."""
    g = gaussians.detach()
    count = len(g)
    shN = torch.nn.functional.pad(g.shN, (0, 0, 0, bases - g.shN.shape[1]))
    parts = [g.means, torch.zeros_like(g.means), g.sh0.reshape(count, 3)]
    parts += [shN.transpose(1, 2).reshape(count, 3 * bases)]
    parts += [g.logit_opacities[:, None], g.log_scales, g.quats]
    return [part.cpu().numpy() for part in parts]


def _gaussians(table: _Table) -> Gaussians:
    """The Gaussians of a table, without degrees of zeros, which writers of a fixed layout add."""
    columns, labels = table.columns, table.labels
    bases = (len(columns) - 14) // 3
    rest = columns[6:-8].reshape(3, bases, columns.shape[1])  # all red, all green, all blue
    steps = zip(BASES[:0:-1], BASES[-2::-1], strict=True)
    with np.errstate(invalid="ignore"):  # NaN of some kinds
        bases = next((most for most, below in steps if rest[:, below:most].any()), 0)
    rest = rest[:, :bases]

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


def _wanted(path: Path, types: Mapping[str, str], notes: list[str]) -> list[str]:
    """The float properties to read, by the file's SH degree: `_properties` without normals.

    Of degree 4 the coefficients of degrees 1 to 3 are read; without f_dc the colours, if there are any.
    """
    rest = sum(name.startswith("f_rest_") for name in types)
    bases, odd = divmod(rest, 3)
    if odd or bases not in (*BASES, _DEGREE_4):
        allowed = ", ".join(str(3 * bases) for bases in (*BASES, _DEGREE_4))
        raise DataError(f"{path}: {rest} f_rest properties; degree 0 to 4 has one of {allowed}")
    wanted = [name for name in _properties(bases) if name not in ("nx", "ny", "nz")]
    if bases == _DEGREE_4:
        kept = BASES[-1]
        cut = {f"f_rest_{bases * colour + i}" for colour in range(3) for i in range(kept, bases)}
        wanted = [name for name in wanted if name not in cut]
        notes.append("harmonics of degree 4 are left out; degrees 0 to 3 are kept")
    colours = {"f_dc_0": "red", "f_dc_1": "green", "f_dc_2": "blue"}
    if not types.keys() & colours.keys() and all(types.get(name) in _FULL for name in colours.values()):
        wanted = [colours.get(name, name) for name in wanted]
    if missing := [name for name in wanted if name not in types]:
        named = ", ".join(missing[:4]) + (", ..." if len(missing) > 4 else "")
        if missing == ["scale_2"]:
            named += ": flat Gaussians of 2DGS are drawn otherwise"
        raise DataError(f"{path}: {len(missing)} splat properties missing ({named}); give a 3DGS .ply")
    return wanted


def _read_body(
    path: Path, file: BinaryIO, header: PlyHeader, wanted: list[str]
) -> tuple[Float32[np.ndarray, "P N"], np.ndarray, Position]:
    """The wanted columns, the labels [N], and what was subtracted from the first three."""
    count, labelled = header.count, "label" in header.types
    if not header.order:
        table = read_vertices(path, file, header)
        offset = offset_of(np.stack([table[axis] for axis in "xyz"], axis=1)[:: count // SOME + 1])
        for axis, by in zip("xyz", offset, strict=True):
            table[axis] = table[axis] - by
        with np.errstate(over="ignore"):
            columns = np.stack([table[name] for name in wanted]).astype(np.float32)
        return columns, _whole(table["label"]) if labelled else np.full(count, -1, np.int64), offset
    present = (path.stat().st_size - file.tell()) // header.dtype.itemsize
    if present < count:
        raise DataError(
            f"{path}: {count} Gaussians announced, {max(present, 0)} present; the file is truncated, copy it "
            "again"
        )
    columns, labels = np.empty((len(wanted), count), np.float32), np.full(count, -1, np.int64)
    offset, start = NO_OFFSET, file.tell()
    if count and any(header.types[axis] == "f8" for axis in "xyz"):
        some = np.memmap(file, header.dtype, "r", start, (count,))[:: count // SOME + 1]
        offset = offset_of(np.stack([some[axis] for axis in "xyz"], axis=1))
        file.seek(start)
    by = dict(zip("xyz", offset, strict=True)) if any(offset) else {}
    for start in range(0, count, ROWS):
        rows = slice(start, min(start + ROWS, count))
        block = np.fromfile(file, header.dtype, rows.stop - start)
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


def _check_values(path: Path, table: _Table) -> None:
    for column, name in zip(table.columns, table.names, strict=True):
        if bad := int(np.count_nonzero(~np.isfinite(column))):
            raise DataError(f"{path}: {bad} values of {name} are NaN or infinite; export the scene again")
    if bad := int(np.count_nonzero(~table.columns[-4:].any(axis=0))):
        raise DataError(
            f"{path}: {bad} Gaussians have a rotation (rot_0..3) of zeros; export the scene again"
        )


READER = SplatReader(lambda path, _: read_ply_splat(path), magic=(b"ply\n", b"ply\r"))
WRITER = SplatWriter(
    lambda path, g, names, parents, antialiased: write_ply(
        path, g, names, parents=parents, antialiased=antialiased
    ),
    antialiases=False,
)
