"""Floaters: Gaussians that hang in free space, found after training by what each view shows of them.

Criteria, each by itself:

- hardly shown: a camera of the capture that turned towards them would show little else, but all photos
  together show next to nothing of them;
- in front: most views that support them show content far behind them;
- category: they paint pixels of a category that is far behind them, such as the sky.

What a floater hides no photo has shown, and what it paints the training needed: taking it away may leave a
hole. So `clean` renders training and calibration views, and takes only what costs next to nothing there.
"""

import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Literal, get_args

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int64
from scipy.ndimage import minimum_filter
from torch import Tensor

from sagesplat.core.config import CleanConfig
from sagesplat.core.gaussians import Gaussians
from sagesplat.core.geometry import project, weighted_quantile
from sagesplat.metrics.image import psnr, squared_error_map
from sagesplat.raster import Backend, Workspace, add_weights, device_of, each_view, rasterize
from sagesplat.scene.images import Photos
from sagesplat.scene.scene import Camera, Scene, View
from sagesplat.segment.masks import UNLABELLED
from sagesplat.segment.valid import ALL_VALID, ValidPixels
from sagesplat.train.early_stopping import spread

Criterion = Literal["hardly shown", "in front", "category"]
CRITERIA = get_args(Criterion)
LabelImage = Callable[[View], np.ndarray]  # a view's category ids, int16 [H, W]; -1: unlabelled

_MIN_WEIGHT = 0.1  # a view supports a Gaussian if its blending weights there, summed over pixels, reach this
_SHOWN_SHARE = 0.003  # hardly shown: less of the weight that the nearest camera would see if it looked at it
_CONTENT_DEPTH = 0.8  # in front: nearer than this fraction of the depth of the content around it
_CATEGORY_DEPTH = 0.3  # category: nearer than this fraction of the median depth of the category
_MOST = 0.5  # of the views that support a Gaussian, or of its weight
_NEAR = 0.05  # quantile of the depths of tracked points, or of the pixels, that is a view's near content
_TRACKED = 20  # points in a view at least
_WINDOW = 3  # px of half the size, around a Gaussian's centre; the nearest content there counts
_COVERED = 0.5  # alpha of pixels that show content
_GUARDS = 12  # views of a kind that are rendered before and after
_SIDE_BY_SIDE = 2**24  # blending weights, by Gaussian and category: of views with more, one at a time
_TRIES = 5  # of how much may go of what a criterion found
_UNKNOWN_ERROR = 1e-3  # mean squared error of a splat without photos: 30 dB


@dataclass(frozen=True, eq=False)
class Floaters:
    """Gaussians that criteria found; one that fits several is of the first."""

    found: dict[str, Bool[np.ndarray, " N"]]  # by criterion, in the order of `CRITERIA`
    weight: Float32[np.ndarray, " N"]  # blending weight, summed over pixels and views


@dataclass(frozen=True, eq=False)
class Cleaned:
    """What `clean` takes away, and what it costs."""

    removed: dict[str, Bool[np.ndarray, " N"]]  # by criterion
    found: dict[str, int]  # by criterion, whether it is removed or not
    before: dict[str, float]  # mean PSNR by kind of view ("train", "calibration"), dB
    after: dict[str, float]

    @property
    def keep(self) -> Bool[np.ndarray, " N"]:
        """The Gaussians that stay."""
        return ~np.any(list(self.removed.values()), axis=0)


