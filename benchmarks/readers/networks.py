"""Readers of networks and their weights: ONNX, classes, LPIPS, DeepLab."""

import io
import json
import struct
from collections import OrderedDict
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import torch

from benchmarks.hostile import MIB, Reader
from benchmarks.readers.making import as_json, file
from sagesplat.metrics import lpips
from sagesplat.segment import deeplabv2
from sagesplat.segment.onnx import OnnxSegmenter, read_classes

CLASSES = {"classes": ["sky", "x"], "coco_panoptic": {"sky": 187, "x": None}, "mean": [0.4, 0.5, 0.6]}
FLOAT, INTS = 1, 7  # of a tensor's elements, and of an attribute
PHOTO = np.full((12, 16, 3), 99, np.uint8)
# LPIPS in small: its layers, with two channels each
LAYOUT = lpips._Layout((3,) * 5, ((2,),) * 5, (1, 2), 3, 1, 12)


def _field(number: int, value: int | str | bytes) -> bytes:
    """One field of a protobuf message."""
    if isinstance(value, int):
        return _varint(number << 3) + _varint(value)
    value = value.encode() if isinstance(value, str) else value
    return _varint(number << 3 | 2) + _varint(len(value)) + value


def _varint(value: int) -> bytes:
    low, rest = value & 0x7F, value >> 7
    return bytes([low | 0x80]) + _varint(rest) if rest else bytes([low])


def _value(name: str, *shape: int) -> bytes:
    dims = b"".join(_field(1, _field(1, length)) for length in shape)
    return _field(1, name) + _field(2, _field(1, _field(1, FLOAT) + _field(2, dims)))


def _node(kind: str, inputs: list[str], output: str, **ints: tuple[int, ...]) -> bytes:
    attributes = b"".join(
        _field(5, _field(1, name) + b"".join(_field(8, i) for i in values) + _field(20, INTS))
        for name, values in ints.items()
    )
    return _field(
        1, b"".join(_field(1, i) for i in inputs) + _field(2, output) + _field(4, kind) + attributes
    )


def _onnx(folder: Path, size: int) -> list[bytes]:
    """The mean of each 4 x 4 block, then a linear map of the channels for each of 2 * size classes."""
    names = [f"c{i}" for i in range(2 * size)]
    listed = {"classes": names, "coco_panoptic": {name: 500 + i for i, name in enumerate(names)}}
    (folder / "classes.json").write_text(json.dumps(listed))
    weights = np.linspace(-1, 1, 6 * size, dtype=np.float32)
    tensor = b"".join(_field(1, d) for d in (2 * size, 3, 1, 1)) + _field(2, FLOAT) + _field(8, "weights")
    tensor += _field(9, struct.pack(f"<{weights.size}f", *weights))
    graph = _node("AveragePool", ["photo"], "pooled", kernel_shape=(4, 4), strides=(4, 4))
    graph += _node("Conv", ["pooled", "weights"], "logits", kernel_shape=(1, 1))
    graph += _field(2, "blocks") + _field(5, tensor) + _field(11, _value("photo", 1, 3, 12, 16))
    graph += _field(12, _value("logits", 1, 2 * size, 3, 4))
    return [_field(1, 8) + _field(7, graph) + _field(8, _field(2, 13))]


def _read_onnx(path: Path) -> None:
    OnnxSegmenter(path, path.with_name("classes.json"), device="cpu")([PHOTO])


def _classes(folder: Path, size: int) -> list[bytes]:
    names = ["sky", *(f"thing {i}" for i in range(size))]
    ids = {name: 187 if name == "sky" else None for name in names}
    return as_json(
        CLASSES | {"classes": names, "coco_panoptic": ids}, {"classes": ["sky"], "vocabulary": "ade20k"}
    )


def _lpips(folder: Path, size: int) -> list[bytes]:
    content = io.BytesIO()
    with patch.dict(lpips._LAYOUTS, {"alex": LAYOUT}):
        arrays: Any = {name: np.ones(shape, np.float32) for name, shape in lpips.shapes("alex").items()}
    np.savez(content, **arrays)
    return [content.getvalue()]


def _read_lpips(path: Path) -> None:
    with patch.dict(lpips._LAYOUTS, {"alex": LAYOUT}):
        lpips.load_lpips("alex", path)


def _state(size: int) -> dict[str, torch.Tensor]:
    """A state dict of the port's names: one convolution, and a counter of training."""
    return OrderedDict(
        {"module.conv1.weight": torch.ones(2 * size, 3), "bn1.num_batches_tracked": torch.tensor(7)}
    )


def _deeplab(folder: Path, size: int) -> list[bytes]:
    (folder / "size").write_text(str(2 * size))
    files = []
    for new, content in ((True, _state(size)), (True, {"state_dict": _state(size)}), (False, _state(size))):
        saved = io.BytesIO()
        torch.save(content, saved, _use_new_zipfile_serialization=new)
        files.append(saved.getvalue())
    return files


def _safetensors(folder: Path, size: int) -> list[bytes]:
    from safetensors.torch import save

    (folder / "size").write_text(str(2 * size))
    return [save(_state(size))]


def _read_deeplab(path: Path) -> None:
    """What `load_deeplabv2` does, for a network of one convolution."""
    wanted = {"conv1.weight": torch.ones(int(path.with_name("size").read_text()), 3)}
    found: Any = deeplabv2._renamed(path, deeplabv2._read_weights(path))
    deeplabv2._check(path, found, wanted)
    found["conv1.weight"].float()


READERS = (
    Reader("onnx", ".onnx", _onnx, file("m.onnx", _read_onnx), 300, 16 * MIB),
    Reader("classes", ".json", _classes, file("c.json", read_classes), 1000),
    Reader("lpips", ".npz", _lpips, file("l.npz", _read_lpips), 1),
    Reader("deeplab", ".pth", _deeplab, file("w.pth", _read_deeplab), 3000, 2 * MIB),
    Reader("safetensors", ".safetensors", _safetensors, file("w.safetensors", _read_deeplab), 3000),
)
