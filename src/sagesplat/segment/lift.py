"""2D-to-3D label transfer: labels of the SfM points, by vote over the label images."""

from collections.abc import Collection, Iterator
from dataclasses import dataclass, fields
from itertools import pairwise
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32, Int16, Int32, Int64, Shaped

from sagesplat.core.errors import LabelError, short
from sagesplat.io.files import atomic_path
from sagesplat.io.npz import Npz
from sagesplat.scene.scene import Scene
from sagesplat.segment.masks import UNLABELLED, Masks
from sagesplat.segment.valid import ALL_VALID, ValidPixels

IGNORED = -2  # label of points at which no Gaussian begins: they show what does not belong to the scene


@dataclass(frozen=True, eq=False)
class LiftedLabels:
    """The label of each point, and how clear the vote for it was."""

    label_ids: Int16[np.ndarray, " P"]  # category id, -1 where nothing voted
    num_votes: Int32[np.ndarray, " P"]  # labelled pixels that the point was seen on
    num_agreeing: Int32[np.ndarray, " P"]  # those among them with the point's label
    ignored: Bool[np.ndarray, " P"] | None = None  # most of its pixels do not count; None: of no point

    @property
    def initial_ids(self) -> Int16[np.ndarray, " P"]:
        """Label of the Gaussian that begins at each point; `IGNORED` where none does."""
        if self.ignored is None:
            return self.label_ids
        return np.where(self.ignored, np.int16(IGNORED), self.label_ids)

    def select(self, rows: Int64[np.ndarray, " M"]) -> "LiftedLabels":
        """The labels of some points."""
        ignored = None if self.ignored is None else self.ignored[rows]
        return LiftedLabels(self.label_ids[rows], self.num_votes[rows], self.num_agreeing[rows], ignored)

    @property
    def agreement(self) -> float:
        """Share of all votes that agree with the label of their point; NaN without a vote."""
        votes = int(self.num_votes.sum())
        return float(self.num_agreeing.sum() / votes) if votes else float("nan")

    def write(self, path: Path) -> None:
        """Write labels.npz."""
        with atomic_path(path) as temporary:
            columns = {f.name: getattr(self, f.name) for f in fields(self)}
            np.savez(temporary, **{name: column for name, column in columns.items() if column is not None})

    @classmethod
    def read(cls, path: Path, num_points: int) -> "LiftedLabels":
        """Read labels.npz; LabelError where it is missing, damaged or not of `num_points` points."""
        types = {"label_ids": np.int16, "num_votes": np.int32, "num_agreeing": np.int32}
        try:
            with Npz(path) as stored:
                more = {"ignored": np.bool_} if "ignored" in stored else {}
                columns = {
                    name: stored[name].astype(dtype, casting="safe") for name, dtype in (types | more).items()
                }
        except FileNotFoundError:
            raise LabelError(f"{path}: no such file; lift the labels first") from None
        except (OSError, KeyError, TypeError, ValueError) as error:
            raise LabelError(f"{path}: not the labels of points ({short(error)}); lift them again") from None
        shapes = {column.shape for column in columns.values()}
        if shapes != {(num_points,)}:
            raise LabelError(
                f"{path}: arrays of shape {shapes} where the scene has {num_points} points; lift them again"
            )
        return cls(**columns)


