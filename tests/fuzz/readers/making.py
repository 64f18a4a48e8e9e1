"""What the lists of readers share: small splats and photos, and readers of a path as readers of bytes."""

import json
import os
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import torch
from PIL import Image

from sagesplat.core.gaussians import Gaussians

PHOTOS = ("a.png", "b.png", "c.png")


def splats(count: int = 3, bases: int = 3) -> Gaussians:
    """A few Gaussians of two categories."""
    generator = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    labels = torch.tensor([2] * (count - 1) + [5], dtype=torch.int16)
    scales, opacities, shN = normal(count, 3) - 3, normal(count), 0.1 * normal(count, bases, 3)
    return Gaussians(normal(count, 3), normal(count, 4), scales, opacities, normal(count, 1, 3), shN, labels)


def written(path: Path, write: Callable[[Path], Any]) -> bytes:
    """What a writer writes."""
    write(path)
    content = path.read_bytes()
    path.unlink()
    return content


@cache
def _handle(path: Path) -> int:
    path.parent.mkdir(parents=True, exist_ok=True)
    return os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644)


def put(path: Path, content: bytes) -> Path:
    """Make this a file's content, in place: opening it each time would take longer than most readers do."""
    if not path.exists():
        _handle.cache_clear()
    os.ftruncate(_handle(path), len(content))
    os.pwrite(_handle(path), content, 0)
    return path


def file(name: str, read: Callable[[Path], Any]) -> Callable[[Path, bytes], Any]:
    """A reader of a path as one of content; `name` is the file's."""
    return lambda folder, content: read(put(folder / name, content))


Make = Callable[[Path, int], list[bytes]]


def written_by(name: str, write: Callable[[Path, int], Any]) -> Make:
    """A maker of what a function writes to a path, by size."""
    return lambda folder, size: [written(folder / name, lambda path: write(path, size))]


def noted(entries: Mapping[str, Any]) -> Make:
    """A maker of a document with these entries, and with as many others as the size says."""
    return documents(lambda size: {**entries, **{f"note{i}": i for i in range(size - 1)}})


def documents(*made: Callable[[int], Any]) -> Make:
    """A maker of JSON: a document by size, or several."""
    return lambda folder, size: as_json(*(document(size) for document in made))


def as_json(*documents: Any) -> list[bytes]:
    """Documents as files."""
    return [json.dumps(document).encode() for document in documents]


def put_photos(folder: Path) -> None:
    """Three small photos."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in PHOTOS:
        Image.new("RGB", (16, 12), (9, 99, 9)).save(folder / name)
