"""Removes floaters from a splat file of any tool."""

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from sagesplat.adapt.free_viewpoints import check_size, free_cameras
from sagesplat.adapt.observe import RenderedLabels
from sagesplat.adapt.renders import Renders
from sagesplat.core.config import CleanConfig
from sagesplat.core.errors import RunError
from sagesplat.core.events import Emit, Progress, StageDone, StageStarted, Warned
from sagesplat.core.gaussians import Gaussians
from sagesplat.core.geometry import offset_text
from sagesplat.formats.labels import sidecar, write_or_remove_labels
from sagesplat.formats.offsets import beside, read_offset, write_offset
from sagesplat.formats.ply import WRITER as PLY_WRITER
from sagesplat.formats.ply import read_ply_splat, select_ply
from sagesplat.formats.splat import Splat, relative_to, undrawable
from sagesplat.formats.splats import read_splat, scene_writer, write_splat, writer_of
from sagesplat.io.typed import check_limits
from sagesplat.raster import Backend, device_of
from sagesplat.scene import load_scene
from sagesplat.scene.cameras import NamedCamera, read_camera_file
from sagesplat.scene.images import Photos
from sagesplat.scene.scene import Camera, Points, Scene, View
from sagesplat.stages.clean import CleanFigures, clean_lines, figures_of
from sagesplat.train.clean import clean, find_floaters

_VIEWS = 96  # viewpoints that are drawn where there are none
_FOV, _SIZE = 60.0, (512, 384)  # degrees along the longer side, px
_DRAWN = "viewpoints were drawn; --cameras of its photos would tell what they hardly show"
_SIDE = 1024  # px, longer side of the views of a capture; larger ones are looked at smaller


def clean_splat(
    source: Path, out: Path, config: CleanConfig, emit: Emit, *,
    cameras: Path | None = None, picture: Path | None = None, backend: Backend = "cpu",
) -> CleanFigures:  # fmt: skip
    """Write a splat without its floaters; what stays is as it was.

    From PLY to PLY rows are copied with all their properties. `cameras`: where its photos were taken from, a
    capture with or without photos, or a file of cameras; None: viewpoints are drawn, and what they hardly
    show is then no criterion. `picture`: PNG of views before and after.
    """
    check_limits(config, "clean.")
    _check_paths(source, out, picture, config)
    emit(StageStarted("clean"))
    begin = time.perf_counter()
    splat = read_splat(source)
    for note in splat.notes:
        emit(Warned(f"{source}: {note}"))
    for reason, count in splat.dropped.items():
        emit(Warned(f"{source}: {count:,} Gaussians left out: {reason}"))
    check_size(splat.gaussians, str(source))
    given = [] if cameras is None else read_camera_file(cameras)
    seen = relative_to(splat, given[0].offset) if given else splat
    g, filtered = seen.gaussians.to(device_of(backend)), splat.antialiased
    scene, photos, how = _views(g, seen, cameras, given, backend)
    real, rows = not isinstance(photos, Renders), list(range(len(scene.views)))
    floaters = find_floaters(
        g, scene, rows,
        hardly_shown=cameras is not None,  # what drawn viewpoints hardly show may be seen from nearer
        label_image=RenderedLabels(g, backend, filtered).__getitem__, antialiased=filtered,
        on_view=lambda done: emit(Progress("clean", done, len(rows))),
    )  # fmt: skip
    if not floaters.weight.any():
        raise RunError(f"{cameras}: no camera has {source} in sight; give cameras of this scene, or none")
    cleaned = clean(
        g, floaters, scene, photos, config,
        kinds={"train": rows}, real=real, antialiased=filtered, backend=backend,
    )  # fmt: skip
    figures = figures_of(cleaned)
    lines = clean_lines(figures)[: 2 if real else 1]  # renders have no PSNR to lose
    if picture:
        from sagesplat.output.before_after import before_after

        before_after(
            picture, g, cleaned.keep, [view.camera for view in scene.views], f"{source.name}: {lines[0]}",
            antialiased=filtered, backend=backend,
        )  # fmt: skip
    _write(source, out, splat, cleaned.keep)
    if any(splat.offset) and beside(out).exists():
        how = f"{how}; positions are relative to {offset_text(splat.offset)} ({beside(out).name})"
    emit(StageDone("clean", time.perf_counter() - begin, (*lines, how)))
    return figures


def _check_paths(source: Path, out: Path, picture: Path | None, config: CleanConfig) -> None:
    """RunError for what would overwrite the splat, or write nothing."""
    if config.floaters == "keep":
        raise RunError("--clean.floaters keep: nothing would be removed; leave it out")
    scene_writer(out)  # the name is that of a file which can be written
    for path in (out, picture):
        if path is not None and path.resolve() == source.resolve():
            raise RunError(f"{path}: the splat itself; name another file")
    if picture is not None and picture.suffix.lower() != ".png":
        raise RunError(f"{picture}: pictures are PNG; name it {picture.with_suffix('.png').name}")


def _views(
    g: Gaussians, splat: Splat, cameras: Path | None, given: Sequence[NamedCamera], backend: Backend
) -> tuple[Scene, Photos, str]:
    """Where to look from, what is seen there, and where that comes from."""
    if cameras is None:
        drawn = free_cameras(
            g, _VIEWS, up=splat.up, fov=_FOV, size=_SIZE, seed=0, kind="auto", backend=backend
        )
        scene = _scene_of(Path(), drawn.cameras)
        return scene, Renders(g, scene.views, backend, splat.antialiased), _DRAWN
    if all(one.photo is not None for one in given):
        scene = load_scene(cameras, test_every=0)
        scene = replace(scene, views=tuple(replace(v, camera=v.camera.within(_SIDE)) for v in scene.views))
        return scene, Photos(scene.views), f"{len(scene.views)} photos of {cameras}"
    scene = _scene_of(cameras, [one.camera.within(_SIDE) for one in given])
    return (
        scene,
        Renders(g, scene.views, backend, splat.antialiased),
        f"{len(scene.views)} cameras of {cameras}",
    )


def _scene_of(path: Path, cameras: Sequence[Camera]) -> Scene:
    """Cameras without photos and points as a scene."""
    views = tuple(View(f"{i:03d}", camera, path) for i, camera in enumerate(cameras))
    nothing = np.zeros(0, np.int64)
    points = Points(
        np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8), nothing, nothing.astype(np.int32),
        np.zeros((0, 2), np.float32),
    )  # fmt: skip
    return Scene(path.name, path, views, points, test_every=0)


def _write(source: Path, out: Path, splat: Splat, keep: np.ndarray) -> None:
    """Write the Gaussians that stay; from PLY to PLY their rows with all properties that the file has."""
    stays = splat.gaussians.select(torch.from_numpy(keep))
    if splat.kind != "PLY" or writer_of(out) is not PLY_WRITER:
        write_splat(
            out, stays, splat.names, parents=splat.parents, antialiased=splat.antialiased, offset=splat.offset
        )
        return
    g = read_ply_splat(source).gaussians
    drawn = ~torch.stack(list(undrawable(g).values())).any(0).numpy()
    labelled_here = torch.equal(g.label_ids[torch.from_numpy(drawn)], splat.gaussians.label_ids)
    drawn[drawn] = keep
    select_ply(source, out, drawn)
    write_offset(out, read_offset(source))
    if labelled_here:  # and not by a file beside it
        sidecar(out).unlink(missing_ok=True)
    else:
        write_or_remove_labels(out, stays.label_ids, splat.names, splat.parents)
