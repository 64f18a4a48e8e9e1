"""Segmentation networks in ONNX format."""

import math
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from jaxtyping import Float32, Int16, UInt8
from msgspec import Meta
from PIL import Image

from sagesplat.core.config import MasksConfig
from sagesplat.core.errors import BackendUnavailable, LabelError, short
from sagesplat.core.extras import install
from sagesplat.core.limits import LARGEST, Number
from sagesplat.core.memory import ran_out
from sagesplat.io.files import read_json
from sagesplat.io.typed import convert_as, refused
from sagesplat.segment import coco
from sagesplat.segment.masks import UNLABELLED, Taxonomy, taxonomy_of
from sagesplat.segment.segmenters import (
    Segmented,
    SegmenterFactory,
    arg_max_resized,
    existing_file,
    group_classes,
    parse_device,
)
from sagesplat.segment.taxonomies import SOURCES, to_coco

_Scale = Annotated[float, Meta(ge=1e-30, le=LARGEST)]  # not 0 in 32 bits either
_TIME_LIMIT = 300.0  # seconds that a network may take for a photo
_PIXELS = 2**24  # of a network's input: 200 MB
_VALUES = 2**29  # of its output: 2 GB
_OUTPUTS = {f"tensor({kind})" for kind in ("float", "float16", "double", "int64", "int32", "uint8")}


@dataclass(frozen=True, eq=False)
class Classes:
    """What a network's classes mean, and how it wants its input."""

    label_ids: Int16[np.ndarray, " C"]  # category id of each class, -1 = none
    taxonomy: Taxonomy
    mean: Float32[np.ndarray, " 3"]  # RGB in 0 ... 1
    std: Float32[np.ndarray, " 3"]


def read_classes(path: Path) -> Classes:
    """Read {"classes": [names], "coco_panoptic": {name: category id or null}, "mean": [3], "std": [3]}.

    With "vocabulary": "ade20k" (or another of `taxonomies.SOURCES`), "coco_panoptic" need only say what
    differs. mean and std may be absent: 0.5 each, which maps 0 ... 255 to -1 ... 1. Names of categories are
    COCO's, or the class's where COCO has none of that id. Raises LabelError.
    """
    content = read_json(path, "it says what the classes of the model are", LabelError)
    form = 'of the form {"classes": ["sky"], "coco_panoptic": {"sky": 187}}'
    with refused(path, form, "list each class with its category id or null", LabelError):
        made = convert_as(content, _File, strict=False)
        ids = _categories(made)
        if missing := [name for name in made.classes if name not in ids]:
            raise ValueError(f"no category of {missing[0]!r:.60}")
        mean, std = (np.broadcast_to(np.array(values, np.float32), 3) for values in (made.mean, made.std))
    label_ids = [UNLABELLED if (found := ids[name]) is None else found for name in made.classes]
    pairs = zip(label_ids, made.classes, strict=True)
    names = {i: coco.NAMES.get(i, name) for i, name in pairs if i != UNLABELLED}
    taxonomy = taxonomy_of(names, path)  # says which ids do not fit
    return Classes(np.array(label_ids, np.int16), taxonomy, mean, std)


@dataclass(frozen=True)
class _File:
    classes: list[str]
    coco_panoptic: dict[str, int | None] = field(default_factory=dict)
    vocabulary: str | None = None
    mean: Number | list[Number] = 0.5
    std: _Scale | list[_Scale] = 0.5


def _categories(made: _File) -> dict[str, int | None]:
    """The category of each class: listed, or that of COCO nearest to it in a known vocabulary."""
    if made.vocabulary is None:
        return made.coco_panoptic
    if made.vocabulary not in SOURCES:
        raise ValueError(f'"vocabulary" is {made.vocabulary!r:.60}; take one of {", ".join(SOURCES)}')
    nearest = zip(made.classes, to_coco(made.classes, made.vocabulary), strict=True)
    return dict(nearest) | made.coco_panoptic


