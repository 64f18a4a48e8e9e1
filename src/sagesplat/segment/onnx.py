"""Label images from a segmentation network in ONNX format, on the CPU."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from jaxtyping import Float32, Int16, UInt8
from PIL import Image

from sagesplat.errors import BackendUnavailable, LabelError, RunError
from sagesplat.files import read_json
from sagesplat.scene.scene import Scene
from sagesplat.segment import coco
from sagesplat.segment.masks import (
    UNLABELLED,
    Taxonomy,
    prepare_folder,
    read_mask,
    taxonomy_of,
    write_labels,
    write_mask,
)


class PhotoList(Protocol):
    """What photos are taken from: by row of Scene.views, at the size of the view's camera."""

    def __getitem__(self, index: int, /) -> UInt8[np.ndarray, "H W 3"]: ...


@dataclass(frozen=True, eq=False)
class Classes:
    """What a network's classes mean, and how it wants its input."""

    label_ids: Int16[np.ndarray, " C"]  # category id of each class, -1 = none
    taxonomy: Taxonomy
    mean: Float32[np.ndarray, " 3"]  # RGB in 0 ... 1
    std: Float32[np.ndarray, " 3"]


def read_classes(path: Path) -> Classes:
    """Read {"classes": [names], "coco_panoptic": {name: category id or null}, "mean": [3], "std": [3]}.

    mean and std may be absent: 0.5 each, which maps 0 ... 255 to -1 ... 1. Names of categories are COCO's, or
    the class's where COCO has none of that id. Raises LabelError.
    """
    try:
        content = read_json(path)
    except RunError as error:
        raise LabelError(f"{error}; it says what the classes of the model are") from None
    try:
        classes, ids = content["classes"], content["coco_panoptic"]
        label_ids = [UNLABELLED if ids[name] is None else int(ids[name]) for name in classes]
        mean, std = (np.broadcast_to(np.float32(content.get(key, 0.5)), 3) for key in ("mean", "std"))
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise LabelError(
            f'{path}: not of the form {{"classes": ["sky"], "coco_panoptic": {{"sky": 187}}}} ({error!r}); '
            "list each class with its category id or null"
        ) from None
    if not (np.isfinite([mean, std]).all() and (std > 0).all()):
        raise LabelError(f"{path}: mean {mean.tolist()}, std {std.tolist()}; give numbers, std above 0")
    pairs = zip(label_ids, classes, strict=True)
    names = {i: coco.NAMES.get(i, name) for i, name in pairs if i != UNLABELLED}
    taxonomy = taxonomy_of(names, path)  # says which ids do not fit
    return Classes(np.array(label_ids, np.int16), taxonomy, mean, std)


class OnnxSegmenter:
    """A semantic segmentation network: RGB in, one logit per class and (coarser) pixel out."""

    def __init__(self, model: Path, classes: Path, *, threads: int = 1):
        self.classes = read_classes(classes)
        self._session = open_session(model, threads)
        self._model = model
        entry = self._session.get_inputs()[0]
        self._input, shape = entry.name, entry.shape
        channels = next((axis for axis in (1, 3) if len(shape) == 4 and shape[axis] == 3), None)
        size = [length for axis, length in enumerate(shape) if axis not in (0, channels)]
        fixed = all(isinstance(length, int) for length in size)  # a size left open is None or a name
        if channels is None or not fixed or entry.type != "tensor(float)":
            raise LabelError(
                f"{model}: input {entry.type} of shape {shape}, but [1, 3, height, width] or "
                "[1, height, width, 3] of floats in fixed size is needed; export it so"
            )
        self._channels, (self._height, self._width) = channels, size

    def segment(self, photo: UInt8[np.ndarray, "H W 3"]) -> Int16[np.ndarray, "H W"]:
        """The category id of each pixel, -1 where the network's class has none."""
        height, width = photo.shape[:2]
        x = np.moveaxis(to_input(photo, self._height, self._width, self.classes), 2, self._channels - 1)
        try:
            logits = np.asarray(self._session.run(None, {self._input: np.ascontiguousarray(x[None])})[0])
        except Exception as error:  # onnxruntime has a class of its own for each kind of failure
            raise LabelError(f"{self._model}: does not run ({_first_line(error)}); export it again") from None
        axis = class_axis(logits.shape, len(self.classes.label_ids), self._channels)
        if axis is None:
            raise LabelError(
                f"{self._model}: output of shape {list(logits.shape)}, but {len(self.classes.label_ids)} "
                "classes are listed; take the file of classes that belongs to the model"
            )
        logits = np.moveaxis(logits[0], axis - 1, 0).astype(np.float32, copy=False)
        return self.classes.label_ids[arg_max_resized(logits, height, width)]


