"""Tiny networks with random weights, in folders as they are published, for tests of several files."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

transformers: Any = pytest.importorskip("transformers", reason="needs sagesplat[hf]")

WORDS = ["stone", "fountain", "ivy", "wooden", "bench", "tree", "chair"]
_SEPARATORS = {"[PAD]": 0, "[UNK]": 100, "[CLS]": 101, "[SEP]": 102, "[MASK]": 103, ".": 1012, "?": 1029}
_LETTERS = [chr(code) for code in range(33, 127)]
_SMALL = {"hidden_size": 16, "intermediate_size": 16, "num_hidden_layers": 1, "num_attention_heads": 2}


def photo(height: int = 120, width: int = 160, seed: int = 0) -> np.ndarray:
    """A photo with something in it."""
    coarse = np.random.default_rng(seed).integers(0, 256, (6, 8, 3), dtype=np.uint8)
    return np.asarray(Image.fromarray(coarse).resize((width, height)))


def _bert(folder: Path) -> None:
    """A tokenizer that knows WORDS, its separators at the ids that Grounding DINO relies on."""
    vocabulary = [f"[unused{i}]" for i in range(1040)] + WORDS
    for token, number in _SEPARATORS.items():
        vocabulary[number] = token
    (folder / "vocab.txt").write_text("\n".join(vocabulary))
    about = {"tokenizer_class": "BertTokenizer", "do_lower_case": True}
    (folder / "tokenizer_config.json").write_text(json.dumps(about))


def _clip(folder: Path) -> None:
    """A tokenizer of single characters."""
    tokens = [*_LETTERS, *(letter + "</w>" for letter in _LETTERS), "<|startoftext|>", "<|endoftext|>"]
    (folder / "vocab.json").write_text(json.dumps({token: i for i, token in enumerate(tokens)}))
    (folder / "merges.txt").write_text("#version: 0.2\n")
    (folder / "tokenizer_config.json").write_text(json.dumps({"tokenizer_class": "CLIPTokenizer"}))


def _text(length: int) -> dict[str, Any]:
    count = 2 * len(_LETTERS) + 2
    ids = {"vocab_size": count, "bos_token_id": count - 2, "eos_token_id": count - 1}
    return {**_SMALL, **ids, "max_position_embeddings": length}


def grounding_dino() -> Any:
    swin = transformers.SwinConfig(
        embed_dim=8, depths=[1] * 4, num_heads=[1] * 4, window_size=4, image_size=64,
        out_features=["stage2", "stage3", "stage4"],
    )  # fmt: skip
    config = transformers.GroundingDinoConfig(
        backbone_config=swin, text_config=transformers.BertConfig(vocab_size=1047, **_SMALL), d_model=32,
        encoder_layers=1, decoder_layers=2, encoder_attention_heads=2, decoder_attention_heads=2,
        encoder_ffn_dim=16, decoder_ffn_dim=16, num_queries=10, max_text_len=12,
    )  # fmt: skip
    return transformers.GroundingDinoForObjectDetection(config)


def owlv2() -> Any:
    vision = {**_SMALL, "image_size": 64, "patch_size": 16}
    config = transformers.Owlv2Config(text_config=_text(16), vision_config=vision, projection_dim=16)
    model = transformers.Owlv2ForObjectDetection(config)
    with torch.no_grad():
        for parameter in model.parameters():  # a fresh one puts all boxes at the photo's border
            parameter.mul_(0.5)
    return model


def clipseg() -> Any:
    vision = {**_SMALL, "image_size": 32, "patch_size": 16}
    config = transformers.CLIPSegConfig(
        text_config=_text(77), vision_config=vision, projection_dim=16, extract_layers=[0], reduce_dim=8,
        decoder_num_attention_heads=2, decoder_intermediate_size=16, conditional_layer=0,
    )  # fmt: skip
    return transformers.CLIPSegForImageSegmentation(config)


def _decoder() -> dict[str, Any]:
    return {"hidden_size": 32, "mlp_dim": 16, "num_attention_heads": 2, "iou_head_hidden_dim": 16}


def sam() -> Any:
    vision = {
        "hidden_size": 16, "output_channels": 32, "num_hidden_layers": 1, "num_attention_heads": 2,
        "image_size": 128, "patch_size": 16, "mlp_dim": 16, "window_size": 4, "global_attn_indexes": [0],
        "num_pos_feats": 16,
    }  # fmt: skip
    prompts = {"hidden_size": 32, "image_size": 128, "patch_size": 16, "image_embedding_size": 8}
    config = transformers.SamConfig(
        vision_config=vision, prompt_encoder_config=prompts, mask_decoder_config=_decoder()
    )
    return transformers.SamModel(config)


def sam2() -> Any:
    hiera = {
        "model_type": "sam2_hiera_det_model", "hidden_size": 8, "num_attention_heads": 1,
        "image_size": [128, 128], "blocks_per_stage": [1, 2, 2, 1], "embed_dim_per_stage": [8, 16, 32, 64],
        "num_attention_heads_per_stage": [1, 1, 2, 2], "window_size_per_stage": [8, 4, 4, 4],
        "global_attention_blocks": [4],
    }  # fmt: skip
    vision = {
        "backbone_config": hiera, "backbone_channel_list": [64, 32, 16, 8], "fpn_hidden_size": 32,
        "backbone_feature_sizes": [[32, 32], [16, 16], [8, 8]],
    }  # fmt: skip
    prompts = {"hidden_size": 32, "image_size": 128, "patch_size": 16}
    config = transformers.Sam2Config(
        vision_config=vision, prompt_encoder_config=prompts, mask_decoder_config=_decoder()
    )
    return transformers.Sam2Model(config)


def sam3() -> Any:
    vit = {
        **_SMALL, "model_type": "sam3_vit_model", "hidden_size": 32, "image_size": 112, "patch_size": 14,
        "window_size": 4, "global_attn_indexes": [0], "pretrain_image_size": 56,
    }  # fmt: skip
    vision = {
        "backbone_config": vit, "fpn_hidden_size": 32,
        "backbone_feature_sizes": [[32, 32], [16, 16], [8, 8]],
    }  # fmt: skip
    small = {"hidden_size": 32, "num_layers": 1, "num_attention_heads": 2, "intermediate_size": 16}
    config = transformers.Sam3Config(
        vision_config=vision, text_config={**_text(32), "projection_dim": 16}, geometry_encoder_config=small,
        detr_encoder_config=small, detr_decoder_config={**small, "num_queries": 6},
        mask_decoder_config={"hidden_size": 32, "num_attention_heads": 2},
    )  # fmt: skip
    return transformers.Sam3Model(config)


def _square(kind: str, side: int) -> dict[str, Any]:
    return {"image_processor_type": kind, "size": {"height": side, "width": side}}


KINDS: dict[str, tuple[Callable[[], Any], dict[str, Any], Callable[[Path], None] | None]] = {
    "dino": (
        grounding_dino,
        {"image_processor_type": "GroundingDinoImageProcessor"}
        | {"size": {"shortest_edge": 64, "longest_edge": 96}},
        _bert,
    ),
    "owlv2": (owlv2, _square("Owlv2ImageProcessor", 64), _clip),
    "clipseg": (clipseg, _square("ViTImageProcessor", 64), _clip),
    "sam": (
        sam,
        {"image_processor_type": "SamImageProcessor", "size": {"longest_edge": 128}}
        | {"pad_size": {"height": 128, "width": 128}},
        None,
    ),
    "sam2": (sam2, _square("Sam2ImageProcessor", 128), None),
    "sam3": (sam3, _square("Sam3ImageProcessor", 112), _clip),
}


def save(folder: Path, kind: str) -> Path:
    """A network of a kind, always with the same weights."""
    torch.manual_seed(3)
    transformers.utils.logging.disable_progress_bar()
    make, processor, tokenizer = KINDS[kind]
    make().save_pretrained(folder)
    (folder / "preprocessor_config.json").write_text(json.dumps(processor))
    if tokenizer is not None:
        tokenizer(folder)
    return folder
