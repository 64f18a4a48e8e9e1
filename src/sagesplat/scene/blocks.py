"""Splits a large scene into blocks of its ground plane: a k-d tree balanced by points and views."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from jaxtyping import Bool, Float, Float64, Int, Int64
from msgspec import Meta

from sagesplat.core import geometry
from sagesplat.core.errors import RunError, SceneError
from sagesplat.core.limits import Count, NotNegative, Number
from sagesplat.io.files import write_json
from sagesplat.io.typed import read_json_as, refused
from sagesplat.scene.scene import Points, Scene

MOST = 4096  # blocks
_CURE = "delete it and run `sagesplat run` again"
_ANGLES = np.radians(np.arange(0, 90, 7.5))  # orientations of the split; the one of least cost is taken
_SLACK = 0.08  # of the weight by which a cut may be unbalanced, to run through a sparse region
_TRIES = 33  # positions that are tried for a cut
_MARGIN = 0.2  # that a block is trained on, as a share of a block's mean width within the cameras' bounds
_MIN_SHARE = 0.25  # of a photo's visible points: as many lie in a block that trains on it
_FAR_SHARE = 0.5  # limit on the points beyond the margin, as a share of the block's own
_NARROW = 0.25  # least width of a scene as a share of its length, for the margin
_LEAST_UP = 0.02  # share of the cameras' variance that is added along their mean up direction
_MOST_SAMPLED = 200_000  # points that a split considers
_Corner = tuple[Number | None, Number | None]


@dataclass(frozen=True, eq=False)
class Blocks:
    """B boxes that tile the ground plane; the outer ones extend to infinity."""

    axes: Float64[np.ndarray, "2 3"]  # of the ground plane, in world coordinates
    low: Float64[np.ndarray, "B 2"]  # corners along the axes, world units; -inf at the scene's edge
    high: Float64[np.ndarray, "B 2"]
    margin: float  # world units beyond its border that a block is trained on

    def __len__(self) -> int:
        return len(self.low)

    def ground(self, xyz: Float[np.ndarray, "N 3"]) -> Float64[np.ndarray, "N 2"]:
        """Ground-plane coordinates of world points, world units."""
        return xyz.astype(np.float64) @ self.axes.T

    def of(self, xyz: Float[np.ndarray, "N 3"]) -> Int64[np.ndarray, " N"]:
        """The block that contains each world point."""
        at = self.ground(xyz)
        blocks = np.zeros(len(at), np.int64)
        for block in range(1, len(self)):
            inside = (at >= self.low[block]) & (at < self.high[block])
            blocks[inside.all(1)] = block
        return blocks

    def within(self, xyz: Float[np.ndarray, "N 3"], block: int, reach: float) -> Bool[np.ndarray, " N"]:
        """Which points are in a block, or at most `reach` world units beyond its border along either axis."""
        at = self.ground(xyz)
        return np.all((at >= self.low[block] - reach) & (at < self.high[block] + reach), axis=1)

    def to_border(self, xyz: Float[np.ndarray, "N 3"]) -> Float64[np.ndarray, " N"]:
        """Distance of points from the border of their block, in the ground plane, world units."""
        at, block = self.ground(xyz), self.of(xyz)
        return np.minimum(at - self.low[block], self.high[block] - at).min(1, initial=np.inf)

    def neighbours(self) -> Bool[np.ndarray, "B B"]:
        """Pairs of distinct blocks whose boxes touch."""
        touch = (self.low[:, None] <= self.high[None]) & (self.low[None] <= self.high[:, None])
        return touch.all(2) & ~np.eye(len(self), dtype=bool)


def split(scene: Scene, count: int) -> Blocks:
    """Split a scene into `count` blocks with about equal numbers of points and of training views.

    RunError for an impossible count.
    """
    cameras = np.stack([scene.views[i].camera.position for i in scene.train_ids]).astype(np.float64)
    xyz = scene.points.xyz.astype(np.float64)
    if not 2 <= count <= min(MOST, len(cameras), max(len(xyz), 1)):
        raise RunError(
            f"{scene.path}: {count} blocks of {len(cameras)} training views and {len(xyz):,} points are "
            "impossible; choose fewer with --blocks.count (1 trains the scene as one)"
        )
    xyz = xyz[:: max(1, len(xyz) // _MOST_SAMPLED)]
    plane = _ground_plane(scene, cameras)
    places = np.concatenate([xyz, cameras]) @ plane.T
    weights = np.repeat([1 / len(xyz), 1 / len(cameras)], [len(xyz), len(cameras)])
    best: tuple[float, Blocks] | None = None
    for angle in _ANGLES:
        turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        at = places @ turn.T
        at_cameras = at[len(xyz) :]  # the bounds of points would include a far background
        outline = np.stack([at_cameras.min(0), at_cameras.max(0)])
        size = np.ptp(outline, axis=0)
        reach = _MARGIN * float(np.sqrt(np.prod(np.maximum(size, _NARROW * size.max())) / count))
        boxes: list[tuple[np.ndarray, np.ndarray]] = []
        cost = _cut(at, weights, np.full(2, -np.inf), np.full(2, np.inf), outline, count, reach, boxes)
        if best is None or cost < best[0]:
            low, high = (np.array(corner) for corner in zip(*boxes, strict=True))
            best = cost, Blocks(turn @ plane, low, high, reach)
    assert best
    return best[1]


def _ground_plane(scene: Scene, cameras: np.ndarray) -> np.ndarray:
    """Two unit axes [2, 3] across the up direction: the cameras' least variance, or else up in the photos."""
    up = -np.mean([scene.views[i].camera.w2c[1, :3] for i in scene.train_ids], axis=0)
    up /= max(float(np.linalg.norm(up)), 1e-12)
    spread = np.cov(cameras.T)
    spread += _LEAST_UP * np.trace(spread) * (np.eye(3) - np.outer(up, up))
    return np.linalg.eigh(spread)[1].T[:0:-1]