def segment_onnx(
    scene: Scene,
    photos: PhotoList,
    model: Path,
    classes: Path,
    target: Path,
    *,
    threads: int = 1,
    on_view: Callable[[int, int], None] | None = None,
) -> None:
    """Write a normalised folder of masks: label images of every view by a network, then labels.json.

    A finished label image in `target` is kept, so that a killed run goes on where it was: empty the folder
    before using another model. `on_view(done, total)` is called after each view. Raises LabelError for files
    that cannot be used, BackendUnavailable without onnxruntime.
    """
    segmenter = OnnxSegmenter(model, classes, threads=threads)
    taxonomy = segmenter.classes.taxonomy
    occurring: set[int] = set()
    paths = prepare_folder(target, scene.views)
    for i, (view, path) in enumerate(zip(scene.views, paths, strict=True)):
        label_ids = _finished(path, taxonomy, (view.camera.height, view.camera.width))
        if label_ids is None:
            label_ids = segmenter.segment(photos[i])
            write_mask(path, label_ids, taxonomy)
        occurring.update(np.unique(label_ids).tolist())
        if on_view is not None:
            on_view(i + 1, len(scene.views))
    write_labels(target, taxonomy, occurring)


def _finished(path: Path, taxonomy: Taxonomy, shape: Sequence[int]) -> Int16[np.ndarray, "H W"] | None:
    """The label image of an earlier run, if it is of this size and of these categories."""
    try:
        label_ids = read_mask(path, taxonomy)
    except LabelError:
        return None
    return label_ids if label_ids.shape == tuple(shape) else None


def open_session(model: Path, threads: int) -> Any:
    """An onnxruntime session on the CPU."""
    try:
        import onnxruntime
    except ImportError:
        raise BackendUnavailable(
            "segmentation by a network needs onnxruntime; pip install 'sagesplat[onnx]'"
        ) from None
    if not model.is_file():
        raise LabelError(f"{model}: no such file; name an ONNX model")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads, options.inter_op_num_threads = threads, 1
    options.log_severity_level = 3  # errors only
    try:
        return onnxruntime.InferenceSession(str(model), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime has a class of its own for each kind of failure
        raise LabelError(
            f"{model}: no model that onnxruntime can load ({_first_line(error)}); export it again"
        ) from None


def to_input(
    photo: UInt8[np.ndarray, "H W 3"], height: int, width: int, classes: Classes
) -> Float32[np.ndarray, "h w 3"]:
    """The photo at the network's input size (bilinear, antialiased where it shrinks), normalised."""
    small = Image.fromarray(photo).resize((width, height), Image.Resampling.BILINEAR)
    return (np.asarray(small, np.float32) / 255 - classes.mean) / classes.std


def class_axis(shape: Sequence[int], num_classes: int, likely: int) -> int | None:
    """The axis of the classes in an output of four: the input's channel axis, or else the other one."""
    return next((a for a in (likely, 4 - likely) if len(shape) == 4 and shape[a] == num_classes), None)


def arg_max_resized(
    logits: Float32[np.ndarray, "C h w"], height: int, width: int
) -> Int16[np.ndarray, "H W"]:
    """The class with the largest logit after bilinear resampling to `height` x `width`.

    Class by class, so that large photos never hold all logits at full size.
    """
    best = np.full((height, width), -np.inf, np.float32)
    classes = np.zeros((height, width), np.int16)
    for c, logit in enumerate(logits):
        resized = Image.fromarray(logit).resize((width, height), Image.Resampling.BILINEAR)
        resized = np.asarray(resized)
        larger = resized > best
        best[larger], classes[larger] = resized[larger], c
    return classes


def _first_line(error: Exception) -> str:
    return str(error).strip().partition("\n")[0]
