"""The pack: the increments that the first view needs in one file, for a first load in few requests.

It is a concatenation of increments, in the order of their benefit for the first view: level 1 of all cells,
those in sight first, which the page asks for together with the manifest; then the upgrades by which
categories reach the target, by gain of expected quality x pixel share per byte. Levels of a cell must come
in order, so an increment counts with the slope of the concave hull of quality over bytes. The viewer orders
by the same gains (web/src/core/order.ts), and asks for ranges of the pack. A server without ranges sends
all of it: so nothing is in it that the first view does not need.

Where the first view needs a level that replaces those below, the ones between the first and that are left
out: nobody is to download what is thrown away at once.
"""

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import takewhile
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from sagesplat.adapt.cell_models import LEAST_SHARE, FidelityModel, expect, needed
from sagesplat.adapt.cell_plans import reach
from sagesplat.adapt.cells import Cells
from sagesplat.formats.increments import ranges_of
from sagesplat.scene.scene import Camera

# of the first view, as in the viewer on a usual screen
FOV_Y, ASPECT, HEIGHT = math.radians(60), 16 / 9, 1080
_LEAST = 1e-6  # least gain


@dataclass(frozen=True, eq=False)
class Ladder:
    """The data of a cell that decides where its files are placed."""

    sizes: Sequence[int]  # bytes of its files, by level
    weight: float = 1.0  # of its label
    replaces: Sequence[int] = field(default_factory=list)  # levels that replace those below, ascending


def costs_of(ladders: Sequence[Ladder]) -> Int[np.ndarray, "C K"]:
    """Bytes of the cells' levels, as far as any has them; above a cell's last level that of the last one."""
    table = np.zeros((len(ladders), max((len(one.sizes) for one in ladders), default=0)), np.int64)
    for row, one in enumerate(ladders):
        total = 0
        for k, size in enumerate(one.sizes):
            total = size + (0 if k + 1 in one.replaces else total)
            table[row, k:] = total
    return table


def order_of(
    ladders: Sequence[Ladder],
    cells: Cells,
    models: Mapping[int, FidelityModel],
    camera: Camera,
    target: float,
) -> list[tuple[int, int]]:
    """(cell id, level) of the files that the view of a camera needs, in their order.

    `ladders`: of the cells, in their order. `models`: of fidelity, with the files' levels. `target`: that a
    viewer begins with.
    """
    cost = costs_of(ladders)
    if not len(ladders):
        return []
    expected = expect(models, cells, [camera], cost.shape[1])
    mean, share = expected.mean[0], expected.share[0]
    wanted = reach(cost, mean, share, expected.column, needed(models, expected, target)[0]).levels + 1
    ranked = []
    for row, (cell, ladder) in enumerate(zip(cells.ids.tolist(), ladders, strict=True)):
        visible, last = bool(share[row] > 0), len(ladder.sizes)
        path = _path(ladder, min(int(wanted[row]), last))
        total = np.cumsum(np.take(ladder.sizes, path - 1), dtype=np.float64)
        known = not np.isnan(mean[row]).any()
        quality = mean[row, path - 1] if known else np.sqrt(total / total[-1])
        weight = max(ladder.weight * max(float(share[row]), LEAST_SHARE), _LEAST**2)
        ranked.append((0 if visible else 1, -weight / total[0], cell, 1))
        gains = gains_of(quality, total).tolist()
        ranked += [
            (2, -weight * gain, cell, level)
            for level, gain in zip(path[1:].tolist(), gains, strict=True)
            if visible and level <= wanted[row]
        ]
    return [(cell, level) for *_, cell, level in sorted(ranked)]


def gains_of(ssim: Float[np.ndarray, " K"], total: Float[np.ndarray, " K"]) -> Float[np.ndarray, " K-1"]:
    """SSIM gain per byte of each level from the second on: slopes of the concave hull, never rising.

    `ssim` may be NaN: unknown. `total`: bytes of a level including all levels below.
    """
    gains, have, last = np.zeros(len(ssim) - 1), 0, math.inf
    while have < len(gains):
        slopes = np.nan_to_num(ssim[have + 1 :] - np.nanmax(ssim[: have + 1], initial=0), nan=-1.0)
        slopes /= total[have + 1 :] - total[have]
        to = have + 1 + int(slopes.argmax()) if slopes.max() > 0 else len(gains)
        least = _LEAST / (total[to] - total[have])
        last = min(last, max(float(slopes.max()), least))
        gains[have:to] = last
        have = to
    return gains


def write_pack(
    folder: Path, labels: Sequence[dict[str, Any]], order: Sequence[tuple[int, int]]
) -> dict[str, Any]:
    """Write increments of a manifest's labels, which are in `folder`, as one pack; its manifest entry."""
    unnamed, digest, size = folder / "scene.pack", hashlib.sha256(), 0
    levels = {
        cell["id"]: ranges_of((some["uri"], some.get("offset", 0), some["bytes"]) for some in cell["levels"])
        for label in labels
        for cell in label["cells"]
    }
    with unnamed.open("wb") as file:
        for cell, level in order:
            uri, offset, nbytes = levels[cell][level - 1]
            with (folder / uri).open("rb") as source:
                source.seek(offset)
                content = source.read(nbytes)
            digest.update(content)
            size += file.write(content)
    uri = f"scene-{digest.hexdigest()[:12]}.pack"
    unnamed.replace(folder / uri)
    return {"uri": uri, "bytes": size, "sha256": digest.hexdigest(), "order": [list(one) for one in order]}


def beginning_of(manifest: Mapping[str, Any]) -> int:
    """Bytes of the first levels at the beginning of a manifest's pack, which every plan wants."""
    levels = {cell["id"]: cell["levels"] for label in manifest["labels"] for cell in label["cells"]}
    first = takewhile(lambda one: one[1] == 1, manifest["pack"]["order"])
    return sum(levels[cell][0]["bytes"][0] for cell, _ in first)


def _path(ladder: Ladder, wanted: int) -> np.ndarray:
    """The levels whose files a viewer loads for a level, and beyond it."""
    start = max((level for level in ladder.replaces if level <= wanted), default=1)
    return np.array([1, *range(max(start, 2), len(ladder.sizes) + 1)])