def _cut(
    at: np.ndarray, weights: np.ndarray, low: np.ndarray, high: np.ndarray, outline: np.ndarray,
    count: int, reach: float, boxes: list[tuple[np.ndarray, np.ndarray]],
) -> float:  # fmt: skip
    """Append `count` boxes to `boxes`, split across the longer side; the cost: the weight near all cuts."""
    if count == 1:
        boxes.append((low, high))
        return 0.0
    axis = int(np.argmax(np.minimum(high, outline[1]) - np.maximum(low, outline[0])))
    first = count // 2
    order = np.argsort(at[:, axis], kind="stable")
    along, summed = at[order, axis], weights[order].cumsum()
    shares = first / count + np.array([-_SLACK, _SLACK])
    ends = along[np.searchsorted(summed, shares * summed[-1]).clip(1, len(along) - 1)]
    tries = np.linspace(ends[0], ends[1], _TRIES)
    padded = np.concatenate([[0.0], summed])
    beside = padded[np.searchsorted(along, tries + reach)] - padded[np.searchsorted(along, tries - reach)]
    centred = 1 + np.abs(np.linspace(-1, 1, _TRIES))  # prefers the most balanced of equal cuts
    place = tries[np.argmin(beside * centred)]
    left = at[:, axis] < place
    top, bottom = high.copy(), low.copy()
    top[axis] = bottom[axis] = place
    cost = float(beside[np.argmin(beside * centred)])
    cost += _cut(at[left], weights[left], low, top, outline, first, reach, boxes)
    return cost + _cut(at[~left], weights[~left], bottom, high, outline, count - first, reach, boxes)


def visible_shares(scene: Scene, of_points: Int[np.ndarray, " P"], count: int) -> Float64[np.ndarray, "V B"]:
    """For each view, the share of its visible points in each block.

    Visible are the points of its tracks, or without any those in its frustum.
    """
    seen = np.zeros((len(scene.views), count))
    points = scene.points
    if len(points.track_points):
        np.add.at(seen, (points.track_views, of_points[points.track_points]), 1)
    for row in np.flatnonzero(seen.sum(1) == 0):
        camera = scene.views[row].camera
        pixels, _ = geometry.project(points.xyz, camera.w2c, camera.K)
        inside = ((pixels >= 0) & (pixels < [camera.width, camera.height])).all(1)
        seen[row] = np.bincount(of_points[inside], minlength=count)
    return seen / np.maximum(seen.sum(1, keepdims=True), 1)


def assigned_views(
    scene: Scene, blocks: Blocks, shares: Float64[np.ndarray, "V B"]
) -> Bool[np.ndarray, "V B"]:
    """The blocks that each view is assigned to.

    These are the blocks with at least `_MIN_SHARE` of its visible points, the one with most, and its own.
    """
    own = blocks.of(np.stack([view.camera.position for view in scene.views]))
    every = np.arange(len(scene.views))
    assigned = shares >= _MIN_SHARE
    assigned[every, own] = True
    assigned[every, shares.argmax(1)] = True
    return assigned


