"""Universal segmentation networks of Hugging Face: EoMT, Mask2Former, MaskFormer, OneFormer and DETR.

Such a network answers with queries: a distribution over classes and a mask each. `HfSegmenter` makes scores
per category of them, the semantic inference of MaskFormer (Cheng et al. 2021, arXiv:2107.06278, section 3.4);
where instances are asked for, it finds those of things among the queries (`panoptic.instances_of`).
"""

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Float32, Int16, Int64, UInt8
from torch import Tensor
from torch.nn.functional import interpolate

from sagesplat.core.config import MasksConfig
from sagesplat.core.errors import LabelError, short
from sagesplat.segment import coco, hub
from sagesplat.segment.instances import is_thing
from sagesplat.segment.masks import UNLABELLED, Taxonomy
from sagesplat.segment.panoptic import instances_of
from sagesplat.segment.segmenters import (
    Segmented,
    Segmenter,
    SegmenterFactory,
    arg_max_resized,
    group_classes,
)

DEFAULT_MODEL = "tue-mps/coco_panoptic_eomt_small_640_2x"
FAMILIES = ("detr", "eomt", "eomt_dinov3", "mask2former", "maskformer", "oneformer")
_MASK2FORMER_SIZE = (384, 384)  # where its own post-processing adds up masks, whatever the input's size


class _Answer(NamedTuple):
    """What a network says of photos of one size, or of the crops that EoMT cut them into."""

    weights: Float32[Tensor, "B Q K"]  # of each query: the probability of each category, without "no object"
    masks: Float[Tensor, "B Q h w"]  # logits
    input_size: tuple[int, int]  # of the network's input
    size: tuple[int, int]  # that the photo has in it: padding is right and below
    crops: list[list[int]]  # of each: its photo, start and end along the longer side; none: whole photos

    def without_padding(self, maps: Tensor) -> tuple[slice, slice]:
        """The rows and columns of maps of the input that show the photo."""
        of = zip(maps.shape[-2:], self.size, self.input_size, strict=True)
        height, width = (max(1, round(o * s / f)) for o, s, f in of)
        return slice(height), slice(width)


