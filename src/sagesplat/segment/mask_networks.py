"""Networks that make masks: of boxes (SAM and SAM 2), or of words (CLIPSeg and SAM 3)."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32, UInt8
from PIL import Image
from torch import Tensor

from sagesplat.core.errors import BackendUnavailable
from sagesplat.io.typed import known_json
from sagesplat.segment import hub
from sagesplat.segment.detections import Boxes, Found
from sagesplat.segment.detectors import padded_tokens

BOX_FAMILIES = {"sam", "sam2", "sam2_video"}
WORD_FAMILIES = {"clipseg": 0.4, "sam3": 0.5, "sam3_video": 0.5}  # family: usual threshold
_TOGETHER = 32  # boxes whose masks are computed at once
_WORDS_TOGETHER = 4  # prompts that CLIPSeg computes at once
_IMAGENET = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
_HALF = (0.5, 0.5, 0.5), (0.5, 0.5, 0.5)
_SAM3_TOKENS = 32  # of a prompt, as its own processor has it


class BoxMasks:
    """SAM (Kirillov et al. 2023) or SAM 2 (Ravi et al. 2024, arXiv:2408.00714): a mask for each box."""

    def __init__(self, folder: Path, name: str, config: Any, device: torch.device):
        transformers = hub.package("transformers")
        self.name, self._device = name, device
        self._first = config.model_type == "sam"
        if self._first:
            self._processor = hub.load_image_processor(folder)
            self._model = hub.load_model(transformers.SamModel, folder, name, config)
        else:
            # published folders name the network for videos, whose weights have more parts
            self._model = hub.load_model(transformers.Sam2Model, folder, name)
            self._input = _Squared(folder, 1024, _IMAGENET)
        self._model.to(device).eval()

    @torch.inference_mode()
    def __call__(
        self, photo: UInt8[np.ndarray, "H W 3"], corners: Float32[np.ndarray, "N 4"]
    ) -> Float32[np.ndarray, "N h w"]:
        """Logits of the mask of each box (left, top, right, bottom, pixels); they cover the whole photo."""
        pixels, covered = self._prepared(photo)
        height, width = photo.shape[:2]
        scale = np.array([covered[1] / width, covered[0] / height], np.float32)
        boxes = torch.from_numpy(corners * np.tile(scale, 2)).to(self._device)
        features = self._model.get_image_embeddings(pixels)
        masks = []
        for some in boxes.split(_TOGETHER):
            output = self._model(image_embeddings=features, input_boxes=some[None], multimask_output=False)
            masks.append(output.pred_masks[0, :, 0])
        logits = torch.cat(masks)
        full, of = pixels.shape[-2:], logits.shape[-2:]
        h, w = (max(1, round(o * c / f)) for o, c, f in zip(of, covered, full, strict=True))
        return hub.finite(logits[:, :h, :w], self.name)

    def _prepared(self, photo: UInt8[np.ndarray, "H W 3"]) -> tuple[Tensor, tuple[int, int]]:
        """The network's input, and height and width of the photo in it; padding is right and below."""
        if not self._first:
            pixels = self._input(photo).to(self._device)
            return pixels, (pixels.shape[2], pixels.shape[3])
        inputs = hub.prepared(self._processor, [photo], self.name)
        height, width = (int(size) for size in inputs["reshaped_input_sizes"][0])
        return inputs["pixel_values"].to(self._device), (height, width)


class BoxFinder:
    """A detector's boxes, and a mask for each."""

    def __init__(self, detect: Callable[..., Boxes], masks: Callable[..., np.ndarray], threshold: float):
        self._detect, self._masks, self.threshold = detect, masks, threshold

    def __call__(self, photo: UInt8[np.ndarray, "H W 3"], /) -> Found:
        """What is in a photo."""
        boxes = self._detect(photo, self.threshold)
        empty = np.zeros((0, 1, 1), np.float32)
        masks = self._masks(photo, boxes.corners) if len(boxes.corners) else empty
        return Found(boxes.prompts, boxes.scores, masks, boxes.best)


