"""The levels of every category, recorded in training or nested, read from disk on demand."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Protocol

import numpy as np
import torch

from sagesplat.core.errors import RunError
from sagesplat.core.gaussians import Gaussians, concat, relabelled
from sagesplat.core.second_opacity import SecondOpacities, blended
from sagesplat.formats.levels import (
    LevelFile,
    read_header,
    read_level,
    read_replaces,
    read_second,
    read_sizes,
    starts_of,
)


class Ladder(Protocol):
    """Levels of quality, each category by itself: recorded in training, or prefixes of one model."""

    @property
    def levels(self) -> list[int]:
        """Their numbers, ascending: training steps of recorded ones, 1 to K of prefixes."""
        ...

    @property
    def counts(self) -> dict[tuple[int, int], int]:
        """Gaussians of each (label id, level)."""
        ...

    @property
    def recovering(self) -> frozenset[int]:
        """Levels taken soon after an opacity reset."""
        return frozenset()

    def load(self, level: int, label_ids: Sequence[int] | None = None) -> Gaussians:
        """The Gaussians of one level, or of some of its categories."""
        ...

    def size(self, level: int) -> int:
        """Gaussians of a level, all categories together."""
        return sum(n for (_, at), n in self.counts.items() if at == level)

    def compose(self, levels: Mapping[int, int]) -> Gaussians:
        """The union over categories of the Gaussians of each at its level (label id -> level)."""
        ...


@dataclass(frozen=True)
class RecordedLadder(Ladder):
    """The paper's: what training recorded on its way."""

    files: tuple[LevelFile, ...]

    @property
    def levels(self) -> list[int]:
        """Training steps of the levels."""
        return [f.step for f in self.files]

    @property
    def counts(self) -> dict[tuple[int, int], int]:
        """Gaussians of each (label id, level); 0 where a category has none (left) at a level."""
        labels = sorted({label for f in self.files for label in f.counts})
        return {(label, f.step): f.counts.get(label, 0) for f in self.files for label in labels}

    @property
    def recovering(self) -> frozenset[int]:
        """Levels taken soon after an opacity reset."""
        return frozenset(f.step for f in self.files if f.recovering)

    def load(self, level: int, label_ids: Sequence[int] | None = None) -> Gaussians:
        """See `Ladder`."""
        for file in self.files:
            if file.step == level:
                return read_level(file.path, label_ids)
        raise _unknown(level, self.levels)

    def compose(self, levels: Mapping[int, int]) -> Gaussians:
        """See `Ladder`."""
        return concat(
            [
                self.load(level, [i for i, at in levels.items() if at == level])
                for level in sorted(set(levels.values()))
            ]
        )


@dataclass(frozen=True)
class PrefixLadder(Ladder):
    """One ordered set of Gaussians per cell, of which each level is a range of rows.

    Ids, those of its Gaussians included, are of cells. Level k of a cell ends at row `sizes[cell][k - 1]`. It
    begins at row 0; or, where it or a level below replaces what is below it, where that begins (`starts`).
    """

    path: Path
    sizes: dict[int, tuple[int, ...]]
    replaces: dict[int, tuple[int, ...]] = field(default_factory=dict)  # by label id; none: only prefixes

    @property
    def levels(self) -> list[int]:
        """1 to K."""
        return list(range(1, 1 + max(map(len, self.sizes.values()))))

    @property
    def counts(self) -> dict[tuple[int, int], int]:
        """Gaussians of each (label id, level)."""
        return {
            (label, k): end - start
            for label, sizes in self.sizes.items()
            for k, (start, end) in enumerate(zip(self.starts[label], sizes, strict=True), 1)
        }

    @cached_property
    def starts(self) -> dict[int, tuple[int, ...]]:
        """The row of the category that each level begins with, by label id."""
        return {label: starts_of(sizes, self.replaces.get(label, ())) for label, sizes in self.sizes.items()}

    @cached_property
    def gaussians(self) -> Gaussians:
        """All of them, by category and in its order."""
        return read_level(self.path)

    @cached_property
    def second(self) -> SecondOpacities | None:
        """Their second opacities; None where each has only one."""
        return read_second(self.path, self.sizes)

    @cached_property
    def _rows(self) -> dict[int, range]:
        """Rows of each category, which lie together, by label id in the order of the rows."""
        labels, first, counts = np.unique(
            self.gaussians.label_ids.numpy(), return_index=True, return_counts=True
        )
        order = np.argsort(first)
        return {int(labels[i]): range(first[i], first[i] + counts[i]) for i in order}

    @cached_property
    def ranges(self) -> dict[int, tuple[tuple[int, int], ...]]:
        """First row and last + 1 of each level, among all Gaussians, by label id in the order of the rows."""
        return {
            label: tuple(
                (rows[0] + first, rows[0] + last)
                for first, last in zip(self.starts[label], self.sizes[label], strict=True)
            )
            for label, rows in self._rows.items()
            if label in self.sizes
        }

    def load(self, level: int, label_ids: Sequence[int] | None = None) -> Gaussians:
        """See `Ladder`."""
        return self.compose(dict.fromkeys(self.sizes if label_ids is None else label_ids, level))

    def compose(self, levels: Mapping[int, int]) -> Gaussians:
        """See `Ladder`."""
        for level in levels.values():
            if not 1 <= level <= len(self.levels):
                raise _unknown(level, self.levels)
        return composed(self.gaussians, self.second, self.ranges, levels)


