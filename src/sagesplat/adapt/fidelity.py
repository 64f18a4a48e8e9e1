"""Fidelity: SSIM of a composition against the full model rendered from the same viewpoint, per category.

It needs no photo, so it can be measured at any number of viewpoints (`adapt.viewpoints`). The pixels of a
category are those that its Gaussians paint in the full model. In the full model itself it is 1.

The full model is the last level; of a splat that was adopted it is what came in, which the last level rounds.
"""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int, Int16, Int32, UInt16

from sagesplat.adapt.ladder import Ladder, PrefixLadder
from sagesplat.adapt.observe import RenderedLabels, render_rgb
from sagesplat.adapt.seen import Seen, seen_from
from sagesplat.core.errors import DataError, short
from sagesplat.core.gaussians import Gaussians
from sagesplat.io.array_file import ArrayFile, Stored
from sagesplat.io.files import atomic_path
from sagesplat.io.npz import Npz
from sagesplat.kernels.planes import to_planes
from sagesplat.metrics.image import box_of, means_by_label, ssim_between, tiles_around
from sagesplat.raster import Backend, Workspace, device_of, each_view
from sagesplat.scene.scene import Camera
from sagesplat.segment.masks import UNLABELLED

_KEEP = 4 * 10**8  # bytes of a file of the full model's pictures: plans look where models were fitted
_STEPS = np.float32(2**16 - 1)  # of colours in them: half the memory, and SSIM is the same to 3e-6
_SEEN_BYTES = 44  # of a Gaussian in what its levels are rendered from
_KEEP_LEVELS = 10**8  # of what levels are rendered from: for many Gaussians it takes as much as 20 pictures
PROMISED_SHARE = 2e-3  # of a picture that a category has to cover: of fewer pixels nothing is promised


@dataclass(frozen=True, eq=False)
class SampledFidelity:
    """Fidelity of every cell, or category, at every level, all at the same level, at drawn viewpoints."""

    labels: tuple[int, ...]  # ids of cells or categories, ascending
    fidelity: Float32[np.ndarray, "V L K"]  # NaN where the category is not in sight
    pixels: Int32[np.ndarray, "V L"]  # of the category in the full model's image
    image: Int32[np.ndarray, " V"]  # pixels of the whole image
    whole: Float32[np.ndarray, "V K"]  # over all pixels
    distance: Float32[np.ndarray, "V L"]  # d_min, world units; NaN: unknown

    def by_label(self, label_of: Mapping[int, int]) -> "SampledFidelity":
        """The same of categories, from their cells: means over pixels, and the least distance."""
        column = {label: i for i, label in enumerate(sorted(set(label_of.values())))}
        member = np.zeros((len(self.labels), len(column)), bool)
        for row, cell in enumerate(self.labels):
            member[row, column[label_of[cell]]] = True
        far = np.where(np.isnan(self.distance), np.inf, self.distance)
        nearest = np.where(member, far[..., None], np.inf).min(1, initial=np.inf)
        return SampledFidelity(
            labels=tuple(column),
            fidelity=pooled_cells(self.fidelity.transpose(0, 2, 1), self.pixels, member).transpose(0, 2, 1),
            pixels=(self.pixels @ member).astype(np.int32),
            image=self.image,
            whole=self.whole,
            distance=np.where(np.isinf(nearest), np.nan, nearest).astype(np.float32),
        )

    def shown(self) -> np.ndarray:
        """Whether a category covers at least `PROMISED_SHARE` of the image, bool [V, L]."""
        return (self.pixels > 0) & (self.pixels >= PROMISED_SHARE * self.image[:, None])

    def shares(self) -> Float[np.ndarray, "V L"]:
        """Of the picture's pixels."""
        return self.pixels / self.image[:, None]


def pooled_cells(
    fidelity: Float32[np.ndarray, "V J C"], pixels: Int32[np.ndarray, "V C"], member: Bool[np.ndarray, "C L"]
) -> Float32[np.ndarray, "V J L"]:
    """Fidelity of categories from that of their cells; NaN where none of them is in sight or measured."""
    weight = np.where(np.isnan(fidelity), 0, pixels[:, None])
    total = weight @ member
    value = (weight * np.nan_to_num(fidelity)) @ member
    return np.where(total > 0, value / np.where(total > 0, total, 1), np.nan).astype(np.float32)