class OnnxSegmenter:
    """A semantic segmentation network: RGB in, a logit per class and (coarser) pixel out, or class ids."""

    def __init__(
        self,
        model: Path | str,
        classes: Path | str,
        *,
        device: str = "auto",
        threads: int = 1,
        time_limit: float = _TIME_LIMIT,
    ):
        """`time_limit`: seconds for a photo. LabelError for a model or classes of no use."""
        model, classes = Path(model), Path(classes)
        self.classes = read_classes(classes)
        self.taxonomy = self.classes.taxonomy
        self._ids, self._group = group_classes(self.classes.label_ids.tolist())
        self._session = open_session(model, threads, device)
        self._model, self._time_limit = model, time_limit
        self._check_output()
        self._input, self._channels, (self._height, self._width) = self._read_input()

    def _read_input(self) -> tuple[str, int, tuple[int, int]]:
        """Name of the input, the axis of its channels, its height and width."""
        inputs = self._session.get_inputs()
        kind, shape = (inputs[0].type, list(inputs[0].shape)) if len(inputs) == 1 else ("", [])
        channels = next((axis for axis in (1, 3) if len(shape) == 4 and shape[axis] == 3), None)
        size = [length for axis, length in enumerate(shape) if axis not in (0, channels)]
        # a size left open is None or a name
        fixed = len(size) == 2 and all(type(n) is int and n > 0 for n in size)
        if channels is None or not fixed or math.prod(size) > _PIXELS or kind != "tensor(float)":
            what = f"input {kind} of shape {shape}" if kind else f"{len(inputs)} inputs"
            raise LabelError(
                f"{self._model}: {short(what)}, but [1, 3, height, width] or [1, height, width, 3] of floats "
                f"in fixed size is needed (up to {_PIXELS:,} pixels); export it so"
            )
        return inputs[0].name, channels, (size[0], size[1])

    def _check_output(self) -> None:
        """LabelError where the first output, as far as the model says its shape, cannot be label scores."""
        outputs = self._session.get_outputs()
        kind, shape = (outputs[0].type, list(outputs[0].shape)) if outputs else ("nothing", [])
        self._output = outputs[0].name if outputs else ""
        known = [n for n in shape if type(n) is int]
        if kind not in _OUTPUTS or math.prod(known) > _VALUES:
            raise LabelError(
                f"{self._model}: answers with {short(f'{kind} of shape {shape}')}, but numbers by class or "
                f"class numbers, up to {_VALUES:,} of them, are needed; export it so"
            )

    def __call__(self, photos: Sequence[UInt8[np.ndarray, "H W 3"]], /) -> list[Segmented]:
        """Label images, one photo after the other."""
        return [self._segment(photo) for photo in photos]

    def _segment(self, photo: UInt8[np.ndarray, "H W 3"]) -> Segmented:
        height, width = photo.shape[:2]
        output = self._run(photo)
        if np.issubdtype(output.dtype, np.integer):
            return self._of_numbers(output, height, width)
        likely = (self._channels, 4 - self._channels)  # the axis of the input's channels, else the other one
        axes = (a for a in likely if output.ndim == 4 and output.shape[a] == len(self._group))
        if (axis := next(axes, None)) is None:
            raise self._unfit(output)
        logits = np.moveaxis(output[0], axis - 1, 0).astype(np.float32, copy=False)
        return Segmented(self._ids[arg_max_resized(self._grouped(logits), height, width)])

    def _run(self, photo: UInt8[np.ndarray, "H W 3"]) -> np.ndarray:
        """The network's first output, [1, ...]."""
        import onnxruntime

        x = np.moveaxis(to_input(photo, self._height, self._width, self.classes), 2, self._channels - 1)
        options = onnxruntime.RunOptions()
        options.log_severity_level = 4  # what goes wrong is in the exception
        # a network may hold a loop that never ends; onnxruntime looks at this before each node
        timer = threading.Timer(self._time_limit, setattr, (options, "terminate", True))
        timer.daemon = True
        timer.start()
        try:
            feeds = {self._input: np.ascontiguousarray(x[None])}
            output = np.asarray(self._session.run([self._output], feeds, options)[0])
        except Exception as error:  # onnxruntime has a class of its own for each kind of failure
            if ran_out(error):
                raise
            if options.terminate:
                raise LabelError(
                    f"{self._model}: no answer within {self._time_limit:g} s; take another network"
                ) from None
            raise LabelError(f"{self._model}: does not run ({_first_line(error)}); export it again") from None
        finally:
            timer.cancel()
        if not output.ndim or output.shape[0] != 1 or not output.size or output.size > _VALUES:
            raise self._unfit(output)
        return output

    def _grouped(self, logits: Float32[np.ndarray, "C h w"]) -> Float32[np.ndarray, "K h w"]:
        """Log of the summed probability of each category, up to a constant per pixel."""
        if not np.isfinite(logits).all():
            raise LabelError(f"{self._model}: logits that are not finite; export it again (in 32 bits)")
        top = logits.max(0)
        members = np.eye(len(self._ids), dtype=np.float32)[:, self._group]
        sums = np.tensordot(members, np.exp(logits - top), 1)
        # Relative to the smallest float: a category far below the best is no -inf, which would spread.
        return np.log(np.maximum(sums, np.finfo(np.float32).tiny)) + top

    def _of_numbers(self, output: np.ndarray, height: int, width: int) -> Segmented:
        """Label image of a network that ends in an arg max: [1, h, w] class numbers, with axes of 1."""
        axis = next((a for a in (1, 3) if output.ndim == 4 and output.shape[a] == 1), None)
        numbers = (output if axis is None else output.squeeze(axis))[0]
        if (
            numbers.ndim != 2
            or not numbers.size
            or not 0 <= numbers.min() <= numbers.max() < len(self._group)
        ):
            raise self._unfit(output)
        rows = ((np.arange(height) + 0.5) * numbers.shape[0] / height).astype(int)
        columns = ((np.arange(width) + 0.5) * numbers.shape[1] / width).astype(int)
        return Segmented(self.classes.label_ids[numbers[rows[:, None], columns]])

    def _unfit(self, output: np.ndarray) -> LabelError:
        largest = f" up to {output.max()}" if np.issubdtype(output.dtype, np.integer) and output.size else ""
        return LabelError(
            f"{self._model}: output of shape {list(output.shape)}{largest}, but {len(self._group)} "
            "classes are listed; take the file of classes that belongs to the model"
        )


