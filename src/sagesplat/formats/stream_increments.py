"""Increments of nested levels as coded streams, one for each category."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Int64

from sagesplat.core.gaussians import Gaussians, concat
from sagesplat.core.names import slugs
from sagesplat.core.second_opacity import SecondOpacities
from sagesplat.formats.increments import GPU_BYTES, STREAM, Increment, by_file, stream_of, write_index
from sagesplat.formats.stream import Encoded, encode_stream
from sagesplat.formats.stream_header import Grid, Precision
from sagesplat.io.files import atomic_folder


@dataclass(frozen=True, eq=False)
class Streams:
    """Increments as coded streams, and which Gaussians these hold."""

    increments: list[Increment]
    sizes: dict[int, tuple[int, ...]]  # by label id, Gaussians up to the end of each level
    rows: Int64[np.ndarray, " M"]  # of the Gaussians that were given, in the order of the increments


def write_streams(
    folder: Path,
    g: Gaussians,
    sizes: Mapping[int, Sequence[int]],
    names: dict[int, str],
    *,
    second: SecondOpacities | None = None,
    antialiased: bool = False,
    grids: Mapping[int, Grid] | None = None,
) -> Streams:
    """Write the increments of nested levels as a coded stream for each category, and their index.

    `folder` is replaced. `sizes` and `names` as in `write_increments`; `second`: second opacities of the
    Gaussians, with weights of all categories. `grids`: by label id, of Gaussians that were decoded before,
    what they are rounded to already. What is hardly to be seen is left out (see `encode_stream`,
    whose errors are raised), and with it a category that has nothing else.
    """
    stems = slugs({label: names.get(label, str(label)) for label in sizes})
    labels = g.label_ids.cpu().numpy()
    written, left, order = list[Increment](), dict[int, tuple[int, ...]](), [np.arange(0)]
    with atomic_folder(folder) as fresh:
        for label in sorted(sizes):
            rows = torch.from_numpy(np.flatnonzero(labels == label))
            own = second and SecondOpacities(second.logits[rows], {label: second.weights[label]})
            precision = Precision(grid=(grids or {}).get(label))
            coded = encode_stream(
                g.select(rows), sizes[label], second=own, precision=precision, antialiased=antialiased,
                name=stems[label],
            )  # fmt: skip
            if not len(coded.rows):
                continue
            uri = f"{stems[label]}-{hashlib.sha256(coded.content).hexdigest()[:12]}{STREAM}"
            (fresh / uri).write_bytes(coded.content)
            written += _ranges(label, uri, coded, GPU_BYTES[g.sh_degree])
            left[label] = coded.sizes
            order.append(rows.numpy()[coded.rows])
        write_index(fresh, written)
    return Streams(written, left, np.concatenate(order))


def _ranges(label: int, uri: str, coded: Encoded, gpu_bytes: int) -> list[Increment]:
    """The increments of a stream. The bytes of a level without Gaussians belong to the next, or the last."""
    counts = np.diff(coded.sizes, prepend=0).tolist()
    levels = [i for i, count in enumerate(counts) if count]
    cuts = [0, *(coded.ends[i] for i in levels[:-1]), len(coded.content)]
    return [
        Increment(
            label, i + 1, uri, counts[i], high - low, counts[i] * gpu_bytes,
            hashlib.sha256(coded.content[low:high]).hexdigest(),
            offset=low, weight=coded.weights[i] if coded.weights else None,
        )
        for i, (low, high) in zip(levels, pairwise(cuts), strict=True)
    ]  # fmt: skip


def read_streams(folder: Path, listed: Sequence[Increment]) -> tuple[Gaussians, SecondOpacities | None]:
    """What all increments of `write_streams` hold: Gaussians, and their second opacities if they have some.

    DataError for a missing or damaged file.
    """
    found = [stream_of(folder, some) for some in by_file(folder, listed)]
    g, seconds = concat([one.gaussians for one in found]), [one.second for one in found if one.second]
    if not seconds:
        return g, None
    weights = {label: of_levels for one in seconds for label, of_levels in one.weights.items()}
    return g, SecondOpacities(torch.cat([one.logits for one in seconds]), weights)