def training_scene(
    scene: Scene, blocks: Blocks, block: int, views: Sequence[int], seed: int
) -> tuple[Scene, Int64[np.ndarray, " Q"]]:
    """The scene that a block is trained on, with only these views, and the rows of its points.

    It has the points within the margin. As background it also has points beyond it that the views see, at
    most `_FAR_SHARE` times as many. RunError for a block without views or points.
    """
    points, rows = scene.points, np.asarray(views, np.int64)
    near = blocks.within(points.xyz, block, blocks.margin)
    if not len(rows) or near.sum() < 4:
        raise RunError(
            f"{scene.path}: block {block} has {len(rows)} views and {int(near.sum())} points; "
            "choose fewer blocks with --blocks.count"
        )
    far = np.flatnonzero(_seen(scene, rows) & ~near)
    most = int(_FAR_SHARE * near.sum())
    if len(far) > most:
        far = np.random.default_rng([seed, block]).choice(far, most, replace=False)
    kept = np.sort(np.concatenate([np.flatnonzero(near), far]))
    place, view_place = np.full(len(points.xyz), -1), np.full(len(scene.views), -1)
    place[kept], view_place[rows] = np.arange(len(kept)), np.arange(len(rows))
    tracks = (place[points.track_points] >= 0) & (view_place[points.track_views] >= 0)
    part = Points(
        points.xyz[kept],
        points.rgb[kept],
        place[points.track_points[tracks]],
        view_place[points.track_views[tracks]].astype(np.int32),
        points.track_uv[tracks],
    )
    return (
        replace(
            scene,
            name=f"{scene.name}, block {block}",
            views=tuple(scene.views[i] for i in rows),
            points=part,
            test_names=frozenset(),
            calibration_names=frozenset(),
        ),
        kept,
    )


def _seen(scene: Scene, rows: np.ndarray) -> np.ndarray:
    """Which points (bool [P]) any of the views sees."""
    points = scene.points
    seen = np.zeros(len(points.xyz), bool)
    if len(points.track_points):
        seen[points.track_points[np.isin(points.track_views, rows)]] = True
        return seen
    for row in rows:
        camera = scene.views[row].camera
        pixels, _ = geometry.project(points.xyz, camera.w2c, camera.K)
        seen |= ((pixels >= 0) & (pixels < [camera.width, camera.height])).all(1)
    return seen


def graph_colouring(adjacent: Bool[np.ndarray, "B B"]) -> Int64[np.ndarray, " B"]:
    """A greedy graph colouring: adjacent blocks differ. Blocks of one colour can be changed concurrently."""
    chosen = np.full(len(adjacent), -1)
    for block in np.argsort(-adjacent.sum(1), kind="stable"):
        taken = set(chosen[adjacent[block]].tolist())
        chosen[block] = next(colour for colour in range(len(adjacent)) if colour not in taken)
    return chosen


def write_blocks(path: Path, blocks: Blocks, **more: Any) -> None:
    """Write a partition to a JSON file, with further entries `more`."""
    corners = {"low": _finite(blocks.low), "high": _finite(blocks.high)}
    write_json(path, {"axes": blocks.axes.tolist(), **corners, "margin": blocks.margin, **more})


@dataclass(frozen=True, eq=False)
class _Partition:
    """What `write_blocks` writes; a corner of null is infinitely far."""

    axes: Float64[np.ndarray, "2 3"]
    low: Annotated[list[_Corner], Meta(min_length=1, max_length=MOST)]
    high: list[_Corner]
    margin: NotNegative

    def __post_init__(self) -> None:
        if len(self.low) != len(self.high):
            raise ValueError(f"{len(self.low)} boxes with {len(self.high)} ends")


def read_blocks(path: Path) -> Blocks:
    """The partition that `write_blocks` wrote; SceneError for any other content."""
    made = read_json_as(path, _Partition, "a partition", _CURE, SceneError)
    low = np.array([[-np.inf if v is None else v for v in row] for row in made.low])
    high = np.array([[np.inf if v is None else v for v in row] for row in made.high])
    return Blocks(made.axes, low, high, made.margin)


@dataclass(frozen=True)
class Division:
    """What each of B blocks is made of."""

    points: list[Count]  # SfM points in its box
    views: list[Count]  # training views
    sees: list[list[Count]]  # blocks that its training views see


def read_division(path: Path) -> Division:
    """What `write_blocks` wrote of the content of the blocks; SceneError for anything else."""
    count, what = len(read_blocks(path)), "a partition"
    made = read_json_as(path, Division, what, _CURE, SceneError)
    with refused(path, what, _CURE, SceneError):
        if {len(made.points), len(made.views), len(made.sees)} != {count}:
            raise ValueError(f"not of {count} blocks")
        if any(other >= count for each in made.sees for other in each):
            raise ValueError("a block that sees one that is not there")
    return made


def _finite(corners: np.ndarray) -> list[list[float | None]]:
    return [[v if np.isfinite(v) else None for v in row] for row in corners.tolist()]
