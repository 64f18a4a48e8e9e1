"""Segmentation by text: settings, loading, and what becomes of a fake network's answers."""

from pathlib import Path

import numpy as np
import pytest
import torch
from text_networks import photo, save

from sagesplat.core.config import MasksConfig
from sagesplat.core.errors import LabelError, RunError, SageError
from sagesplat.segment.detections import Found
from sagesplat.segment.masks import Taxonomy
from sagesplat.segment.prompts import prompts_of
from sagesplat.segment.registry import SEGMENTERS
from sagesplat.segment.segmenters import Segmented, Segmenter
from sagesplat.segment.text import TextOver, TextSegmenter, load_text, settings

WORDS = "stone fountain; ivy; wooden bench; tree"


class Finds:
    """Finds its prompts in columns of a photo: prompt, score, columns."""

    threshold = 0.3

    def __init__(self, *each: tuple[int, float, slice], best: list[float]):
        self.each, self.best = each, best

    def __call__(self, image: np.ndarray, /) -> Found:
        masks = np.full((len(self.each), *image.shape[:2]), -20, np.float32)
        for row, (_, _, columns) in enumerate(self.each):
            masks[row, :, columns] = 20
        prompts = np.array([prompt for prompt, _, _ in self.each], np.int64)
        scores = np.array([score for _, score, _ in self.each], np.float32)
        return Found(prompts, scores, masks, np.array(self.best, np.float32))


def test_prompts_label_what_is_found_and_remember_their_best_scores() -> None:
    finder = Finds((1, 0.6, slice(0, 3)), (0, 0.5, slice(2, 5)), best=[0.5, 0.6])
    segmenter = TextSegmenter(finder, prompts_of(["fountain", "trees"], {}))
    assert segmenter.taxonomy.names == {184: "tree-merged", 201: "fountain"}
    (answer,) = segmenter([photo(4, 8)])
    np.testing.assert_array_equal(answer.label_ids[0], [184, 184, 184, 201, 201, -1, -1, -1])
    assert answer.instances is not None
    np.testing.assert_array_equal(answer.instances[0], [0, 0, 0, 1, 1, -1, -1, -1])
    finder.best = [0.1, 0.7]
    assert len(segmenter([photo(4, 8), photo(6, 8)])) == 2
    assert segmenter.best == {"fountain": pytest.approx(0.5), "tree-merged": pytest.approx(0.7)}


class Lawn:
    """All is lawn, or a tree."""

    taxonomy = Taxonomy({7: "lawn", 184: "tree-merged"})

    def __call__(self, photos, /) -> list[Segmented]:
        ids = np.array([7, 184], np.int16)
        each = np.zeros((4, 8), int)
        each[:, 6:] = 1
        return [Segmented(ids[each]) for _ in photos]


def test_prompts_over_another_segmenter() -> None:
    base: Segmenter = Lawn()
    prompts = prompts_of(["fountain", "tree"], base.taxonomy.names)
    finder = Finds((0, 0.65, slice(0, 3)), (1, 0.65, slice(3, 4)), best=[0.65, 0.65])
    both = TextOver(base, TextSegmenter(finder, prompts))
    assert both.taxonomy.names == {7: "lawn", 184: "tree-merged", 201: "fountain"}
    (answer,) = both([photo(4, 8)])
    np.testing.assert_array_equal(answer.label_ids[0], [201, 201, 201, 184, 7, 7, 184, 184])
    assert both.best == {"fountain": pytest.approx(0.65), "tree-merged": pytest.approx(0.65)}


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    kinds = ("dino", "owlv2", "sam", "sam2", "clipseg", "sam3")
    return {kind: str(save(tmp_path_factory.mktemp(kind), kind)) for kind in kinds}


def config_of(folders: dict[str, str], model: str, masks: str | None, threshold: float = 0.01) -> MasksConfig:
    return MasksConfig(
        segmenter="text", prompts=WORDS, model=folders[model], prompt_threshold=threshold,
        mask_model=None if masks is None else folders[masks],
    )  # fmt: skip


