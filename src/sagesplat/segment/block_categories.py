"""Per-block categories: each (block, category) pair has an id and a name of its own."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sagesplat.core.errors import LabelError
from sagesplat.segment.masks import MAX_LABEL_ID, UNLABELLED, Taxonomy

_MARK = "@"  # between category and block in a name


@dataclass(frozen=True)
class BlockCategories:
    """Numbers per-block categories: those of block 0, of block 1, ...; in each, unlabelled comes first."""

    taxonomy: Taxonomy  # of the categories
    blocks: int

    def __post_init__(self) -> None:
        if self.blocks * len(self.categories) > MAX_LABEL_ID:
            raise LabelError(
                f"{self.blocks} blocks of {len(self.categories)} categories are too many; choose fewer with "
                "--blocks.count or --labels.keep"
            )

    @cached_property
    def categories(self) -> np.ndarray:
        """Category ids, ascending."""
        return np.array([UNLABELLED, *sorted(self.taxonomy.names)], np.int16)

    def ids(self, label_ids: np.ndarray, block: np.ndarray | int) -> np.ndarray:
        """Per-block ids (int16) of category ids and blocks; arrays of one shape."""
        column = np.searchsorted(self.categories, label_ids)
        return (column + np.asarray(block) * len(self.categories)).astype(np.int16)

    def block_of(self, part_ids: np.ndarray) -> np.ndarray:
        """Blocks of per-block ids."""
        return (part_ids // len(self.categories)).astype(np.int16)

    def category_ids(self, part_ids: np.ndarray) -> np.ndarray:
        """Category ids (int16) of per-block ids."""
        return self.categories[part_ids % len(self.categories)]

    @property
    def names(self) -> Taxonomy:
        """The per-block categories as a taxonomy."""
        found = {}
        for block in range(self.blocks):
            for column, label in enumerate(self.categories.tolist()):
                part = block * len(self.categories) + column
                found[part] = per_block_name(self.taxonomy.name(label), block)
        return Taxonomy(found)


def per_block_name(category: str, block: int | None) -> str:
    """The name of a (block, category) pair; block None: the category's own."""
    return category if block is None else f"{category}{_MARK}{block}"


def category_of(name: str) -> str:
    """The category in a per-block name; any other name unchanged."""
    return split_name(name)[0]


def split_name(name: str) -> tuple[str, int | None]:
    """Category and block of a per-block name; (name, None) for any other name."""
    category, mark, block = name.rpartition(_MARK)
    return (category, int(block)) if mark and category and block.isdecimal() else (name, None)