def lift(
    scene: Scene,
    masks: Masks,
    *,
    views: Collection[int] | None = None,
    valid: ValidPixels = ALL_VALID,
) -> LiftedLabels:
    """Transfer 2D labels to the SfM points: each point takes the label that most of its pixels have.

    A point votes once per observation of its track; where a scene has no tracks, once per view whose frustum
    it is in, occluded or not.

    Args:
        scene: The capture.
        masks: Label images, [H, W] of category ids; unlabelled pixels do not vote.
        views: Rows of `Scene.views` that vote; None: all.
        valid: The pixels that count. A point that is seen on more that do not count than that do is ignored.

    Returns:
        Label ids int16 [P] (-1: no vote), how many votes each point had and how many agreed, and which points
        are ignored. Ties go to the label with more pixels in all label images.
    """
    ids = np.array(sorted(masks.taxonomy.names))
    column_of = np.zeros(ids[-1] + 1, np.int64)
    column_of[ids] = np.arange(len(ids))
    counts = np.zeros((len(scene.points.xyz), len(ids)), np.int32)
    flat_counts = counts.reshape(-1)  # np.add.at is several times faster on one axis
    num_pixels = np.zeros(len(ids), np.int64)
    balance = np.zeros(len(scene.points.xyz), np.int32)  # pixels that count less those that do not
    pixels = _track_pixels(scene) if len(scene.points.track_points) else _projected_pixels(scene)
    for row, (view, (points, uv)) in enumerate(zip(scene.views, pixels, strict=True)):
        if views is not None and row not in views:
            continue
        label_ids, counts_here = masks[view], valid[view]
        # unsigned, unlabelled pixels are 65535: out of the way
        num_pixels += np.bincount(label_ids.view(np.uint16).ravel(), minlength=ids[-1] + 1)[ids]
        on_valid = None if counts_here is None else _pixels_at(counts_here, points, uv)[0]
        seen, points = _pixels_at(label_ids, points, uv)
        np.add.at(balance, points, 1 if on_valid is None else 2 * on_valid.astype(np.int32) - 1)
        voted = seen != UNLABELLED
        np.add.at(flat_counts, points[voted] * len(ids) + column_of[seen[voted]], 1)
    order = np.argsort(-num_pixels, kind="stable")  # arg max takes the first of several
    winner = order[counts[:, order].argmax(1)]
    num_votes = counts.sum(1, dtype=np.int32)
    return LiftedLabels(
        label_ids=np.where(num_votes > 0, ids[winner], UNLABELLED).astype(np.int16),
        num_votes=num_votes,
        num_agreeing=np.take_along_axis(counts, winner[:, None], 1)[:, 0],
        ignored=balance < 0 if (balance < 0).any() else None,
    )


def agreement_in(
    scene: Scene, masks: Masks, label_ids: Int16[np.ndarray, " P"], views: Collection[int]
) -> float:
    """Share of the labelled observations in `views` that show their point's label; NaN without any."""
    same = seen = 0
    pixels = _track_pixels(scene) if len(scene.points.track_points) else _projected_pixels(scene)
    for row, (view, (points, uv)) in enumerate(zip(scene.views, pixels, strict=True)):
        if row not in views:
            continue
        found, points = _pixels_at(masks[view], points, uv)
        both = (found != UNLABELLED) & (label_ids[points] != UNLABELLED)
        seen += int(both.sum())
        same += int((found == label_ids[points])[both].sum())
    return same / seen if seen else float("nan")


def _pixels_at(
    image: Shaped[np.ndarray, "H W"], points: Int64[np.ndarray, " M"], uv: Float32[np.ndarray, "M 2"]
) -> tuple[Shaped[np.ndarray, " m"], Int64[np.ndarray, " m"]]:
    """An image at pixels, and their points; on the far edge or, after undistortion, outside there is none."""
    inside = (uv >= 0).all(1) & (uv < image.shape[::-1]).all(1)
    x, y = uv[inside].astype(np.int64).T
    return image[y, x], points[inside]


def _track_pixels(scene: Scene) -> Iterator[tuple[Int64[np.ndarray, " M"], Float32[np.ndarray, "M 2"]]]:
    """View by view: the points that have an observation in it, and where."""
    points = scene.points
    order = np.argsort(points.track_views, kind="stable")
    starts = np.searchsorted(points.track_views[order], np.arange(len(scene.views) + 1))
    for start, end in pairwise(starts):
        rows = order[start:end]
        yield points.track_points[rows], points.track_uv[rows]


def _projected_pixels(scene: Scene) -> Iterator[tuple[Int64[np.ndarray, " M"], Float32[np.ndarray, "M 2"]]]:
    """View by view: the points in front of the camera, and where it sees them."""
    for view in scene.views:
        seen = scene.points.xyz @ view.camera.w2c[:3, :3].T + view.camera.w2c[:3, 3]
        rows = np.flatnonzero(seen[:, 2] > 1e-6)
        homogeneous = seen[rows] @ view.camera.K.T
        yield rows, homogeneous[:, :2] / homogeneous[:, 2:]
