"""What a run tells whoever watches it. The engine emits these and prints nothing."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path


@dataclass(frozen=True)
class StageStarted:
    """A stage begins."""

    name: str


@dataclass(frozen=True)
class StageSkipped:
    """A stage's result is there already, made from the same inputs with the same settings."""

    name: str


@dataclass(frozen=True)
class Progress:
    """A stage has done so much of its work."""

    name: str
    done: int
    total: int
    text: str = ""


@dataclass(frozen=True)
class Training:
    """Progress of the training stage: once a step."""

    step: int
    total: int
    loss: float
    counts: dict[str, int]  # Gaussians by category name, as of the last level
    num_gaussians: int


@dataclass(frozen=True)
class Warned:
    """Something that the user should know, but that does not stop the run."""

    text: str


@dataclass(frozen=True)
class StageDone:
    """A stage has ended; `lines` sum up its result."""

    name: str
    seconds: float
    lines: tuple[str, ...]


@dataclass(frozen=True)
class TableMade:
    """A table worth showing."""

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class RunDone:
    """The end of a run."""

    report: Path
    run: Path | None = None  # where there is something to walk through (`sagesplat view`)


Event = StageStarted | StageSkipped | Progress | Training | Warned | StageDone | TableMade | RunDone
Emit = Callable[[Event], None]


def named(emit: Emit, name: str) -> Emit:
    """Passes on what a part of a larger work does, under its name; not its tables, nor what is up to date."""

    def tell(event: Event) -> None:
        match event:
            case StageStarted() | StageDone() | Progress():
                emit(replace(event, name=f"{name}/{event.name}"))
            case Warned(text):
                emit(Warned(f"{name}: {text}"))
            case Training():
                emit(event)

    return tell