def open_session(model: Path, threads: int, device: str = "cpu") -> Any:
    """An onnxruntime session; on a GPU where one is asked for, or with `auto` where onnxruntime knows one."""
    try:
        import onnxruntime
    except ImportError:
        raise BackendUnavailable(
            f"segmentation by a network needs onnxruntime; {install('sagesplat[onnx]')}"
        ) from None
    if not model.is_file():
        raise LabelError(f"{model}: no such file; name an ONNX model")
    kind, index = parse_device(device)
    on_gpu = kind != "cpu" and "CUDAExecutionProvider" in onnxruntime.get_available_providers()
    unavailable = BackendUnavailable(
        f"device {device}: onnxruntime finds no CUDA here; {install('onnxruntime-gpu')}, or use --device cpu"
    )
    if kind == "cuda" and not on_gpu:
        raise unavailable
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads, options.inter_op_num_threads = threads, 1
    options.log_severity_level = 4  # errors are raised too
    gpu = [("CUDAExecutionProvider", {"device_id": index})] if on_gpu else []
    try:
        session = onnxruntime.InferenceSession(str(model), options, providers=[*gpu, "CPUExecutionProvider"])
    except Exception as error:  # onnxruntime has a class of its own for each kind of failure
        if ran_out(error):
            raise
        raise LabelError(
            f"{model}: no model that onnxruntime can load ({_first_line(error)}); export it again"
        ) from None
    if kind == "cuda" and "CUDAExecutionProvider" not in session.get_providers():
        raise unavailable  # it falls back to the CPU silently where CUDA's libraries are missing
    return session


def to_input(
    photo: UInt8[np.ndarray, "H W 3"], height: int, width: int, classes: Classes
) -> Float32[np.ndarray, "h w 3"]:
    """The photo at the network's input size (bilinear, antialiased where it shrinks), normalised."""
    small = Image.fromarray(photo).resize((width, height), Image.Resampling.BILINEAR)
    return (np.asarray(small, np.float32) / 255 - classes.mean) / classes.std


def _first_line(error: Exception) -> str:
    return short(str(error).strip().partition("\n")[0])


_NEEDS = "--segmenter onnx needs --model NETWORK.onnx and --classes CLASSES.json"


def _settings(config: MasksConfig) -> dict[str, Any]:
    return {
        "model": existing_file(config.model, _NEEDS),
        "classes": existing_file(config.classes, _NEEDS),
    }


def _load(config: MasksConfig, device: str, threads: int, warn: Callable[[str], None]) -> OnnxSegmenter:
    return OnnxSegmenter(**_settings(config), device=device, threads=threads)


FACTORY = SegmenterFactory(_settings, _load, (".onnx",))