def find_floaters(
    g: Gaussians,
    scene: Scene,
    views: Collection[int],
    *,
    hardly_shown: bool = True,
    label_image: LabelImage | None = None,
    valid: ValidPixels = ALL_VALID,
    antialiased: bool = False,
    on_view: Callable[[int], None] | None = None,
) -> Floaters:
    """Find floaters by each of the `CRITERIA`.

    Args:
        g: N trained Gaussians.
        scene: Views, and points whose tracks tell how near the content of a view is, where it has some.
        views: Rows of `Scene.views` that the Gaussians were trained on.
        hardly_shown: Whether those count that the views hardly show: not where views were drawn.
        label_image: Needed for the criterion "category", and for Gaussians of at least two categories.
        valid: The pixels that count.
        antialiased: How the Gaussians were trained.
        on_view: Called with the number of views done.

    Returns:
        The Gaussians that each criterion found, and their importance.
    """
    n = len(g)
    supported, in_front, contradicting, weight = np.zeros((4, n), np.float32)
    ids = np.unique(np.append(g.label_ids.cpu().numpy(), UNLABELLED))
    if len(ids) < 3:  # of one category nothing can contradict
        label_image = None
    xyz, space, most = g.means.cpu().numpy(), Workspace(), np.zeros(n, np.float32)
    breadth = g.log_scales.exp().sort(dim=1).values[:, 1:].prod(1)
    width = 1 if label_image is None else len(ids)

    def of_view(row: int) -> tuple[np.ndarray, ...]:
        view, counts = scene.views[row], valid[scene.views[row]]
        columns = _columns(view, counts, ids, label_image)
        weights = np.zeros((n, width), np.float32)
        add_weights(g, view.camera, columns, weights, antialiased=antialiased, workspace=space)
        depth = xyz @ view.camera.w2c[2, :3] + view.camera.w2c[2, 3]
        near = depth < _CONTENT_DEPTH * _content(g, scene, row, depth, antialiased, space)
        against = np.zeros(n, np.float32)
        if label_image is not None:
            against = _contradicting(weights[:, 1:], depth)
        return weights.sum(1), _most_pixels(g, breadth, view.camera), near, against

    small = n * width <= _SIDE_BY_SIDE
    in_views = each_view(of_view, list(views), g.means.device) if small else map(of_view, views)
    for done, (total, pixels, near, against) in enumerate(in_views, 1):
        supports = total >= _MIN_WEIGHT
        weight += total
        supported += supports
        most = np.maximum(most, pixels)
        in_front += supports & near
        contradicting += against
        if on_view:
            on_view(done)
    found = {
        "hardly shown": (weight < _SHOWN_SHARE * most) & hardly_shown,
        "in front": (supported > 0) & (in_front > _MOST * supported),
        "category": (supported > 0) & (contradicting > _MOST * weight),
    }
    taken = np.zeros(n, bool)
    for name, rows in found.items():
        found[name] = rows & ~taken
        taken |= rows
    return Floaters(found, weight)


def clean(
    g: Gaussians,
    floaters: Floaters,
    scene: Scene,
    photos: Photos,
    config: CleanConfig,
    *,
    kinds: Mapping[str, Collection[int]],
    real: bool = True,
    valid: ValidPixels = ALL_VALID,
    antialiased: bool = False,
    backend: Backend = "auto",
) -> Cleaned:
    """Choose what to remove of the floaters, so that no kind of view loses more than `config.max_loss` dB.

    Criteria are tried in their order. Where all that one found would cost too much, those of the least
    blending weight go, as many as the views do not miss (bisection).

    Args:
        g: N Gaussians.
        floaters: What `find_floaters` found of them.
        scene: The capture.
        photos: What the Gaussians should look like, by row of `scene.views`.
        config: The largest loss.
        kinds: Rows of views by kind ("train", "calibration"); some of each are rendered. Kinds without rows
            do not count.
        real: False: `photos` are renders of these Gaussians, which are taken to be 30 dB off the truth.
        valid: The pixels that count.
        antialiased: How the Gaussians were trained.
        backend: Rasteriser; decides the device.
    """
    kinds = {kind: spread(valid.rows(scene, rows), _GUARDS) for kind, rows in kinds.items()}
    kinds = {kind: rows for kind, rows in kinds.items() if rows}
    on_device, space = g.to(device_of(backend)), Workspace()

    def quality(keep: Bool[np.ndarray, " N"]) -> dict[str, float]:
        kept = on_device.select(torch.from_numpy(keep).to(on_device.means.device))
        every = [row for rows in kinds.values() for row in rows]
        found = dict(zip(every, each_view(partial(of_view, kept), every, kept.means.device), strict=True))
        return {kind: float(np.mean([found[row] for row in rows])) for kind, rows in kinds.items()}

    def of_view(kept: Gaussians, row: int) -> float:
        view, photo = scene.views[row], photos[row].astype(np.float32) / 255
        with torch.no_grad():
            render = rasterize(kept, view.camera, antialiased=antialiased, backend=backend, workspace=space)
        errors = squared_error_map(render.rgb.clamp(0, 1).float().cpu().numpy(), photo)
        mean = float((errors if (counts := valid[view]) is None else errors[counts]).mean())
        return float(psnr(mean if real else mean + _UNKNOWN_ERROR))

    keep = np.ones(len(g), bool)
    before = after = best = quality(keep)
    removed = dict[str, np.ndarray]()
    for name, rows in floaters.found.items():
        order = np.flatnonzero(rows)[np.argsort(floaters.weight[rows], kind="stable")]
        least = {kind: best[kind] - config.max_loss for kind in kinds}
        removed[name], after = _unmissed(order, keep, after, least, quality)
        keep &= ~removed[name]
        best = {kind: max(best[kind], after[kind]) for kind in kinds}  # a gain pays for nothing else
    found = {name: int(rows.sum()) for name, rows in floaters.found.items()}
    return Cleaned(removed, found, before, after)


