"""Where the independent pieces of a stage are computed: here, or on the nodes of a cluster."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from sagesplat.events import Emit


@dataclass(frozen=True)
class Task:
    """A piece of work that another process can do, and do again: what it writes is the same each time.

    `function` is one of a module, called as `function(*arguments, emit)`; its arguments and result can be
    pickled. It reads and writes files of the run folder and the capture, which all nodes see.
    """

    name: str  # for messages
    function: Callable[..., Any]
    arguments: tuple[Any, ...] = ()
    gpus: float = 0.0  # that it computes on
    memory: int = 0  # bytes that it is expected to need (0: not known)


class Executor(Protocol):
    """Does tasks."""

    @property
    def parallel(self) -> int:
        """How many tasks it can do at once: what a stage divides its work by."""
        ...

    def run(self, tasks: Sequence[Task], emit: Emit) -> Iterator[tuple[int, Any]]:
        """The result of each task with its number, as they come; events of the tasks go to `emit`.

        The first SageError of a task ends all of them.
        """
        ...


class Local:
    """One task after the other, in this process."""

    parallel = 1

    def run(self, tasks: Sequence[Task], emit: Emit) -> Iterator[tuple[int, Any]]:
        """See `Executor`."""
        for number, task in enumerate(tasks):
            yield number, task.function(*task.arguments, emit)


LOCAL: Executor = Local()


def results(executor: Executor, tasks: Sequence[Task], emit: Emit) -> list[Any]:
    """The results of all tasks, in their order."""
    found = dict(executor.run(tasks, emit))
    return [found[number] for number in range(len(tasks))]
