"""The pack: all increments of a bundle in one file, for the first load without a round trip per increment.

It is a concatenation of the increments, in the order of their benefit for the first view: level 1 of all
visible and nearby labels, then increments by their gain of expected quality x pixel share per byte.
Levels of a label must come in order. So an increment counts with the slope of the concave hull of quality
over bytes. The viewer has the same rules (web/src/core/order.ts).

Where the first view needs a level that replaces those below, the ones between the first and that come last:
nobody is to download what is thrown away at once.
"""

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from sagesplat.adapt.process import matern32
from sagesplat.adapt.viewpoint import Prediction, ViewModel, where
from sagesplat.scene.scene import Camera
from sagesplat.viewer import boxes
from sagesplat.viewer.frames import camera_at

# of the first view, as in the viewer on a usual screen
FOV_Y, ASPECT = math.radians(60), 16 / 9
_HEIGHT = 1080  # pixels
_LEAST_SHARE = 1e-4  # least pixel share, so that every visible label counts
_LEAST = 1e-6  # weight of labels out of sight, and least gain
NEARBY = 2**18  # bytes of first levels out of sight that precede all finer levels
_TURN = 0.25  # assumed probability that the viewer soon turns to a label out of sight


@dataclass(frozen=True, eq=False)
class Ladder:
    """The data of a label that decides where its files are placed."""

    sizes: Sequence[int]  # bytes of its files, by level
    weight: float
    boxes: Float[np.ndarray, "B 6"]  # in the bundle's axes
    model: ViewModel | None  # with the files' levels; None: no quality model
    shares: Float[np.ndarray, " V"] | None  # share of each camera's pixels
    replaces: Sequence[int] = field(default_factory=list)  # levels that replace those below, ascending
    target: float = 1.0  # quality that a viewer begins with


def order_of(
    ladders: Sequence[Ladder],
    cameras: Sequence[Camera],
    position: Float[np.ndarray, "3"],
    quaternion: Float[np.ndarray, "4"],
    lens: tuple[float, float] = (math.inf, math.inf),
) -> list[tuple[int, int]]:
    """(index of the ladder, level) of all files, ordered for the view from a pose in the bundle's axes.

    `lens`: of the photos (`adapt.observe.widest_lens`).
    """
    planes = boxes.frustum(position, quaternion, FOV_Y, ASPECT)
    photo = boxes.photo_frustum(position, quaternion, FOV_Y, ASPECT, lens)
    camera = camera_at(position, quaternion, FOV_Y, round(ASPECT * _HEIGHT), _HEIGHT)
    ranked, behind = [], []
    for index, ladder in enumerate(ladders):
        visible = not len(ladder.boxes) or boxes.touching(ladder.boxes, planes).any()
        weight = ladder.weight * max(_share(ladder, cameras, camera, position, planes), _LEAST_SHARE)
        weight = max(weight * (1 if visible else _LEAST), _LEAST**2)
        distance = boxes.distance(ladder.boxes, position, planes, photo)
        path, skipped = _path(ladder, camera, distance)
        total = np.cumsum(np.take(ladder.sizes, path - 1), dtype=np.float64)
        ssim, limit = _expected(ladder, camera, distance, path, total), math.inf
        if visible:
            ranked.append((0, -weight / total[0], index, 1))
        else:
            around = ladder.weight * max(_apparent_size(ladder.boxes, position, planes[:0]), _LEAST_SHARE)
            first = ssim[0] if ssim[0] > 0 else 1.0
            limit = _TURN * around * first / total[0]
            behind.append((-limit, index, total[0]))
        gains = gains_of(ssim, total)
        ranked += [
            (2, -min(weight * gain, limit), index, k)
            for k, gain in zip(path[1:].tolist(), gains.tolist(), strict=True)
        ]
        ranked += [(3, 0.0, index, k) for k in skipped]
    nearby = 0
    for value, index, nbytes in sorted(behind):
        nearby += nbytes
        ranked.append((1 if nearby <= NEARBY else 2, value, index, 1))
    return [(index, level) for *_, index, level in sorted(ranked)]


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
    """Write the increments of a manifest's labels, which are in `folder`, as one pack; its manifest entry."""
    unnamed, digest, size = folder / "scene.pack", hashlib.sha256(), 0
    with unnamed.open("wb") as file:
        for index, level in order:
            entry = labels[index]["levels"][level - 1]
            with (folder / entry["uri"]).open("rb") as source:
                source.seek(entry.get("offset", 0))
                content = source.read(entry["bytes"])
            digest.update(content)
            size += file.write(content)
    uri = f"scene-{digest.hexdigest()[:12]}.pack"
    unnamed.replace(folder / uri)
    return {"uri": uri, "bytes": size, "sha256": digest.hexdigest(), "order": [list(one) for one in order]}


def _path(ladder: Ladder, camera: Camera, distance: float) -> tuple[np.ndarray, list[int]]:
    """The levels whose files a viewer loads for the target, ascending; and those that it skips."""
    every = range(1, 1 + len(ladder.sizes))
    if not ladder.replaces:
        return np.array(every), []
    wanted = len(ladder.sizes)
    if ladder.model is not None:
        reached = _predicted(ladder.model, camera, distance).bound[0] >= ladder.target
        if reached.any():
            wanted = ladder.model.levels[int(reached.argmax())]
    start = max((level for level in ladder.replaces if level <= wanted), default=1)
    return np.array([1, *range(max(start, 2), len(ladder.sizes) + 1)]), list(every[1 : start - 1])


def _expected(
    ladder: Ladder, camera: Camera, distance: float, path: np.ndarray, total: np.ndarray
) -> np.ndarray:
    """Expected SSIM by level; without a model the square root of the share of bytes, as in the planner."""
    if ladder.model is None:
        return np.sqrt(total / total[-1])
    ssim = np.full(len(ladder.sizes), np.nan)
    ssim[np.array(ladder.model.levels) - 1] = _predicted(ladder.model, camera, distance).mean[0]
    return ssim[path - 1]


def _predicted(model: ViewModel, camera: Camera, distance: float) -> Prediction:
    return model.predict(np.array([distance]), *where([camera], model.focal))


def _share(
    ladder: Ladder, cameras: Sequence[Camera], camera: Camera, position: np.ndarray, planes: np.ndarray
) -> float:
    """Pixel share: kernel-weighted mean over the known views; without a model the apparent size."""
    if ladder.model is None or ladder.shares is None:
        return _apparent_size(ladder.boxes, position, planes)
    extent = ladder.model.extent
    here, known = (  # of place alone
        np.array([[*one.position / extent, *one.direction, 0.0, 0.0] for one in some], np.float64)
        for some in ([camera], cameras)
    )
    near = matern32(here, known, ladder.model.lengths)[0]
    return float(near @ ladder.shares / near.sum()) if near.sum() > 1e-12 else float(ladder.shares.mean())


def _apparent_size(category: np.ndarray, position: np.ndarray, planes: np.ndarray) -> float:
    """Apparent size of boxes: mean of (half diagonal / distance)^2, each at most 1; 0 out of sight."""
    near = category[boxes.touching(category, planes)]
    if not len(near):
        return 0.0
    distance = np.linalg.norm((near[:, :3] + near[:, 3:]) / 2 - position, axis=1)
    half = np.linalg.norm(near[:, 3:] - near[:, :3], axis=1) / 2
    return float((np.minimum(1, half / np.maximum(distance, 1e-9)) ** 2).sum() / len(category))