def _unmissed(
    order: Int64[np.ndarray, " F"],
    keep: Bool[np.ndarray, " N"],
    now: dict[str, float],
    least: Mapping[str, float],
    quality: Callable[[Bool[np.ndarray, " N"]], dict[str, float]],
) -> tuple[Bool[np.ndarray, " N"], dict[str, float]]:
    """The first ones of `order` that can go from `keep` at a quality of `least`, by bisection.

    Returns which they are, and the quality without them (`now`: with them).
    """
    low, count, high = 0, len(order), len(order)  # so many can go; so many are tried; more cannot
    for _ in range(_TRIES):
        if count == low:
            break
        tried = keep.copy()
        tried[order[:count]] = False
        found = quality(tried)
        if all(found[kind] >= limit for kind, limit in least.items()):
            low, now = count, found
        else:
            high = count - 1
        count = (low + high + 1) // 2
    gone = np.zeros(len(keep), bool)
    gone[order[:low]] = True
    return gone, now


def _most_pixels(g: Gaussians, breadth: Float[Tensor, " N"], camera: Camera) -> Float32[np.ndarray, " N"]:
    """Blending weight of each Gaussian where the camera looks straight at it and nothing else is in front.

    `breadth`: product of the standard deviations of its broadest side, square world units.
    """
    distance = torch.linalg.vector_norm(g.means - g.means.new_tensor(camera.position), dim=1).clamp_min(1e-9)
    pixels = 2 * math.pi * breadth * float(camera.K[0, 0] * camera.K[1, 1]) / distance**2
    return (g.logit_opacities.sigmoid() * pixels.clamp_max(camera.width * camera.height)).cpu().numpy()


def _columns(
    view: View,
    counts: np.ndarray | None,
    ids: np.ndarray,
    label_image: LabelImage | None,
) -> Int64[np.ndarray, "H W"]:
    """The column of each pixel: of its category's row in `ids`, 0 where it has none; -1: does not count."""
    if label_image is None:
        columns = np.zeros((view.camera.height, view.camera.width), np.int64)
    else:
        labels = label_image(view)
        columns = np.searchsorted(ids, labels).clip(0, len(ids) - 1)
        columns[ids[columns] != labels] = 0
    if counts is not None:
        columns[~counts] = -1
    return columns


def _content(
    g: Gaussians,
    scene: Scene,
    row: int,
    depth: Float[np.ndarray, " N"],
    antialiased: bool,
    space: Workspace,
) -> Float[np.ndarray, " N"]:
    """Depth of what a view shows around each Gaussian's centre, or of its near content where that is more."""
    camera = scene.views[row].camera
    half = camera.resized(max(1, camera.width // 2), max(1, camera.height // 2))  # exact enough, and faster
    feature = torch.from_numpy(np.maximum(depth, 0).astype(np.float32))[:, None].to(g.means.device)
    with torch.no_grad():
        render = rasterize(g, half, sh_degree=0, features=feature, antialiased=antialiased, workspace=space)
    assert render.features is not None
    alpha = render.alpha.float().cpu().numpy()
    shown = render.features[..., 0].float().cpu().numpy() / np.maximum(alpha, _COVERED)
    covered = alpha >= _COVERED
    nearest = minimum_filter(np.where(covered, shown, np.inf), _WINDOW)
    pixels = project(g.means.cpu().numpy(), half.w2c, half.K)[0]
    at = np.floor(np.nan_to_num(pixels, nan=-1.0)).clip(-1, 1e6).astype(np.int64)
    inside = (at >= 0).all(1) & (at < (half.width, half.height)).all(1)
    found = np.zeros(len(depth))
    found[inside] = nearest[at[inside, 1], at[inside, 0]]
    near = _tracked(scene, row)
    if not len(near):
        near = shown[covered] if covered.any() else np.zeros(1)
    return np.maximum(np.where(np.isfinite(found), found, 0), np.quantile(near, _NEAR))


def _tracked(scene: Scene, row: int) -> Float[np.ndarray, " P"]:
    """Depths of the points whose tracks are in a view; none where they are too few."""
    points = scene.points.track_points[scene.points.track_views == row]
    camera = scene.views[row].camera
    depth = scene.points.xyz[points] @ camera.w2c[2, :3] + camera.w2c[2, 3]
    return depth if len(points) >= _TRACKED else depth[:0]


def _contradicting(
    weights: Float32[np.ndarray, "N L"], depth: Float[np.ndarray, " N"]
) -> Float32[np.ndarray, " N"]:
    """Weight of each Gaussian on pixels of categories whose median depth is far behind it."""
    found = np.zeros(len(depth), np.float32)
    for column in weights.T:
        rows = np.flatnonzero(column)
        if len(rows):
            median = weighted_quantile(depth[rows], column[rows], 0.5)
            found[rows] += column[rows] * (depth[rows] < _CATEGORY_DEPTH * median)
    return found
