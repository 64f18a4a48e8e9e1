import json
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from sagesplat.core.errors import BackendUnavailable, LabelError, OutOfMemory
from sagesplat.segment import coco, panoptic
from sagesplat.segment.hf import HfSegmenter, _Answer, class_ids
from sagesplat.segment.hub import prepared, torch_device
from sagesplat.segment.segmenters import Segmenter

transformers: Any = pytest.importorskip("transformers", reason="needs sagesplat[hf]")

NAMES = ["person", "sky-other-merged", "Tree_merged", "car"]
IDS = [1, 187, 184, 3]
SWIN = {
    "embed_dim": 8, "depths": [1, 1, 1, 1], "num_heads": [1, 1, 1, 1], "window_size": 4, "image_size": 64,
    "out_features": ["stage1", "stage2", "stage3", "stage4"],
}  # fmt: skip
SMALL = {
    "hidden_dim": 32, "encoder_feedforward_dim": 16, "encoder_layers": 1, "decoder_layers": 2,
    "num_attention_heads": 2, "dim_feedforward": 16, "num_queries": 5,
}  # fmt: skip
EDGES = {"shortest_edge": 64, "longest_edge": 96}


def labels(names: list[str]) -> dict[str, dict[int, str]]:
    return {"id2label": dict(enumerate(names))}


def eomt(names: list[str]) -> Any:
    config = transformers.EomtConfig(
        hidden_size=16, num_hidden_layers=2, num_attention_heads=2, image_size=64, patch_size=16,
        num_blocks=1, num_queries=5, num_register_tokens=1, **labels(names),
    )  # fmt: skip
    return transformers.EomtForUniversalSegmentation(config)


def mask2former(names: list[str]) -> Any:
    config = transformers.Mask2FormerConfig(
        backbone_config=transformers.SwinConfig(**SWIN), feature_size=32, mask_feature_size=32,
        **SMALL, **labels(names),
    )  # fmt: skip
    return transformers.Mask2FormerForUniversalSegmentation(config)


def oneformer(names: list[str]) -> Any:
    config = transformers.OneFormerConfig(
        backbone_config=transformers.SwinConfig(**SWIN), task_seq_len=9, text_encoder_width=16,
        text_encoder_context_length=9, text_encoder_num_layers=1, text_encoder_vocab_size=40, conv_dim=32,
        mask_dim=32, query_dec_layers=1, **SMALL, **labels(names),
    )  # fmt: skip
    return transformers.OneFormerForUniversalSegmentation(config)


def detr(names: list[str]) -> Any:
    stages = {"hidden_sizes": [8, 8, 16, 16], "depths": [1, 1, 1, 1], "embedding_size": 8}
    config = transformers.DetrConfig(
        use_timm_backbone=False,
        backbone_config=transformers.ResNetConfig(**stages, out_features=SWIN["out_features"]),
        d_model=32, encoder_layers=1, decoder_layers=1, encoder_ffn_dim=16, decoder_ffn_dim=16,
        encoder_attention_heads=8, decoder_attention_heads=8, num_queries=5, **labels(names),
    )  # fmt: skip
    return transformers.DetrForSegmentation(config)


PROCESSORS = {
    "eomt": {"image_processor_type": "EomtImageProcessor", "size": {"shortest_edge": 64, "longest_edge": 64}}
    | {"do_pad": True},
    "crops": {
        "image_processor_type": "EomtImageProcessor",
        "size": {"shortest_edge": 64, "longest_edge": None},
    }
    | {"do_split_image": True},
    "mask2former": {"image_processor_type": "Mask2FormerImageProcessor", "size": {"height": 64, "width": 96}},
    "oneformer": {"image_processor_type": "OneFormerImageProcessor", "size": EDGES}
    | {"class_info_file": "coco_panoptic.json", "repo_path": "shi-labs/oneformer_demo"},
    "detr": {"feature_extractor_type": "DetrFeatureExtractor", "size": EDGES},
}
MODELS: dict[str, Callable[[list[str]], Any]] = {
    "eomt": eomt, "crops": eomt, "mask2former": mask2former, "oneformer": oneformer, "detr": detr,
}  # fmt: skip


