"""All chunks of a bundle in one file, for the first load: one stream instead of a round trip a chunk.

The chunks' bytes one after the other, in the order in which they gain most for the first view: level 1 of
every label in sight and of those nearby, then what gains most expected SSIM x share of the pixels a byte. As
levels come in order, one is worth as much as the best way that begins with it: the concave hull of SSIM over
bytes. The rules are the viewer's (web/src/core/order.ts).
"""

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from sagesplat.adapt.viewpoint import ViewModel, matern32
from sagesplat.scene.scene import Camera
from sagesplat.viewer import boxes
from sagesplat.viewer.frames import camera_at

FOV_Y, ASPECT = math.radians(60), 16 / 9  # of the first view: the viewer's own on a usual screen
_LEAST_SHARE = 1e-4  # so that nothing in sight is worth nothing
_LEAST = 1e-6  # what is out of sight, or gains nothing, against the rest
NEARBY = 2**18  # bytes of lowest levels out of sight that come before anything finer
_TURN = 0.25  # how likely it is that one turns to what is out of sight soon


@dataclass(frozen=True, eq=False)
class Ladder:
    """What tells where a label's files belong."""

    sizes: Sequence[int]  # bytes of its files, by level
    weight: float
    boxes: Float[np.ndarray, "B 6"]  # in the bundle's axes
    model: ViewModel | None  # with the files' levels; None: nothing is promised
    shares: Float[np.ndarray, " V"] | None  # of the pixels of each camera


def order_of(
    ladders: Sequence[Ladder],
    cameras: Sequence[Camera],
    position: Float[np.ndarray, "3"],
    quaternion: Float[np.ndarray, "4"],
) -> list[tuple[int, int]]:
    """(index of a ladder, level) of all files for the view from a pose in the bundle's axes."""
    planes = boxes.frustum(position, quaternion, FOV_Y, ASPECT)
    camera = camera_at(position, quaternion, FOV_Y, 16, 9)
    ranked, behind = [], []
    for index, ladder in enumerate(ladders):
        sees = not len(ladder.boxes) or boxes.touching(ladder.boxes, planes).any()
        weight = ladder.weight * max(_share(ladder, cameras, camera, position, planes), _LEAST_SHARE)
        weight = max(weight * (1 if sees else _LEAST), _LEAST**2)
        total = np.cumsum(ladder.sizes, dtype=np.float64)
        distance = boxes.distance(ladder.boxes, position, planes)
        ssim, limit = _expected(ladder, camera, distance, total), math.inf
        if sees:
            ranked.append((0, -weight / total[0], index, 1))
        else:
            around = ladder.weight * max(_apparent_size(ladder.boxes, position, planes[:0]), _LEAST_SHARE)
            first = ssim[0] if ssim[0] > 0 else 1.0
            limit = _TURN * around * first / total[0]
            behind.append((-limit, index, total[0]))
        gains = gains_of(ssim, total)
        ranked += [(2, -min(weight * gain, limit), index, k) for k, gain in enumerate(gains.tolist(), 2)]
    nearby = 0
    for value, index, nbytes in sorted(behind):
        nearby += nbytes
        ranked.append((1 if nearby <= NEARBY else 2, value, index, 1))
    return [(index, level) for *_, index, level in sorted(ranked)]


def gains_of(ssim: Float[np.ndarray, " K"], total: Float[np.ndarray, " K"]) -> Float[np.ndarray, " K-1"]:
    """SSIM gained a byte by each level from the second on, never rising; `ssim` NaN: unknown.

    `total`: bytes of a level with all below it.
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
    """Write the chunks of a manifest's labels, which lie in `folder`, as one file; the manifest's entry."""
    unnamed, digest, size = folder / "scene.pack", hashlib.sha256(), 0
    with unnamed.open("wb") as file:
        for index, level in order:
            content = (folder / labels[index]["levels"][level - 1]["uri"]).read_bytes()
            digest.update(content)
            size += file.write(content)
    uri = f"scene-{digest.hexdigest()[:12]}.pack"
    unnamed.replace(folder / uri)
    return {"uri": uri, "bytes": size, "sha256": digest.hexdigest(), "order": [list(one) for one in order]}


def _expected(ladder: Ladder, camera: Camera, distance: float, total: np.ndarray) -> np.ndarray:
    """SSIM by level; without promises it grows with the root of the bytes, as the planner has it."""
    if ladder.model is None:
        return np.sqrt(total / total[-1])
    at = np.array([distance]), camera.position[None].astype(np.float64), camera.direction[None].astype(float)
    ssim = np.full(len(total), np.nan)
    ssim[np.array(ladder.model.levels) - 1] = ladder.model.predict(*at).mean[0]
    return ssim


def _share(
    ladder: Ladder, cameras: Sequence[Camera], camera: Camera, position: np.ndarray, planes: np.ndarray
) -> float:
    """Of the pixels: what views close by have, by the model's kernel; without promises the apparent size."""
    if ladder.model is None or ladder.shares is None:
        return _apparent_size(ladder.boxes, position, planes)
    extent = ladder.model.extent
    here, known = (
        np.array([[*one.position / extent, *one.direction, 0.0] for one in some], np.float64)
        for some in ([camera], cameras)
    )
    near = matern32(here, known, ladder.model.lengths)[0]
    return float(near @ ladder.shares / near.sum()) if near.sum() > 1e-12 else float(ladder.shares.mean())


def _apparent_size(found: np.ndarray, position: np.ndarray, planes: np.ndarray) -> float:
    """How large boxes look: the mean square of half their diagonal over their distance, 0 out of sight."""
    near = found[boxes.touching(found, planes)]
    if not len(near):
        return 0.0
    away = np.linalg.norm((near[:, :3] + near[:, 3:]) / 2 - position, axis=1)
    half = np.linalg.norm(near[:, 3:] - near[:, :3], axis=1) / 2
    return float((np.minimum(1, half / np.maximum(away, 1e-9)) ** 2).sum() / len(found))
