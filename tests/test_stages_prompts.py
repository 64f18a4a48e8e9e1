"""Segmentation by text as a stage: it resumes, says how long it takes, and what was found nowhere."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sagesplat.core.config import MasksConfig, SceneConfig
from sagesplat.core.errors import RunError
from sagesplat.core.events import Event, Noted, StageDone, Warned
from sagesplat.demo.capture import make_capture
from sagesplat.run.job import Job
from sagesplat.run.run_dir import RunDir
from sagesplat.segment import text
from sagesplat.segment.detections import Found
from sagesplat.segment.masks import Taxonomy
from sagesplat.segment.segmenters import Segmented
from sagesplat.stages.label import make_masks, segmenter_kind
from sagesplat.stages.prompts import read_scores
from sagesplat.stages.scene import open_scene

CONFIG = MasksConfig(segmenter="text", prompts="stone fountain; ivy; tree")


class Left:
    """Finds the first prompt in the left half of a photo, and the others nowhere."""

    threshold = 0.3
    calls = 0
    killed_after: int | None = None

    def __init__(self, words: list[str]):
        self.words = words

    def __call__(self, photo: np.ndarray, /) -> Found:
        if Left.calls == Left.killed_after:
            raise KeyboardInterrupt
        Left.calls += 1
        mask = np.full((1, *photo.shape[:2]), -20, np.float32)
        mask[:, :, : photo.shape[1] // 2] = 20
        best = np.full(len(self.words), 0.125, np.float32)
        best[0] = 0.65
        if self.words[0] == "nothing":
            return Found(np.zeros(0, int), best[:0], mask[:0], best / 4)
        if "basin" in self.words:  # the same but for a column
            both = np.concatenate([mask, mask])
            both[1, :, 0] = -20
            rows = np.array([0, self.words.index("basin")])
            return Found(rows, np.array([0.65, 0.6], np.float32), both, best)
        return Found(np.zeros(1, int), best[:1], mask, best)


@pytest.fixture(autouse=True)
def fake(monkeypatch: pytest.MonkeyPatch) -> None:
    def finder(config: MasksConfig, words: list[str], device: Any, warn: Callable[[str], None]) -> Left:
        return Left(words)

    monkeypatch.setattr(text, "_finder", finder)
    monkeypatch.setattr(Left, "calls", 0)
    monkeypatch.setattr(Left, "killed_after", None)


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("demo") / "capture"
    make_capture(folder, views=6, width=64, height=48)
    return folder


def begun(run: Path, capture: Path, **options: Any) -> tuple[Job, list[Event]]:
    events: list[Event] = []
    job = Job(RunDir(run), events.append, **options)
    open_scene(job, capture, SceneConfig(calibrate_every=0))
    return job, events


def warnings(events: list[Event]) -> list[str]:
    return [event.text for event in events if isinstance(event, Warned)]


def test_words_become_categories_and_what_is_found_nowhere_is_said(capture: Path, tmp_path: Path) -> None:
    job, events = begun(tmp_path / "run", capture)
    make_masks(job, CONFIG)
    assert job.taxonomy.names == {201: "stone fountain"}
    label_ids = job.masks[job.scene.views[0]]
    assert (label_ids[:, :32] == 201).all()
    assert (label_ids[:, 32:] == -1).all()
    said = warnings(events)
    for name in ("ivy", "tree-merged"):
        assert (
            f"prompt '{name}': found in no photo; its best score is 0.12 and 0.3 is needed: describe it in "
            "other words, or lower --prompt-threshold" in said
        )
    lines = next(event.lines for event in events if isinstance(event, StageDone) and event.name == "segment")
    assert lines == ("best scores: stone fountain 0.65, ivy 0.12, tree-merged 0.12",)
    (time,) = [event.text for event in events if isinstance(event, Noted)]
    assert time == "segmentation takes about 1 s for 6 photos on this machine"
    make_masks(job, CONFIG)  # done
    assert Left.calls == 6
    with pytest.raises(RunError, match="prompts"):
        make_masks(job, MasksConfig(segmenter="text", prompts="stone fountain"))


def test_a_killed_segmentation_goes_on(capture: Path, tmp_path: Path) -> None:
    Left.killed_after = 4
    job, _ = begun(tmp_path / "run", capture)
    with pytest.raises(KeyboardInterrupt):
        make_masks(job, CONFIG)
    known = read_scores(job.run.segmented / ".prompts-0.json")
    assert (known.best["ivy"], known.threshold) == (pytest.approx(0.125), 0.3)
    assert known.shared == {"stone fountain=stone fountain": 2.0}
    Left.killed_after = None
    job, events = begun(tmp_path / "run", capture)
    make_masks(job, CONFIG)
    assert Left.calls == 6
    assert any("for 2 photos" in event.text for event in events if isinstance(event, Noted))
    other = MasksConfig(segmenter="text", prompts="wooden bench", prompt_threshold=0.4)
    job, _ = begun(tmp_path / "run", capture, force=True)
    make_masks(job, other)
    assert Left.calls == 12
    assert job.taxonomy.names == {201: "wooden bench"}


class Grass:
    """All is grass."""

    taxonomy = Taxonomy({193: "grass-merged"})
    note = None

    def __init__(self, *_: Any, **__: Any) -> None:
        pass

    def __call__(self, photos: Any) -> list[Segmented]:
        return [Segmented(np.full(photo.shape[:2], 193, np.int16)) for photo in photos]


def test_words_over_a_network_s_categories(
    capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from sagesplat.segment import hf

    monkeypatch.setattr(hf, "HfSegmenter", Grass)
    job, _ = begun(tmp_path / "run", capture)
    make_masks(job, MasksConfig(segmenter="hf", model="a/b", prompts="stone fountain"))
    assert job.taxonomy.names == {193: "grass-merged", 201: "stone fountain"}
    label_ids = job.masks[job.scene.views[0]]
    assert (label_ids == np.where(np.arange(64) < 32, 201, 193)).all()
    with pytest.raises(RunError, match="over-prompts"):
        make_masks(job, MasksConfig(segmenter="hf", model="a/b", prompts="ivy"))


def test_prompts_imply_the_segmenter_unless_another_source_is_named(tmp_path: Path) -> None:
    (tmp_path / "masks").mkdir()
    assert segmenter_kind(tmp_path, MasksConfig()) == "masks"
    assert segmenter_kind(tmp_path, MasksConfig(prompts="ivy")) == "masks"
    assert segmenter_kind(tmp_path, MasksConfig(prompts="ivy", segmenter="text")) == "text"
    assert segmenter_kind(tmp_path / "other", MasksConfig(prompts="ivy")) == "text"
    assert segmenter_kind(tmp_path, MasksConfig(prompts="ivy", model="n.onnx")) == "onnx"


def test_words_over_given_label_images(capture: Path, tmp_path: Path) -> None:
    job, _ = begun(tmp_path / "plain", capture)
    make_masks(job, MasksConfig())
    plain = {view.name: job.masks[view] for view in job.scene.views}
    Left.killed_after = 4
    job, events = begun(tmp_path / "run", capture)
    config = MasksConfig(prompts="stone fountain; ivy")
    with pytest.raises(KeyboardInterrupt):
        make_masks(job, config)
    Left.killed_after = None
    job, events = begun(tmp_path / "run", capture)
    make_masks(job, config)
    assert Left.calls == 6
    (fountain,) = (i for i, name in job.taxonomy.names.items() if name == "stone fountain")
    for view in job.scene.views:
        left = np.arange(64) < 32
        assert np.array_equal(job.masks[view], np.where(left, fountain, plain[view.name]))
    assert any("prompt 'ivy': found in no photo" in line for line in warnings(events))
    make_masks(job, config)
    assert Left.calls == 6


def test_a_word_for_a_given_category_is_that_one(capture: Path, tmp_path: Path) -> None:
    job, _ = begun(tmp_path / "run", capture)
    before = Taxonomy.read(capture / "masks" / "labels.json").names
    label, name = next(iter(before.items()))
    make_masks(job, MasksConfig(prompts=name))
    assert (job.masks[job.scene.views[0]][:, :32] == label).all()
    assert set(job.taxonomy.names) <= set(before)


def test_two_words_for_the_same_masks_are_said(capture: Path, tmp_path: Path) -> None:
    job, events = begun(tmp_path / "run", capture)
    make_masks(job, MasksConfig(segmenter="text", prompts="stone fountain; ivy; basin; wooden bench"))
    assert [line for line in warnings(events) if "the same for both" in line] == [
        "prompts 'stone fountain' and 'basin': the network finds the same for both (their masks overlap by "
        '97%); leave one of them, or add --labels.merge "basin=stone fountain"'
    ]
