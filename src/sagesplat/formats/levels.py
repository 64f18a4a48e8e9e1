"""Level files: one .npz per level, with one set of arrays per category, at most 79 bytes per Gaussian.

means are float32, quats int16, log_scales, logit_opacities and sh0 float16, shN int8 on a square-root scale
per coefficient. An exact file has float32 everywhere, and gives back what was written bit for bit. Single
categories can be read, so a composition reads only what it uses. Reading needs at most 32 bytes of memory per
byte of the file.
"""

import zipfile
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Int
from numba import prange

from sagesplat.core.errors import DataError, short
from sagesplat.core.gaussians import PARAMETERS, Gaussians, checked
from sagesplat.core.second_opacity import SecondOpacities
from sagesplat.core.sh import num_bases
from sagesplat.io.files import atomic_path
from sagesplat.io.npz import Npz
from sagesplat.kernels.jit import njit

_DAMAGED = (OSError, KeyError, TypeError, ValueError)  # raised for truncated or damaged files
_LADDER = (["sizes"], ["replaces"], ["weights"])  # arrays of a category that are no Gaussians
_SECOND = "second_opacities"  # array of further ones
_HALVES = ("log_scales", "logit_opacities", "sh0")


@dataclass(frozen=True)
class LevelFile:
    """The header of a level file: its content without the Gaussians."""

    path: Path
    step: int
    recovering: bool  # recorded soon after an opacity reset, before the quality recovered
    sh_degree: int
    counts: dict[int, int]  # Gaussians by label id


def write_level(
    folder: Path, step: int, g: Gaussians, *, recovering: bool, sh_degree: int, exact: bool = False
) -> Path:
    """Write Gaussians as the level FOLDER/STEP.npz, without SH coefficients above `sh_degree`; its path."""
    path = folder / f"{step:06d}.npz"
    _write(path, LevelFile(path, step, recovering, sh_degree, g.counts()), g, {}, exact)
    return path


def write_set(
    path: Path,
    g: Gaussians,
    step: int,
    sizes: Mapping[int, Sequence[int]] | None = None,
    *,
    replaces: Mapping[int, Collection[int]] | None = None,
    second: SecondOpacities | None = None,
    exact: bool = False,
    **more: Any,
) -> None:
    """Write Gaussians in order, as nested levels by label id, with further arrays `more`.

    `sizes`: rows of the category up to the end of each level. `replaces`: levels that replace those below
    (see `starts_of`). `second`: the second opacities of the Gaussians, with weights of all these levels.
    `exact`: as float32, identical when read.
    """
    arrays: dict[str, np.ndarray] = {
        f"{label}/sizes": np.array(n, np.int64) for label, n in (sizes or {}).items()
    }
    for label, levels in (replaces or {}).items():
        if levels:
            arrays[f"{label}/replaces"] = np.array(sorted(levels), np.int64)
    if second is not None:
        arrays |= {f"{label}/weights": np.array(w, np.float64) for label, w in second.weights.items()}
        more |= {_SECOND: second.logits.numpy()}
    arrays |= {f"more/{name}": np.asarray(value) for name, value in more.items()}
    _write(path, LevelFile(path, step, False, g.sh_degree, g.counts()), g, arrays, exact)


def select_level(source: Path, target: Path, keep: Bool[np.ndarray, " N"]) -> None:
    """Write the Gaussians of a level file that `keep` selects, in the order of `read_level`, unchanged.

    Columns are copied as they are stored: what stays keeps every bit. DataError for a damaged file;
    ValueError where `keep` is of another number of Gaussians.
    """
    counts = read_header(source).counts
    if sum(counts.values()) != len(keep):
        raise ValueError(f"{len(keep)} rows for {sum(counts.values())} Gaussians")
    ends = np.cumsum([counts[label] for label in sorted(counts)])
    with _open(source) as file:
        try:
            arrays = {"meta": file["meta"]}
            for label, rows in zip(sorted(counts), np.split(keep, ends[:-1]), strict=True):
                names = [f"{label}/{column}" for column in (*PARAMETERS, "shN_scale")]
                for name in names if rows.any() else []:
                    if name in file:
                        arrays[name] = file[name] if name.endswith("_scale") else file[name][rows]
        except (*_DAMAGED, IndexError) as error:
            raise DataError(f"{source}: a broken level ({short(error)}); {_again(source)}") from None
    with atomic_path(target, nbytes=sum(a.nbytes for a in arrays.values())) as temporary:
        np.savez(temporary, allow_pickle=False, **arrays)


