"""Events of a run. The engine emits them and prints nothing; the console, the tests and the viewer listen."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path


@dataclass(frozen=True)
class StageStarted:
    """A stage begins."""

    name: str


@dataclass(frozen=True)
class StageSkipped:
    """A stage is skipped: its result was made from the same inputs with the same settings."""

    name: str


@dataclass(frozen=True)
class Progress:
    """Progress of a stage: `done` of `total` units of work, and a short text."""

    name: str
    done: int
    total: int
    text: str = ""


@dataclass(frozen=True)
class Training:
    """Progress of training, emitted at every step."""

    step: int
    total: int
    loss: float
    counts: dict[str, int]  # Gaussians by category name, at the last recorded level
    num_gaussians: int


@dataclass(frozen=True)
class Warned:
    """A warning that does not stop the run."""

    text: str


@dataclass(frozen=True)
class Noted:
    """Something to know before it happens."""

    text: str


@dataclass(frozen=True)
class StageDone:
    """A stage ended; `lines` summarise its result."""

    name: str
    seconds: float
    lines: tuple[str, ...]


@dataclass(frozen=True)
class TableMade:
    """A table for the console."""

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class RunDone:
    """The run ended, with a report."""

    report: Path
    next: tuple[str, ...] = ()  # words of the command that comes next, without the program
    noticed: tuple[str, ...] = ()  # what the run noticed, and dealt with, in words
    outcome: str = ""  # the run in one line: its size and its quality


Event = StageStarted | StageSkipped | Progress | Training | Warned | Noted | StageDone | TableMade | RunDone
Emit = Callable[[Event], None]


def named(emit: Emit, name: str) -> Emit:
    """An `Emit` for one of several tasks: events get its name as a prefix; tables and skips are dropped."""

    def tell(event: Event) -> None:
        match event:
            case StageStarted() | StageDone() | Progress():
                emit(replace(event, name=f"{name}/{event.name}"))
            case Warned(text):
                emit(Warned(f"{name}: {text}"))
            case Training():
                emit(event)

    return tell
