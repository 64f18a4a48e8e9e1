"""The registry of segmenters: what the command line offers, and what a new one takes."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import get_args, get_type_hints

import numpy as np
import pytest

from sagesplat.core.config import MasksConfig, SceneConfig
from sagesplat.core.errors import RunError
from sagesplat.core.events import Event, Warned
from sagesplat.demo.capture import make_capture
from sagesplat.io.files import read_json
from sagesplat.run.job import Job
from sagesplat.run.run_dir import RunDir
from sagesplat.segment.masks import Taxonomy
from sagesplat.segment.registry import SEGMENTERS, segmenter_for
from sagesplat.segment.segmenters import Segmented, SegmenterFactory
from sagesplat.stages.label import make_masks
from sagesplat.stages.scene import open_scene


def test_the_command_line_offers_every_segmenter() -> None:
    offered = get_args(get_type_hints(MasksConfig)["segmenter"])
    assert set(offered) == {"auto", "masks", *SEGMENTERS}
    assert len(offered) == len(SEGMENTERS) + 2


@pytest.mark.parametrize(
    ("model", "kind"),
    [
        (None, "hf"), ("tue-mps/coco", "hf"), ("network.onnx", "onnx"), ("a/b.pth", "deeplabv2"),
        ("b.pt", "deeplabv2"), ("b.safetensors", "deeplabv2"),
    ],
)  # fmt: skip
def test_the_suffix_of_a_model_tells_its_segmenter(model: str | None, kind: str) -> None:
    assert segmenter_for(model) == kind


class Threshold:
    """Bright pixels are of one category, dark ones of another."""

    taxonomy = Taxonomy({1: "dark", 2: "bright"})

    def __init__(self, level: int) -> None:
        self.level = level

    def __call__(self, photos: Sequence[np.ndarray], /) -> list[Segmented]:
        ids = np.array([1, 2], np.int16)
        return [Segmented(ids[(p[..., 0] > self.level).astype(int)]) for p in photos]


def _load(config: MasksConfig, device: str, threads: int, warn: Callable[[str], None]) -> Threshold:
    warn(f"threshold on {device} with {threads}")
    return Threshold(int(Path(config.model or "").read_text()))


def test_a_new_segmenter_is_one_entry(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    factory = SegmenterFactory(lambda config: {"level": Path(config.model or "")}, _load, (".level",))
    monkeypatch.setitem(SEGMENTERS, "threshold", factory)
    make_capture(tmp_path / "capture", views=8, width=64, height=48)
    (tmp_path / "my.level").write_text("127")
    events: list[Event] = []
    job = Job(RunDir(tmp_path / "run"), events.append, threads=3)
    open_scene(job, tmp_path / "capture", SceneConfig())
    make_masks(job, MasksConfig(model=str(tmp_path / "my.level")))
    assert set(job.taxonomy.names.values()) == {"dark", "bright"}
    assert Warned("threshold on auto with 3") in events
    settings = read_json(job.run.provenance("segment"))["settings"]
    assert settings["segmenter"] == "threshold"
    assert len(settings["level"]) == 64  # of the file's content


@pytest.mark.parametrize(
    ("kind", "config", "message"),
    [
        ("onnx", MasksConfig(), "--segmenter onnx needs --model"),
        ("onnx", MasksConfig(model=__file__), "--segmenter onnx needs --model .* and --classes"),
        ("deeplabv2", MasksConfig(model="no.pth"), "no.pth: no such file; --segmenter deeplabv2 needs"),
    ],
)
def test_missing_files_are_named(kind: str, config: MasksConfig, message: str) -> None:
    with pytest.raises(RunError, match=message):
        SEGMENTERS[kind].settings(config)
