"""What to do next with a run, from what it measured."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sagesplat.adapt.observe import TOTAL, Observations
from sagesplat.adapt.plan import Plan
from sagesplat.output.tables import mean, name_of

GAP = 0.05  # SSIM of training over test photos from which more photos help
FAITHFUL = 0.9  # SSIM of training photos below which longer training helps


@dataclass(frozen=True)
class Commands:
    """What the commands of a report name, as they are typed in a shell in the folder that holds the run."""

    run: str  # the run folder
    capture: str = ""  # the capture; empty: none to train on
    max_steps: int = 0  # that the run trained for


@dataclass(frozen=True)
class NextStep:
    """Something to do, why, and its command (empty: none)."""

    title: str
    why: str
    command: str = ""


def view_quality(rows: Observations, num_views: int) -> np.ndarray:
    """SSIM of the full model in each view, whole image; NaN where there is none. [V]."""
    rows = rows.select((rows.label_id == TOTAL) & (rows.level == rows.level.max(initial=0)))
    found = np.full(num_views, np.nan)
    found[rows.view] = rows.ssim
    return found


def worst_view(quality: np.ndarray, views: np.ndarray) -> int | None:
    """The one of `views` that measures least; None without any measurement."""
    known = views[np.isfinite(quality[views])] if len(views) else views
    return int(known[np.argmin(quality[known])]) if len(known) else None


def next_steps(
    observations: Observations,
    train_views: np.ndarray,
    test_views: np.ndarray,
    view_names: Sequence[str],
    names: Mapping[int, str],
    plan: Plan,
    commands: Commands,
) -> list[NextStep]:
    """What to do next, what helps most first.

    Training photos that are reproduced much better than unseen ones ask for more photos; training photos that
    are not reproduced ask for longer training.
    """
    found, quality = [], view_quality(observations, len(view_names))
    trained, unseen = mean(quality[train_views]), mean(quality[test_views])
    if commands.capture and trained - unseen >= GAP:
        gaps = _gaps(observations, train_views, test_views)
        most, worst = max(gaps, key=gaps.__getitem__, default=None), worst_view(quality, test_views)
        where = "" if most is None else f" The gap is largest for {name_of(most, names)} ({gaps[most]:.2f})"
        if worst is not None:
            where += f", the least is reached in {view_names[worst]} ({quality[worst]:.3f}; see the map)"
        found.append(
            NextStep(
                "More photos",
                f"Photos that training saw measure SSIM {trained:.3f}, unseen ones {unseen:.3f}: photos from "
                f"between those that there are would help most.{where}{'.' if where else ''}",
            )
        )
    if commands.capture and commands.max_steps and trained < FAITHFUL:
        longer = f"--train.max-steps {2 * commands.max_steps} --force"
        found.append(
            NextStep(
                "Train longer",
                f"Even the photos that training saw measure only SSIM {trained:.3f} after "
                f"{commands.max_steps:,} steps.",
                f"sagesplat run {commands.capture} {commands.run} {longer}",
            )
        )
    unproven = [c.label_id for c in plan.choices if c.calibrated is False or c.status == "no promise"]
    if plan.quality == "fidelity" and unproven:
        some = ", ".join(name_of(label, names) for label in unproven[:3]) + ", ..." * (len(unproven) > 3)
        found.append(
            NextStep(
                "Measure at more viewpoints",
                f"Too few of the drawn viewpoints show {some} to calibrate a promise.",
                f"sagesplat sample {commands.run} --sample.calibration-views 400 --force",
            )
        )
    return found


def _gaps(rows: Observations, train_views: np.ndarray, test_views: np.ndarray) -> dict[int, float]:
    """By category, SSIM of the full model over training views less that over test views."""
    rows = rows.select((rows.label_id != TOTAL) & (rows.level == rows.level.max(initial=0)))
    found = {}
    for label in np.unique(rows.label_id).tolist():
        mine = rows.select(rows.label_id == label)
        gap = mean(mine.ssim[np.isin(mine.view, train_views)]) - mean(
            mine.ssim[np.isin(mine.view, test_views)]
        )
        if np.isfinite(gap):
            found[label] = gap
    return found
