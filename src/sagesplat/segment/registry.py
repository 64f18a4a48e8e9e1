"""The segmenters that `--segmenter` can name; a new one is a file with a `FACTORY` and a line here."""

from pathlib import Path

from sagesplat.segment import deeplabv2, hf, onnx, text
from sagesplat.segment.segmenters import SegmenterFactory

SEGMENTERS: dict[str, SegmenterFactory] = {
    "hf": hf.FACTORY,
    "onnx": onnx.FACTORY,
    "deeplabv2": deeplabv2.FACTORY,
    "text": text.FACTORY,
}
DEFAULT = "hf"


def segmenter_for(model: str | None) -> str:
    """The kind of segmenter that a `--model` is for, by its suffix; `DEFAULT` without one that is known."""
    suffix = Path(model or "").suffix
    return next((kind for kind, factory in SEGMENTERS.items() if suffix in factory.suffixes), DEFAULT)
