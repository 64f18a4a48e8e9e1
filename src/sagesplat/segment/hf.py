"""Universal segmentation networks of Hugging Face: EoMT, Mask2Former, MaskFormer, OneFormer and DETR.

Such a network answers with queries: a distribution over classes and a mask each. `HfSegmenter` makes scores
per category of them, the semantic inference of MaskFormer (Cheng et al. 2021, arXiv:2107.06278, section 3.4);
where instances are asked for, it finds those of things among the queries (`panoptic.instances_of`).
"""

import re
import textwrap
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float32, Int16, Int64, UInt8
from PIL import Image
from torch import Tensor
from torch.nn.functional import interpolate

from sagesplat.core.config import MasksConfig
from sagesplat.core.errors import BackendUnavailable, LabelError, OutOfMemory, short
from sagesplat.core.memory import ran_out
from sagesplat.segment import coco
from sagesplat.segment.instances import is_thing
from sagesplat.segment.masks import UNLABELLED, Taxonomy
from sagesplat.segment.panoptic import instances_of
from sagesplat.segment.segmenters import (
    Segmented,
    Segmenter,
    SegmenterFactory,
    answer,
    group_classes,
    parse_device,
)

DEFAULT_MODEL = "tue-mps/coco_panoptic_eomt_small_640_2x"
FAMILIES = ("detr", "eomt", "eomt_dinov3", "mask2former", "maskformer", "oneformer")
_MASK2FORMER_SIZE = (384, 384)  # where its own post-processing adds up masks, whatever the input's size
_FILES = ["*.json", "*.txt", "model*.safetensors"]  # of a repository: never pickles, never code


