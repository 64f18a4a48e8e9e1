"""Networks that make masks, on tiny ones with random weights."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from text_networks import photo, save, transformers

from sagesplat.segment.hub import load_image_processor, load_tokenizer, quiet, read_config
from sagesplat.segment.mask_networks import (
    BOX_FAMILIES,
    WORD_FAMILIES,
    BoxMasks,
    ClipSeg,
    Sam3,
)

CPU = torch.device("cpu")
CORNERS = np.array([[10, 20, 100, 110], [0, 0, 159, 119], [50.5, 3, 60, 90]], np.float32)


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return {kind: save(tmp_path_factory.mktemp(kind), kind) for kind in ("sam", "sam2", "clipseg", "sam3")}


def box_masks(folder: Path) -> BoxMasks:
    with quiet():
        return BoxMasks(folder, "tiny", read_config(folder, "tiny", BOX_FAMILIES, "masks"), CPU)


def config(folder: Path) -> Any:
    return read_config(folder, "tiny", WORD_FAMILIES, "masks")


def test_masks_of_sam_are_those_of_its_own_post_processing(folders: dict[str, Path]) -> None:
    masks = box_masks(folders["sam"])
    logits = masks(photo(), CORNERS)
    assert logits.shape == (3, 24, 32)  # of 32 x 32, without the padding below
    processor = load_image_processor(folders["sam"])
    inputs = processor(images=photo(), return_tensors="pt")
    boxes = torch.from_numpy(CORNERS)[None] * (128 / 160)
    with torch.inference_mode():
        output = masks._model(inputs["pixel_values"], input_boxes=boxes, multimask_output=False)
    (own,) = processor.post_process_masks(
        output.pred_masks, inputs["original_sizes"], inputs["reshaped_input_sizes"],
        pad_size={"height": 128, "width": 128},
    )  # fmt: skip
    for mine, theirs in zip(logits, own[:, 0].numpy(), strict=True):
        resized = np.asarray(Image.fromarray(mine).resize((160, 120), Image.Resampling.BILINEAR))
        assert ((resized > 0) == theirs).mean() > 0.97  # theirs by way of the padded input


def test_sam2_gets_boxes_in_its_square(folders: dict[str, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    masks = box_masks(folders["sam2"])
    given: list[torch.Tensor] = []
    forward = masks._model.forward

    def noted(**options: Any) -> Any:
        given.append(options["input_boxes"])
        return forward(**options)

    monkeypatch.setattr(masks._model, "forward", noted)
    many = np.concatenate([CORNERS] * 12)
    logits = masks(photo(), many)
    assert [len(boxes[0]) for boxes in given] == [32, 4]
    np.testing.assert_allclose(given[0][0, 0], [8, 20 * 128 / 120, 80, 110 * 128 / 120], rtol=1e-6)
    assert logits.shape == (36, 32, 32)
    np.testing.assert_allclose(logits[:3], logits[33:], atol=1e-4)
    pixels = masks._input(photo())
    assert pixels.shape == (1, 3, 128, 128)
    mean = photo().reshape(-1, 3).mean(0) / 255
    expected = (mean - [0.485, 0.456, 0.406]) / np.array([0.229, 0.224, 0.225])
    np.testing.assert_allclose(pixels[0].mean((1, 2)), expected, atol=0.02)


def test_sam2_is_published_as_the_network_for_videos(folders: dict[str, Path], tmp_path: Path) -> None:
    folder = shutil.copytree(folders["sam2"], tmp_path / "video")
    about = json.loads((folder / "config.json").read_text())
    about |= {"model_type": "sam2_video", "architectures": ["Sam2VideoModel"]}
    (folder / "config.json").write_text(json.dumps(about))
    video, image = box_masks(folder), box_masks(folders["sam2"])
    np.testing.assert_array_equal(video(photo(), CORNERS), image(photo(), CORNERS))


def test_clipseg_has_a_mask_for_each_prompt_above_the_threshold(folders: dict[str, Path]) -> None:
    folder, words = folders["clipseg"], ["ivy", "stone fountain", "bench", "tree", "chair"]
    said: list[str] = []
    with quiet():
        find = ClipSeg(folder, "tiny", config(folder), CPU, words, 0.7, said.append)
    tokens = load_tokenizer(folder)(words, padding=True, return_tensors="pt")
    pixels = load_image_processor(folder)(images=[photo()] * 5, return_tensors="pt")["pixel_values"]
    with torch.inference_mode():
        p = find._model(pixel_values=pixels, **tokens).logits.sigmoid().numpy()
    found = find(photo())
    np.testing.assert_allclose(found.best, p.max((1, 2)), atol=1e-4)
    np.testing.assert_array_equal(found.prompts, np.flatnonzero(p.max((1, 2)) >= 0.7))
    np.testing.assert_array_equal(found.masks > 0, (p > 0.7)[found.prompts])
    assert not found.things
    assert (found.scores == 1).all()
    assert not said
    with quiet():
        none = ClipSeg(folder, "tiny", config(folder), CPU, words[:1], 0.999999, said.append)(photo())
    assert none.masks.shape == (0, 64, 64)


def test_sam3_finds_the_things_that_a_prompt_names(folders: dict[str, Path]) -> None:
    with quiet():
        find = Sam3(folders["sam3"], "tiny", CPU, ["ivy", "bench"], 0.25, [].append)
    found = find(photo())
    tokens = load_tokenizer(folders["sam3"])(
        ["ivy", "bench"], padding="max_length", max_length=32, return_tensors="pt"
    )
    with torch.inference_mode():
        output = find._model(find._input(photo()).expand(2, -1, -1, -1), **tokens)
    scores = (output.pred_logits.sigmoid() * output.presence_logits.sigmoid()).numpy()
    np.testing.assert_allclose(found.best, scores.max(1), atol=1e-5)
    prompts, queries = np.nonzero(scores >= 0.25)
    np.testing.assert_array_equal(found.prompts, prompts)
    np.testing.assert_allclose(found.masks, output.pred_masks.numpy()[prompts, queries], atol=1e-4)
    assert found.things
    assert transformers.Sam3Model is type(find._model)