@dataclass(frozen=True)
class NestedLadder(Ladder):
    """Ours: the levels of categories, each of which has its cells at the same level."""

    cells: PrefixLadder
    label_of: dict[int, int]  # label id by cell id

    @property
    def levels(self) -> list[int]:
        """1 to K."""
        return self.cells.levels

    @property
    def counts(self) -> dict[tuple[int, int], int]:
        """Gaussians of each (label id, level)."""
        return self._counts

    @cached_property
    def _counts(self) -> dict[tuple[int, int], int]:
        found: dict[tuple[int, int], int] = {}
        for (cell, level), count in self.cells.counts.items():
            key = self.label_of[cell], level
            found[key] = found.get(key, 0) + count
        return dict(sorted(found.items()))

    def load(self, level: int, label_ids: Sequence[int] | None = None) -> Gaussians:
        """See `Ladder`."""
        labels = set(self.label_of.values()) if label_ids is None else label_ids
        return self.compose(dict.fromkeys(labels, level))

    def compose(self, levels: Mapping[int, int]) -> Gaussians:
        """See `Ladder`."""
        return self.compose_cells(self.of_cells(levels))

    def cells_of(self, label: int) -> list[int]:
        """The ids of a category's cells, ascending: the order of its Gaussians."""
        return sorted(cell for cell, of in self.label_of.items() if of == label)

    def of_cells(self, levels: Mapping[int, int]) -> dict[int, int]:
        """Level by cell id, from levels by label id."""
        return {cell: levels[label] for cell, label in self.label_of.items() if label in levels}

    def compose_cells(self, levels: Mapping[int, int]) -> Gaussians:
        """The union over cells of the Gaussians of each at its level (cell id -> level), by category."""
        return self.by_label(self.cells.compose(levels))

    def by_label(self, g: Gaussians) -> Gaussians:
        """Gaussians of cells with the label ids of their categories, the rows of each together."""
        g = relabelled(g, self.label_of)
        found = g.label_ids
        if (found[1:] < found[:-1]).any():
            g = g.select(torch.argsort(found, stable=True))
        return g


def composed(
    g: Gaussians,
    second: SecondOpacities | None,
    ranges: Mapping[int, Sequence[tuple[int, int]]],
    levels: Mapping[int, int],
) -> Gaussians:
    """The union of a range of rows of each category, that of its level, with the opacities of that level."""
    parts = {
        label: slice(*of_level[levels[label] - 1]) for label, of_level in ranges.items() if label in levels
    }
    # slices are copied several times as fast as rows are gathered
    union = g.slices(list(parts.values()))
    if second is None or not parts:
        return union
    logits = torch.cat([second.logits[rows] for rows in parts.values()])
    counts = torch.tensor([rows.stop - rows.start for rows in parts.values()])
    weights = torch.tensor([second.weights[label][levels[label] - 1] for label in parts])
    weights = weights.repeat_interleave(counts).to(logits.device)
    return replace(union, logit_opacities=blended(union.logit_opacities, logits, weights))


def _unknown(level: int, levels: list[int]) -> RunError:
    return RunError(f"level {level} is not in the ladder; it has {levels}")


def read_ladder(folder: Path) -> RecordedLadder:
    """The levels that training recorded in a `levels` folder."""
    files = tuple(sorted((read_header(p) for p in folder.glob("[!.]*.npz")), key=lambda f: f.step))
    if not files:
        raise RunError(f"{folder}: no levels; run `sagesplat train` first")
    return RecordedLadder(files)


def read_prefixes(path: Path) -> PrefixLadder:
    """The nested ladder in a file, by cell."""
    if not path.exists():
        raise RunError(f"{path}: no nested ladder; run `sagesplat nest` first")
    sizes = read_sizes(path)
    return PrefixLadder(path, sizes, read_replaces(path, sizes))
