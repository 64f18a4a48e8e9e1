"""Observations: the quality of each category at each level, view by view."""

import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from jaxtyping import Bool, Float32, Int16, Int32, UInt8
from scipy.ndimage import maximum_filter, minimum_filter
from torch import Tensor

from sagesplat.adapt.ladder import Ladder, NestedLadder
from sagesplat.adapt.seen import seen_from
from sagesplat.adapt.seen_cpu import drawn_from
from sagesplat.adapt.viewpoints import LONGEST
from sagesplat.core import geometry
from sagesplat.core.gaussians import Gaussians
from sagesplat.io.columns import ColumnTable, from_rows, read_columns
from sagesplat.metrics.color_correct import color_correct_affine
from sagesplat.metrics.image import (
    box_of,
    means_by_label,
    pasted,
    psnr,
    squared_error_map,
    ssim_map,
    tiles_around,
)
from sagesplat.raster import Backend, Workspace, device_of, each_view, most_painted, rasterize
from sagesplat.scene.images import Photos
from sagesplat.scene.scene import Camera, Scene, View
from sagesplat.segment.masks import UNLABELLED
from sagesplat.segment.valid import ALL_VALID, ValidPixels

TOTAL = -2  # label id of the rows that average over all pixels of the image


@dataclass(frozen=True, eq=False)
class Observations(ColumnTable):
    """One row per (category, level, view); columns of equal length."""

    label_id: Int32[np.ndarray, " R"]  # category id, -1 = unlabelled, -2 = the whole image
    level: Int32[np.ndarray, " R"]  # of recorded levels the training step, of nested ones 1 to K
    view: Int32[np.ndarray, " R"]  # row in Scene.views
    distance: Float32[np.ndarray, " R"]  # d_min of method A, world units; NaN where nothing is in sight
    ssim: Float32[np.ndarray, " R"]  # mean of the SSIM map over the category's pixels
    ssim_eroded: Float32[np.ndarray, " R"]  # the same over the mask eroded by 5 px; NaN if nothing is left
    psnr: Float32[np.ndarray, " R"]  # dB over the category's pixels
    num_pixels: Int32[np.ndarray, " R"]


def read_observations(path: Path) -> Observations:
    """The table that `write_csv` wrote. DataError where it is not one."""
    return read_columns(path, Observations, "delete it and run `sagesplat observe` again")


def large_enough(observations: Observations, scene: Scene) -> Observations:
    """The rows whose category has at least `MIN_SHARE` of the pixels of its view."""
    pixels = np.array([view.camera.width * view.camera.height for view in scene.views])
    return observations.select(observations.num_pixels >= MIN_SHARE * pixels[observations.view])


# A category that covers less of a view's pixels is not measured there: a few pixels say nothing of its level.
MIN_SHARE = 5e-4
ERODE = 5  # px that the inner mask keeps away from the category's border
_BORDER = -3  # pixels of an eroded label image that belong to no category
PERCENTILE = 5.0


def distances_in_views(
    scene: Scene, point_labels: Int16[np.ndarray, " P"], percentile: float | None = PERCENTILE
) -> dict[int, Float32[np.ndarray, " V"]]:
    """d_min of each category in each view: how far its closest points in sight are from the camera.

    The given percentile over the category's SfM points inside the view's frustum; 0 is the paper's minimum,
    which one mislabelled point can spoil, and None the mean. World units; NaN where no point is in sight.
    """
    labels = np.unique(point_labels)
    table = {int(label): np.full(len(scene.views), np.nan, np.float32) for label in labels}
    for row, view in enumerate(scene.views):
        camera = view.camera
        pixels, _ = geometry.project(scene.points.xyz, camera.w2c, camera.K)
        inside = ((pixels >= 0) & (pixels < [camera.width, camera.height])).all(1)
        seen_labels = point_labels[inside]
        distance = np.linalg.norm(scene.points.xyz[inside] - camera.position, axis=1)
        for label in np.unique(seen_labels):
            mine = distance[seen_labels == label]
            table[int(label)][row] = mine.mean() if percentile is None else np.percentile(mine, percentile)
    return table


def widest_lens(cameras: Sequence[Camera]) -> tuple[float, float]:
    """Largest half width and half height, at distance 1, of the pictures that models know.

    Those are the cameras' own, and the ones of other shapes and the same area that `adapt.viewpoints` draws.
    """
    own = np.array([[c.width / c.K[0, 0], c.height / c.K[1, 1]] for c in cameras], np.float64)
    shaped = max(math.sqrt(c.width * c.height * LONGEST) / c.focal for c in cameras)
    wide, high = (np.maximum(own.max(0), shaped) / 2).tolist()
    return wide, high


