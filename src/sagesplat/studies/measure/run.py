"""Measures how close levels of detail are to their scene, whoever made them."""

from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
from scipy.ndimage import uniform_filter

from sagesplat.adapt.free_viewpoints import check_size, free_cameras
from sagesplat.core.config import MeasureConfig
from sagesplat.core.errors import RunError
from sagesplat.core.events import Emit, Progress, StageStarted, Warned
from sagesplat.core.gaussians import Gaussians
from sagesplat.core.geometry import Position
from sagesplat.formats.splat import relative_to
from sagesplat.formats.splats import Splat
from sagesplat.io.typed import check_limits
from sagesplat.metrics.image import ssim_map
from sagesplat.output.contact_sheet import contact_sheet
from sagesplat.raster import Backend, prepared
from sagesplat.scene.cameras import read_camera_file
from sagesplat.scene.scene import Camera
from sagesplat.studies.lpips import load_metrics
from sagesplat.studies.measure.levels import Level, level_of, levels_of, unique_names
from sagesplat.studies.measure.report import (
    SIDE,
    Measured,
    Strip,
    categories_table,
    levels_table,
    worst_view,
    write_report,
)
from sagesplat.studies.measure.score import FLIP, MS_SSIM, Renderer, compare


def measure_levels(
    reference: Path | str | Gaussians,
    levels: Path | str | Gaussians | Sequence[Path | str | Gaussians] = (),
    out: Path | str = Path("measure"),
    config: MeasureConfig = MeasureConfig(),
    *,
    on_event: Emit = lambda event: None,
    device: str = "auto",
    backend: Backend = "auto",
    threads: int = 0,
) -> Measured:
    """Measure levels of detail against their scene, whoever made them: what `sagesplat measure` does.

    Args:
        reference: The full scene: a splat of any format or Gaussians; or, without `levels`, a lod-meta.json,
            a bundle or a run folder, whose finest level is then the reference of its others.
        levels: What is measured against it; of a path with several levels all of them.
        out: Folder for tables (levels.csv, views.csv, measure.json), curves and a contact sheet of the
            viewpoints; made if it is not there.
        config: Viewpoints and metrics.
        on_event: Called with each event (`Progress`, `TableMade`, `Warned`). Nothing is printed otherwise.
        device: "auto" (a CUDA GPU where there is one that works), "cpu" or "cuda".
        backend: Rasteriser: "auto", "cpu", "cuda" or "reference".
        threads: CPU threads; 0: one per core. Set for the whole process.

    Returns:
        SSIM, PSNR and other metrics of every level at every viewpoint; `print` shows their means.

    Raises:
        RunError: For one level alone, and where no viewpoint has anything in sight.
        DataError: For what is no splat, and has no levels.

    Example:
        >>> from sagesplat import measure_levels
        >>> print(measure_levels("runs/garden"))  # doctest: +SKIP
    """
    backend, _ = prepared(device, backend, threads)
    some = levels if isinstance(levels, Sequence) and not isinstance(levels, str) else [levels]
    return _measure([reference, *some], Path(out), config, on_event, backend)


def _measure(
    given: Sequence[Path | str | Gaussians], out: Path, config: MeasureConfig, emit: Emit, backend: Backend
) -> Measured:
    """See `measure_levels`."""
    emit(StageStarted("measure"))
    check_limits(config)
    reference, levels, names = _levels(given)
    truth = reference.load()
    for note in truth.notes:
        emit(Warned(f"{reference.name}: {note}"))
    if truth.dropped:
        what = ", ".join(f"{count:,} {reason}" for reason, count in truth.dropped.items())
        emit(Warned(f"{reference.name}: Gaussians left out: {what}"))
    check_size(truth.gaussians, reference.name)
    cameras, views, lines, offset = _viewpoints(truth, config, backend)
    truth, levels = relative_to(truth, offset), [_near(level, offset) for level in levels]
    renderer, total = Renderer(backend), len(levels) * len(cameras)
    if not any(renderer.covered(truth, camera).any() for camera in cameras):
        raise RunError(
            f"{config.cameras}: no camera has {reference.name} in sight; give cameras of this scene"
        )
    metrics = load_metrics(emit, config.lpips)

    def done(images: int) -> None:
        emit(Progress("measure", images, total))

    rows, counts = compare(truth, levels, cameras, metrics, renderer, done)
    measured = Measured(
        reference.name, len(truth.gaussians), names, [level.series for level in levels], counts,
        [level.nbytes for level in levels], views, truth.names,
        [MS_SSIM, FLIP, *metrics], rows,
    )  # fmt: skip
    out.mkdir(parents=True, exist_ok=True)
    up = np.mean([-camera.w2c[1, :3] for camera in cameras], axis=0)
    up = up / max(float(np.linalg.norm(up)), 1e-9)
    contact_sheet(
        out / "viewpoints.png", truth.gaussians, cameras, up, [reference.name, *lines], views,
        antialiased=truth.antialiased, backend=backend,
    )  # fmt: skip
    how = {"viewpoints": lines, "settings": {k: v for k, v in asdict(config).items() if k != "lpips"}}
    how["settings"]["cameras"] = config.cameras and config.cameras.name
    row = worst_view(measured)
    write_report(out, measured, how, _strip(truth, levels, cameras[row], views[row], renderer))
    columns = ("level", "Gaussians", "share", "MB", "SSIM", "PSNR", *measured.others, "SSIM covered")
    emit(levels_table(measured).only(*columns, "worst SSIM").event)
    if measured.labels():
        emit(categories_table(measured).event)
    return measured


