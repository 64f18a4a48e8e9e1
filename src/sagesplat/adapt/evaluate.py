"""Evaluation: composed scenes measured on views that nothing was fitted to, beside the prediction."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float32, Int32

from sagesplat.adapt.ladder import Ladder
from sagesplat.adapt.observe import LabelImages, as_unit, erode, measure, render_rgb
from sagesplat.adapt.plan import Plan
from sagesplat.core.gaussians import Gaussians
from sagesplat.io.columns import from_rows, read_columns, write_columns
from sagesplat.raster import Backend, Workspace, device_of
from sagesplat.scene.images import Photos
from sagesplat.scene.scene import Scene


@dataclass(frozen=True, eq=False)
class Evaluation:
    """One row per (target, view, category) and one per (target, view) for the whole image; equal lengths."""

    target: Float32[np.ndarray, " R"]  # SSIM; NaN for a plan within a budget
    view: Int32[np.ndarray, " R"]  # row in Scene.views
    label_id: Int32[np.ndarray, " R"]  # category id, -1 = unlabelled, -2 = the whole image
    level: Int32[np.ndarray, " R"]  # the level chosen; -1 for the whole image
    predicted: Float32[np.ndarray, " R"]  # SSIM that the plan counts on; NaN for the whole image
    ssim: Float32[np.ndarray, " R"]  # measured on the composed scene, over the category's pixels
    psnr: Float32[np.ndarray, " R"]  # dB, the same
    full_ssim: Float32[np.ndarray, " R"]  # of the full model: every category at its last level
    full_psnr: Float32[np.ndarray, " R"]  # dB, the same
    num_pixels: Int32[np.ndarray, " R"]

    def __len__(self) -> int:
        return len(self.label_id)

    def select(self, keep: np.ndarray) -> "Evaluation":
        """The rows that a boolean mask or an index array names."""
        return Evaluation(**{f.name: getattr(self, f.name)[keep] for f in fields(self)})

    def write_csv(self, path: Path) -> None:
        """One line per row, a header first; floats so that they read back identical."""
        write_columns(path, self)


def read_evaluation(path: Path) -> Evaluation:
    """The table that `write_csv` wrote. DataError where it is not one."""
    return read_columns(path, Evaluation, "delete it and run `sagesplat evaluate` again")


def evaluate(
    scene: Scene,
    photos: Photos,
    masks: LabelImages,
    ladder: Ladder,
    plans: Sequence[Plan],
    predicted: Callable[[int, int, int], float],
    *,
    region: Literal["mask", "eroded"] = "mask",
    compose: Callable[[Plan], Gaussians] | None = None,
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
        predicted: SSIM expected of (label id, level, row of `Scene.views`); NaN: none.
        region: Where a category's SSIM is measured: on its mask, or on the mask eroded by 5 px.
        compose: The Gaussians of a plan; None: its levels as they are.
        backend: Rasteriser; decides the device.
        antialiased: How the model was trained.
        progress: Called with (images measured, images in all).

    Returns:
        One row per (plan, view, category), and one per (plan, view) for the full image.
    """
    ssim = "ssim_eroded" if region == "eroded" else "ssim"
    rows: list[dict[str, float]] = []
    views = scene.test_ids.tolist()
    inner = {row: erode(masks[scene.views[row]]) for row in views}
    done, total = 0, len(views) * (1 + len(plans))
    workspace = Workspace()

    def measure_all(g: Gaussians):
        nonlocal done
        g = g.to(device_of(backend))
        for row in views:
            view = scene.views[row]
            image = render_rgb(g, view.camera, backend=backend, antialiased=antialiased, workspace=workspace)
            yield row, measure(image, as_unit(photos[row]), masks[view], inner[row])
            done += 1
            if progress:
                progress(done, total)

    full = dict(measure_all(ladder.load(ladder.levels[-1])))
    for plan in plans:
        for row, measured in measure_all(compose(plan) if compose else ladder.compose(plan.levels)):
            for label, values in measured.items():
                level = plan.levels.get(label, -1)
                rows.append({
                    "target": plan.target, "view": row, "label_id": label, "level": level,
                    "predicted": predicted(label, level, row) if label in plan.levels else np.nan,
                    "ssim": values[ssim], "psnr": values["psnr"], "num_pixels": values["num_pixels"],
                    "full_ssim": full[row][label][ssim], "full_psnr": full[row][label]["psnr"],
                })  # fmt: skip
    return from_rows(Evaluation, rows)