def within_lens(camera: Camera, lens: tuple[float, float]) -> Camera:
    """The camera with a picture no wider and no higher than `lens`, around its principal point; else itself.

    Models know distances in such pictures: the closest points in a wider one are ones that none of them has.
    """
    focal, size = camera.K.diagonal()[:2].astype(np.float64), np.array([camera.width, camera.height])
    most = np.maximum(np.round(2 * focal * lens), 1).astype(int)
    if (size <= most).all():
        return camera
    width, height = np.minimum(size, most).tolist()
    K = camera.K.copy()
    K[0, 2], K[1, 2] = (
        K[i, 2] if old <= new else new / 2 for i, (old, new) in enumerate(zip(size, most, strict=True))
    )
    return replace(camera, K=K, width=width, height=height)


def render_rgb(
    g: Gaussians,
    camera: Camera,
    *,
    backend: Backend,
    antialiased: bool,
    workspace: Workspace | None = None,
    tile_mask: Bool[np.ndarray, "h w"] | None = None,
) -> Float32[np.ndarray, "H W 3"]:
    """An image in [0, 1], as quality is measured on it; calls may share a `workspace`, images do not."""
    how: dict[str, Any] = {"backend": backend, "antialiased": antialiased, "workspace": workspace}
    with torch.no_grad():
        render = rasterize(g.to(device_of(backend)), camera, tile_mask=tile_mask, **how)
        return render.rgb.clamp(0, 1).float().cpu().numpy()


class LabelImages(Protocol):
    """Where the pixels of each category are: `segment.masks.Masks`, or `RenderedLabels`."""

    def __getitem__(self, view: View) -> Int16[np.ndarray, "H W"]:
        """A view's category ids, -1 = unlabelled."""
        ...


@dataclass(frozen=True, eq=False)
class RenderedLabels:
    """Label images of any view from the labels of Gaussians (the paper's cross-view masks)."""

    gaussians: Gaussians
    backend: Backend = "auto"
    antialiased: bool = False
    workspace: Workspace = field(default_factory=Workspace)
    _kept: dict[str, Int16[np.ndarray, "H W"]] = field(default_factory=dict)

    def __getitem__(self, view: View) -> Int16[np.ndarray, "H W"]:
        """Per pixel the category that paints most of it; -1 where more shines through than that."""
        if view.name not in self._kept:
            self._kept[view.name] = self.render(view.camera)
        return self._kept[view.name]

    def render(
        self, camera: Camera, tile_mask: Bool[np.ndarray, "h w"] | None = None
    ) -> Int16[np.ndarray, "H W"]:
        """The same at any camera; -1 in tiles of 16 x 16 px that are masked."""
        ids, columns = self._columns
        g = self.gaussians.to(device_of(self.backend))
        return ids[most_painted(g, camera, columns, len(ids), tile_mask=tile_mask, **self._how)]

    def paint(
        self, camera: Camera, tile_mask: Bool[np.ndarray, "h w"] | None = None
    ) -> Float32[np.ndarray, "H W 3"]:
        """An image of the Gaussians, as of `render_rgb`."""
        return render_rgb(self.gaussians, camera, tile_mask=tile_mask, **self._how)

    def picture(self, camera: Camera) -> tuple[Float32[np.ndarray, "H W 3"], Int16[np.ndarray, "H W"]]:
        """Both; on a CPU from one projection. The image holds until the next call in the same thread."""
        if (
            device_of(self.backend).type != "cpu"
            or self.backend == "reference"
            or camera.exposure is not None
        ):
            return self.paint(camera), self.render(camera)
        ids, columns = self._columns
        drawn, rows = drawn_from(self.gaussians, None, {}, camera, self.antialiased, self.workspace)
        everything = [(0, len(rows), 0.0)]
        if len(ids) == 2 and UNLABELLED not in self.gaussians.counts():  # what does not shine through
            image = drawn.render(everything)
            return image, ids[(drawn.remains < 0.5).astype(np.int64)]
        painted = ids[drawn.most_painted(everything, columns.numpy()[rows], len(ids))]
        return drawn.render(everything), painted

    @property
    def _how(self) -> dict[str, Any]:
        return {"antialiased": self.antialiased, "backend": self.backend, "workspace": self.workspace}

    @cached_property
    def _columns(self) -> tuple[Int16[np.ndarray, " L"], Tensor]:
        """The labels, unlabelled first, and the number of each Gaussian's among them [N]."""
        ids = sorted({UNLABELLED, *self.gaussians.counts()})
        g = self.gaussians.to(device_of(self.backend))
        known = torch.tensor(ids, device=g.label_ids.device, dtype=g.label_ids.dtype)
        return np.array(ids, np.int16), torch.searchsorted(known, g.label_ids)


