"""Segmentation by text: the user's own words become categories, alone or over those of another segmenter.

Grounding DINO or OWLv2 find boxes and SAM 2 makes masks of them; CLIPSeg and SAM 3 make masks of words.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import UInt8

from sagesplat.core.config import MasksConfig
from sagesplat.core.errors import LabelError, RunError
from sagesplat.io.typed import check_limits
from sagesplat.segment import hub
from sagesplat.segment.detections import Finder, painted_over, segmented, shared_areas
from sagesplat.segment.detectors import DETECTORS, detector
from sagesplat.segment.display_names import title_of
from sagesplat.segment.mask_networks import BOX_FAMILIES, WORD_FAMILIES, BoxFinder, BoxMasks, ClipSeg, Sam3
from sagesplat.segment.masks import Taxonomy
from sagesplat.segment.prompts import Prompt, parse_prompts, prompts_of
from sagesplat.segment.segmenters import Segmented, Segmenter, SegmenterFactory

DEFAULT_DETECTOR = "IDEA-Research/grounding-dino-tiny"
DEFAULT_MASK_MODEL = "facebook/sam2.1-hiera-tiny"
_THRESHOLDS = DETECTORS | WORD_FAMILIES
_NEEDS = (
    "config.json, preprocessor_config.json, model.safetensors and the tokenizer's files that belong together"
)


class TextSegmenter:
    """Labels what a network finds for the prompts; all other pixels are unlabelled.

    `best` has the highest score of each prompt, by the category's name, in the photos so far; `shared` what
    two prompts' masks have in common, "ivy=vine", and one's own, "ivy=ivy", in photos' areas.
    """

    def __init__(self, finder: Finder, prompts: Sequence[Prompt], device: torch.device | None = None):
        self._finder, self._prompts = finder, prompts
        self._device = device or torch.device("cpu")
        self.threshold = finder.threshold
        self.taxonomy = Taxonomy(dict(sorted((p.label_id, p.name) for p in prompts)))
        self.best = dict.fromkeys((p.name for p in prompts), 0.0)
        self.shared: dict[str, float] = {}

    def __call__(self, photos: Sequence[UInt8[np.ndarray, "H W 3"]], /) -> list[Segmented]:
        """One photo after the other: what is found in each decides how much there is to compute."""
        return [self._segment(photo) for photo in photos]

    def _segment(self, photo: UInt8[np.ndarray, "H W 3"]) -> Segmented:
        with hub.computing("segmentation by text", self._device, 1):
            found = self._finder(photo)
        for prompt, score in zip(self._prompts, found.best.tolist(), strict=True):
            self.best[prompt.name] = max(self.best[prompt.name], score)
        names = [prompt.name for prompt in self._prompts]
        common = shared_areas(found, len(names))
        for one, other in zip(*np.nonzero(np.triu(common)), strict=True):
            pair = f"{names[one]}={names[other]}"
            self.shared[pair] = self.shared.get(pair, 0.0) + float(common[one, other])
        ids = [prompt.label_id for prompt in self._prompts]
        return segmented(found, ids, self.threshold, (photo.shape[0], photo.shape[1]))


class TextOver:
    """What prompts find, painted over the label images of another segmenter."""

    def __init__(self, base: Segmenter, text: TextSegmenter):
        self._base, self._text = base, text
        self.threshold, self.best, self.shared = text.threshold, text.best, text.shared
        self.taxonomy = base.taxonomy | text.taxonomy

    def __call__(self, photos: Sequence[UInt8[np.ndarray, "H W 3"]], /) -> list[Segmented]:
        """Both for each photo."""
        pairs = zip(self._base(photos), self._text(photos), strict=True)
        return [painted_over(below, above) for below, above in pairs]


def settings(config: MasksConfig) -> dict[str, Any]:
    """What segmentation by text depends on; LabelError or RunError for settings that cannot be."""
    if not config.prompts.strip():
        raise RunError('--segmenter text needs --prompts "stone fountain; ivy; wooden bench"')
    check_limits(config)
    if config.segmenter == "text" and config.model and config.prompt_model:
        raise RunError("--model and --prompt-model name the same network here; leave one of them")
    return {
        "model": hub.model_setting(detector_of(config)),
        "mask_model": hub.model_setting(config.mask_model or DEFAULT_MASK_MODEL),
        "prompts": list(parse_prompts(config.prompts)),
        "prompt_threshold": config.prompt_threshold,
    }


def detector_of(config: MasksConfig) -> str:
    """The network that is asked for the prompts: --model is one of another segmenter where there is one."""
    own = config.model if config.segmenter == "text" else None
    return config.prompt_model or own or DEFAULT_DETECTOR


def load_text(
    config: MasksConfig, device: str, threads: int, warn: Callable[[str], None], base: Mapping[int, str]
) -> TextSegmenter:
    """The segmenter for the prompts; `base`: names by id of the categories that they stand beside."""
    settings(config)
    prompts = prompts_of(parse_prompts(config.prompts), base)
    torch.set_num_threads(threads)
    where = hub.torch_device(device)
    with hub.quiet():
        finder = _finder(config, [title_of(prompt.words) for prompt in prompts], where, warn)
    return TextSegmenter(finder, prompts, where)


def _finder(
    config: MasksConfig, words: Sequence[str], device: torch.device, warn: Callable[[str], None]
) -> Finder:
    """The networks that are asked for, loaded."""
    name = detector_of(config)
    warn(f"network {name}; if it is not on this machine yet, it is downloaded from huggingface.co")
    folder = hub.folder_of(name)
    about = hub.read_config(folder, name, _THRESHOLDS, "segmentation by text")
    family = about.model_type
    threshold = config.prompt_threshold or _THRESHOLDS[family]
    if family in WORD_FAMILIES and config.mask_model:
        raise LabelError(f"{name}: a network of kind {family} makes masks itself; leave out --mask-model")
    with hub.loading(name, _NEEDS):
        if family == "clipseg":
            return ClipSeg(folder, name, about, device, words, threshold, warn)
        if family in WORD_FAMILIES:
            return Sam3(folder, name, device, words, threshold, warn)
        detect = detector(folder, name, about, device, words, warn)
    return BoxFinder(detect, _box_masks(config, device, warn), threshold)


def _box_masks(config: MasksConfig, device: torch.device, warn: Callable[[str], None]) -> BoxMasks:
    name = config.mask_model or DEFAULT_MASK_MODEL
    warn(f"network {name}; if it is not on this machine yet, it is downloaded from huggingface.co")
    folder = hub.folder_of(name)
    about = hub.read_config(folder, name, BOX_FAMILIES, "masks of boxes")
    with hub.loading(name):
        return BoxMasks(folder, name, about, device)


def _load(config: MasksConfig, device: str, threads: int, warn: Callable[[str], None]) -> TextSegmenter:
    return load_text(config, device, threads, warn, {})


FACTORY = SegmenterFactory(settings, _load)