def save(folder: Path, kind: str, names: list[str]) -> Path:
    """A tiny network with random weights as checkpoints are published."""
    torch.manual_seed(3)
    transformers.utils.logging.disable_progress_bar()
    model = MODELS[kind](names)
    with torch.no_grad():
        for parameter in model.parameters():  # more decided than a fresh network
            parameter.mul_(3)
    model.save_pretrained(folder)
    (folder / "preprocessor_config.json").write_text(json.dumps(PROCESSORS[kind]))
    if kind == "oneformer":
        letters = sorted(set("thetaskissemantic"))
        tokens = ["<|startoftext|>", "<|endoftext|>", *letters, *(c + "</w>" for c in letters)]
        (folder / "vocab.json").write_text(json.dumps({token: i for i, token in enumerate(tokens)}))
        (folder / "merges.txt").write_text("#version: 0.2\n")
        (folder / "tokenizer_config.json").write_text(json.dumps({"tokenizer_class": "CLIPTokenizer"}))
    return folder


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return {kind: save(tmp_path_factory.mktemp(kind), kind, NAMES) for kind in MODELS}


def noise(height: int, width: int) -> np.ndarray:
    """A photo with something in it."""
    coarse = np.random.default_rng(0).integers(0, 256, (4, 6, 3), dtype=np.uint8)
    return np.asarray(Image.fromarray(coarse).resize((width, height)))


@pytest.mark.parametrize("kind", ["crops", "mask2former", "oneformer", "detr"])
@pytest.mark.parametrize("size", [(400, 600), (600, 400)])
def test_labels_are_those_of_the_network_s_own_post_processing(
    folders: dict[str, Path], kind: str, size: tuple[int, int]
) -> None:
    segmenter = HfSegmenter(folders[kind], device="cpu")
    (found,) = segmenter([noise(*size)])
    inputs = prepared(segmenter._processor, [noise(*size)], "tiny")
    more = {} if segmenter._task is None else {"task_inputs": segmenter._task}
    with torch.inference_mode():
        pixels = inputs["pixel_values"]
        output = segmenter._model(pixel_values=pixels, **(more if kind != "crops" else {}))
    if kind == "crops":
        output.patch_offsets = inputs["patch_offsets"]
    process = segmenter._processor.post_process_semantic_segmentation
    (expected,) = process(output, target_sizes=[size])
    assert found.label_ids.shape == size
    assert (found.label_ids == np.array(IDS)[expected.numpy()]).mean() > 0.999


@pytest.mark.parametrize("kind", MODELS)
def test_photos_together_are_as_alone(folders: dict[str, Path], kind: str) -> None:
    segmenter: Segmenter = HfSegmenter(str(folders[kind]), device="cpu")
    assert segmenter.taxonomy.names == {i: coco.NAMES[i] for i in sorted(IDS)}
    photos = [noise(48, 64), noise(48, 64)[:, ::-1], noise(70, 30), noise(1, 1), noise(3, 3)]
    together = segmenter(photos[:2]) + segmenter(photos[2:])
    for photo, found in zip(photos, together, strict=True):
        (alone,) = segmenter([photo])
        assert found.label_ids.shape == photo.shape[:2]
        assert found.label_ids.dtype == np.int16
        assert (found.label_ids == alone.label_ids).mean() > 0.99
    assert segmenter([]) == []


class Stub(torch.nn.Module):
    """Queries that are sure: query q is class q, on where `masks` [B, Q, h, w] says."""

    def __init__(self, masks: np.ndarray, classes: int):
        super().__init__()
        self.masks, self.classes = torch.as_tensor(masks, dtype=torch.float32) * 60 - 30, classes

    def forward(self, pixel_values: torch.Tensor) -> Any:
        batch, queries = self.masks.shape[:2]
        assert len(pixel_values) == batch
        logits = 30 * torch.eye(queries, self.classes + 1).expand(batch, -1, -1)
        return SimpleNamespace(class_queries_logits=logits, masks_queries_logits=self.masks)


