"""Photos and cameras for the training steps, on the device that trains."""

from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cached_property, partial

import numpy as np
import torch
from torch import Tensor

from sagesplat.kernels.planes import from_bytes
from sagesplat.scene.images import Photos
from sagesplat.scene.scene import Camera, Scene
from sagesplat.segment.valid import ALL_VALID, ValidPixels
from sagesplat.train.lr_schedule import smaller, smaller_valid

Seen = tuple[Tensor, Camera]
_MEMORY_SHARE = 0.25  # of a GPU's free memory, for photos


@dataclass(eq=False)
class PhotoLoader:
    """Photos by view and size. On a GPU they stay as bytes until a limit is reached; later ones travel each
    time, from pinned memory, and are fetched ahead of their step.
    """

    scene: Scene
    photos: Photos
    device: torch.device
    valid_pixels: ValidPixels = ALL_VALID
    limit: int = -1  # bytes of photos kept on a GPU; -1: a quarter of what is free
    _kept: dict[tuple[int, int], Seen] = field(default_factory=dict)
    _coming: dict[tuple[int, int], "Future[Seen]"] = field(default_factory=dict)
    _valid: dict[tuple[int, int], Tensor] = field(default_factory=dict)
    _used: int = 0
    _worker: ThreadPoolExecutor = field(init=False)

    def __post_init__(self) -> None:
        cuda = self.device.type == "cuda"  # which GPU is in use is every thread's own affair
        begin = partial(torch.cuda.set_device, self.device) if cuda else None
        self._worker = ThreadPoolExecutor(1, initializer=begin)
        if self.limit < 0:
            free = torch.cuda.mem_get_info(self.device)[0] if self.device.type == "cuda" else 0
            self.limit = int(_MEMORY_SHARE * free)

    def __call__(self, row: int, factor: int = 1) -> Seen:
        """A view's photo `factor` times smaller, [H, W, 3], and its camera.

        On a CPU float32 in [0, 1]; on a GPU uint8, which the loss there takes as it is.
        """
        key = row, factor
        if key in self._kept:
            return self._kept[key]
        photo, camera = self._coming.pop(key).result() if key in self._coming else self._load(row, factor)
        if self.device.type == "cpu":
            return from_bytes(photo), camera
        photo = photo.to(self.device, non_blocking=True)
        if self._used + photo.nbytes <= self.limit:
            self._kept[key] = photo, camera
            self._used += photo.nbytes
        return photo, camera

    @cached_property
    def rows(self) -> np.ndarray:
        """Rows of the views to train on: the training views that have a pixel that counts."""
        return np.array(self.valid_pixels.rows(self.scene, self.scene.train_ids), np.int64)

    def valid(self, row: int, factor: int = 1) -> Tensor | None:
        """Which pixels of a photo `factor` times smaller count, bool [H, W]; None: all."""
        key = row, factor
        if key not in self._valid:
            valid = self.valid_pixels[self.scene.views[row]]
            if valid is None:
                return None
            self._valid[key] = torch.from_numpy(smaller_valid(valid, factor)).to(self.device)
        return self._valid[key]

    def expect(self, row: int, factor: int = 1) -> None:
        """Begin to fetch a photo that a later step will look at."""
        key = row, factor
        if self.device.type != "cpu" and key not in self._kept and key not in self._coming:
            self._coming[key] = self._worker.submit(self._load, row, factor)

    def _load(self, row: int, factor: int) -> Seen:
        photo, camera = smaller(self.photos[row], self.scene.views[row].camera, factor)
        pixels = torch.from_numpy(photo)
        return pixels.pin_memory() if self.device.type == "cuda" else pixels, camera
