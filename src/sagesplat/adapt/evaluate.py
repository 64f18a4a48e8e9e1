"""Evaluation: composed scenes measured on views that nothing was fitted to, beside the prediction.

Each composition is compared with the photo, over the pixels of the photo's label image, and with the full
model rendered from the same viewpoint, over the pixels that the full model's Gaussians paint.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import get_args

import numpy as np
from jaxtyping import Float32, Int16, Int32

from sagesplat.adapt.fidelity import PROMISED_SHARE
from sagesplat.adapt.ladder import Ladder
from sagesplat.adapt.observe import (
    TOTAL,
    LabelImages,
    RenderedLabels,
    as_unit,
    erode,
    measure,
    measure_colours,
    render_rgb,
)  # fmt: skip
from sagesplat.adapt.plan import Plan
from sagesplat.adapt.viewpoint import QualityKind
from sagesplat.core.gaussians import Gaussians
from sagesplat.io.columns import ColumnTable, from_rows, read_columns
from sagesplat.metrics.image import means_by_label, pasted, ssim_map
from sagesplat.metrics.ms_ssim import ms_ssim
from sagesplat.raster import Backend, Workspace, device_of, each_view
from sagesplat.scene.images import Photos
from sagesplat.scene.scene import Camera, Scene
from sagesplat.segment.valid import ALL_VALID, ValidPixels

QUALITIES: tuple[QualityKind, ...] = get_args(QualityKind)  # by the number in the table
UNIFORM = -3  # label id of the whole image with all categories at one level
COLOURS = ("plain_psnr", "cc_psnr", "cc_ssim")  # of `measure_colours`
OTHERS = ("ms_ssim", "flip", "lpips")  # further similarities to the photo, with its exposure
OF_WHOLE = (*COLOURS, *OTHERS)  # columns that only whole images of plans have
Similarity = Callable[[np.ndarray, np.ndarray], float]
KEPT = 512 * 2**20  # bytes of the full model's images to keep; of further views they are rendered again


@dataclass(frozen=True, eq=False)
class Evaluation(ColumnTable):
    """One row per (plan, view, category), one per (plan, view) for the whole image, one per (level, view).

    The last are of all categories at one level, and have no target.
    """

    quality: Int32[np.ndarray, " R"]  # of the plan, a place in QUALITIES
    target: Float32[np.ndarray, " R"]  # NaN for a plan within a budget
    view: Int32[np.ndarray, " R"]  # row in Scene.views
    label_id: Int32[
        np.ndarray, " R"
    ]  # category id, -1 = unlabelled, -2 = the whole image, -3 = the same of a level
    level: Int32[np.ndarray, " R"]  # the level chosen; -1 for the whole image of a plan
    predicted: Float32[np.ndarray, " R"]  # that the plan counts on in this view; NaN for the whole image
    fidelity: Float32[np.ndarray, " R"]  # SSIM against the full model; NaN where it shows too little of it
    ssim: Float32[np.ndarray, " R"]  # against the photo, with its exposure, over the category's pixels
    psnr: Float32[np.ndarray, " R"]  # dB, the same
    full_ssim: Float32[np.ndarray, " R"]  # of the full model: every category at its last level
    full_psnr: Float32[np.ndarray, " R"]  # dB, the same
    num_pixels: Int32[np.ndarray, " R"]
    # of the whole image of a plan, NaN in other rows: without the photo's exposure, and colour-corrected
    plain_psnr: Float32[np.ndarray, " R"]  # dB
    cc_psnr: Float32[np.ndarray, " R"]  # dB
    cc_ssim: Float32[np.ndarray, " R"]
    full_plain_psnr: Float32[np.ndarray, " R"]
    full_cc_psnr: Float32[np.ndarray, " R"]
    full_cc_ssim: Float32[np.ndarray, " R"]
    # of the same rows, against the photo, with its exposure; NaN where it was not measured
    ms_ssim: Float32[np.ndarray, " R"]
    flip: Float32[np.ndarray, " R"]
    lpips: Float32[np.ndarray, " R"]
    full_ms_ssim: Float32[np.ndarray, " R"]
    full_flip: Float32[np.ndarray, " R"]
    full_lpips: Float32[np.ndarray, " R"]

    def of(self, plan: Plan) -> "Evaluation":
        """The rows of a plan: for its target, or within the budget."""
        within = np.isnan(self.target) if np.isnan(plan.target) else self.target == np.float32(plan.target)
        return self.select(
            within & (self.quality == QUALITIES.index(plan.quality)) & (self.label_id != UNIFORM)
        )

    def uniform(self, quality: QualityKind) -> dict[int, float]:
        """Mean quality of the whole image by level, all categories at that level."""
        rows = self.select(self.label_id == UNIFORM)
        values = rows.fidelity if quality == "fidelity" else rows.ssim
        return {level: float(values[rows.level == level].mean()) for level in np.unique(rows.level).tolist()}

    def of_own_quality(self) -> "Evaluation":
        """The same with what was measured of the plan's own quality as `ssim`."""
        return replace(
            self, ssim=np.where(self.quality == QUALITIES.index("fidelity"), self.fidelity, self.ssim)
        )