class HfSegmenter:
    """A network from a folder, or from huggingface.co by name ("owner/name", downloaded into its cache once).

    `device`: "auto" (a GPU where there is one), "cpu", "cuda" or "cuda:N"; a GPU computes in 16 bits.
    `threads` sets torch's for the whole process. `note` says where the network's own names of classes were
    not trusted. Raises LabelError for what is no such network, BackendUnavailable where transformers, the
    network or the device cannot be had.
    """

    def __init__(
        self,
        model: str | Path = DEFAULT_MODEL,
        *,
        device: str = "auto",
        threads: int | None = None,
    ):
        self._name = str(model)
        self._device = hub.torch_device(device)
        if threads is not None:
            torch.set_num_threads(threads)
        with hub.quiet():
            folder = hub.folder_of(model)
            self._config = hub.read_config(folder, self._name, FAMILIES, "universal segmentation")
            self._processor, self._task, self._model = _load(folder, self._name, self._config)
        self._model.to(self._device).eval()
        names = [str(name) for _, name in sorted(self._config.id2label.items())]
        label_ids, self.note = class_ids(names, self._config.model_type, self._name)
        self._ids, group = group_classes(label_ids)
        self._members = torch.eye(len(self._ids))[torch.as_tensor(group)].to(self._device)  # [C, K]
        self.taxonomy = Taxonomy({i: coco.NAMES[i] for i in self._ids.tolist() if i != UNLABELLED})
        self.instances = False  # whether answers have instances too
        things = [i != UNLABELLED and is_thing(i, coco.NAMES[i]) for i in self._ids.tolist()]
        self._things = np.array(things, bool)

    def __call__(self, photos: Sequence[UInt8[np.ndarray, "H W 3"]], /) -> list[Segmented]:
        """Label images; photos of one size are computed together."""
        if len({photo.shape for photo in photos}) > 1:
            return [found for photo in photos for found in self([photo])]
        with hub.computing(self._name, self._device, len(photos)):
            return self._segment(photos) if photos else []

    @torch.inference_mode()
    def _segment(self, photos: Sequence[UInt8[np.ndarray, "H W 3"]]) -> list[Segmented]:
        height, width = photos[0].shape[:2]
        answer = self._answer(hub.prepared(self._processor, photos, self._name), height, width)
        images = (self._merged if answer.crops else self._cropped)(answer, len(photos))
        scores = (hub.finite(image, self._name) for image in images)
        found = [Segmented(self._ids[arg_max_resized(of, height, width)]) for of in scores]
        if not self.instances:
            return found
        return [
            replace(one, instances=self._instances(photo, answer, height, width))
            for photo, one in enumerate(found)
        ]

    def _instances(self, photo: int, answer: _Answer, height: int, width: int) -> Int16[np.ndarray, "H W"]:
        """Instances of things in one photo, of all crops that it was cut into."""
        weights, masks, (h, w) = answer.weights, answer.masks, answer.size
        if not answer.crops:
            of_photo = masks[photo][:, *answer.without_padding(masks)]
            crops, places = [(weights[photo], of_photo)], [np.s_[0:height, 0:width]]
            return instances_of(crops, places, self._things, (height, width))
        crops, places = [], []
        tall, scale = h > w, (height / h if h > w else width / w)
        for row, (of_photo, start, end) in enumerate(answer.crops):
            if of_photo == photo:
                begin, stop = round(start * scale), round(end * scale)
                crops.append((weights[row], masks[row]))
                places.append(np.s_[begin:stop, 0:width] if tall else np.s_[0:height, begin:stop])
        return instances_of(crops, places, self._things, (height, width))

    def _answer(self, inputs: Any, height: int, width: int) -> _Answer:
        pixels = inputs["pixel_values"].to(self._device)
        more = {"pixel_mask": inputs["pixel_mask"].to(self._device)} if "pixel_mask" in inputs else {}
        if self._task is not None:
            more["task_inputs"] = self._task.expand(len(pixels), -1).to(self._device)
        cuda = self._device.type == "cuda"
        dtype = torch.bfloat16 if cuda and torch.cuda.is_bf16_supported() else torch.float16
        with torch.autocast("cuda", dtype, enabled=cuda):
            output = self._model(pixel_values=pixels, **more)
        detr = self._config.model_type == "detr"
        logits = output.logits if detr else output.class_queries_logits
        masks = output.pred_masks if detr else output.masks_queries_logits
        weights = logits.float().softmax(-1)[..., :-1] @ self._members
        offsets = inputs.get("patch_offsets")
        crops = torch.stack(offsets).tolist() if offsets else []
        size = self._covered(inputs, height, width)
        return _Answer(weights, masks, tuple(pixels.shape[-2:]), size, crops)

    def _covered(self, inputs: Any, height: int, width: int) -> tuple[int, int]:
        """Height and width of the photo in the network's input, which has padding right and below."""
        if "pixel_mask" in inputs:
            mask = inputs["pixel_mask"][0]
            return int(mask.any(1).sum()), int(mask.any(0).sum())
        if not self._config.model_type.startswith("eomt"):
            return tuple(inputs["pixel_values"].shape[-2:])
        from transformers.image_transforms import get_size_with_aspect_ratio

        size = self._processor.size
        return get_size_with_aspect_ratio((height, width), size["shortest_edge"], size["longest_edge"])

    def _scores(self, answer: _Answer, row: int) -> Float32[Tensor, "K h2 w2"]:
        """Semantic inference, at the resolution where the family's own post-processing does it."""
        masks, family = answer.masks[row].float()[None], self._config.model_type
        if family == "mask2former":
            masks = interpolate(masks, _MASK2FORMER_SIZE, mode="bilinear")
        elif family.startswith("eomt"):
            masks = interpolate(masks, answer.input_size, mode="bilinear")
        return torch.einsum("qk,qhw->khw", answer.weights[row], masks[0].sigmoid())

    def _cropped(self, answer: _Answer, photos: int) -> Iterator[Float32[Tensor, "K h2 w2"]]:
        """Scores of each photo without those of the input's padding."""
        for scores in (self._scores(answer, photo) for photo in range(photos)):
            yield scores[:, *answer.without_padding(scores)]

    def _merged(self, answer: _Answer, photos: int) -> Iterator[Float32[Tensor, "K h2 w2"]]:
        """Scores of each photo from those of the crops that EoMT cut it into; means where they overlap."""
        device, (height, width) = answer.weights.device, answer.size
        for photo in range(photos):
            total = torch.zeros(len(self._ids), height, width, device=device)
            count = torch.zeros(height, width, device=device)
            for row, (of_photo, start, end) in enumerate(answer.crops):
                if of_photo == photo:
                    along = np.s_[..., start:end, :] if height > width else np.s_[..., start:end]
                    total[along] += self._scores(answer, row)
                    count[along] += 1
            yield total / count.clamp(min=1)


