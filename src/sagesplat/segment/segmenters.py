"""Segmenters: their interface, and the loop that applies one to the views of a scene."""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from jaxtyping import Float32, Int16, UInt8
from PIL import Image

from sagesplat.core.config import MasksConfig
from sagesplat.core.errors import BackendUnavailable, LabelError, RunError
from sagesplat.io.files import write_json
from sagesplat.io.lock import locked
from sagesplat.io.typed import known_json
from sagesplat.scene.scene import Scene, View
from sagesplat.segment.instances import write_instances
from sagesplat.segment.masks import (
    UNLABELLED,
    Masks,
    Taxonomy,
    mask_path,
    prepare_folder,
    read_mask,
    write_mask,
)

_BEGINS = 60.0  # seconds that another process may take to begin a folder


@dataclass(frozen=True, eq=False)
class Segmented:
    """A segmenter's answer for a photo."""

    label_ids: Int16[np.ndarray, "H W"]  # category id of each pixel, -1 where it has none
    instances: Int16[np.ndarray, "H W"] | None = None
    """Number of each pixel's instance in this photo, -1 for none; an instance lies within one category."""


class Segmenter(Protocol):
    """A network, or anything else, that labels pixels."""

    taxonomy: Taxonomy  # all categories that it can answer with

    def __call__(self, photos: Sequence[UInt8[np.ndarray, "H W 3"]], /) -> list[Segmented]:
        """An answer for each photo; those of one call may be computed together."""
        ...


@dataclass(frozen=True)
class SegmenterFactory:
    """How one kind of segmenter is made from `--segmenter` and its settings; `registry` lists all kinds."""

    settings: Callable[[MasksConfig], dict[str, Any]]
    """What the answers depend on, by name: plain values, and paths of files or folders whose content counts.

    Raises RunError where a setting is missing or a file does not exist.
    """
    load: Callable[[MasksConfig, str, int, Callable[[str], None]], Segmenter]
    """(settings, device, threads, warn) -> the segmenter; `warn` takes lines for the user."""
    suffixes: tuple[str, ...] = ()
    """Of `--model`, with `--segmenter auto`."""
    instances: Callable[[Segmenter], None] | None = None
    """Tells a segmenter to answer with instances too; None: it always does, or never."""


def existing_file(path: str | Path | None, needs: str) -> Path:
    """A file that a setting names; RunError where it is not set or does not exist. `needs`: the cure."""
    if path is None:
        raise RunError(needs)
    if not Path(path).is_file():
        raise RunError(f"{path}: no such file; {needs}")
    return Path(path)


class PhotoList(Protocol):
    """What photos are taken from: by row of Scene.views, at the size of the view's camera."""

    def __getitem__(self, index: int, /) -> UInt8[np.ndarray, "H W 3"]: ...


def segment_some(
    scene: Scene,
    photos: PhotoList,
    segmenter: Segmenter,
    target: Path,
    rows: Sequence[int],
    *,
    instances: Path | None = None,
    below: Masks | None = None,
    on_view: Callable[[int, int], None] | None = None,
) -> set[int]:
    """Write the label images of some views (rows of Scene.views); the ids that occur in them come back.

    Several processes may do so with other views and the same network: the first one begins the folder.

    In the folder `instances` those of the answers that have some are kept (`instances.read_instances`). A
    finished label image in `target` is kept, and a killed run resumes, unless it is of other categories:
    empty the folder before using another model of the same ones. `below`: label images that the answers are
    painted over. `on_view(done, total)` is called after each view, `total` being that of `rows`. Raises
    LabelError.
    """
    if not scene.views:
        raise LabelError(f"{scene.path}: a scene without views; there is no photo to segment")
    taxonomy, total = segmenter.taxonomy if below is None else below.taxonomy | segmenter.taxonomy, len(rows)
    with locked(target, _BEGINS):
        paths = prepare_folder(target, scene.views)
        _begin(target, taxonomy, paths)
    occurring: set[int] = set()
    done = 0

    def finish(label_ids: Int16[np.ndarray, "H W"]) -> None:
        nonlocal done
        done += 1
        occurring.update(np.unique(label_ids).tolist())
        if on_view is not None:
            on_view(done, total)

    missing = []
    for row in rows:
        label_ids = _finished(paths[row], taxonomy, scene.views[row])
        if label_ids is None:
            missing.append(row)
        else:
            finish(label_ids)
    for row in missing:
        (found,) = segmenter([photos[row]])
        label_ids = found.label_ids
        if below is not None:
            label_ids = np.where(label_ids != UNLABELLED, label_ids, below[scene.views[row]])
        if instances is not None and found.instances is not None:
            write_instances(mask_path(instances, scene.views[row]), found.instances)
        write_mask(paths[row], label_ids, taxonomy)
        finish(label_ids)
    return occurring


def _begin(target: Path, taxonomy: Taxonomy, paths: Sequence[Path]) -> None:
    """Remove what an earlier run left, unless it was of the same categories."""
    marker, content = target / ".taxonomy.json", {str(i): name for i, name in taxonomy.names.items()}
    if known_json(marker, dict) != content:
        for path in paths:
            path.unlink(missing_ok=True)
        write_json(marker, content)


def _finished(path: Path, taxonomy: Taxonomy, view: View) -> Int16[np.ndarray, "H W"] | None:
    """The label image of an earlier run, if it is of the view's size."""
    try:
        label_ids = read_mask(path, taxonomy)
    except LabelError:
        return None
    return label_ids if label_ids.shape == (view.camera.height, view.camera.width) else None


def group_classes(label_ids: Sequence[int | None]) -> tuple[Int16[np.ndarray, " K"], np.ndarray]:
    """The ids that classes stand for, rising, and the row [C] of each class among them.

    Classes without a category share the id -1.
    """
    each = np.array([UNLABELLED if i is None else i for i in label_ids], np.int16)
    return np.unique(each, return_inverse=True)


def arg_max_resized(
    logits: Float32[np.ndarray, "C h w"], height: int, width: int
) -> Int16[np.ndarray, "H W"]:
    """The class with the largest logit after bilinear resampling to `height` x `width`.

    Class by class, so that large photos never hold all logits at full size.
    """
    best = np.full((height, width), -np.inf, np.float32)
    classes = np.zeros((height, width), np.int16)
    # The best of a pixel is at least the mean: a class that is below it everywhere never wins.
    least = logits.mean(0).min()
    least -= 1e-4 * abs(least)  # rounding
    for c, logit in enumerate(logits):
        if logit.max() < least:
            continue
        resized = Image.fromarray(logit).resize((width, height), Image.Resampling.BILINEAR)
        resized = np.asarray(resized)
        larger = resized > best
        best[larger], classes[larger] = resized[larger], c
    return classes


def parse_device(device: str) -> tuple[str, int]:
    """`auto`, `cpu` or `cuda`, and which GPU: of "auto", "cpu", "cuda" or "cuda:N"."""
    found = re.fullmatch(r"(auto|cpu|cuda)|cuda:(\d+)", device)
    if found is None:
        raise BackendUnavailable(f"device {device!r} is not known; use --device cpu, cuda or cuda:N")
    return found[1] or "cuda", int(found[2] or 0)