@pytest.mark.parametrize(
    ("model", "masks"), [("dino", "sam2"), ("owlv2", "sam"), ("clipseg", None), ("sam3", None)]
)
def test_networks_of_all_families_segment(folders: dict[str, str], model: str, masks: str | None) -> None:
    said: list[str] = []
    config = config_of(folders, model, masks)
    segmenter = SEGMENTERS["text"].load(config, "cpu", torch.get_num_threads(), said.append)
    assert f"network {folders[model]};" in said[0]
    assert segmenter.taxonomy.names == {
        184: "tree-merged", 201: "stone fountain", 202: "ivy", 203: "wooden bench",
    }  # fmt: skip
    photos = [photo(), photo(90, 70, seed=1)]
    answers = segmenter(photos)
    for image, answer in zip(photos, answers, strict=True):
        assert answer.label_ids.shape == image.shape[:2]
        assert set(np.unique(answer.label_ids)) <= {-1, 184, 201, 202, 203}
        assert (answer.label_ids != -1).any()
        assert (answer.instances is None) == (model == "clipseg")
        if answer.instances is not None:
            np.testing.assert_array_equal(answer.instances >= 0, answer.label_ids >= 0)
    assert isinstance(segmenter, TextSegmenter)
    assert min(segmenter.best.values()) > 0.01


def test_networks_of_the_wrong_kind(folders: dict[str, str], tmp_path: Path) -> None:
    silent = save(tmp_path / "silent", "owlv2")
    for name in ("vocab.json", "merges.txt", "tokenizer_config.json"):
        (silent / name).unlink()
    cases: list[tuple[str, str | None, str]] = [
        (folders["sam2"], None, "a network of kind sam2; take one of clipseg, grounding-dino, "),
        (folders["dino"], folders["owlv2"], "a network of kind owlv2; take one of sam, sam2, sam2_video"),
        (folders["clipseg"], folders["sam"], "kind clipseg makes masks itself; leave out --mask-model"),
        (str(silent), folders["sam2"], "cannot be loaded .*tokenizer"),
    ]
    for model, masks, complaint in cases:
        config = MasksConfig(segmenter="text", prompts="ivy", model=model, mask_model=masks)
        with pytest.raises(LabelError, match=complaint):
            load_text(config, "cpu", 1, [].append, {})


def test_what_the_answers_depend_on(tmp_path: Path) -> None:
    config = MasksConfig(segmenter="text", prompts="ivy; the tree")
    assert settings(config) == {
        "model": "IDEA-Research/grounding-dino-tiny", "mask_model": "facebook/sam2.1-hiera-tiny",
        "prompts": ["ivy", "the tree"], "prompt_threshold": 0.0,
    }  # fmt: skip
    given = MasksConfig(segmenter="text", prompts="ivy", model=str(tmp_path), mask_model="a/b")
    assert settings(given) | {"prompts": 0} == {
        "model": tmp_path, "mask_model": "a/b", "prompts": 0, "prompt_threshold": 0.0,
    }  # fmt: skip
    over = MasksConfig(segmenter="hf", prompts="ivy", model="eomt", prompt_model="google/owl")
    assert settings(over)["model"] == "google/owl"


@pytest.mark.parametrize(
    ("config", "complaint"),
    [
        (MasksConfig(segmenter="text"), '--segmenter text needs --prompts "stone fountain; ivy'),
        (MasksConfig(segmenter="text", prompts=" "), "needs --prompts"),
        (MasksConfig(prompts="a;;b"), "one is empty"),
        (
            MasksConfig(prompts="ivy", prompt_threshold=1.0),
            "--prompt-threshold 1.0 is impossible; choose a number from 0 to below 1",
        ),
        (MasksConfig(prompts="ivy", prompt_threshold=float("nan")), "--prompt-threshold nan is impossible"),
        (MasksConfig(segmenter="text", prompts="ivy", model="a", prompt_model="b"), "leave one of them"),
    ],
)
def test_settings_that_cannot_be(config: MasksConfig, complaint: str) -> None:
    with pytest.raises(SageError, match=complaint) as caught:
        SEGMENTERS["text"].settings(config)
    assert isinstance(caught.value, RunError | LabelError)


def test_the_usual_threshold_is_the_family_s(folders: dict[str, str]) -> None:
    for model, masks, usual in (("dino", "sam2", 0.3), ("owlv2", "sam", 0.2), ("sam3", None, 0.5)):
        config = config_of(folders, model, masks, threshold=0)
        assert load_text(config, "cpu", 1, [].append, {}).threshold == usual
