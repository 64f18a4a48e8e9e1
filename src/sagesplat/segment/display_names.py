"""Names of categories, for people."""

from collections import Counter
from collections.abc import Collection, Mapping

_SUFFIXES = ("-merged", "-other", "-stuff")  # of COCO's panoptic names


def title_of(name: str) -> str:
    """A category's name for people: grass for grass-merged; the name itself where nothing else is left.

    An instance keeps its number: tree 2 for tree-merged 2.
    """
    title, _, number = name.rpartition(" ")
    if title and number.isdecimal():
        return f"{title_of(title)} {number}"
    title = name
    for suffix in _SUFFIXES:
        title = title.removesuffix(suffix)
    return title.replace("-", " ").strip() or name


def categories(count: int) -> str:
    """How many categories: "1 category", "8 categories"."""
    return f"{count} {'category' if count == 1 else 'categories'}"


def meant(typed: str, names: Collection[str]) -> str:
    """The name that was typed: it itself, or the only one that people see so; else what was typed."""
    if typed in names:
        return typed
    found = [name for name in names if title_of(name) == typed]
    return found[0] if len(found) == 1 else typed


def titles(names: Mapping[int, str]) -> dict[int, str]:
    """Names for people by label id; names whose short forms are the same keep their full ones."""
    short = {label: title_of(name) for label, name in names.items()}
    times = Counter(short.values())
    return {label: short[label] if times[short[label]] == 1 else name for label, name in names.items()}