def starts_of(sizes: Sequence[int], replaces: Collection[int] = ()) -> tuple[int, ...]:
    """The first row of each level of a category: level k is the rows from starts[k-1] to before sizes[k-1].

    `sizes`: the rows up to the end of each level, ascending. `replaces`: the levels, from 2 on, that replace
    those below: they begin where the level below ends. ValueError for one that cannot, since it adds nothing
    or has nothing below.
    """
    starts = [0] * len(sizes)
    for level in sorted(replaces):
        if not 2 <= level <= len(sizes) or not 0 < sizes[level - 2] < sizes[level - 1]:
            raise ValueError(f"level {level} of {len(sizes)} cannot replace those below it")
        starts[level - 1 :] = [sizes[level - 2]] * (len(sizes) - level + 1)
    return tuple(starts)


def _write(path: Path, header: LevelFile, g: Gaussians, more: dict[str, Any], exact: bool) -> None:
    meta = np.array([header.step, header.recovering, header.sh_degree], np.int64)
    arrays: dict[str, np.ndarray] = {"meta": meta, **more}
    whole = {name: p.detach().cpu().numpy() for name, p in g.parameters().items()}
    whole["shN"] = whole["shN"][:, : num_bases(header.sh_degree) - 1]
    label_ids = g.label_ids.cpu().numpy()
    for label in header.counts:
        rows = _range_if_one(np.flatnonzero(label_ids == label))
        values = {name: value[rows] for name, value in whole.items()}
        if exact:
            columns = {name: value.astype(np.float32, copy=False) for name, value in values.items()}
        else:
            columns = _encoded(values)
        arrays |= {f"{label}/{name}": column for name, column in columns.items()}
    with atomic_path(path, nbytes=sum(a.nbytes for a in arrays.values())) as temporary:
        np.savez(temporary, allow_pickle=False, **arrays)


def _range_if_one(rows: Int[np.ndarray, " n"]) -> Int[np.ndarray, " n"] | slice:
    """Rows that follow each other as a slice, which copies nothing."""
    first, last = rows[0], rows[-1]
    return slice(first, last + 1) if last - first == len(rows) - 1 else rows


