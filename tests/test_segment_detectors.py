"""Detectors by text, on tiny networks: their answers are those of transformers' own post-processing."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from text_networks import photo, save, transformers

from sagesplat.core.errors import LabelError
from sagesplat.segment.detectors import GroundingDino, Owlv2, detector
from sagesplat.segment.hub import load_image_processor, load_tokenizer, quiet, read_config

CPU = torch.device("cpu")
FAMILIES = {"grounding-dino", "owlv2"}


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return {kind: save(tmp_path_factory.mktemp(kind), kind) for kind in ("dino", "owlv2")}


def loaded(folder: Path, words: list[str], said: list[str] | None = None) -> Any:
    with quiet():
        config = read_config(folder, "tiny", FAMILIES, "detection by text")
        return detector(folder, "tiny", config, CPU, words, (said if said is not None else []).append)


def test_grounding_dino_is_asked_as_its_own_processor_asks(folders: dict[str, Path]) -> None:
    words = ["Stone Fountain", "ivy", "wooden bench"]
    detect = loaded(folders["dino"], words)
    assert isinstance(detect.score, GroundingDino)
    processor = transformers.GroundingDinoProcessor(
        load_image_processor(folders["dino"]), load_tokenizer(folders["dino"])
    )
    inputs = processor(images=photo(), text=words, return_tensors="pt")
    with torch.inference_mode():
        output = detect.score.model(**inputs)
    p = output.logits[0].sigmoid().numpy()
    expected = np.stack([p[:, 1:3].mean(1), p[:, 4], p[:, 6:8].mean(1)], 1)
    (boxes,) = processor.post_process_grounded_object_detection(
        output, threshold=0, text_threshold=0, target_sizes=[(120, 160)]
    )
    found = detect(photo(), 0.2)
    np.testing.assert_allclose(found.best, expected.max(0), atol=1e-5)
    for prompt, score, corners in zip(found.prompts, found.scores, found.corners, strict=True):
        row = np.abs(expected[:, prompt] - score).argmin()
        assert expected[row, prompt] == pytest.approx(score, abs=1e-5)
        whole = boxes["boxes"][row].numpy().clip(0, [160, 120, 160, 120])
        np.testing.assert_allclose(corners, whole, atol=1e-3)
    assert len(found.scores) > 3
    assert found.scores.min() >= 0.2
    assert found.scores.tolist() == sorted(found.scores, reverse=True)


def test_more_prompts_than_a_text_holds_are_asked_for_in_several_passes(folders: dict[str, Path]) -> None:
    words = ["stone fountain", "ivy", "wooden bench", "tree", "chair", "stone bench"]
    together = loaded(folders["dino"], words)
    assert list(together.score.passes()) == [[0, 1, 2, 3], [4, 5]]  # of up to 12 tokens
    best = together(photo(), 0.5).best
    for some in (slice(0, 4), slice(4, 6)):
        alone = loaded(folders["dino"], words[some])
        assert len(list(alone.score.passes())) == 1
        np.testing.assert_allclose(best[some], alone(photo(), 0.5).best, atol=1e-5)
    assert set(together(photo(), 0.01).prompts.tolist()) == set(range(6))


def test_words_that_are_not_known_or_too_many_are_said(folders: dict[str, Path]) -> None:
    said: list[str] = []
    detect = loaded(folders["dino"], ["喷泉", "ivy " * 20], said)
    assert said == [
        "tiny: knows none of the words of '喷泉'; it was trained on English",
        f"tiny: reads 9 of the 20 tokens of {'ivy ' * 20!r}; shorten it",
    ]
    assert len(detect(photo(), 0.01).best) == 2
    said.clear()
    loaded(folders["owlv2"], ["ivy", "stone fountain with ivy"], said)
    assert said == ["tiny: reads 16 of the 22 tokens of 'stone fountain with ivy'; shorten it"]


@pytest.mark.parametrize("size", [(120, 160), (160, 90)])
def test_owlv2_finds_what_its_own_post_processing_finds(
    folders: dict[str, Path], size: tuple[int, int]
) -> None:
    words = ["fountain", "ivy"]
    detect = loaded(folders["owlv2"], words)
    assert isinstance(detect.score, Owlv2)
    tokenizer, processor = load_tokenizer(folders["owlv2"]), load_image_processor(folders["owlv2"])
    inputs = tokenizer(words, padding="max_length", max_length=16, return_tensors="pt")
    inputs |= processor(images=photo(*size), return_tensors="pt")
    with torch.inference_mode():
        output = detect.score.model(
            inputs["input_ids"], inputs["pixel_values"], attention_mask=inputs["attention_mask"]
        )
    (own,) = processor.post_process_object_detection(output, threshold=0, target_sizes=[size])
    found = detect(photo(*size), 0.3)
    np.testing.assert_allclose(found.best, output.logits[0].sigmoid().amax(0), atol=1e-5)
    corners = own["boxes"].numpy().clip(0, [size[1], size[0]] * 2)
    assert len(found.corners) > 2
    for corner in found.corners:
        assert np.abs(corners - corner).max(1).min() < 1e-3
    best = int(own["scores"].argmax())
    assert found.prompts[0] == own["labels"][best]
    np.testing.assert_allclose(found.scores[0], own["scores"][best], atol=1e-5)


def test_scores_that_are_no_numbers(folders: dict[str, Path]) -> None:
    detect = loaded(folders["owlv2"], ["ivy"])
    with torch.no_grad():
        detect.score.model.class_head.logit_scale.weight.fill_(float("nan"))
    with pytest.raises(LabelError, match="tiny: scores that are not finite"):
        detect(photo(), 0.1)
