"""The ladder: every recorded level of every category, read from disk only when asked for."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from sagesplat.errors import RunError
from sagesplat.gaussians import Gaussians, concat
from sagesplat.train.levels import LevelFile, read_header, read_level


@dataclass(frozen=True)
class Ladder:
    """Levels by training step, in ascending order."""

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
        """The Gaussians of one level, or of some of its categories."""
        for file in self.files:
            if file.step == level:
                return read_level(file.path, label_ids)
        raise RunError(f"level {level} is not in the ladder; it has {self.levels}")

    def compose(self, levels: Mapping[int, int]) -> Gaussians:
        """The union over categories of the Gaussians of each at its level (label id -> level)."""
        return concat(
            [
                self.load(level, [i for i, at in levels.items() if at == level])
                for level in sorted(set(levels.values()))
            ]
        )


def read_ladder(folder: Path) -> Ladder:
    """The ladder in a `levels` folder."""
    files = tuple(sorted((read_header(p) for p in folder.glob("*.npz")), key=lambda f: f.step))
    if not files:
        raise RunError(f"{folder}: no levels; run `sagesplat train` first")
    return Ladder(files)