def _encoded(values: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    quats = values["quats"] / np.linalg.norm(values["quats"], axis=1, keepdims=True)
    shN = values["shN"]
    scale = np.maximum(shN.max(axis=0, initial=0), -shN.min(axis=0, initial=0))
    return {
        "means": values["means"],
        "quats": np.round(quats * 32767).astype(np.int16),
        **{name: values[name].astype(np.float16) for name in _HALVES},
        "shN": _roots(shN.reshape(len(shN), -1), np.where(scale > 0, scale, 1).ravel()).reshape(shN.shape),
        "shN_scale": scale.astype(np.float32),
    }


@njit(parallel=True, cache=True, error_model="numpy")
def _roots(values, scale):
    """127 times the square roots of `values` [N, K] over `scale` [K], with their signs, as int8."""
    found = np.empty(values.shape, np.int8)
    for i in prange(len(values)):
        for k in range(len(scale)):
            share = values[i, k] / scale[k]
            root = np.rint(np.sqrt(abs(share)) * np.float32(127))
            found[i, k] = np.int8(root if share >= 0 else -root)
    return found


def read_sizes(path: Path) -> dict[int, tuple[int, ...]]:
    """Level sizes by label id, as written by `write_set`; DataError for a file without them."""
    counts = read_header(path).counts
    with _open(path) as file:
        try:
            sizes = {label: _integers(file, f"{label}/sizes") for label in counts}
        except _DAMAGED as error:
            raise DataError(f"{path}: not nested levels ({short(error)}); {_again(path)}") from None
    lengths = {len(s) for s in sizes.values()}
    if (
        len(lengths) != 1
        or any(s != tuple(sorted(s)) or s[0] < 0 or s[-1] != counts[i] for i, s in sizes.items() if s)
        or 0 in lengths
    ):
        raise DataError(f"{path}: level sizes that do not fit its Gaussians; {_again(path)}")
    return sizes


def read_replaces(path: Path, sizes: Mapping[int, tuple[int, ...]]) -> dict[int, tuple[int, ...]]:
    """By label id the levels that replace those below, of categories that have some.

    `sizes`: of `read_sizes`. DataError for a damaged file, or levels that cannot replace.
    """
    with _open(path) as file:
        try:
            labels = [label for label in sizes if f"{label}/replaces" in file]
            replaces = {label: _integers(file, f"{label}/replaces") for label in labels}
            for label, levels in replaces.items():
                if len(levels) > len(sizes[label]):
                    raise ValueError(f"{len(levels)} of {len(sizes[label])} levels")
                starts_of(sizes[label], levels)
        except _DAMAGED as error:
            raise DataError(f"{path}: impossible replacing levels ({short(error)}); {_again(path)}") from None
    return replaces


def read_second(path: Path, sizes: Mapping[int, tuple[int, ...]]) -> SecondOpacities | None:
    """The second opacities of a ladder, in the order of `read_level`; None where it has none.

    `sizes`: of `read_sizes`. DataError for a damaged file, or some that do not fit its levels.
    """
    with _open(path) as file:
        try:
            if f"more/{_SECOND}" not in file:
                return None
            logits = torch.from_numpy(file[f"more/{_SECOND}"].astype(np.float32, copy=False))
            weights = {label: tuple(file[f"{label}/weights"].astype(float).tolist()) for label in sizes}
            if logits.shape != (sum(n[-1] for n in sizes.values()),):
                raise ValueError(f"{list(logits.shape)} of them")
            if any(len(weights[label]) != len(n) for label, n in sizes.items()):
                raise ValueError("not a weight for each level")
            if not all(0 <= weight <= 1 for some in weights.values() for weight in some):
                raise ValueError("weights beyond 0 to 1")
            if not torch.isfinite(logits).all():
                raise ValueError("NaN or Inf")
        except _DAMAGED as error:
            raise DataError(f"{path}: impossible second opacities ({short(error)}); {_again(path)}") from None
    return SecondOpacities(logits, weights)


def _integers(file: Npz, name: str) -> tuple[int, ...]:
    """A vector of integers; ValueError for another array."""
    values = file[name]
    if values.ndim != 1 or values.dtype.kind not in "iu":
        raise ValueError(f"{name[:40]!r} is of shape {list(values.shape)} and type {values.dtype.str}")
    return tuple(values.tolist())


def read_more(path: Path, name: str) -> np.ndarray[Any, Any]:
    """A further array that `write_set` wrote; DataError if there is none."""
    with _open(path) as file:
        try:
            return file[f"more/{name}"]
        except _DAMAGED as error:
            raise DataError(f"{path}: no {name} in it ({short(error)}); {_again(path)}") from None


def _again(path: Path) -> str:
    """How a damaged file is made again: one that is there counts as done."""
    if path.name == "cleaned.npz":
        return "delete it and run `sagesplat clean` again"
    if path.parent.name != "levels":
        return "delete it and run `sagesplat nest` again"
    return f"delete {path.parent} and the checkpoint*.npz beside it, and run `sagesplat train` again"


def _open(path: Path) -> Npz:
    try:
        return Npz(path)
    except _DAMAGED as error:
        raise DataError(f"{path}: not a readable level ({short(error)}); {_again(path)}") from None


def read_header(path: Path) -> LevelFile:
    """The header of a level file, without reading its Gaussians. DataError for another file."""
    with _open(path) as file:
        try:
            step, recovering, degree = _integers(file, "meta")
            # of all arrays: a category with a damaged array name must not be lost silently
            names = [n.split("/") for n in file.names if n != "meta"]
            labels = sorted({int(label) for label, *kind in names if label != "more" and kind not in _LADDER})
            counts = {label: len(file[f"{label}/logit_opacities"]) for label in labels}
            if step < 0 or not 0 <= degree <= 3 or not all(-1 <= label < 2**15 for label in labels):
                raise ValueError(f"step {step}, degree {degree}, categories {labels}")
        except _DAMAGED as error:
            raise DataError(f"{path}: not a level ({short(error)}); {_again(path)}") from None
    return LevelFile(path, step, bool(recovering), degree, counts)


def read_level(path: Path, label_ids: Sequence[int] | None = None) -> Gaussians:
    """Read the Gaussians of a level file.

    Args:
        path: levels/NNNNNN.npz, or the nested ladder's ladder.npz.
        label_ids: Only these categories are read, in this order; None: all, ascending.

    Returns:
        Their Gaussians on the CPU, by category; none for categories that the level does not have.

    Raises:
        DataError: If the file is damaged or holds NaN or Inf.

    Example:
        >>> from pathlib import Path
        >>> from sagesplat.formats.levels import read_level
        >>> trees = read_level(Path("runs/garden/levels/007000.npz"), [184])  # doctest: +SKIP
    """
    header = read_header(path)
    wanted = sorted(header.counts) if label_ids is None else [i for i in label_ids if i in header.counts]
    if not wanted:
        return _empty(header.sh_degree)
    with _open(path) as file:
        try:
            g = _decode_all(file, {label: header.counts[label] for label in wanted})
        except _DAMAGED as error:
            raise DataError(f"{path}: a broken level ({short(error)}); {_again(path)}") from None
    for name, parameter in g.parameters().items():
        if not torch.isfinite(parameter).all():
            raise DataError(f"{path}: {name} holds NaN or Inf; {_again(path)}")
    return g


def check_level(path: Path) -> None:
    """DataError if a level's CRC-32 checksums do not match; reads in small blocks of memory."""
    try:
        with Npz(path), zipfile.ZipFile(path) as archive:
            broken = archive.testzip()
    except Exception as error:  # zipfile and zlib have a class for each kind of damage
        broken = short(error)
    if broken is not None:
        raise DataError(f"{path}: a damaged level ({broken}); {_again(path)}")


def _decode_all(file: Npz, counts: Mapping[int, int]) -> Gaussians:
    """Some categories, each read into its place: parts beside their union would take twice the memory."""
    at, whole = 0, dict[str, torch.Tensor]()
    for label, count in counts.items():
        for name, values in vars(_decode(file, label)).items():
            if name not in whole:
                whole[name] = values.new_empty(sum(counts.values()), *values.shape[1:])
            if values.shape[1:] != whole[name].shape[1:]:
                raise ValueError("harmonics of different degrees")
            whole[name][at : at + count] = values
        at += count
    return Gaussians(**whole)


def _decode(file: Npz, label: int) -> Gaussians:
    def column(name: str) -> np.ndarray:
        with np.errstate(all="ignore"):  # values too large for float32 become Inf, which is checked later
            return file[f"{label}/{name}"].astype(np.float32, copy=False)

    values = {name: column(name) for name in ("means", *_HALVES)}
    if file[f"{label}/quats"].dtype == np.float32:  # exact
        values |= {name: column(name) for name in ("quats", "shN")}
    else:
        share, scale = column("shN") / 127, column("shN_scale")
        if share.shape[1:] != scale.shape:
            raise ValueError(f"scales of shape {scale.shape} for harmonics of {share.shape}")
        values["quats"] = column("quats") / 32767
        values["shN"] = np.sign(share) * share**2 * scale
    labels = torch.full((len(values["means"]),), label, dtype=torch.int16)
    return checked(Gaussians(**{name: torch.from_numpy(v) for name, v in values.items()}, label_ids=labels))


def _empty(sh_degree: int) -> Gaussians:
    shapes = {
        "means": (0, 3),
        "quats": (0, 4),
        "log_scales": (0, 3),
        "logit_opacities": (0,),
        "sh0": (0, 1, 3),
    }
    values = {name: torch.zeros(shape) for name, shape in shapes.items()}
    shN = torch.zeros(0, num_bases(sh_degree) - 1, 3)
    return Gaussians(**values, shN=shN, label_ids=torch.zeros(0, dtype=torch.int16))