def read_evaluation(path: Path) -> Evaluation:
    """The table that `write_csv` wrote. DataError where it is not one."""
    return read_columns(path, Evaluation, "delete it and run `sagesplat evaluate` again")


def evaluate(
    scene: Scene,
    photos: Photos,
    masks: LabelImages,
    ladder: Ladder,
    plans: Sequence[Plan],
    predicted: Callable[[Plan, int, int], float],
    *,
    others: Mapping[str, Similarity] | None = None,
    uniform: Sequence[int] = (),
    compose: Callable[[Plan], Gaussians] | None = None,
    full: Gaussians | None = None,
    valid: ValidPixels = ALL_VALID,
    backend: Backend = "auto",
    antialiased: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Evaluation:
    """Measure the composition of each plan and the full model on the test views, next to the predictions.

    Args:
        scene: The capture; `scene.test_ids` are measured.
        photos: Its photos.
        masks: Label images, [H, W] of category ids; indexed by view.
        ladder: The levels.
        plans: What to compose.
        predicted: What is expected of (plan, label id, row of `Scene.views`); NaN: none.
        others: Of OTHERS, what to measure of whole images (image, photo); None: MS-SSIM.
        uniform: Levels to measure with all categories at that level, to compare the plans with.
        compose: The Gaussians of a plan; None: its levels as they are.
        full: What fidelity is against; None: the last level.
        valid: The pixels of photos that count; views without any are left out.
        backend: Rasteriser; decides the device.
        antialiased: How the model was trained.
        progress: Called with (images measured, images in all).

    Returns:
        One row per (plan, view, category), one per (plan, view) and one per (level, view) for the full image.
    """
    last = ladder.load(ladder.levels[-1]).to(device_of(backend))
    origin = last if full is None else full.to(device_of(backend))
    views = _TestViews(scene, photos, masks, valid, last, origin, backend, antialiased)
    others = {"ms_ssim": ms_ssim} if others is None else others
    done, total = 0, len(views.rows) * (1 + len(plans) + len(uniform))

    def measured(g: Gaussians, further: Mapping[str, Similarity]) -> Iterator[_InView]:
        nonlocal done
        for found in views.measure(g, further):
            yield found
            done += 1
            if progress:
                progress(done, total)

    rows: list[dict[str, float]] = []
    of_last = {found.row: found.against_photo for found in measured(last, others)}
    for level in uniform:
        for found in measured(ladder.load(level), {}):
            values, best = found.against_photo[TOTAL], of_last[found.row][TOTAL]
            rows.append({
                "quality": QUALITIES.index("fidelity"), "target": np.nan,
                "view": found.row, "label_id": UNIFORM, "level": level,
                "predicted": np.nan, "fidelity": found.fidelity[TOTAL],
                **_against_photo(values, best), **_of_whole({}, {}),
            })  # fmt: skip
    known_compositions: dict[str, list[_InView]] = {}
    for plan in plans:
        same = repr((plan.levels, plan.cells, (plan.quality, plan.target) if compose else None))
        if same not in known_compositions:  # low targets often have one plan
            composed = compose(plan) if compose else plan.compose(ladder)
            known_compositions[same] = list(measured(composed, others))
        for found in known_compositions[same]:
            for label, values in found.against_photo.items():
                best, known = of_last[found.row][label], label in plan.levels
                rows.append({
                    "quality": QUALITIES.index(plan.quality), "target": plan.target,
                    "view": found.row, "label_id": label, "level": plan.levels.get(label, -1),
                    "predicted": predicted(plan, label, found.row) if known else np.nan,
                    "fidelity": found.fidelity.get(label, np.nan),
                    **_against_photo(values, best), **_of_whole(values, best),
                })  # fmt: skip
    return from_rows(Evaluation, rows)


@dataclass(frozen=True, eq=False)
class _InView:
    """What Gaussians measure in a test view; of a whole image the label is TOTAL."""

    row: int  # in Scene.views
    against_photo: dict[int, dict[str, float]]  # by label id and name
    fidelity: dict[int, float]  # by label id


@dataclass(frozen=True, eq=False)
class _TestViews:
    """The test views, and the full model's images of them as far as memory allows."""

    scene: Scene
    photos: Photos
    masks: LabelImages
    valid: ValidPixels
    last: Gaussians  # the last level, whose labels say where fidelity is measured
    origin: Gaussians  # what fidelity is against
    backend: Backend
    antialiased: bool
    workspace: Workspace = field(default_factory=Workspace)
    kept: dict[int, np.ndarray] = field(default_factory=dict)

    @cached_property
    def rows(self) -> list[int]:
        """Rows of the views that count, in Scene.views."""
        return self.valid.rows(self.scene, self.scene.test_ids)

    def measure(self, g: Gaussians, further: Mapping[str, Similarity]) -> Iterator[_InView]:
        """What Gaussians measure in each view; without `further` similarities no other colours either."""
        device = device_of(self.backend)
        yield from each_view(partial(self._in_view, g.to(device), further), self.rows, device)

    def _in_view(self, g: Gaussians, further: Mapping[str, Similarity], row: int) -> _InView:
        view, photo = self.scene.views[row], as_unit(self.photos[row])
        neutral = view.camera.neutral  # fidelity is promised of pictures without a photo's exposure
        reference = self.kept[row] if row in self.kept else self._render(self.origin, neutral)
        kept = sum(image.nbytes for image in list(self.kept.values()))  # other threads add some meanwhile
        if row not in self.kept and kept + reference.nbytes <= KEPT:
            self.kept[row] = reference
        image = reference if g is self.origin else self._render(g, neutral)
        least = PROMISED_SHARE * image.shape[0] * image.shape[1]
        fidelity = fidelity_by_label(image, reference, self._labels[view], least)
        valid = self.valid[view]
        colours = measure_colours(image, photo, valid) if further else {}
        if view.camera.exposure is not None:
            image = self._render(g, view.camera)
        measured = measure(image, photo, self.masks[view], self._inner[row], valid)
        against = pasted(photo, image, valid)
        measured[TOTAL] |= {**colours, **{name: of(image, against) for name, of in further.items()}}
        return _InView(row, measured, fidelity)

    @cached_property
    def _labels(self) -> RenderedLabels:
        return RenderedLabels(self.last, self.backend, self.antialiased)

    @cached_property
    def _inner(self) -> dict[int, np.ndarray]:
        return {row: erode(self.masks[self.scene.views[row]]) for row in self.rows}

    def _render(self, g: Gaussians, camera: Camera) -> np.ndarray:
        return render_rgb(
            g, camera, backend=self.backend, antialiased=self.antialiased, workspace=self.workspace
        )


def _against_photo(values: Mapping[str, float], full: Mapping[str, float]) -> dict[str, float]:
    """Columns of what is compared with the photo, of a composition and of the full model."""
    names = ("ssim", "psnr")
    columns = {name: values[name] for name in (*names, "num_pixels")}
    return columns | {f"full_{name}": full[name] for name in names}


def _of_whole(values: Mapping[str, float], full: Mapping[str, float]) -> dict[str, float]:
    """Columns of `OF_WHOLE`, of a plan and of the full model; NaN where they were not measured."""
    return {name: values.get(name, np.nan) for name in OF_WHOLE} | {
        f"full_{name}": full.get(name, np.nan) for name in OF_WHOLE
    }


def fidelity_by_label(
    image: Float32[np.ndarray, "H W 3"],
    reference: Float32[np.ndarray, "H W 3"],
    label_ids: Int16[np.ndarray, "H W"],
    least: float = 0.0,
) -> dict[int, float]:
    """SSIM of an image against the full model's, by category of at least `least` pixels, and of the whole."""
    quality = ssim_map(image, reference)
    found = {i: mean for i, (mean, pixels) in means_by_label(quality, label_ids).items() if pixels >= least}
    return {**found, TOTAL: float(quality.mean())}