class HfSegmenter:
    """A network from a folder, or from huggingface.co by name ("owner/name", downloaded into its cache once).

    `device`: "auto" (a GPU where there is one), "cpu", "cuda" or "cuda:N"; a GPU computes in 16 bits.
    `threads` sets torch's for the whole process. `note` says where the network's own names of classes were
    not trusted, `revision` is the commit that was downloaded. Raises LabelError for what is no such network,
    BackendUnavailable where transformers, the network or the device cannot be had.
    """

    def __init__(
        self,
        model: str | Path = DEFAULT_MODEL,
        *,
        device: str = "auto",
        revision: str | None = None,
        threads: int | None = None,
    ):
        self._name = str(model)
        self._device = torch_device(device)
        if threads is not None:
            torch.set_num_threads(threads)
        with _quiet():
            folder = _folder(model, revision)
            self._config = _config(folder, self._name)
            self._processor, self._task, self._model = _load(folder, self._name, self._config)
        self._model.to(self._device).eval()
        self.revision = None if folder == Path(model) else folder.name
        names = [str(name) for _, name in sorted(self._config.id2label.items())]
        label_ids, self.note = class_ids(names, self._config.model_type, self._name)
        self._ids, group = group_classes(label_ids)
        self._members = torch.eye(len(self._ids))[torch.as_tensor(group)].to(self._device)  # [C, K]
        self.taxonomy = Taxonomy({i: coco.NAMES[i] for i in self._ids.tolist() if i != UNLABELLED})
        self.instances = False  # whether answers have instances too
        things = [i != UNLABELLED and is_thing(i, coco.NAMES[i]) for i in self._ids.tolist()]
        self._things = np.array(things, bool)

    def __call__(self, photos: Sequence[UInt8[np.ndarray, "H W 3"]], /) -> list[Segmented]:
        """Label images and probabilities; photos of one size are computed together."""
        if len({photo.shape for photo in photos}) > 1:
            return [found for photo in photos for found in self([photo])]
        try:
            return self._segment(photos) if photos else []
        except (RuntimeError, MemoryError) as error:  # of a GPU's too
            if not (isinstance(error, torch.cuda.OutOfMemoryError) or ran_out(error)):
                raise
            raise OutOfMemory(
                f"{self._name}: no memory on {self._device} for {len(photos)} photos at once; "
                f"take fewer, smaller photos{'' if self._device.type == 'cpu' else ' or --device cpu'}"
            ) from None

    @torch.inference_mode()
    def _segment(self, photos: Sequence[UInt8[np.ndarray, "H W 3"]]) -> list[Segmented]:
        height, width = photos[0].shape[:2]
        inputs = self._prepare(photos)
        weights, masks = self._queries(inputs)
        size = self._covered(inputs, height, width)
        if inputs.get("patch_offsets"):
            images = self._merged(weights, masks, inputs, size, len(photos))
        else:
            images = (self._cropped(*of_photo, inputs, size) for of_photo in zip(weights, masks, strict=True))
        found = [self._answer(scores, height, width) for scores in images]
        if not self.instances:
            return found
        return [
            replace(answer, instances=self._instances(photo, weights, masks, inputs, size, height, width))
            for photo, answer in enumerate(found)
        ]

    def _instances(
        self,
        photo: int,
        weights: Float32[Tensor, "B Q K"],
        masks: Float[Tensor, "B Q h w"],
        inputs: Any,
        size: tuple[int, int],
        height: int,
        width: int,
    ) -> Int16[np.ndarray, "H W"]:
        """Instances of things in one photo, of all crops that it was cut into."""
        if not inputs.get("patch_offsets"):
            full, of = inputs["pixel_values"].shape[-2:], masks.shape[-2:]
            h, w = (max(1, round(o * s / f)) for o, s, f in zip(of, size, full, strict=True))
            crops, places = [(weights[photo], masks[photo][:, :h, :w])], [np.s_[0:height, 0:width]]
            return instances_of(crops, places, self._things, (height, width))
        crops, places = [], []
        tall, scale = size[0] > size[1], (height / size[0] if size[0] > size[1] else width / size[1])
        for row, (of_photo, start, end) in enumerate(torch.stack(inputs["patch_offsets"]).tolist()):
            if of_photo == photo:
                begin, stop = round(start * scale), round(end * scale)
                crops.append((weights[row], masks[row]))
                places.append(np.s_[begin:stop, 0:width] if tall else np.s_[0:height, begin:stop])
        return instances_of(crops, places, self._things, (height, width))

    def _prepare(self, photos: Sequence[UInt8[np.ndarray, "H W 3"]]) -> Any:
        """The network's input by its own image processor. PIL images: arrays 3 pixels high are ambiguous."""
        try:
            return self._processor(images=[Image.fromarray(p) for p in photos], return_tensors="pt")
        except (ValueError, ZeroDivisionError) as error:
            height, width = photos[0].shape[:2]
            raise LabelError(
                f"{self._name}: cannot take a photo of {width} x {height} pixels ({_first_line(error)}); "
                "leave such photos out"
            ) from None

    def _queries(self, inputs: Any) -> tuple[Float32[Tensor, "B Q K"], Float[Tensor, "B Q h w"]]:
        """Per query: the probability of each category, "no object" left out, and the logits of its mask."""
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
        return logits.float().softmax(-1)[..., :-1] @ self._members, masks

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

    def _scores(
        self, weights: Float32[Tensor, "Q K"], masks: Float[Tensor, "Q h w"], inputs: Any
    ) -> Float32[Tensor, "K h2 w2"]:
        """Semantic inference, at the resolution where the family's own post-processing does it."""
        masks, family = masks.float()[None], self._config.model_type
        if family == "mask2former":
            masks = interpolate(masks, _MASK2FORMER_SIZE, mode="bilinear")
        elif family.startswith("eomt"):
            masks = interpolate(masks, inputs["pixel_values"].shape[-2:], mode="bilinear")
        return torch.einsum("qk,qhw->khw", weights, masks[0].sigmoid())

    def _cropped(
        self,
        weights: Float32[Tensor, "Q K"],
        masks: Float[Tensor, "Q h w"],
        inputs: Any,
        size: tuple[int, int],
    ) -> Float32[Tensor, "K h2 w2"]:
        """Scores of one photo without those of the input's padding."""
        scores = self._scores(weights, masks, inputs)
        of, full = scores.shape[-2:], inputs["pixel_values"].shape[-2:]
        h, w = (max(1, round(o * s / f)) for o, s, f in zip(of, size, full, strict=True))
        return scores[:, :h, :w]

    def _merged(
        self,
        weights: Float32[Tensor, "B Q K"],
        masks: Float[Tensor, "B Q h w"],
        inputs: Any,
        size: tuple[int, int],
        photos: int,
    ) -> Iterator[Float32[Tensor, "K h2 w2"]]:
        """Scores of each photo from those of the crops that EoMT cut it into; means where they overlap."""
        for photo in range(photos):
            total = torch.zeros(len(self._ids), *size, device=weights.device)
            count = torch.zeros(size, device=weights.device)
            for row, (of, start, end) in enumerate(torch.stack(inputs["patch_offsets"]).tolist()):
                if of == photo:
                    along = (
                        (..., slice(start, end), slice(None))
                        if size[0] > size[1]
                        else (..., slice(start, end))
                    )
                    total[along] += self._scores(weights[row], masks[row], inputs)
                    count[along] += 1
            yield total / count.clamp(min=1)

    def _answer(self, scores: Float32[Tensor, "K h w"], height: int, width: int) -> Segmented:
        """Scores as probabilities: what is missing to 1 is "no object", larger sums are scaled to 1."""
        total = scores.sum(0)
        if not total.isfinite().all():
            raise LabelError(f"{self._name}: scores that are not finite; try --device cpu or another network")
        probabilities = (scores / total.clamp(min=1)).cpu().numpy()
        return answer(scores.cpu().numpy(), probabilities, self._ids, height, width)


