"""What the checks of a machine with a GPU share."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from sagesplat.core.gaussians import Gaussians
from sagesplat.raster import Backend, device_of
from sagesplat.scene.images import Photos
from sagesplat.scene.scene import Scene
from sagesplat.segment.masks import Masks
from sagesplat.train.state import from_points


@dataclass(frozen=True)
class Asked:
    """The command line."""

    scene: Path
    downscale: int = 1
    steps: int = 30_000
    minutes: float = 9.0
    device: Literal["cuda", "cpu"] = "cuda"
    only: tuple[str, ...] = ()
    runs: tuple[str, ...] = ()
    masks: Path | None = None
    lpips: Path | None = None
    out: Path | None = None
    write: bool = False


@dataclass(frozen=True)
class Outcome:
    """What became of a check."""

    state: Literal["ok", "FAILED", "skipped"]
    line: str
    figures: dict[str, Any] = field(default_factory=dict)


@dataclass(eq=False)
class Clock:
    """Seconds of wall time between `start` and `stop`, the device's work included."""

    device: torch.device
    seconds: float = 0.0
    _begin: float = 0.0

    def start(self) -> None:
        """Go on."""
        wait(self.device)
        self._begin = time.perf_counter()

    def stop(self) -> None:
        """Hold."""
        wait(self.device)
        self.seconds += time.perf_counter() - self._begin


@dataclass(eq=False)
class Bench:
    """What the checks share."""

    asked: Asked
    backend: Backend
    end: float  # of the time, on perf_counter's clock
    scene: Scene
    photos: Photos
    masks: Masks | None
    labels: np.ndarray  # int16 [P], category of each point
    steps: int = 0  # of each long run, once it is known
    runs: dict[str, Any] = field(default_factory=dict)  # trainings (or the errors they ended with) by name
    trained: Gaussians | None = None  # on the CPU

    @cached_property
    def device(self) -> torch.device:
        """Where the Gaussians lie."""
        return device_of(self.backend)

    @cached_property
    def small(self) -> bool:
        """Whether this is a trial of the script."""
        return self.device.type == "cpu"

    def left(self) -> float:
        """Seconds."""
        return self.end - time.perf_counter()

    def initial(self) -> Gaussians:
        """What every training begins with, on the device."""
        return from_points(self.scene.points, self.labels, 3).to(self.device)

    def chosen(self, name: str) -> bool:
        """Whether a check is asked for."""
        return not self.asked.only or name in self.asked.only


def milliseconds(device: torch.device, call: Callable[[], Any], repeats: int = 30) -> float:
    """Mean time of a call on the device, after three to warm up."""
    for _ in range(3):
        call()
    begin = mark(device)
    for _ in range(repeats):
        call()
    end = mark(device)
    wait(device)
    return between(begin, end) / repeats


def mark(device: torch.device) -> Any:
    """A point in the device's time."""
    if device.type == "cpu":
        return time.perf_counter()
    event = torch.cuda.Event(enable_timing=True)
    event.record()
    return event


def between(begin: Any, end: Any) -> float:
    """Milliseconds between two marks, after `wait`."""
    return 1e3 * (end - begin) if isinstance(begin, float) else begin.elapsed_time(end)


def wait(device: torch.device) -> None:
    """Until the device has done all."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def one_line(error: BaseException) -> str:
    """An error's first line."""
    return f"{type(error).__name__}: {str(error).strip().partition(chr(10))[0]}"[:160]