def test_padding_of_a_square_is_cut_off(folders: dict[str, Path]) -> None:
    segmenter = HfSegmenter(folders["eomt"], device="cpu")
    masks = np.zeros((1, 3, 16, 16))
    masks[0, 0, :8, :4] = masks[0, 1, :8, 4:] = masks[0, 2, 8:] = 1  # below: padding
    segmenter._model = Stub(masks, len(NAMES))
    (found,) = segmenter([np.zeros((128, 256, 3), np.uint8)])  # becomes 32 x 64, padded to 64 x 64
    expected = np.repeat([[IDS[0]] * 64 + [IDS[1]] * 192], 128, 0)
    np.testing.assert_array_equal(found.label_ids[:112], expected[:112])


def test_crops_are_put_back_where_they_were(folders: dict[str, Path]) -> None:
    segmenter = HfSegmenter(folders["crops"], device="cpu")
    masks = np.zeros((3, 3, 16, 16))
    for crop in range(3):
        masks[crop, crop] = 1
    segmenter._model = Stub(masks, len(NAMES))
    for size in ((64, 160), (160, 64)):  # crops at 0, 48 and 96, each 64 long
        (found,) = segmenter([np.zeros((*size, 3), np.uint8)])
        line = found.label_ids[0] if size[0] == 64 else found.label_ids[:, 0]
        assert line[[0, 47, 64, 95, 112, 159]].tolist() == [IDS[0], IDS[0], IDS[1], IDS[1], IDS[2], IDS[2]]


def test_scores_are_summed_and_at_most_1(folders: dict[str, Path]) -> None:
    """Two queries of one class count together; what is left to 1 is no object."""
    segmenter = HfSegmenter(folders["eomt"], device="cpu")
    half = torch.logit(torch.full((3, 2, 2), 0.5))
    weights = torch.tensor([[0.6, 0, 0, 0], [0.4, 0, 0.2, 0], [0, 0.1, 0, 0]])
    scores = segmenter._scores(_Answer(weights[None], half[None], (8, 8), (8, 8), []), 0)
    np.testing.assert_allclose(scores[:, 0, 0], [0.5, 0.05, 0.1, 0], atol=1e-6)
    assert (segmenter._ids[scores.argmax(0)] == min(IDS)).all()


def test_names_of_classes(monkeypatch: pytest.MonkeyPatch) -> None:
    generic = [f"LABEL_{i}" for i in range(250)]
    order = sorted(coco.NAMES)
    assert class_ids([coco.NAMES[i] for i in order], "eomt", "m") == (order, None)
    assert class_ids(["Sky-Other_Merged", "traffic  light", "PERSON"], "eomt", "m") == ([187, 10, 1], None)
    ids, note = class_ids(generic[:133], "eomt", "m")
    assert ids == order
    assert note is not None
    assert note.startswith("m: ")
    wrong = [coco.NAMES[i] for i in order]
    wrong[5] = wrong[4]  # a name twice
    assert class_ids(wrong, "mask2former", "m")[0] == order
    ids, note = class_ids(generic, "detr", "m")
    assert (ids[1], ids[12], ids[200], ids[249]) == (1, None, 200, None)
    assert note is not None
    assert class_ids(["car", "traffic sign", "rider"], "mask2former", "m")[0][0] == 3
    with pytest.raises(LabelError, match=r"no known names among its 250 classes \(LABEL_0, "):
        class_ids(generic, "mask2former", "m")


def test_a_network_from_the_cache(
    tmp_path: Path, folders: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    from huggingface_hub import constants

    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path))
    with pytest.raises(BackendUnavailable, match="hf download tiny, then set HF_HUB_OFFLINE=1"):
        HfSegmenter("tiny", device="cpu")
    commit, repository = "0123456789" * 4, tmp_path / "models--tue-mps--tiny"
    shutil.copytree(folders["eomt"], repository / "snapshots" / commit)
    (repository / "refs").mkdir()
    (repository / "refs" / "main").write_text(commit)
    segmenter = HfSegmenter("tue-mps/tiny", device="cpu")
    assert segmenter.note is None


