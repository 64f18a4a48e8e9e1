"""How even the blocks of a large scene are, and what it looks like where they meet."""

import numpy as np
import torch

from sagesplat.adapt.ladder import read_ladder
from sagesplat.adapt.observe import as_unit, render_rgb
from sagesplat.core.events import Progress, TableMade
from sagesplat.core.gaussians import Gaussians
from sagesplat.formats.levels import read_sizes
from sagesplat.io.files import read_json, write_text
from sagesplat.metrics.image import squared_error_map, ssim_map
from sagesplat.output.tables import Table
from sagesplat.raster import Workspace, device_of, rasterize
from sagesplat.run.job import Job
from sagesplat.run.run_dir import RunDir
from sagesplat.run.stage import run_stage
from sagesplat.scene.blocks import Blocks, read_blocks
from sagesplat.train.boundaries import bands, together
from sagesplat.train.early_stopping import spread

_TIMED = ("train", "base", "nest", "boundaries")  # stages of a block whose seconds are shown
_VIEWS = 32  # training views that are looked at where there are no test views


def measure_borders(job: Job) -> None:
    """Measure the whole scene near the borders of its blocks and away from them, and how even they are."""
    run, file = job.run, job.run.blocks / "blocks.json"
    table_file = run.adapted / "blocks.csv"

    def make() -> list[str]:
        blocks = read_blocks(file)
        files = [run.block(number).interior for number in range(len(blocks))]
        sets = {"put together": together(files)[0], "tuned": job.ladder.load(job.ladder.levels[-1])}
        tables = [balance_table(job, blocks), border_table(job, blocks, sets)]
        for table in tables:
            job.emit(TableMade(table.title, table.header, tuple(map(tuple, table.cells()))))
        tables[0].write_csv(table_file)
        tables[1].write_csv(run.adapted / "borders.csv")
        text = "\n\n".join(f"## {t.title}\n\n{t.markdown()}" for t in tables)
        write_text(run.adapted / "blocks.md", f"{text}\n")
        return [str(run.adapted / "blocks.md")]

    made = [run.block(i).provenance(s) for i in range(len(read_blocks(file))) for s in (*_TIMED, "interior")]
    inputs = [run.scene, run.provenance("train"), run.prefixes, file, *(p for p in made if p.exists())]
    run_stage(job, "borders", {}, inputs, [table_file, run.adapted / "borders.csv"], make)


def balance_table(job: Job, blocks: Blocks) -> Table:
    """Points, views, Gaussians and seconds of each block."""
    made = read_json(job.run.blocks / "blocks.json")
    rows: list[tuple[str | int | float, ...]] = []
    for number in range(len(blocks)):
        run = job.run.block(number)
        seconds = [_seconds(run, stage) for stage in _TIMED]
        trained = sum(read_ladder(run.levels).files[-1].counts.values())
        kept = sum(n[-1] for n in read_sizes(run.interior).values())
        rows.append((number, made["points"][number], made["views"][number], trained, kept, *seconds))
    header = ("block", "points", "views", "Gaussians", "inside", *(f"{stage} s" for stage in _TIMED))
    return Table("Blocks", header, ("d", ",d", "d", ",d", ",d", ".1f", ".1f", ".1f", ".1f"), rows)


def _seconds(run: RunDir, stage: str) -> float:
    record = run.provenance(stage)
    return float(read_json(record)["seconds"]) if record.exists() else float("nan")


def border_table(job: Job, blocks: Blocks, sets: dict[str, Gaussians]) -> Table:
    """PSNR and SSIM of whole scenes on the test views, in bands along the borders and away from them.

    A pixel is in a band where Gaussians of the first set within half the margin of a border paint most of it.
    """
    scene = job.scene
    rows = scene.test_ids.tolist() or spread(scene.train_ids.tolist(), _VIEWS)
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
            photo = as_unit(job.photos[row])
            errors.append(squared_error_map(image, photo))
            quality.append(ssim_map(image, photo))
        found = bands(in_band, errors, quality)
        body.append((name, len(g), found.share, found.psnr, found.psnr_inside, found.ssim, found.ssim_inside))
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
    """Pixels (bool [H, W]) of a view that some Gaussians paint most of."""
    device = device_of(job.backend)
    with torch.no_grad():
        render = rasterize(
            g.to(device), job.scene.views[row].camera, features=which.float()[:, None].to(device),
            backend=job.backend, antialiased=job.antialiased,
        )  # fmt: skip
    assert render.features is not None
    return (render.features[..., 0] > 0.5 * render.alpha).cpu().numpy()
