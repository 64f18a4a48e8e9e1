"""Increments of nested levels as coded streams: one for each cell, one file for each category."""

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
    sizes: dict[int, tuple[int, ...]]  # by cell id, Gaussians up to the end of each level
    rows: Int64[np.ndarray, " M"]  # of the Gaussians that were given, in the order of the increments


def write_streams(
    folder: Path,
    g: Gaussians,
    sizes: Mapping[int, Sequence[int]],
    names: dict[int, str],
    *,
    label_of: Mapping[int, int],
    second: SecondOpacities | None = None,
    antialiased: bool = False,
    grids: Mapping[int, Grid] | None = None,
) -> Streams:
    """Write the increments of nested levels as a file of coded streams for each category, and their index.

    `folder` is replaced. `sizes`, `names` and `label_of` as in `write_increments`; `second`: second opacities
    of the Gaussians, with weights of all cells. `grids`: by cell id, of Gaussians that were decoded before,
    what they are rounded to already. What is hardly to be seen is left out (see `encode_stream`,
    whose errors are raised), and with it a cell or category that has nothing else.
    """
    labels = sorted({label_of[cell] for cell in sizes})
    stems = slugs({label: names.get(label, str(label)) for label in labels})
    cells = g.label_ids.cpu().numpy()
    written, left, order = list[Increment](), dict[int, tuple[int, ...]](), [np.arange(0)]
    with atomic_folder(folder) as fresh:
        for label in labels:
            coded, content = list[tuple[int, int, Encoded]](), b""
            for cell in sorted(cell for cell in sizes if label_of[cell] == label):
                rows = torch.from_numpy(np.flatnonzero(cells == cell))
                precision = Precision(grid=(grids or {}).get(cell))
                own = second and SecondOpacities(second.logits[rows], {cell: second.weights[cell]})
                made = encode_stream(
                    g.select(rows), sizes[cell], second=own, precision=precision, antialiased=antialiased,
                    name=stems[label],
                )  # fmt: skip
                if len(made.rows):
                    coded.append((cell, len(content), made))
                    content += made.content
                    left[cell] = made.sizes
                    order.append(rows.numpy()[made.rows])
            if content:
                uri = f"{stems[label]}-{hashlib.sha256(content).hexdigest()[:12]}{STREAM}"
                (fresh / uri).write_bytes(content)
                for cell, start, made in coded:
                    written += _ranges(label, cell, uri, start, made, GPU_BYTES[g.sh_degree])
        write_index(fresh, written)
    return Streams(written, left, np.concatenate(order))


def _ranges(label: int, cell: int, uri: str, start: int, coded: Encoded, gpu_bytes: int) -> list[Increment]:
    """The increments of a stream, which begins at the byte `start` of its file.

    The bytes of a level without Gaussians belong to the next, or the last.
    """
    counts = np.diff(coded.sizes, prepend=0).tolist()
    levels = [i for i, count in enumerate(counts) if count]
    cuts = [0, *(coded.ends[i] for i in levels[:-1]), len(coded.content)]
    return [
        Increment(
            label, cell, i + 1, uri, counts[i], high - low, counts[i] * gpu_bytes,
            hashlib.sha256(coded.content[low:high]).hexdigest(),
            offset=start + low, weight=coded.weights[i] if coded.weights else None,
        )
        for i, (low, high) in zip(levels, pairwise(cuts), strict=True)
    ]  # fmt: skip


def read_streams(folder: Path, listed: Sequence[Increment]) -> tuple[Gaussians, SecondOpacities | None]:
    """What all increments of `write_streams` hold: Gaussians, and their second opacities if they have some.

    `label_ids` and weights are by cell. DataError for a missing or damaged file.
    """
    found = [stream_of(folder, some) for some in by_file(folder, listed)]
    g, seconds = concat([one.gaussians for one in found]), [one.second for one in found if one.second]
    if not seconds:
        return g, None
    weights = {cell: of_levels for one in seconds for cell, of_levels in one.weights.items()}
    return g, SecondOpacities(torch.cat([one.logits for one in seconds]), weights)
