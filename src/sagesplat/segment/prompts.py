"""Prompts: categories in the user's own words, beside COCO's."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache

from sagesplat.core.errors import LabelError, short
from sagesplat.core.names import collision_key
from sagesplat.segment import coco
from sagesplat.segment.display_names import title_of
from sagesplat.segment.edit import free_id, named
from sagesplat.segment.masks import UNLABELLED_NAME

_ARTICLES = {"a", "an", "the"}
_RESERVED = ",="  # what other options separate names with


@dataclass(frozen=True)
class Prompt:
    """A category that is found by its words."""

    words: str  # what a network is asked for
    name: str  # of the category: COCO's where it is one of COCO's
    label_id: int


def parse_prompts(text: str) -> tuple[str, ...]:
    """The prompts in "stone fountain; ivy; wooden bench".

    LabelError for none at all, an empty one, what cannot be a category's name, and two that mean the same.
    """
    prompts = [part.strip() for part in text.strip().removesuffix(";").split(";")]
    if "" in prompts:
        raise LabelError(f'prompts {short(repr(text))}: one is empty; write --prompts "stone fountain; ivy"')
    words = tuple(_named(prompt) for prompt in prompts)
    seen: dict[str | int, str] = {}
    for prompt in words:
        key = _coco_ids().get(meaning(prompt), meaning(prompt))
        if key in seen:
            other = seen[key]
            raise LabelError(f"prompts: {other!r} and {prompt!r} mean the same; leave one of them")
        seen[key] = prompt
    return words


def _named(prompt: str) -> str:
    wrong, prompt = f"prompt {short(repr(prompt))}", named(prompt, "prompt")
    if found := next((c for c in _RESERVED if c in prompt), None):
        raise LabelError(f"{wrong}: {found!r} cannot be part of a category; separate prompts by ;")
    if prompt == UNLABELLED_NAME or not meaning(prompt):
        raise LabelError(f"{wrong}: names nothing that could be seen; describe what to find")
    return prompt


def meaning(words: str) -> str:
    """The same for words that differ in case, spacing, an article or a plural s: "The Trees", "tree"."""
    parts = re.findall(r"\w+", collision_key(words).replace("_", " "))
    if len(parts) > 1 and parts[0] in _ARTICLES:
        del parts[0]
    if parts and len(parts[-1]) > 3 and parts[-1].endswith("s") and not parts[-1].endswith("ss"):
        parts[-1] = parts[-1][:-1]
    return " ".join(parts)


def prompts_of(texts: Sequence[str], base: Mapping[int, str]) -> list[Prompt]:
    """The category of each prompt, beside those of another segmenter, `base` (names by id).

    A prompt that means a category of `base` is that one; else one of COCO's if it means one; else it gets
    the first free id, from 201 on.
    """
    by_meaning = {meaning(shown): i for i, name in base.items() for shown in (title_of(name), name)}
    taken, prompts = set(base), []
    for text in texts:
        label_id = by_meaning.get(meaning(text))
        name = text if label_id is None else base[label_id]
        if label_id is None:
            own = _coco_ids().get(meaning(text))
            name = text if own is None else coco.NAMES[own]
            label_id = free_id(name, taken)
            taken.add(label_id)
        prompts.append(Prompt(text, name, label_id))
    return prompts


@cache
def _coco_ids() -> dict[str, int]:
    """COCO panoptic's ids by the meaning of their names, as they are stored and as they are shown."""
    return {meaning(shown): i for i, name in coco.NAMES.items() for shown in (title_of(name), name)}
