"""Where independent tasks of a stage run: in this process, or on the nodes of a cluster."""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal, Protocol, TypeVar

from sagesplat.core.events import Emit, Event, Noted, Progress, Training, Warned

Item = TypeVar("Item")


@dataclass(frozen=True)
class Task:
    """A unit of work that another process can run, and repeat: its output is the same each time.

    `function` is one of a module, called as `function(*arguments, emit)`; its arguments and result can be
    pickled. It reads and writes files of the run folder and the capture, which all nodes see. Tasks of one
    name belong together: their progress is shown as one.
    """

    name: str  # for messages
    function: Callable[..., Any]
    arguments: tuple[Any, ...] = ()
    gpus: float = 0.0  # that it computes on
    memory: int = 0  # bytes that it is expected to need (0: not known)


class Executor(Protocol):
    """Runs tasks."""

    @property
    def parallel(self) -> int:
        """How many tasks run at once; a stage divides its work by it."""
        ...

    @property
    def backend(self) -> Literal["cuda"] | None:
        """What tasks compute with where that is not this process's backend."""

    @property
    def memory(self) -> int:
        """Bytes of a node's memory that are a task's share (0: all that its machine has)."""
        ...

    def run(self, tasks: Sequence[Task], emit: Emit) -> Iterator[tuple[int, Any]]:
        """The result of each task with its number, as they come; events of the tasks go to `emit`.

        The first SageError of a task ends all of them.
        """
        ...


class Local:
    """One task after the other, in this process."""

    parallel = 1
    backend = None
    memory = 0

    def run(self, tasks: Sequence[Task], emit: Emit) -> Iterator[tuple[int, Any]]:
        """See `Executor`."""
        for number, task in enumerate(tasks):
            yield number, task.function(*task.arguments, emit)


LOCAL: Executor = Local()


def results(executor: Executor, tasks: Sequence[Task], emit: Emit) -> list[Any]:
    """The results of all tasks, in the order of the tasks."""
    found = dict(executor.run(tasks, emit))
    return [found[number] for number in range(len(tasks))]


def split(items: Sequence[Item], parts: int) -> list[Sequence[Item]]:
    """Up to `parts` neighbouring pieces of nearly equal length, none empty unless there are no items."""
    parts = max(1, min(parts, len(items)))
    ends = [len(items) * i // parts for i in range(parts + 1)]
    return [items[a:b] for a, b in pairwise(ends)]


class ProgressAggregator:
    """Forwards the events of tasks; tasks of one name appear as one.

    Their progress is summed (a task without any yet counts as the mean of the others), and a warning of
    several of them is forwarded once.
    """

    def __init__(self, tasks: Sequence[Task], emit: Emit):
        self._names = [task.name for task in tasks]
        self._parts = Counter(self._names)
        self._emit = emit
        self._reported: dict[str, dict[int, tuple[int, int]]] = {}  # (done, total) by number, by name
        self._ended: dict[str, set[int]] = {}
        self._warned: set[tuple[str, str]] = set()

    def tell(self, number: int, event: Event) -> None:
        """Forward an event of a task."""
        name = self._names[number]
        if self._parts[name] == 1:
            self._emit(event)
            return
        match event:
            case Progress(_, done, total, text):
                self._add(name, number, done, total, text)
            case Training(step, total, loss):
                self._add(name, number, step, total, f"loss {loss:.3f}")
            case Warned(text) | Noted(text) if (name, text) in self._warned:
                pass
            case Warned(text) | Noted(text):
                self._warned.add((name, text))
                self._emit(event)
            case _:
                self._emit(event)

    def end(self, number: int) -> None:
        """Count a task as complete, whatever it reported last."""
        name = self._names[number]
        self._ended.setdefault(name, set()).add(number)
        reported = self._reported.get(name, {})
        if self._parts[name] > 1 and number in reported:
            total = reported[number][1]
            self._add(name, number, total, total, "")

    def _add(self, name: str, number: int, done: int, total: int, text: str) -> None:
        reported, ended = self._reported.setdefault(name, {}), self._ended.get(name, set())
        # of a task on another machine an event may come after its end
        reported[number] = total if number in ended else done, total
        known = sum(of for _, of in reported.values())
        each = known / len(reported)
        silent = ended - reported.keys()
        reached = sum(done for done, _ in reported.values()) + each * len(silent)
        whole = known + each * (self._parts[name] - len(reported))
        self._emit(Progress(name, round(reached), round(whole), text))


class EventBuffer:
    """Buffers the events of tasks until they are fetched: an actor, which may be lost with its content."""

    def __init__(self) -> None:
        self._events: list[tuple[str, int, Event | str]] = []

    def tell(self, run: str, number: int, event: Event | str) -> None:
        """Keep an event of a task, or the name of the node that it began on."""
        self._events.append((run, number, event))

    def take(self) -> list[tuple[str, int, Event | str]]:
        """The events since the last call."""
        taken, self._events = self._events, []
        return taken
