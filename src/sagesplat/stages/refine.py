"""Writes what training refined of the cameras, for everything after it."""

from pathlib import Path

from sagesplat.run.job import Job
from sagesplat.scene.refined import given_cameras, write_refined
from sagesplat.train.events import Trained


def write_cameras(job: Job, path: Path, trained: Trained) -> list[str]:
    """Write the refined cameras; without any, remove those of an earlier training. Returns lines on them."""
    if not trained.per_view:
        path.unlink(missing_ok=True)
        return []
    write_refined(path, given_cameras(job.given_scene))
    return []