def _levels(given: Sequence[Path | str | Gaussians]) -> tuple[Level, list[Level], list[str]]:
    """The reference, the levels, and their names, each another."""
    sources = [one if isinstance(one, Gaussians) else Path(one) for one in given]
    first, *others = [
        [level_of(one, number)] if isinstance(one, Gaussians) else levels_of(one)
        for number, one in enumerate(sources)
    ]
    levels = [level for some in others for level in some] if others else first[1:]
    if not levels:
        raise RunError(
            f"{first[0].name}: one level, and nothing to compare it with; name its levels after it, or give "
            "a lod-meta.json, a bundle or a run"
        )
    owners = [one for one, some in zip(sources[1:], others, strict=True) for _ in some]
    owners = owners or [sources[0]] * len(levels)
    folders = ["" if isinstance(one, Gaussians) else one.resolve().parent.name for one in owners]
    return first[0], levels, unique_names(levels, folders)


def _viewpoints(
    truth: Splat, config: MeasureConfig, backend: Backend
) -> tuple[list[Camera], list[str], list[str], Position]:
    """Viewpoints, their names, lines about them, and the offset of their positions."""
    if config.cameras is None:
        size = config.size, max(1, round(0.75 * config.size))
        drawn = free_cameras(
            truth.gaussians, config.views, up=truth.up if config.up == "auto" else config.up, fov=config.fov,
            size=size, seed=config.seed, kind=config.kind, backend=backend,
        )  # fmt: skip
        names = [f"{i:03}" for i in range(1, len(drawn.cameras) + 1)]
        return list(drawn.cameras), names, [drawn.reason], truth.offset
    found = read_camera_file(config.cameras)
    picked = np.linspace(0, len(found) - 1, min(config.views, len(found))).round().astype(int)
    some = [found[i] for i in picked]
    line = f"{len(some)} of the {len(found)} cameras of {config.cameras.name}"
    near = [one.camera.within(config.size) for one in some]
    return near, [one.name for one in some], [line], some[0].offset


def _near(level: Level, offset: Position) -> Level:
    """The level with positions relative to an offset; those of a bundle, which says none, are as they are."""

    def load() -> Splat:
        splat = level.load()
        known = any(splat.offset) or splat.kind != "increments"
        return relative_to(splat, offset) if known else splat

    return replace(level, load=load)


def _strip(truth: Splat, levels: Sequence[Level], camera: Camera, name: str, renderer: Renderer) -> Strip:
    """The part of a viewpoint in which the levels differ most from the reference."""
    image = renderer.rgb(truth, camera).copy()
    images = [renderer.rgb(level.load(), camera).copy() for level in levels]
    loss = np.mean([1 - ssim_map(other, image) for other in images], axis=0)
    side = min(SIDE, *loss.shape)
    inside = [slice(side // 2, side // 2 + length - side + 1) for length in loss.shape]  # centres of windows
    worst = uniform_filter(loss, side, mode="constant")[inside[0], inside[1]]
    y, x = np.unravel_index(int(worst.argmax()), worst.shape)

    def crop(picture: np.ndarray) -> np.ndarray:
        return (255 * picture[y : y + side, x : x + side]).round().astype(np.uint8)

    return Strip(name, crop(image), [crop(picture) for picture in images])
