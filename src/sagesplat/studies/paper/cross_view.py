"""Cross-view evaluation: each unseen view gets a plan of its own, and masks from the 3D labels."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Int32

from sagesplat.adapt.ladder import Ladder
from sagesplat.adapt.observe import MIN_SHARE, TOTAL, RenderedLabels, as_unit, measure, render_rgb
from sagesplat.adapt.plan import Plan
from sagesplat.core.events import Progress
from sagesplat.core.gaussians import Gaussians
from sagesplat.io.columns import ColumnTable, from_rows, read_columns
from sagesplat.raster import Workspace
from sagesplat.run.job import Job
from sagesplat.stages.method import Method

NONE = -1  # level or count where there is none


@dataclass(frozen=True, eq=False)
class CrossView(ColumnTable):
    """One row per (target, view, category in sight) and one per (target, view) for the whole image."""

    target: Float32[np.ndarray, " R"]  # SSIM
    view: Int32[np.ndarray, " R"]  # row in Scene.views
    label_id: Int32[np.ndarray, " R"]  # category id, -1 = unlabelled, -2 = the whole image
    level: Int32[np.ndarray, " R"]  # chosen for this view; -1 for the whole image
    count: Int32[np.ndarray, " R"]  # Gaussians of that level; of the composition for the whole image
    predicted: Float32[np.ndarray, " R"]  # that the plan counts on; NaN without a model
    ssim: Float32[np.ndarray, " R"]  # measured on the composed scene, over the rendered mask
    psnr: Float32[np.ndarray, " R"]  # dB, the same
    level_ssim: Float32[np.ndarray, " R"]  # measured with all categories at the chosen level; NaN as above
    oracle_level: Int32[np.ndarray, " R"]  # the cheapest that measures the target in this view; -1 = none
    oracle_count: Int32[np.ndarray, " R"]  # its Gaussians
    full_ssim: Float32[np.ndarray, " R"]  # of the full model: every category at its last level
    full_psnr: Float32[np.ndarray, " R"]
    num_pixels: Int32[np.ndarray, " R"]

    @property
    def regret(self) -> Float32[np.ndarray, " R"]:
        """Gaussians above the cheapest level that measures the target; NaN unless the chosen one does too."""
        known = (self.oracle_level != NONE) & (self.level_ssim >= self.target)
        return np.where(known, self.count - self.oracle_count, np.nan).astype(np.float32)


def read_cross_view(path: Path) -> CrossView:
    """The table that `write_csv` wrote. DataError where it is not one."""
    return read_columns(path, CrossView, "delete it and run `sagesplat crossview` again")


def cross_view(job: Job, method: Method, targets: Sequence[float]) -> CrossView:
    """Plan each test view, compose, and measure per category, beside an oracle.

    The oracle knows what every settled level measures in that view. Categories with less than
    `MIN_SHARE` of the rendered pixels are planned but make no row. The pixels of each category are as the
    Gaussians paint them, unless the method knows better: nobody has masks of unseen views.
    """
    rows: list[dict[str, float]] = []
    ladder, workspace = job.ladder, Workspace()
    options: dict[str, Any] = {"backend": job.backend, "antialiased": job.antialiased}
    labels = method.unseen_labels() or RenderedLabels(ladder.load(ladder.levels[-1]), **options)
    views = job.valid.rows(job.scene, job.scene.test_ids)
    done, total = 0, len(views) * (len(ladder.levels) + len(targets))

    def measured(g: Gaussians, row: int) -> dict[int, dict[str, float]]:
        nonlocal done
        view = job.scene.views[row]
        image = render_rgb(g, view.camera, workspace=workspace, **options)
        done += 1
        job.emit(Progress("crossview", done, total))
        return measure(image, as_unit(job.photos[row]), labels[view], valid=job.valid[view])

    at_level: dict[int, dict[int, dict[int, dict[str, float]]]] = {}
    for level in ladder.levels:  # one level in memory at a time
        g = ladder.load(level)
        at_level[level] = {row: measured(g, row) for row in views}
    for row in views:
        for target in targets:
            plan = method.plan_view(row, target)
            composed = measured(plan.compose(ladder), row)
            levels = {level: views_of[row] for level, views_of in at_level.items()}
            rows += _rows(plan, composed, levels, ladder)
    return from_rows(CrossView, rows)


def _rows(
    plan: Plan,
    composed: Mapping[int, Mapping[str, float]],
    levels: Mapping[int, Mapping[int, Mapping[str, float]]],
    ladder: Ladder,
) -> list[dict[str, float]]:
    """The rows of one view at one target; `levels` holds what each level measures there, by label."""
    rows = []
    chosen = {choice.label_id: choice for choice in plan.choices}
    full = levels[ladder.levels[-1]]
    fewest = MIN_SHARE * composed[TOTAL]["num_pixels"]
    assert plan.view is not None
    for label, values in composed.items():
        if values["num_pixels"] < fewest or (label != TOTAL and label not in chosen):
            continue  # or pixels that nothing is drawn on
        row = {
            "target": plan.target, "view": plan.view, "label_id": label, "level": NONE, "count": plan.count,
            "predicted": np.nan, "level_ssim": np.nan, "oracle_level": NONE, "oracle_count": NONE,
            "ssim": values["ssim"], "psnr": values["psnr"], "num_pixels": values["num_pixels"],
            "full_ssim": full[label]["ssim"], "full_psnr": full[label]["psnr"],
        }  # fmt: skip
        if label != TOTAL:
            choice = chosen[label]
            row |= {"level": choice.level, "count": choice.count, "predicted": choice.predicted}
            row["level_ssim"] = levels[choice.level][label]["ssim"]
            enough = [
                (ladder.counts[label, level], -level)
                for level, quality in levels.items()
                if level not in ladder.recovering and quality[label]["ssim"] >= plan.target
            ]
            if enough:
                count, level = min(enough)
                row |= {"oracle_level": -level, "oracle_count": count}
        rows.append(row)
    return rows