class ClipSeg:
    """CLIPSeg (Lüddecke and Ecker 2022, arXiv:2112.10003): one mask per prompt, and no single things.

    A pixel is inside where its probability reaches the threshold.
    """

    def __init__(
        self,
        folder: Path,
        name: str,
        config: Any,
        device: torch.device,
        words: Sequence[str],
        threshold: float,
        warn: Callable[[str], None],
    ):
        self.name, self.threshold, self._device = name, threshold, device
        self._processor = hub.load_image_processor(folder)
        length = config.text_config.max_position_embeddings
        self._text = padded_tokens(hub.load_tokenizer(folder), words, length, name, warn).to(device)
        kind = hub.package("transformers").CLIPSegForImageSegmentation
        self._model = hub.load_model(kind, folder, name, config).to(device).eval()

    @torch.inference_mode()
    def __call__(self, photo: UInt8[np.ndarray, "H W 3"], /) -> Found:
        """What is in a photo."""
        pixels = hub.prepared(self._processor, [photo], self.name)["pixel_values"].to(self._device)
        ids, mask = self._text["input_ids"], self._text["attention_mask"]
        planes = []
        for start in range(0, len(ids), _WORDS_TOGETHER):
            some = slice(start, start + _WORDS_TOGETHER)
            output = self._model(
                pixel_values=pixels.expand(len(ids[some]), -1, -1, -1),
                input_ids=ids[some],
                attention_mask=mask[some],
            )
            planes.append(output.logits.reshape(len(ids[some]), *output.logits.shape[-2:]))
        logits = hub.finite(torch.cat(planes), self.name)
        best = 1 / (1 + np.exp(-logits.max((1, 2)).clip(-30, 30)))
        reached = np.flatnonzero(best >= self.threshold)
        level = np.float32(np.log(self.threshold / (1 - self.threshold)))
        # the mask holds the scores, so each counts as sure
        return Found(reached, np.ones(len(reached), np.float32), logits[reached] - level, best, things=False)


class Sam3:
    """SAM 3 (Carion et al. 2025): masks of all things that a prompt names, directly.

    Its weights are under a licence of their own and given to those who ask Meta for them.
    """

    def __init__(
        self,
        folder: Path,
        name: str,
        device: torch.device,
        words: Sequence[str],
        threshold: float,
        warn: Callable[[str], None],
    ):
        kind = getattr(hub.package("transformers"), "Sam3Model", None)
        if kind is None:
            raise BackendUnavailable(f"{name}: needs a transformers that has SAM 3; upgrade it")
        self.name, self.threshold, self._device = name, threshold, device
        self._input = _Squared(folder, 1008, _HALF)
        self._text = padded_tokens(hub.load_tokenizer(folder), words, _SAM3_TOKENS, name, warn).to(device)
        self._model = hub.load_model(kind, folder, name).to(device).eval()

    @torch.inference_mode()
    def __call__(self, photo: UInt8[np.ndarray, "H W 3"], /) -> Found:
        """What is in a photo."""
        features = self._model.get_vision_features(self._input(photo).to(self._device))
        prompts, scores, masks, best = [], [], [], []
        for row, (ids, mask) in enumerate(
            zip(self._text["input_ids"], self._text["attention_mask"], strict=True)
        ):
            output = self._model(vision_embeds=features, input_ids=ids[None], attention_mask=mask[None])
            found = output.pred_logits[0].sigmoid()
            if output.presence_logits is not None:
                found = found * output.presence_logits[0].sigmoid()
            score = hub.finite(found, self.name)
            kept = np.flatnonzero(score >= self.threshold)
            prompts.append(np.full(len(kept), row))
            scores.append(score[kept])
            masks.append(hub.finite(output.pred_masks[0], self.name)[kept])
            best.append(score.max())
        rows, reached, logits = (np.concatenate(parts) for parts in (prompts, scores, masks))
        return Found(rows, reached, logits, np.array(best, np.float32))


class _Squared:
    """A photo stretched to the square that a network takes; transformers does so with torchvision only."""

    def __init__(
        self, folder: Path, side: int, default: tuple[tuple[float, float, float], tuple[float, float, float]]
    ):
        try:
            stored = (known_json(folder / "processor_config.json", dict) or {}).get("image_processor")
            stored = stored or known_json(folder / "preprocessor_config.json", dict) or {}
            size = stored.get("size", {})
            self._size = int(size.get("width", side)), int(size.get("height", side))
            self._mean = np.broadcast_to(np.float32(stored.get("image_mean", default[0])), 3)
            self._std = np.broadcast_to(np.float32(stored.get("image_std", default[1])), 3)
        except AttributeError as error:
            raise ValueError(f"preprocessor_config.json: {error}") from None

    def __call__(self, photo: UInt8[np.ndarray, "H W 3"]) -> Float32[Tensor, "1 3 h w"]:
        small = np.asarray(Image.fromarray(photo).resize(self._size, Image.Resampling.BILINEAR), np.float32)
        pixels = (small / 255 - self._mean) / self._std
        return torch.from_numpy(np.ascontiguousarray(pixels.transpose(2, 0, 1)))[None]
