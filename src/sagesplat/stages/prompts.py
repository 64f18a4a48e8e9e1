"""What segmentation tells while it runs: how long it will take, and what prompts found."""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from sagesplat.core.config import MasksConfig
from sagesplat.core.durations import duration
from sagesplat.core.errors import LabelError
from sagesplat.core.limits import Number
from sagesplat.io.files import write_json
from sagesplat.io.typed import known_json
from sagesplat.segment import text
from sagesplat.segment.masks import Taxonomy
from sagesplat.segment.registry import SEGMENTERS
from sagesplat.segment.segmenters import Segmented, Segmenter

_SCORES = ".prompts-*.json"  # a file for each task
MASKS = "masks"  # label images that were given: no network, but for the prompts over them
_SAME = 0.9  # intersection over union of all masks of two prompts, from which on they mean the same


def settings_of(kind: str, config: MasksConfig) -> dict[str, Any]:
    """What the label images depend on: the segmenter's settings, and those of prompts over it.

    Of `MASKS` those of the prompts alone.
    """
    if kind == MASKS:
        return text.settings(replace(config, segmenter="text"))
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
    given: Taxonomy | None = None,
) -> Segmenter:
    """The segmenter, with the prompts over it where there are some; `instances`: whether they are wanted.

    Of `MASKS` the one for the prompts; `given`: the categories of the label images.
    """
    if kind == MASKS:
        base = {} if given is None else given.names
        return text.load_text(replace(config, segmenter="text"), device, threads, warn, base)
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
    """Scores and masks' areas of prompts so far, kept in the folder of label images: a killed run goes on.

    `part` tells tasks apart that segment other photos.
    """

    def __init__(self, folder: Path, part: int, segmenter: Segmenter):
        self._path = folder / _SCORES.replace("*", str(part))
        self._text = segmenter if isinstance(segmenter, text.TextSegmenter | text.TextOver) else None
        if self._text is not None:
            known = read_scores(self._path)
            _add(known.best, self._text.best)
            for pair, area in known.shared.items():
                self._text.shared[pair] = self._text.shared.get(pair, 0.0) + area

    def keep(self) -> None:
        """Write them; called after each photo."""
        if self._text is not None:
            names = {f.name for f in fields(KnownScores)}
            write_json(self._path, {name: getattr(self._text, name) for name in sorted(names)})


@dataclass(frozen=True)
class KnownScores:
    """What a file of `Scores` holds."""

    best: dict[str, Number] = field(default_factory=dict)  # highest score, by the category's name
    shared: dict[str, Number] = field(default_factory=dict)  # areas, by pair of names: see `TextSegmenter`
    threshold: Number = 0.0  # least score that counts


def read_scores(path: Path) -> KnownScores:
    """What is in a file of `Scores`; nothing where it is not there or damaged."""
    return known_json(path, KnownScores) or KnownScores()


def _add(scores: Mapping[str, float], best: dict[str, float]) -> None:
    for name, score in scores.items():
        best[name] = max(score, best.get(name, 0.0))


def prompt_lines(
    folder: Path, taxonomy: Taxonomy, occurring: set[int], warn: Callable[[str], None]
) -> list[str]:
    """A line with the highest score of each prompt; warns of those that no photo has, or that mean the same.

    LabelError, with the scores, where no pixel of any photo has a label.
    """
    best, shared, threshold = dict[str, float](), dict[str, float](), 0.0
    for path in sorted(folder.glob(_SCORES)):
        known = read_scores(path)
        threshold = known.threshold
        _add(known.best, best)
        for pair, area in known.shared.items():
            shared[pair] = shared.get(pair, 0.0) + area
    names = [name for label_id, name in taxonomy.names.items() if label_id in occurring]
    missing = [_missing(name, score, threshold) for name, score in best.items() if name not in names]
    if missing and not names:
        raise LabelError(f"{folder}: {'; '.join(missing)}")
    for line in (*missing, *_synonyms(shared)):
        warn(line)
    listed = ", ".join(f"{name} {score:.2f}" for name, score in best.items())
    return [f"best scores: {listed}"] if best else []


def _missing(name: str, score: float, threshold: float) -> str:
    """Why no pixel has a prompt's label: its best score is too low, or other prompts have them all."""
    if score >= threshold:
        return (
            f"prompt {name!r}: found with a score of up to {score:.2f}, but other prompts have a larger "
            "probability at all its pixels: describe it in other words, or leave one of them"
        )
    digits = (f"{score:.{n}f}" for n in (2, 3, 4))  # as many as show that it is below
    shown = next((text for text in digits if float(text) < threshold), f"{score}")
    return (
        f"prompt {name!r}: found in no photo; its best score is {shown} and {threshold:g} is needed: "
        "describe it in other words, or lower --prompt-threshold"
    )


def _synonyms(shared: Mapping[str, float]) -> Iterator[str]:
    """A line for each two prompts whose masks are the same nearly everywhere."""
    for pair, common in shared.items():
        one, _, other = pair.partition("=")
        either = shared.get(f"{one}={one}", 0) + shared.get(f"{other}={other}", 0) - common
        if one != other and common > 0 and (overlap := common / max(either, common)) >= _SAME:
            yield (
                f"prompts {one!r} and {other!r}: the network finds the same for both (their masks overlap by "
                f'{overlap:.0%}); leave one of them, or add --labels.merge "{other}={one}"'
            )
