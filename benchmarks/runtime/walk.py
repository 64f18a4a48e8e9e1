"""The walk: 60 s on one screen, recorded once."""

from dataclasses import replace
from pathlib import Path

from benchmarks.visitor import visit
from sagesplat.adapt.viewpoints import capture_cameras
from sagesplat.io.files import write_json
from sagesplat.run.job import Job
from sagesplat.scene.scene import Camera


def recorded(job: Job, file: Path, seed: int, screen: float, every: int) -> list[Camera]:
    """Cameras of a visit, two a second, of which every n-th is kept; written to a file.

    A third along the capture's cameras, a third among them, a third stepping back (`visitor.visit`), on the
    screen of the first photo times `screen`.
    """
    first = capture_cameras(job.scene)[0]
    first = first.resized(round(first.width * screen), round(first.height * screen))
    cameras = [replace(first, w2c=camera.w2c) for camera in visit(job, seed)[::every]]
    frames = [camera.w2c.tolist() for camera in cameras]
    size = {"width": first.width, "height": first.height, "K": first.K.tolist()}
    write_json(file, {"seed": seed, "seconds_apart": every / 2, **size, "w2c": frames})
    return cameras
