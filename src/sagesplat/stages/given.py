"""What a script gives in memory, as the files that stages read."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from sagesplat.core.errors import RunError
from sagesplat.core.gaussians import Gaussians
from sagesplat.core.geometry import NO_OFFSET, Position
from sagesplat.core.names import repaired
from sagesplat.formats.labels import NO_PARENTS
from sagesplat.formats.offsets import write_offset
from sagesplat.formats.ply import write_ply
from sagesplat.io.files import write_json
from sagesplat.run.run_dir import RunDir
from sagesplat.scene.cameras import VIEWPOINTS
from sagesplat.scene.scene import Camera
from sagesplat.stages.scene import check_folder


def write_given_splat(
    run: RunDir,
    g: Gaussians,
    names: Mapping[int, str],
    antialiased: bool,
    *,
    parents: Mapping[int, str] = NO_PARENTS,
    offset: Position = NO_OFFSET,
) -> Path:
    """A PLY in the run folder with the Gaussians, bit by bit, and their labels; named after the folder.

    `parents`: the categories of instances, by their ids; `offset`: what was subtracted from the positions.
    RunError for a folder that holds something else than a run.
    """
    check_folder(run)
    run.from_python.mkdir(parents=True, exist_ok=True)
    path = run.from_python / f"{repaired(run.path.resolve().name)}.ply"
    write_ply(path, g.detach(), names, parents=parents, antialiased=antialiased, labels_inside=True)
    write_offset(path, offset)
    return path


def write_given_cameras(run: RunDir, cameras: Sequence[Camera], offset: Position = NO_OFFSET) -> Path:
    """A viewpoints.json in the run folder. RunError for no cameras, and as for a splat."""
    if not cameras:
        raise RunError(f"{run.path}: an empty list of cameras; leave them out to have viewpoints drawn")
    check_folder(run)
    entries = [
        {
            "w2c": camera.w2c.tolist(),
            "K": camera.K.tolist(),
            "width": camera.width,
            "height": camera.height,
            "background": list(camera.background),
        }
        for camera in cameras
    ]
    run.from_python.mkdir(parents=True, exist_ok=True)
    path = run.from_python / "viewpoints.json"
    write_json(path, {"format": VIEWPOINTS, "version": 1, "viewpoints": entries, "offset": offset})
    return path