def torch_device(device: str) -> torch.device:
    """The device of a name; `auto` is a GPU where there is one. Raises BackendUnavailable."""
    kind, index = parse_device(device)
    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if kind == "cpu" or (kind == "auto" and not count):
        return torch.device("cpu")
    if index >= count:
        raise BackendUnavailable(f"device {device}: this machine has {count} CUDA devices; use --device cpu")
    return torch.device("cuda", index)


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


def _folder(model: str | Path, revision: str | None) -> Path:
    """The folder of a network: the one given, or that of the cache after a download where needed."""
    name = str(model)
    if name and Path(name).is_dir():
        return Path(name)
    if isinstance(model, Path) or re.fullmatch(r"[\w-][\w.-]*(/[\w-][\w.-]*)?", name) is None:
        raise LabelError(f"{name}: no such folder; name one with config.json, or a network as owner/name")
    huggingface_hub = _import("huggingface_hub")
    try:
        return Path(huggingface_hub.snapshot_download(name, revision=revision, allow_patterns=_FILES))
    except Exception as error:  # of the hub's client, of its HTTP library or of the disk
        version = f" --revision {revision}" if revision else ""
        raise BackendUnavailable(
            f"{name}: no folder, not in Hugging Face's cache, and no download ({_first_line(error)}); "
            f"where there is a network: hf download {name}{version}, then set HF_HUB_OFFLINE=1"
        ) from None


def _config(folder: Path, name: str) -> Any:
    transformers = _import("transformers")
    try:
        config = transformers.AutoConfig.from_pretrained(folder, trust_remote_code=False)
    except Exception as error:  # many kinds for what may be in the file
        if ran_out(error):
            raise
        raise LabelError(
            f"{name}: no network of transformers ({_first_line(error)}); name one for universal segmentation"
        ) from None
    if config.model_type not in FAMILIES:
        kind = short(config.model_type)
        raise LabelError(f"{name}: a network of kind {kind}; take one of {', '.join(FAMILIES)}")
    return config


def _load(folder: Path, name: str, config: Any) -> tuple[Any, Int64[Tensor, "1 T"] | None, Any]:
    """Image processor, OneFormer's task as tokens (else None), and the model."""
    transformers = _import("transformers")
    # class_info_file would be downloaded, and serves training alone
    alone = {"class_info_file": None} if config.model_type == "oneformer" else {}
    try:
        processor = transformers.AutoImageProcessor.from_pretrained(
            folder, backend="pil", trust_remote_code=False, **alone
        )
        task = _task_tokens(folder, config) if config.model_type == "oneformer" else None
        model, info = transformers.AutoModelForUniversalSegmentation.from_pretrained(
            folder,
            config=config,
            use_safetensors=True,
            dtype=torch.float32,
            output_loading_info=True,
        )
    except ImportError as error:
        raise BackendUnavailable(
            f"{name}: needs another package ({_first_line(error)}); install it"
        ) from None
    except Exception as error:  # of many kinds for files that are missing, damaged or do not fit
        if ran_out(error):
            raise
        raise LabelError(
            f"{name}: cannot be loaded ({_first_line(error)}); it needs config.json, "
            "preprocessor_config.json and model.safetensors that belong together"
        ) from None
    absent = sorted(set(info["missing_keys"]) & {key for key, _ in model.named_parameters()})
    if absent:
        raise LabelError(
            f"{name}: weights lack {len(absent)} parameters ({absent[0]}, ...); take a trained network"
        )
    return processor, task, model


def _task_tokens(folder: Path, config: Any) -> Int64[Tensor, "1 T"]:
    """What OneFormer is asked for, padded with 0 as in its training."""
    tokenizer = _import("transformers").AutoTokenizer.from_pretrained(folder, trust_remote_code=False)
    length = config.task_seq_len
    tokens = tokenizer(["the task is semantic"], padding="max_length", max_length=length, truncation=True)
    return torch.tensor(tokens["input_ids"]) * torch.tensor(tokens["attention_mask"])


def _import(name: str) -> Any:
    try:
        return __import__(name)
    except ImportError:
        raise BackendUnavailable(
            "segmentation by a network of Hugging Face needs transformers; pip install 'sagesplat[hf]'"
        ) from None


@contextmanager
def _quiet() -> Iterator[None]:
    """No log lines and progress bars of transformers: what matters becomes an error."""
    logging = _import("transformers").utils.logging
    verbosity, bars = logging.get_verbosity(), logging.is_progress_bar_enabled()
    logging.set_verbosity(logging.CRITICAL)
    logging.disable_progress_bar()
    try:
        yield
    finally:
        logging.set_verbosity(verbosity)
        if bars:
            logging.enable_progress_bar()


def _first_line(error: Exception) -> str:
    """What an error says, without the lists and advice that transformers adds."""
    return textwrap.shorten(str(error).strip().partition("\n")[0], 200, placeholder=" ...")


def _settings(config: MasksConfig) -> dict[str, Any]:
    model = config.model or DEFAULT_MODEL
    return {"model": Path(model) if Path(model).is_dir() else model}


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
