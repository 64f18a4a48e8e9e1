"""Draws the pictures of the concept pages from a run of the demo: python docs/pictures.py runs/demo."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont

from sagesplat import Camera, FinishedRun, Gaussians, label_image, open_run, rasterize
from sagesplat.stages.looks import looks

IMAGES = Path(__file__).parent / "images"
LARGER = 1.5  # than the photos
SCREEN = 2.0  # the largest that promises are for, times the photos' pixels
LEVELS = (1, 4, 8, 12)


def main() -> None:
    """Write concept-categories.webp, concept-levels.webp and fidelities.webp."""
    run = open_run(sys.argv[1])
    view = run.scene.views[2]
    camera = enlarged(view.camera)
    full = run.compose(dict.fromkeys(run.costs.labels, LEVELS[-1]))
    colours = {i: run.job.taxonomy.color(i) for i in run.names if i >= 0}
    size = (camera.width, camera.height)
    photo = Image.open(view.image_path).convert("RGB").resize(size, Image.Resampling.LANCZOS)
    labels = Image.fromarray(label_image(run.job.masks[view], colours)).resize(size, Image.Resampling.NEAREST)
    own = torch.tensor([colours.get(int(i), (128, 128, 128)) for i in full.label_ids]) / 255
    grid([photo, labels, render(run, full, camera, own)], 3, "concept-categories.webp")

    cells = []
    for level in LEVELS:
        g = run.compose(dict.fromkeys(run.costs.labels, level))
        kilobytes = run.costs.transfer_bytes[:, level - 1].sum() / 1000
        cell = render(run, g, camera)
        caption(cell, f"level {level}: {len(g):,} Gaussians, {kilobytes:,.0f} kB")
        cells.append(cell)
    grid(cells, 2, "concept-levels.webp")

    crops = []
    for look in looks(run.job, SCREEN):
        crop = Image.fromarray(look.image)
        what = "full model" if look.asked == 1 else f"asked {look.asked:g}: {look.fidelity:.3f}"
        caption(crop, f"{what}, {look.nbytes / 1000:,.0f} kB", 13)
        crops.append(crop)
    grid(crops, len(crops), "fidelities.webp")


def enlarged(camera: Camera) -> Camera:
    """The same view with more pixels."""
    K = camera.K.copy()
    K[:2] *= LARGER
    return replace(camera, K=K, width=round(camera.width * LARGER), height=round(camera.height * LARGER))


def render(
    run: FinishedRun, g: Gaussians, camera: Camera, colours: torch.Tensor | None = None
) -> Image.Image:
    """Gaussians in their own colours, or in given ones [N, 3]."""
    with torch.no_grad():
        drawn = rasterize(g, camera, features=colours, antialiased=run.antialiased)
    image = drawn.rgb if drawn.features is None else drawn.features
    return Image.fromarray((image.clamp(0, 1).numpy() * 255).round().astype(np.uint8))


def caption(image: Image.Image, text: str, height: int = 22) -> None:
    """Write a line of some pixels' height into the lower left corner."""
    draw, font = ImageDraw.Draw(image), ImageFont.load_default(height)
    at = (height // 2, image.height - round(1.65 * height))
    box = draw.textbbox(at, text, font)
    draw.rectangle((box[0] - 6, box[1] - 4, box[2] + 6, box[3] + 4), fill=(20, 24, 30))
    draw.text(at, text, (255, 255, 255), font)


def grid(cells: list[Image.Image], columns: int, name: str) -> None:
    """Save pictures side by side."""
    w, h = cells[0].size
    rows = -(-len(cells) // columns)
    sheet = Image.new("RGB", (columns * (w + 8) - 8, rows * (h + 8) - 8), (255, 255, 255))
    for i, cell in enumerate(cells):
        sheet.paste(cell, (i % columns * (w + 8), i // columns * (h + 8)))
    sheet.save(IMAGES / name, quality=88, method=6)


if __name__ == "__main__":
    main()
