"""What segmentation tells while it runs: how long it will take, and what prompts found."""

import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from sagesplat.core.config import MasksConfig
from sagesplat.core.durations import duration
from sagesplat.core.errors import LabelError
from sagesplat.core.typed import fits
from sagesplat.io.files import read_object, write_json
from sagesplat.segment import text
from sagesplat.segment.masks import Taxonomy
from sagesplat.segment.registry import SEGMENTERS
from sagesplat.segment.segmenters import Segmented, Segmenter

_SCORES = ".prompts-*.json"  # a file for each task


def settings_of(kind: str, config: MasksConfig) -> dict[str, Any]:
    """What the label images depend on: the segmenter's settings, and those of prompts over it."""
    own = SEGMENTERS[kind].settings(config)
    if kind == "text" or not config.prompts:
        return own
    return own | {f"over_{name}": value for name, value in text.settings(config).items()}


def load(
    kind: str,
    config: MasksConfig,
    device: str,
    threads: int,
    warn: Callable[[str], None],
    *,
    instances: bool = False,
) -> Segmenter:
    """The segmenter, with the prompts over it where there are some; `instances`: whether they are wanted."""
    segmenter = SEGMENTERS[kind].load(config, device, threads, warn)
    if instances and (ask := SEGMENTERS[kind].instances) is not None:
        ask(segmenter)
    if kind == "text" or not config.prompts:
        return segmenter
    return text.TextOver(segmenter, text.load_text(config, device, threads, warn, segmenter.taxonomy.names))


class Timed:
    """A segmenter that says after its first photo how long the rest will take."""

    def __init__(self, segmenter: Segmenter, remaining: Callable[[], int], tell: Callable[[str], None]):
        self._segmenter, self._remaining, self._tell = segmenter, remaining, tell
        self._told = False
        self.taxonomy = segmenter.taxonomy

    def __call__(self, photos: Sequence[UInt8[np.ndarray, "H W 3"]], /) -> list[Segmented]:
        """The segmenter's answers."""
        start = time.perf_counter()
        found = self._segmenter(photos)
        if not self._told and photos:
            self._told, left = True, self._remaining()
            seconds = (time.perf_counter() - start) / len(photos) * left
            self._tell(
                f"segmentation takes about {duration(max(seconds, 1))} for {left} photos on this machine"
            )
        return found


class Scores:
    """The highest score of each prompt so far, kept in the folder of label images: a killed run goes on.

    `part` tells tasks apart that segment other photos.
    """

    def __init__(self, folder: Path, part: int, segmenter: Segmenter):
        self._path = folder / _SCORES.replace("*", str(part))
        self._text = segmenter if isinstance(segmenter, text.TextSegmenter | text.TextOver) else None
        if self._text is not None:
            _add(read_scores(self._path)[0], self._text.best)

    def keep(self) -> None:
        """Write them; called after each photo."""
        if self._text is not None:
            write_json(self._path, {"best": self._text.best, "threshold": self._text.threshold})


def read_scores(path: Path) -> tuple[dict[str, float], float]:
    """The scores in a file of `Scores`, by the category's name, and the least that counts.

    None of them, and 0, where it is not there or damaged.
    """
    content = read_object(path)
    best, threshold = content.get("best"), content.get("threshold")
    if not (isinstance(best, dict) and fits(best, dict[str, float]) and isinstance(threshold, float)):
        return {}, 0.0
    return best, threshold


def _add(scores: Mapping[str, float], best: dict[str, float]) -> None:
    for name, score in scores.items():
        best[name] = max(score, best.get(name, 0.0))


def prompt_lines(
    folder: Path, taxonomy: Taxonomy, occurring: set[int], warn: Callable[[str], None]
) -> list[str]:
    """A line with the highest score of each prompt; warns of those that no photo has.

    LabelError, with the scores, where no pixel of any photo has a label.
    """
    best, threshold = dict[str, float](), 0.0
    for path in sorted(folder.glob(_SCORES)):
        scores, threshold = read_scores(path)
        _add(scores, best)
    names = [name for label_id, name in taxonomy.names.items() if label_id in occurring]
    missing = [
        f"prompt {name!r}: found in no photo; its best score is {score:.2f} and {threshold:g} is needed: "
        "describe it in other words, or lower --prompt-threshold"
        for name, score in best.items()
        if name not in names
    ]
    if missing and not names:
        raise LabelError(f"{folder}: {'; '.join(missing)}")
    for line in missing:
        warn(line)
    listed = ", ".join(f"{name} {score:.2f}" for name, score in best.items())
    return [f"best scores: {listed}"] if best else []
