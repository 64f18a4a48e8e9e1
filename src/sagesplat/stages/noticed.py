"""What a run noticed of its photos and its model, and dealt with: a few words each, for people."""

import numpy as np

from sagesplat.run.job import Job
from sagesplat.stages.clean import CleanFigures, read_clean_figures
from sagesplat.stages.refine import read_refined_figures

_LEAST_SHARE = 5e-4  # of all pixels
_LEAST_MOVE = 0.05  # px


def noticed(job: Job) -> tuple[str, ...]:
    """What was noticed, in words; nothing where a capture is clean. RunError for files that are damaged."""
    run, lines = job.run, list[str]()
    refined = read_refined_figures(run.refined)
    if exposure := refined.exposure:
        lines.append(f"exposure varies by {exposure.range_ev:.1f} EV")
    if lens := job.given_scene.views[0].vignetting:
        lines.append(f"vignetting of {100 * lens.lost:.0f} % taken out of the photos")
    if (share := _ignored(job)) >= _LEAST_SHARE:
        lines.append(f"{100 * share:.2g} % of pixels ignored")
    if run.ladder == "nested" and (floaters := read_clean_figures(run.floaters)):
        lines += _removed(floaters)
    if (poses := refined.poses) and poses.pixels >= _LEAST_MOVE:
        lines.append(f"poses moved by {poses.pixels:.1f} px")
    return tuple(lines)


def _ignored(job: Job) -> float:
    """Share of the pixels of all views that do not count."""
    if not job.run.valid.exists():
        return 0.0
    valid = [(view.camera, job.valid[view]) for view in job.scene.views]
    ignored = sum(0 if counts is None else int((~counts).sum()) for _, counts in valid)
    return ignored / int(np.sum([camera.width * camera.height for camera, _ in valid]))


def _removed(figures: CleanFigures) -> list[str]:
    """Floaters that were removed, apart from what nobody sees anyway."""
    unseen = figures.removed.get("hardly shown", 0)
    floaters = sum(figures.removed.values()) - unseen
    words = [
        (floaters, f"{floaters:,} floater{'s' if floaters > 1 else ''} removed"),
        (unseen, f"{unseen:,} Gaussians removed that hardly any photo shows"),
    ]
    return [text for count, text in words if count]