def as_unit(photo: UInt8[np.ndarray, "H W 3"]) -> Float32[np.ndarray, "H W 3"]:
    """A photo in [0, 1]."""
    return photo.astype(np.float32) / 255


def near_border(label_ids: Int16[np.ndarray, "H W"], width: int) -> Bool[np.ndarray, "H W"]:
    """Pixels that have another category within `width` px (in either axis)."""
    size = 2 * width + 1
    return minimum_filter(label_ids, size) != maximum_filter(label_ids, size)


def erode(label_ids: Int16[np.ndarray, "H W"]) -> Int16[np.ndarray, "H W"]:
    """The label image without pixels that have another category within 5 px (in either axis)."""
    return np.where(near_border(label_ids, ERODE), np.int16(_BORDER), label_ids)


def measure(
    image: Float32[np.ndarray, "H W 3"],
    photo: Float32[np.ndarray, "H W 3"],
    label_ids: Int16[np.ndarray, "H W"],
    inner_ids: Int16[np.ndarray, "H W"] | None = None,
    valid: Bool[np.ndarray, "H W"] | None = None,
    tile_mask: Bool[np.ndarray, "h w"] | None = None,
) -> dict[int, dict[str, float]]:
    """SSIM, eroded SSIM, PSNR and pixels by label id, and under TOTAL those of the whole image.

    `inner_ids`: the eroded label image, where it is at hand. `valid`: the pixels that count; windows of SSIM
    that reach into others see the image there, and not the photo. `tile_mask`: what was rendered, as
    `tiles_around` has it for the labels that are wanted; values of others then mean nothing.
    """
    inner_ids = erode(label_ids) if inner_ids is None else inner_ids
    if tile_mask is not None:
        box = box_of(tile_mask)
        valid = None if valid is None else valid[box]
        image, photo, label_ids, inner_ids = image[box], photo[box], label_ids[box], inner_ids[box]
    quality, error = _maps(image, photo, valid)
    inner = means_by_label(quality, inner_ids, valid)
    errors = means_by_label(error, label_ids, valid)
    rows = {
        label: {
            "ssim": mean,
            "ssim_eroded": inner[label][0] if label in inner else np.nan,
            "psnr": float(psnr(errors[label][0])),
            "num_pixels": pixels,
        }
        for label, (mean, pixels) in means_by_label(quality, label_ids, valid).items()
    }
    rows[TOTAL] = _total(quality, error, valid)
    return rows


def measure_total(
    image: Float32[np.ndarray, "H W 3"],
    photo: Float32[np.ndarray, "H W 3"],
    valid: Bool[np.ndarray, "H W"] | None = None,
) -> dict[str, float]:
    """What `measure` finds of the whole image."""
    return _total(*_maps(image, photo, valid), valid)


def _maps(
    image: Float32[np.ndarray, "H W 3"],
    photo: Float32[np.ndarray, "H W 3"],
    valid: Bool[np.ndarray, "H W"] | None,
) -> tuple[Float32[np.ndarray, "H W"], Float32[np.ndarray, "H W"]]:
    """SSIM and squared error at every pixel, none at those that do not count."""
    photo = pasted(photo, image, valid)
    return ssim_map(image, photo), squared_error_map(image, photo)


def _total(
    quality: Float32[np.ndarray, "H W"],
    error: Float32[np.ndarray, "H W"],
    valid: Bool[np.ndarray, "H W"] | None,
) -> dict[str, float]:
    if valid is not None:
        quality, error = quality[valid], error[valid]
    whole = float(quality.mean()) if quality.size else np.nan
    decibels = float(psnr(error.mean())) if error.size else np.nan
    return {"ssim": whole, "ssim_eroded": whole, "psnr": decibels, "num_pixels": quality.size}


def measure_colours(
    image: Float32[np.ndarray, "H W 3"],
    photo: Float32[np.ndarray, "H W 3"],
    valid: Bool[np.ndarray, "H W"] | None = None,
) -> dict[str, float]:
    """PSNR of an image without its photo's exposure, and of it colour-corrected, as gsplat names them."""
    corrected = color_correct_affine(image, photo, valid)
    plain, of_corrected = measure_total(image, photo, valid), measure_total(corrected, photo, valid)
    return {"plain_psnr": plain["psnr"], "cc_psnr": of_corrected["psnr"], "cc_ssim": of_corrected["ssim"]}