def class_ids(names: Sequence[str], family: str, model: str) -> tuple[list[int | None], str | None]:
    """The COCO panoptic id of each class of a network, and a note where its names were not what decided.

    Names of hosted networks are often missing (LABEL_0) or those of another data set. Raises LabelError.
    """
    own = {_plain(name): label_id for label_id, name in coco.NAMES.items()}
    ids = [own.get(_plain(name)) for name in names]
    if None not in ids and len(set(ids)) == len(ids):
        return ids, None
    if len(names) == len(coco.NAMES):
        return [*sorted(coco.NAMES)], f"{model}: names of classes are not COCO's; took COCO panoptic's order"
    if family == "detr" and len(names) > max(coco.NAMES):
        by_id = [i if i in coco.NAMES else None for i in range(len(names))]
        return by_id, f"{model}: took the numbers of classes for COCO's category ids"
    from sagesplat.segment.taxonomies import to_coco

    ids = to_coco(names, None)
    if all(i is None for i in ids):
        raise LabelError(
            f"{model}: no known names among its {len(names)} classes ({short(', '.join(names[:3]))}, ...); "
            'give it the names of COCO, ADE20K or Cityscapes as "id2label" in config.json'
        )
    return ids, None


def _plain(name: str) -> str:
    return " ".join(re.split(r"[\s_-]+", name.strip().lower()))


def _load(folder: Path, name: str, config: Any) -> tuple[Any, Int64[Tensor, "1 T"] | None, Any]:
    """Image processor, OneFormer's task as tokens (else None), and the model."""
    oneformer = config.model_type == "oneformer"
    # class_info_file would be downloaded, and serves training alone
    alone = {"class_info_file": None} if oneformer else {}
    with hub.loading(name):
        processor = hub.load_image_processor(folder, **alone)
        task = _task_tokens(folder, config) if oneformer else None
        kind = hub.package("transformers").AutoModelForUniversalSegmentation
        return processor, task, hub.load_model(kind, folder, name, config)


def _task_tokens(folder: Path, config: Any) -> Int64[Tensor, "1 T"]:
    """What OneFormer is asked for, padded with 0 as in its training."""
    tokens = hub.load_tokenizer(folder)(
        ["the task is semantic"], padding="max_length", max_length=config.task_seq_len, truncation=True
    )
    return torch.tensor(tokens["input_ids"]) * torch.tensor(tokens["attention_mask"])


def _settings(config: MasksConfig) -> dict[str, Any]:
    return {"model": hub.model_setting(config.model or DEFAULT_MODEL)}


def _load_segmenter(
    config: MasksConfig, device: str, threads: int, warn: Callable[[str], None]
) -> HfSegmenter:
    model = config.model or DEFAULT_MODEL
    warn(f"network {model}; if it is not on this machine yet, it is downloaded from huggingface.co")
    segmenter = HfSegmenter(model, device=device, threads=threads)
    if segmenter.note:
        warn(segmenter.note)
    return segmenter


def _ask_for_instances(segmenter: Segmenter) -> None:
    assert isinstance(segmenter, HfSegmenter)
    segmenter.instances = True


FACTORY = SegmenterFactory(_settings, _load_segmenter, instances=_ask_for_instances)
