"""Makes the tables of a scene in blocks: balance of the blocks, and quality along their borders."""

import math

import numpy as np
import torch

from sagesplat.adapt.ladder import read_ladder
from sagesplat.adapt.observe import as_unit, render_rgb
from sagesplat.core.events import Progress
from sagesplat.core.gaussians import Gaussians
from sagesplat.formats.levels import read_sizes
from sagesplat.io.files import write_text
from sagesplat.metrics.image import pasted, squared_error_map, ssim_map
from sagesplat.output.table import Table
from sagesplat.raster import Workspace, device_of, rasterize
from sagesplat.run.job import Job
from sagesplat.run.recorded import stage_seconds
from sagesplat.run.stage import run_stage
from sagesplat.scene.blocks import Blocks, read_blocks, read_division
from sagesplat.train.boundaries import bands, merged, read_block
from sagesplat.train.early_stopping import spread

_TIMED = ("train", "base", "nest", "boundaries")  # stages of a block whose seconds are shown
_VIEWS = 32  # training views that are measured if there are no test views


def measure_borders(job: Job) -> None:
    """Measure the quality near the borders of the blocks and elsewhere, and the balance of the blocks."""
    run, file = job.run, job.run.division
    table_file = run.adapted / "blocks.csv"

    def make() -> list[str]:
        blocks = read_blocks(file)
        parts = [read_block(run.block(number).interior) for number in range(len(blocks))]
        sets = {"merged": merged(parts).full, "tuned": job.ladder.load(job.ladder.levels[-1])}
        tables = [balance_table(job, blocks), border_table(job, blocks, sets)]
        for table in tables:
            job.emit(table.event)
        tables[0].write_csv(table_file)
        tables[1].write_csv(run.adapted / "borders.csv")
        text = "\n\n".join(f"## {t.title}\n\n{t.markdown()}" for t in tables)
        write_text(run.adapted / "blocks.md", f"{text}\n")
        return [str(run.adapted / "blocks.md")]

    made = [run.block(i).provenance(s) for i in range(len(read_blocks(file))) for s in (*_TIMED, "interior")]
    levels = [run.prefixes, run.cells]
    inputs = [*run.scene_files, run.provenance("train"), *levels, file, *(p for p in made if p.exists())]
    run_stage(job, "borders", {}, inputs, [table_file, run.adapted / "borders.csv"], make)


def balance_table(job: Job, blocks: Blocks) -> Table:
    """Points, views, Gaussians and seconds of each block, one row each."""
    made = read_division(job.run.division)
    rows: list[tuple[str | int | float, ...]] = []
    for number in range(len(blocks)):
        run = job.run.block(number)
        took = stage_seconds(run)
        seconds = [took.get(stage, math.nan) for stage in _TIMED]
        trained = sum(read_ladder(run.levels).files[-1].counts.values())
        kept = sum(n[-1] for n in read_sizes(run.interior).values())
        rows.append((number, made.points[number], made.views[number], trained, kept, *seconds))
    header = ("block", "points", "views", "Gaussians", "inside", *(f"{stage} s" for stage in _TIMED))
    return Table("Blocks", header, ("d", ",d", "d", ",d", ",d", ".1f", ".1f", ".1f", ".1f"), rows)


def border_table(job: Job, blocks: Blocks, sets: dict[str, Gaussians]) -> Table:
    """PSNR and SSIM of full scenes on the test views, in bands along the borders and elsewhere.

    A pixel is in a band if Gaussians of the first set that are within half the margin of a border contribute
    most of it.
    """
    scene = job.scene
    rows = job.valid.rows(scene, scene.test_ids) or spread(job.valid.rows(scene, scene.train_ids), _VIEWS)
    first = next(iter(sets.values()))
    near = torch.from_numpy(blocks.to_border(first.means.numpy()) < blocks.margin / 2)
    in_band = [_shows(job, first, near, row) for row in rows]
    workspace, body = Workspace(), []
    for done, (name, g) in enumerate(sets.items(), 1):
        errors, quality = [], []
        for row in rows:
            image = render_rgb(
                g,
                scene.views[row].camera,
                backend=job.backend,
                antialiased=job.antialiased,
                workspace=workspace,
            )
            photo = pasted(as_unit(job.photos[row]), image, job.valid[scene.views[row]])
            errors.append(squared_error_map(image, photo))
            quality.append(ssim_map(image, photo))
        b = bands(in_band, errors, quality)
        body.append((name, len(g), b.share, b.psnr, b.psnr_inside, b.ssim, b.ssim_inside))
        job.emit(Progress("borders", done, len(sets)))
    header = (
        "scene",
        "Gaussians",
        "in bands",
        "PSNR there",
        "PSNR elsewhere",
        "SSIM there",
        "SSIM elsewhere",
    )
    title = f"Along the borders of {len(blocks)} blocks and elsewhere, {len(rows)} views"
    return Table(title, header, ("", ",d", ".1%", ".2f", ".2f", ".4f", ".4f"), body)


def _shows(job: Job, g: Gaussians, which: torch.Tensor, row: int) -> np.ndarray:
    """Pixels (bool [H, W]) of a view to which the Gaussians `which` contribute most."""
    device = device_of(job.backend)
    with torch.no_grad():
        render = rasterize(
            g.to(device), job.scene.views[row].camera, features=which.float()[:, None].to(device),
            backend=job.backend, antialiased=job.antialiased,
        )  # fmt: skip
    assert render.features is not None
    return (render.features[..., 0] > 0.5 * render.alpha).cpu().numpy()
