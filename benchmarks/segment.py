"""What segmenters find on a few views: overlays side by side, and IoU against label images that are given."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Int16, UInt8
from PIL import Image, ImageDraw, ImageFont

from benchmarks import deeplab
from sagesplat.adapt.observe import render_rgb
from sagesplat.formats.levels import read_level
from sagesplat.output.figures import label_image
from sagesplat.run.job import Job
from sagesplat.run.run_dir import RunDir
from sagesplat.scene.images import Photos
from sagesplat.scene.scene import Scene
from sagesplat.segment import coco
from sagesplat.segment.deeplabv2 import DeepLabV2Segmenter, HeadClasses
from sagesplat.segment.display_names import titles
from sagesplat.segment.masks import Masks, Taxonomy
from sagesplat.segment.onnx import OnnxSegmenter
from sagesplat.segment.segmenters import Segmenter

WIDTH = 1000  # px of a sheet at most: a page shows it at some 740
PICTURE = 250  # px of a picture's width at most
TEXT = 18  # px of its letters
GAP = 4  # px between pictures
LEAST = 0.003  # of the sheet's pixels that a category needs for the legend
_MIDDLE = 110  # grey of a photo, with which the legend's colours are mixed as those of the pictures are
SHARE = 0.01  # of the pixels that a category needs for its IoU to tell something

LabelImage = Int16[np.ndarray, "H W"]


def networks(models: Sequence[Path], classes: Path) -> dict[str, Segmenter]:
    """ONNX networks by name."""
    return {model.stem: OnnxSegmenter(model, classes) for model in models}


def small_deeplab(
    masks: Masks, scene: Scene, photos: Photos, held_out: Sequence[int]
) -> dict[str, Segmenter]:
    """A small DeepLabV2 that learned from all views but the held out ones, without and with the CRF."""
    ids = sorted(masks.taxonomy.names)
    index = np.full(max(coco.NAMES) + 2, -1, np.int16)  # the last one is for -1
    index[ids] = np.arange(len(ids))
    rows = [row for row in range(len(scene.views)) if row not in held_out]
    labels = [index[masks[scene.views[row]]] for row in rows]
    model = deeplab.train_small([photos[row] for row in rows], labels, len(ids), steps=160)
    heads = HeadClasses(tuple(range(len(ids))), tuple(ids))
    return {
        name: DeepLabV2Segmenter(model, heads, size=None, crf=crf)
        for name, crf in (("deeplabv2 (small)", False), ("with CRF", True))
    }


def ious(found: Sequence[LabelImage], truth: Sequence[LabelImage]) -> dict[int, float]:
    """IoU of each category that covers enough of the truth; its unlabelled pixels do not count."""
    p, t = (np.concatenate([image.ravel() for image in images]) for images in (found, truth))
    p, t = p[t >= 0], t[t >= 0]
    common = [int(i) for i, n in zip(*np.unique(t, return_counts=True), strict=True) if n >= SHARE * len(t)]
    return {i: float(((p == i) & (t == i)).sum() / ((p == i) | (t == i)).sum()) for i in common}


def sheet(
    photos: Sequence[UInt8[np.ndarray, "H W 3"]],
    columns: Mapping[str, Sequence[LabelImage]],
    taxonomy: Taxonomy,
    blend: float,
    first: tuple[str, Sequence[UInt8[np.ndarray, "H W 3"]]] | None = None,
) -> Image.Image:
    """One row a view, one column a segmenter, colours over `1 - blend` of the photo, names above.

    The `first` column, with its name, is shown without colours. Below all a legend of the categories that
    cover at least `LEAST` of the pictures, the largest first.
    """
    shown = {first[0]: list(first[1])} if first else {}
    for name, images in columns.items():
        shown[name] = []
        for photo, labels in zip(photos, images, strict=True):
            colours = {int(i): taxonomy.color(int(i)) for i in np.unique(labels) if i >= 0}
            mixed = (1 - blend) * photo + blend * label_image(labels, colours)
            shown[name].append(mixed.astype(np.uint8))
    wide = min((WIDTH + GAP) // len(shown) - GAP, PICTURE)
    width = len(shown) * (wide + GAP) - GAP
    high = round(wide * photos[0].shape[0] / photos[0].shape[1])
    heads = {name: _wrapped(name, wide) for name in shown}
    top = max(map(len, heads.values())) * (TEXT + 2) + 6
    bottom = top + len(photos) * (high + GAP)
    legend = _legend(columns, taxonomy, width)
    page = Image.new("RGB", (width, bottom + 8 + len(legend) * (TEXT + 10)), "white")
    ink, font = ImageDraw.Draw(page), ImageFont.load_default(TEXT)
    for column, (name, pictures) in enumerate(shown.items()):
        x = column * (wide + GAP)
        for line, text in enumerate(heads[name]):
            ink.text((x + 2, 1 + line * (TEXT + 2)), text, "black", font)
        for row, picture in enumerate(pictures):
            page.paste(Image.fromarray(picture).resize((wide, high)), (x, top + row * (high + GAP)))
    for row, entries in enumerate(legend):
        y = bottom + 4 + row * (TEXT + 10)
        for x, name, colour in entries:
            shade = tuple(round(blend * part + (1 - blend) * _MIDDLE) for part in colour)
            ink.rectangle((x, y + 2, x + TEXT, y + 2 + TEXT), fill=shade)
            ink.text((x + TEXT + 6, y), name, "black", font)
    return page


def _legend(
    columns: Mapping[str, Sequence[LabelImage]], taxonomy: Taxonomy, width: int
) -> list[list[tuple[int, str, tuple[int, int, int]]]]:
    """Rows of (x, name, colour) that fit into `width` pixels."""
    pixels = np.concatenate([labels.ravel() for images in columns.values() for labels in images])
    ids, counts = np.unique(pixels, return_counts=True)
    shares = {int(i): n / len(pixels) for i, n in zip(ids, counts, strict=True)}
    shown = sorted((i for i, share in shares.items() if share >= LEAST), key=lambda i: -shares[i])
    names = titles({i: taxonomy.name(i) for i in shown})
    font, rows, x = ImageFont.load_default(TEXT), [[]], 2
    for i in shown:
        length = TEXT + 6 + round(font.getlength(names[i]))
        if rows[-1] and x + length > width:
            rows, x = [*rows, []], 2
        rows[-1].append((x, names[i], taxonomy.color(i) if i >= 0 else (128, 128, 128)))
        x += length + 18
    return rows


def _wrapped(name: str, width: int) -> list[str]:
    """Lines of a name that fit into `width` pixels, broken after spaces and underscores."""
    font, lines = ImageFont.load_default(TEXT), [""]
    for part in re.findall(r"[^ _]*[ _]?", name):
        if lines[-1] and font.getlength((lines[-1] + part).rstrip()) > width:
            lines.append("")
        lines[-1] += part
    return lines


def rendered(run: Path, rows: Sequence[int]) -> list[UInt8[np.ndarray, "H W 3"]]:
    """What a trained run shows in some views: for sheets of photos that may not be passed on."""
    job = Job(RunDir(run), lambda event: None)
    g = read_level(job.trained)
    cameras = [job.scene.views[row].camera.neutral for row in rows]
    images = (render_rgb(g, camera, backend=job.backend, antialiased=job.antialiased) for camera in cameras)
    return [(255 * image).round().astype(np.uint8) for image in images]


def fusion_sheet(job: Job, rows: Sequence[int], blend: float) -> Image.Image:
    """Label images of a fused run before and after."""
    views = [job.scene.views[row] for row in rows]
    columns = {
        name: [masks[view] for view in views]
        for name, masks in (("before fusion", job.masks), ("after", job.level_masks))
    }
    return sheet([job.photos[row] for row in rows], columns, job.taxonomy, blend)


def compare(
    scene: Scene,
    masks: Masks,
    segmenters: Mapping[str, Segmenter],
    rows: Sequence[int],
    measured: Sequence[int] = (),
) -> tuple[dict[str, dict[str, float]], dict[str, list[LabelImage]]]:
    """IoU by segmenter and category, with their mean, on the `measured` views; label images of `rows`."""
    photos, measured = Photos(scene.views), measured or rows
    truth = [masks[scene.views[row]] for row in measured]
    columns, table = dict[str, list[LabelImage]](), {}
    for name, segmenter in segmenters.items():
        labels = {row: segmenter([photos[row]])[0].label_ids for row in sorted({*rows, *measured})}
        columns[name] = [labels[row] for row in rows]
        by_id = ious([labels[row] for row in measured], truth)
        found = {masks.taxonomy.name(i): iou for i, iou in by_id.items()}
        table[name] = found | {"mean": float(np.mean(list(found.values())))}
    return table, columns