def test_unusable_networks(
    tmp_path: Path, folders: dict[str, Path], capfd: pytest.CaptureFixture[str]
) -> None:
    from safetensors.torch import load_file, save_file

    def copy(name: str) -> Path:
        return shutil.copytree(folders["eomt"], tmp_path / name)

    (tmp_path / "bert").mkdir()
    (tmp_path / "bert" / "config.json").write_text('{"model_type": "bert"}')
    weights = copy("pickle") / "model.safetensors"
    torch.save(load_file(weights), weights.with_name("pytorch_model.bin"))
    weights.unlink()
    weights = copy("part") / "model.safetensors"
    tensors = load_file(weights)
    save_file(
        {key: t for key, t in tensors.items() if "class_predictor" not in key}, weights, {"format": "pt"}
    )
    cases = [
        (tmp_path / "bert", "a network of kind bert; take one of detr, eomt"),
        (tmp_path / "pickle", "cannot be loaded .*safetensors"),
        (tmp_path / "part", "weights lack 2 parameters .class_predictor.bias"),
    ]
    for model, complaint in cases:
        with pytest.raises(LabelError, match=complaint) as caught:
            HfSegmenter(model, device="cpu")
        assert str(model) in str(caught.value)
    assert capfd.readouterr() == ("", "")


def test_without_transformers(folders: dict[str, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "transformers", None)
    with pytest.raises(BackendUnavailable, match=r"pip install 'sagesplat\[hf\]'"):
        HfSegmenter(folders["eomt"], device="cpu")


def test_devices(folders: dict[str, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    assert torch_device("auto") == torch.device("cuda", 0)
    with pytest.raises(BackendUnavailable, match="2 CUDA devices"):
        torch_device("cuda:2")
    segmenter = HfSegmenter(folders["eomt"], device="cpu")

    def full_machine(**_: Any) -> Any:
        raise RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 8 bytes")

    segmenter._model = full_machine
    with pytest.raises(OutOfMemory, match=r"on cpu for 1 photos at once; take fewer, smaller photos$"):
        segmenter([noise(8, 8)])


@pytest.mark.parametrize("kind", ["crops", "mask2former", "detr"])
def test_instances_only_where_they_are_asked_for(
    folders: dict[str, Path], monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    monkeypatch.setattr(panoptic, "LEAST_SCORE", 0.0)  # an untrained network is sure of nothing
    monkeypatch.setattr(panoptic, "LEAST_OVERLAP", 0.0)
    segmenter = HfSegmenter(folders[kind], device="cpu")
    photo = noise(120, 180)
    (without,) = segmenter([photo])
    segmenter.instances = True
    (found,) = segmenter([photo])
    assert without.instances is None
    assert found.instances is not None
    assert found.instances.shape == photo.shape[:2]
    assert (found.label_ids == without.label_ids).all()


def test_queries_that_others_hide_are_no_instances() -> None:
    logits = torch.full((3, 4, 8), -9.0)
    logits[0, :, :4] = logits[1, :, 4:] = 9
    logits[2, :, :3] = 9  # the first query has all of it
    weights = torch.tensor([[0.9, 0.0], [0.8, 0.1], [0.7, 0.0]])
    found = panoptic.instances_of([(weights, logits)], [np.s_[0:4, 0:8]], np.array([True, False]), (4, 8))
    assert found[0].tolist() == [0, 0, 0, 0, 1, 1, 1, 1]
    assert (
        panoptic.instances_of([(weights, logits)], [np.s_[0:4, 0:8]], np.zeros(2, bool), (4, 8)) == -1
    ).all()


def test_photos_no_network_can_take(folders: dict[str, Path]) -> None:
    segmenter = HfSegmenter(folders["eomt"], device="cpu")
    with pytest.raises(LabelError, match="cannot take a photo of 300 x 1 pixels"):
        segmenter([noise(1, 300)])
