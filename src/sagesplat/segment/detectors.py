"""Networks that find boxes by text: Grounding DINO and OWLv2."""

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from jaxtyping import Float32, UInt8
from torch import Tensor

from sagesplat.segment import hub
from sagesplat.segment.detections import Boxes, without_duplicates

_SEPARATORS = "[CLS]", "[SEP]", ".", "?"  # tokens at which Grounding DINO ends a phrase
_MOST = 300  # boxes of a photo, those with the highest scores
DETECTORS = {"grounding-dino": 0.3, "mm-grounding-dino": 0.3, "owlv2": 0.2}  # family: usual threshold


class Scorer(Protocol):
    """A network that looks for the words that it was made for."""

    def __call__(self, inputs: Any, /) -> tuple[Float32[Tensor, "Q P"], Float32[Tensor, "Q 4"]]:
        """Scores for each prompt; boxes as centre, width and height, as parts of the network's input."""
        ...


@dataclass(frozen=True, eq=False)
class Detector:
    """A network with its image processor: finds boxes in photos."""

    name: str
    device: torch.device
    processor: Any
    score: Scorer
    pads: bool  # photos to a square, which boxes are then parts of

    @torch.inference_mode()
    def __call__(self, photo: UInt8[np.ndarray, "H W 3"], threshold: float) -> Boxes:
        """The boxes with a score of at least the threshold."""
        height, width = photo.shape[:2]
        scores, parts = self.score(hub.prepared(self.processor, [photo], self.name).to(self.device))
        scores, parts = hub.finite(scores, self.name), hub.finite(parts, self.name)
        best, side = scores.max(0), max(width, height)
        corners = np.concatenate([parts[:, :2] - parts[:, 2:] / 2, parts[:, :2] + parts[:, 2:] / 2], 1)
        corners = corners * np.tile(np.array([side, side] if self.pads else [width, height], np.float32), 2)
        corners = corners.clip(0, np.array([width, height, width, height], np.float32))
        extended = np.all(corners[:, 2:] > corners[:, :2], axis=1)
        boxes, prompts = np.nonzero((scores >= threshold) & extended[:, None])
        reached = scores[boxes, prompts]
        order = np.argsort(-reached, kind="stable")[:_MOST]
        return without_duplicates(Boxes(prompts[order], reached[order], corners[boxes[order]], best))


class GroundingDino:
    """Grounding DINO (Liu et al. 2023, arXiv:2303.05499): all prompts are one text, with "." between them.

    As in its authors' evaluation, the score of a prompt is the mean of those of its tokens. Prompts that do
    not fit into one text are looked for in several passes.
    """

    def __init__(
        self, model: Any, tokenizer: Any, words: Sequence[str], name: str, warn: Callable[[str], None]
    ):
        self.model = model
        find = tokenizer.convert_tokens_to_ids
        self._begin, self._end, self._stop, _ = separators = [find(token) for token in _SEPARATORS]
        self._longest, unknown = model.config.max_text_len, tokenizer.unk_token_id
        self.tokens = []
        for each in words:
            plain = re.sub(r"[.?]+", " ", each.lower())
            tokens = tokenizer(plain, add_special_tokens=False)["input_ids"]
            tokens = [token for token in tokens if token not in separators]
            if all(token == unknown for token in tokens):
                warn(f"{name}: knows none of the words of {each!r}; it was trained on English")
            self.tokens.append(fitting(tokens, self._longest - 3, each, name, warn))

    def passes(self) -> Iterator[list[int]]:
        """Rows of the prompts of each text."""
        rows: list[int] = []
        length = 2
        for row, tokens in enumerate(self.tokens):
            if length + len(tokens) + 1 > self._longest:
                yield rows
                rows, length = [], 2
            rows.append(row)
            length += len(tokens) + 1
        yield rows

    def __call__(self, inputs: Any, /) -> tuple[Float32[Tensor, "Q P"], Float32[Tensor, "Q 4"]]:
        """See `Scorer`."""
        scores, boxes = [], []
        for rows in self.passes():
            ids, spans = [self._begin], []
            for row in rows:
                spans.append(slice(len(ids), len(ids) + len(self.tokens[row])))
                ids += [*self.tokens[row], self._stop]
            text = torch.tensor([[*ids, self._end]], device=self.model.device)
            output = self.model(
                **inputs, input_ids=text, token_type_ids=torch.zeros_like(text),
                attention_mask=torch.ones_like(text),
            )  # fmt: skip
            found = output.logits[0].sigmoid()
            here = torch.zeros(len(found), len(self.tokens), device=found.device)
            here[:, rows] = torch.stack([found[:, span].mean(1) for span in spans], 1)
            scores.append(here)
            boxes.append(output.pred_boxes[0])
        return torch.cat(scores), torch.cat(boxes)


class Owlv2:
    """OWLv2 (Minderer et al. 2023, arXiv:2306.09683): each prompt is a query of its own."""

    def __init__(
        self, model: Any, tokenizer: Any, words: Sequence[str], name: str, warn: Callable[[str], None]
    ):
        self.model = model
        length = model.config.text_config.max_position_embeddings
        self._text = padded_tokens(tokenizer, words, length, name, warn).to(model.device)

    def __call__(self, inputs: Any, /) -> tuple[Float32[Tensor, "Q P"], Float32[Tensor, "Q 4"]]:
        """See `Scorer`."""
        output = self.model(pixel_values=inputs["pixel_values"], **self._text)
        return output.logits[0].sigmoid(), output.pred_boxes[0]


def detector(
    folder: Path,
    name: str,
    config: Any,
    device: torch.device,
    words: Sequence[str],
    warn: Callable[[str], None],
) -> Detector:
    """The detector of a folder, for these words."""
    processor, tokenizer = hub.load_image_processor(folder), hub.load_tokenizer(folder)
    kind = hub.package("transformers").AutoModelForZeroShotObjectDetection
    model = hub.load_model(kind, folder, name, config).to(device).eval()
    pads = config.model_type == "owlv2"
    score = (Owlv2 if pads else GroundingDino)(model, tokenizer, words, name, warn)
    return Detector(name, device, processor, score, pads)


def padded_tokens(
    tokenizer: Any, words: Sequence[str], length: int, name: str, warn: Callable[[str], None]
) -> Any:
    """The words as tokens [P, length] with their attention mask."""
    for each in words:
        fitting(tokenizer(each)["input_ids"], length, each, name, warn)
    return tokenizer(
        list(words), padding="max_length", truncation=True, max_length=length, return_attention_mask=True,
        return_token_type_ids=False, return_tensors="pt",
    )  # fmt: skip


def fitting(tokens: list[int], most: int, words: str, name: str, warn: Callable[[str], None]) -> list[int]:
    """As many tokens as a network reads; warns of others."""
    if len(tokens) > most:
        warn(f"{name}: reads {most} of the {len(tokens)} tokens of {words!r}; shorten it")
    return tokens[:most]