def shown_enough(pixels: Int[np.ndarray, "V L"], cameras: Sequence[Camera]) -> Bool[np.ndarray, "V L"]:
    """Whether a category covers at least `PROMISED_SHARE` of the image at each viewpoint."""
    image = np.array([camera.width * camera.height for camera in cameras])
    return (pixels > 0) & (pixels >= PROMISED_SHARE * image[:, None])


def measure_levels(
    ladder: Ladder,
    cameras: Sequence[Camera],
    *,
    only: Collection[int] | None = None,
    full: Gaussians | None = None,
    backend: Backend = "auto",
    antialiased: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[Float32[np.ndarray, "V L K"], Int32[np.ndarray, "V L"], Float32[np.ndarray, "V K"]]:
    """Measure the fidelity of every category with all categories at the same level.

    Args:
        ladder: The levels.
        cameras: V viewpoints.
        only: Ids of the categories to measure, by rendering the parts of images that show them; None: all.
        full: The full model, where it is not the last level.
        backend: Rasteriser; decides the device.
        antialiased: How the model was trained.
        progress: Called with (viewpoints measured, viewpoints in all).

    Returns:
        fidelity [V, L, K] of the labels in ascending order, NaN where one is not in sight or not measured;
        pixels [V, L]; fidelity of the whole image [V, K], NaN below the last level unless all are measured.
    """
    references = References(ladder, backend, antialiased, keep=0, only=only, full=full)
    measured = ladder.levels[:-1] if full is None else ladder.levels
    labels = references.labels
    found = np.full((len(cameras), len(labels), len(ladder.levels)), np.nan, np.float32)
    pixels = np.zeros(found.shape[:2], np.int32)
    whole = np.ones((len(cameras), len(ladder.levels)), np.float32)

    def at_viewpoint(row: int) -> None:
        camera = cameras[row]
        at = references.at(camera)
        pixels[row] = at.pixels
        found[row, (pixels[row] > 0) & references.wanted, -1] = 1.0
        for column, level in enumerate(measured):
            of_level = dict.fromkeys(labels, level)
            found[row, :, column], whole[row, column] = references.compare(of_level, camera, at)

    for done, _ in enumerate(each_view(at_viewpoint, range(len(cameras)), device_of(backend)), 1):
        if progress:
            progress(done, len(cameras))
    return found, pixels, whole


def measure_compositions(
    ladder: Ladder,
    cameras: Sequence[Camera],
    planned: Int[np.ndarray, "V J L"],
    *,
    backend: Backend = "auto",
    antialiased: bool = False,
    only: Collection[int] | None = None,
    full: Gaussians | None = None,
    progress: Callable[[int, int], None] | None = None,
    references: "References | None" = None,
) -> tuple[Float32[np.ndarray, "V J L+1"], Int32[np.ndarray, "V L"]]:
    """Measure the fidelity of each category in J compositions at each of V viewpoints.

    `planned`: level (1 to K) of each label, ascending by id. The result's last column is the whole image;
    then come the pixels of each category. `references` are kept from call to call, and decide what is wanted.
    The other arguments are those of `measure_levels`.
    """
    references = references or References(ladder, backend, antialiased, only=only, full=full)
    labels = references.labels
    found = np.full((*planned.shape[:2], len(labels) + 1), np.nan, np.float32)
    pixels = np.zeros((len(cameras), len(labels)), np.int32)

    def at_viewpoint(row: int) -> None:
        camera, known = cameras[row], {}
        compositions = [dict(zip(labels, levels, strict=True)) for levels in planned[row].tolist()]
        at = references.at(camera, compositions)
        pixels[row] = at.pixels
        for column, (levels, planned_here) in enumerate(
            zip(map(tuple, planned[row].tolist()), compositions, strict=True)
        ):
            if levels in known:
                found[row, column] = found[row, known[levels]]
                continue
            known[levels] = column
            found[row, column, :-1], found[row, column, -1] = references.compare(planned_here, camera, at)

    for done, _ in enumerate(each_view(at_viewpoint, range(len(cameras)), device_of(backend)), 1):
        if progress:
            progress(done, len(cameras))
    return found, pixels


@dataclass(frozen=True, eq=False)
class Reference:
    """The full model from one viewpoint, and what its levels are composed of there."""

    colours: Float32[np.ndarray, "H W 3"] | UInt16[np.ndarray, "H W 3"]  # in [0, 1], or steps of that
    label_ids: Int16[np.ndarray, "H W"]
    pixels: Int32[np.ndarray, " L"]  # of each label, ascending
    levels: Seen | None  # None: those of the ladder
    tile_mask: Bool[np.ndarray, "h w"] | None  # where wanted categories are; None: all are wanted

    @cached_property
    def image(self) -> Float32[np.ndarray, "H W 3"]:
        """Colours in [0, 1]."""
        return self.colours if self.colours.dtype == np.float32 else self.colours / _STEPS

    @cached_property
    def box(self) -> tuple[slice, slice]:
        """Rows and columns that wanted categories are in."""
        return (slice(None), slice(None)) if self.tile_mask is None else box_of(self.tile_mask)

    @cached_property
    def planes(self) -> Float32[np.ndarray, "3 H W2"]:
        """The image in the box, as planes: all compositions are compared with it."""
        return to_planes(torch.from_numpy(self.image[self.box]), Workspace(), "")


class _Kept(NamedTuple):
    """A `Reference` whose pictures are in a file."""

    pictures: tuple[Stored, ...]
    pixels: np.ndarray
    levels: Seen | None
    tile_mask: np.ndarray | None


class References:
    """Compares compositions with the full model; what a viewpoint needs is kept, pictures in a file."""

    def __init__(
        self,
        ladder: Ladder,
        backend: Backend,
        antialiased: bool,
        keep: int = _KEEP,
        only: Collection[int] | None = None,
        full: Gaussians | None = None,
    ):
        """`antialiased`: how the model was trained; `keep`: bytes; `only`: ids that are wanted, None: all.

        `full`: the full model; None: the last level.
        """
        self.labels = sorted({label for label, _ in ladder.counts})
        self.wanted = np.array([only is None or label in only for label in self.labels])
        self._ladder, self._antialiased = ladder, antialiased
        self._exact = keep == 0
        self._left, self._left_levels = keep, min(keep, _KEEP_LEVELS)
        self._backend: Backend = backend
        self._given = full
        self._workspace, self._kept, self._file = Workspace(), dict[tuple[object, ...], _Kept](), ArrayFile()

    @cached_property
    def _last(self) -> RenderedLabels:
        """The last level by itself: a copy, which is made where the seen levels do not serve."""
        last = self._ladder.load(self._ladder.levels[-1]).to(device_of(self._backend))
        return RenderedLabels(last, self._backend, self._antialiased, self._workspace)

    @cached_property
    def _full(self) -> RenderedLabels:
        if self._given is None:
            return self._last
        given = self._given.to(device_of(self._backend))
        return RenderedLabels(given, self._backend, self._antialiased, self._workspace)

    def at(self, camera: Camera, compositions: Sequence[Mapping[int, int]] | None = None) -> Reference:
        """The full model's image and label image, and its levels, from a viewpoint.

        `compositions`: those that will be compared; None: any. Levels that can be kept serve for any.
        """
        if isinstance(self._ladder, PrefixLadder) and self._left_levels >= _SEEN_BYTES * len(
            self._ladder.gaussians
        ):
            compositions = None
        key = camera.w2c.tobytes(), camera.K.tobytes(), camera.width, camera.height, camera.background
        kept = self._kept.get(key)
        if kept:
            colours, label_ids = self._file.read(kept.pictures)
            found = Reference(colours, label_ids, kept.pixels, kept.levels, kept.tile_mask)
        else:
            found = self._pictures(camera, compositions)
        if found.levels is None and isinstance(self._ladder, PrefixLadder):
            found = replace(found, levels=self._seen(camera, found.tile_mask, compositions))
        if kept is None:
            self._keep(key, found, levels=compositions is None)
        return found

    def _keep(self, key: tuple[object, ...], found: Reference, levels: bool) -> None:
        """Keep what was found, with the levels, if there is room for it."""
        nbytes = found.colours.nbytes + found.label_ids.nbytes
        if nbytes > self._left:
            return
        try:
            pictures = self._file.add(found.colours, found.label_ids)
        except OSError:  # no room on the disk: what is there serves
            self._left = 0
            return
        self._left -= nbytes
        stay = None
        if levels and found.levels and found.levels.nbytes <= self._left_levels:
            self._left_levels -= found.levels.nbytes
            stay = found.levels.kept()
        self._kept[key] = _Kept(pictures, found.pixels, stay, found.tile_mask)

    def _seen(
        self,
        camera: Camera,
        tile_mask: np.ndarray | None,
        compositions: Sequence[Mapping[int, int]] | None,
    ) -> Seen:
        assert isinstance(self._ladder, PrefixLadder)
        return seen_from(
            self._ladder, camera, backend=self._backend, antialiased=self._antialiased,
            workspace=self._workspace, tile_mask=tile_mask, compositions=compositions,
        )  # fmt: skip

    def _pictures(self, camera: Camera, compositions: Sequence[Mapping[int, int]] | None) -> Reference:
        """The full model's image and label image, with the levels where the latter is made from them."""
        tile_mask, levels, label_ids, image = None, None, None, None
        if not self.wanted.all():
            label_ids = self._last.render(camera)
            tile_mask = tiles_around(np.isin(label_ids, np.array(self.labels)[self.wanted]))
        if isinstance(self._ladder, PrefixLadder) and (label_ids is None or self._given is None):
            last = dict.fromkeys(self.labels, self._ladder.levels[-1])
            levels = self._seen(camera, tile_mask, compositions and [*compositions, last])
            label_ids = levels.label_ids(last) if label_ids is None else label_ids
            image = levels.render(last).copy() if self._given is None else None
        label_ids = self._last.render(camera) if label_ids is None else label_ids
        image = self._full.paint(camera, tile_mask) if image is None else image
        counts = np.bincount(label_ids.ravel().astype(np.int64) - UNLABELLED, minlength=2 + max(self.labels))
        pixels = counts[np.array(self.labels) - UNLABELLED].astype(np.int32)
        # what is kept is the same whenever it is looked at
        colours = image if self._exact else np.rint(image * _STEPS).astype(np.uint16)
        return Reference(colours, label_ids, pixels, levels, tile_mask)

    def compare(
        self, levels: Mapping[int, int], camera: Camera, at: Reference
    ) -> tuple[Float32[np.ndarray, " L"], float]:
        """Fidelity of a composition by label, NaN where one is not in sight or not wanted, and of the whole
        image, NaN unless all are wanted.
        """
        if at.tile_mask is not None and not at.tile_mask.any():
            return np.full(len(self.labels), np.nan, np.float32), np.nan
        if at.levels:
            image = at.levels.render(levels)
        else:
            image = render_rgb(
                self._ladder.compose(levels), camera, backend=self._backend, antialiased=self._antialiased,
                workspace=self._workspace,
            )  # fmt: skip
        shown, space = torch.from_numpy(image[at.box]), self._workspace
        quality = ssim_between(to_planes(shown, space, "shown"), at.planes, shown.shape[1], space)
        means = means_by_label(quality, at.label_ids[at.box])
        by_label = [
            means[label][0] if label in means and wanted else np.nan
            for label, wanted in zip(self.labels, self.wanted, strict=True)
        ]
        return np.array(by_label, np.float32), float(quality.mean()) if at.tile_mask is None else np.nan


def write_sampled(path: Path, sampled: SampledFidelity) -> None:
    """fidelity.npz."""
    with atomic_path(path) as temporary:
        arrays: dict[str, Any] = {**vars(sampled), "labels": np.array(sampled.labels, np.int64)}
        np.savez(temporary, **arrays)


def read_sampled(path: Path) -> SampledFidelity:
    """What `write_sampled` wrote; DataError where the content cannot be used."""
    cure = "delete it and run `sagesplat sample` again"
    try:
        with Npz(path) as file:
            labels = file["labels"]
            arrays = dict(_arrays(file))
        V, L, K = arrays["fidelity"].shape
        shapes = {"pixels": (V, L), "image": (V,), "whole": (V, K), "distance": (V, L)}
        if labels.shape != (L,) or K < 1 or any(arrays[name].shape != s for name, s in shapes.items()):
            raise ValueError("arrays of unequal length")
        if (np.diff(labels) <= 0).any() or (arrays["pixels"] < 0).any():
            raise ValueError("labels or pixels out of range")
        if not (np.nan_to_num(np.abs(arrays["fidelity"])) <= 1 + 1e-5).all():
            raise ValueError("a fidelity outside -1 to 1")
    except (OSError, KeyError, TypeError, ValueError, OverflowError) as error:
        raise DataError(f"{path}: not a file of sampled fidelity ({short(repr(error))}); {cure}") from None
    return SampledFidelity(tuple(int(label) for label in labels), **arrays)


def _arrays(file: Npz) -> Iterator[tuple[str, np.ndarray]]:
    for name in ("fidelity", "whole", "distance"):
        yield name, file[name].astype(np.float32)
    for name in ("pixels", "image"):
        yield name, file[name].astype(np.int32)