def observe(
    scene: Scene,
    photos: Photos,
    masks: LabelImages,
    ladder: Ladder,
    distances: Mapping[int, Float32[np.ndarray, " V"]],
    *,
    views: Sequence[int] | None = None,
    valid: ValidPixels = ALL_VALID,
    labels: Collection[int] | None = None,
    last_only: Collection[int] = (),
    backend: Backend = "auto",
    antialiased: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Observations:
    """Render every level into views of the scene and measure SSIM and PSNR of each category there.

    Cameras that have an exposure are rendered with it: of training photos the one that was learned, of others
    the one that the full model was fitted to their photo with.

    Args:
        scene: The capture.
        photos: Its photos.
        masks: Label images, [H, W] of category ids; indexed by view.
        ladder: The levels.
        distances: d_min by label id, float32 [V] in world units (`distances_in_views`); NaN: not in sight.
        views: Rows of `scene.views`; None: all. Those without a pixel that counts are left out.
        valid: The pixels that count.
        labels: Ids of the categories to measure: only the parts of images that show them are rendered, and
            views without them are not. None: all, and the full image.
        last_only: Rows of views in which the last level alone is measured.
        backend: Rasteriser; decides the device.
        antialiased: How the model was trained.
        progress: Called with (images measured, images in all).

    Returns:
        One row per (category, level, view), and with all categories one for the full image with label id
        `TOTAL`.

    Example:
        >>> from sagesplat import open_run
        >>> from sagesplat.adapt.observe import distances_in_views, observe
        >>> run = open_run("runs/garden").job  # doctest: +SKIP
        >>> near = distances_in_views(run.scene, run.point_labels)  # doctest: +SKIP
        >>> table = observe(run.scene, run.photos, run.level_masks, run.ladder, near)  # doctest: +SKIP
    """
    rows: list[dict[str, float]] = []
    views = valid.rows(scene, range(len(scene.views)) if views is None else views)
    tiles: dict[int, np.ndarray | None] = dict.fromkeys(views)
    if labels is not None:
        shown = {row: np.isin(masks[scene.views[row]], list(labels)) for row in views}
        tiles = {row: tiles_around(mine) for row, mine in shown.items() if mine.any()}
    inner = {row: erode(masks[scene.views[row]]) for row in tiles}
    levels = {row: ladder.levels[-1:] if row in last_only else ladder.levels for row in tiles}
    done, total = 0, sum(map(len, levels.values()))

    def compare(level: int, row: int, image: Float32[np.ndarray, "H W 3"]) -> list[dict[str, float]]:
        view = scene.views[row]
        found = measure(image, as_unit(photos[row]), masks[view], inner[row], valid[view], tiles[row])
        of_level = {"level": level, "view": row}
        return [
            {"label_id": label, **of_level, "distance": _at(distances, label, row), **values}
            for label, values in found.items()
            if labels is None or label in labels
        ]

    for images, found in _each_image(compare, ladder, scene, tiles, levels, backend, antialiased):
        rows += found
        done += images
        if progress:
            progress(done, total)
    table = from_rows(Observations, rows)
    return table.select(np.argsort(table.level, kind="stable"))


def _at(distances: Mapping[int, Float32[np.ndarray, " V"]], label: int, row: int) -> float:
    return distances[label][row] if label in distances else np.nan


def _each_image(
    compare: Callable[[int, int, np.ndarray], list[dict[str, float]]],
    ladder: Ladder,
    scene: Scene,
    views: Mapping[int, np.ndarray | None],
    levels: Mapping[int, Sequence[int]],
    backend: Backend,
    antialiased: bool,
) -> Iterator[tuple[int, list[dict[str, float]]]]:
    """Call `compare` with level, view and image: view by view where levels share Gaussians, else level by
    level. Yields how many images there were, and what was returned.

    `views`: by row the tiles that are wanted at least; None: all. `levels`: by row.
    """
    how: dict[str, Any] = {"backend": backend, "antialiased": antialiased, "workspace": Workspace()}
    if isinstance(ladder, NestedLadder):
        cells = ladder.cells

        def in_view(row: int) -> tuple[int, list[dict[str, float]]]:
            wanted = [dict.fromkeys(cells.sizes, level) for level in levels[row]]
            seen = seen_from(cells, scene.views[row].camera, tile_mask=views[row], compositions=wanted, **how)
            images = zip(levels[row], map(seen.render, wanted), strict=True)
            return len(levels[row]), [
                found for level, image in images for found in compare(level, row, image)
            ]

        yield from each_view(in_view, list(views), device_of(backend))
        return
    for level in ladder.levels:
        g = ladder.load(level).to(device_of(backend))
        rows = [row for row in views if level in levels[row]]

        def at_level(row: int, level: int = level, g: Gaussians = g) -> list[dict[str, float]]:
            return compare(level, row, render_rgb(g, scene.views[row].camera, **how))

        yield from ((1, found) for found in each_view(at_level, rows, device_of(backend)))


def merge(parts: Sequence[Observations]) -> Observations:
    """Tables of neighbouring views, in their order, as the one that all views together make."""
    table = Observations.joined(parts)
    return table.select(np.argsort(table.level, kind="stable"))
