"""Tasks on the nodes of a Ray cluster, which share the disk of the run folder and the capture."""

import time
import uuid
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal

import ray
from ray.exceptions import RayError, RayTaskError
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

from sagesplat import __version__
from sagesplat.core.errors import RunError, short
from sagesplat.core.events import Emit, Event, Warned
from sagesplat.io.files import write_text
from sagesplat.run.executor import EventBuffer, ProgressAggregator, Task
from sagesplat.run.ray_task import ANSWER, Failed, WorkerEnvironment, run_task

_TRIES = 3  # of a task, after the first
_POLL = 0.1  # seconds between two checks of the tasks
_STALLED = 30.0  # seconds without any task at work until a warning


class RayExecutor:
    """Runs tasks on a cluster that this process is connected to."""

    def __init__(
        self, folder: Path, threads: int = 1, backend: Literal["cuda"] | None = None, gpus: float = 0
    ):
        """`folder`: what all nodes share. Tasks take `threads` CPUs and `gpus` GPUs each, in the main."""
        self.backend: Literal["cuda"] | None = backend
        self._threads, self._gpus = threads, gpus
        # named as temporary files are: the next stage removes what a killed driver left
        self._place = WorkerEnvironment(
            folder.absolute() / f".cluster.tmp-{uuid.uuid4().hex[:12]}", Path.cwd()
        )
        near = NodeAffinitySchedulingStrategy(ray.get_runtime_context().get_node_id(), soft=True)
        options: dict[str, Any] = {"num_cpus": 0, "max_restarts": -1, "scheduling_strategy": near}
        self._post: Any = ray.remote(**options)(EventBuffer).remote()
        self._taking: Any = None

    @property
    def parallel(self) -> int:
        """See `Executor`; follows the cluster as it grows and shrinks."""
        return max(1, sum(self._slots(node) for node in self._nodes()))

    @property
    def memory(self) -> int:
        """See `Executor`: the least of the nodes' that can do tasks."""
        shares = [
            node["memory"] / n for node in self._nodes() if (n := self._slots(node)) and "memory" in node
        ]
        return int(min(shares, default=0))

    def close(self) -> None:
        """Remove what lies in the shared folder."""
        self._place.marker.unlink(missing_ok=True)
        with suppress(RayError):
            ray.kill(self._post)

    def run(self, tasks: Sequence[Task], emit: Emit) -> Iterator[tuple[int, Any]]:
        """See `Executor`. A task whose process or node is lost is done again elsewhere."""
        for task in tasks:
            self._check_possible(task)
        write_text(self._place.marker, "")
        run, together = uuid.uuid4().hex, ProgressAggregator(tasks, emit)
        pending = {self._submit(task, run, number): number for number, task in enumerate(tasks)}
        lost, at = dict.fromkeys(range(len(tasks)), 0), dict[int, str]()
        active, said = time.monotonic(), False
        try:
            while pending:
                ready, _ = ray.wait(list(pending), num_returns=1, timeout=_POLL)
                self._listen(run, together, at, wait=ANSWER if ready else 0.0)
                if ready or any(number in at for number in pending.values()):
                    active = time.monotonic()
                elif time.monotonic() - active > _STALLED:
                    for number in pending.values():
                        self._check_possible(tasks[number])
                    if not said:
                        emit(Warned(f"{tasks[0].name}: waiting for {self._asked(tasks[0])} of the cluster"))
                    active, said = time.monotonic(), True
                for done in ready:
                    number = pending.pop(done)
                    try:
                        result = self._result(done)
                    except RayError as error:
                        which = f"{tasks[number].name} ({number + 1} of {len(tasks)})"
                        why = f"its process on {at.pop(number, 'a node')} was lost"
                        lost[number] += 1
                        if lost[number] > _TRIES:
                            cause = short(str(error).strip().partition("\n")[0])
                            raise RunError(
                                f"{which}: {why} {lost[number]} times ({cause}); look at that node's memory "
                                "and at Ray's logs there, then run the same command again"
                            ) from None
                        emit(Warned(f"{which}: {why}; done again ({lost[number]} of {_TRIES})"))
                        pending[self._submit(tasks[number], run, number)] = number
                        continue
                    if isinstance(result, Failed):
                        raise result.error
                    together.end(number)
                    yield number, result
        finally:
            self._cancel(list(pending))

    def _submit(self, task: Task, run: str, number: int) -> Any:
        cpus = self._cpus(task.gpus)
        asked: dict[str, Any] = {
            "num_cpus": cpus, "num_gpus": task.gpus, "max_retries": 0, "scheduling_strategy": "SPREAD",
        }  # fmt: skip
        if task.memory:
            asked["memory"] = task.memory
        return ray.remote(**asked)(run_task).remote(task, self._place, self._post, run, number, cpus)

    def _result(self, done: Any) -> Any:
        """What a task returned; its own error where it raised one, RayError where it was lost."""
        try:
            return ray.get(done)
        except RayTaskError as error:
            cause = error.cause
            if isinstance(cause, ModuleNotFoundError):
                raise RunError(
                    f"a node of the cluster has no {cause.name}; install sagesplat {__version__} on all nodes"
                ) from None
            if isinstance(cause, Exception):
                raise cause from error  # which shows where it came from
            raise

    def _listen(self, run: str, together: ProgressAggregator, at: dict[int, str], wait: float) -> None:
        """Pass on what the tasks told; all of it that came before now, where there is time to `wait`."""
        told: list[tuple[str, int, Event | str]] = []
        try:
            fresh = self._taking is None
            self._taking = self._taking or self._post.take.remote()
            if ray.wait([self._taking], timeout=wait)[0]:
                asked, self._taking = self._taking, None
                told = ray.get(asked)
                if wait and not fresh:  # asked for before the last task was done
                    told += ray.get(self._post.take.remote(), timeout=wait)
        except RayError:  # lost with its process, and begun anew
            pass
        for of, number, event in told:
            if of != run:  # of tasks that were given up
                continue
            if isinstance(event, str):
                at[number] = event
            else:
                together.tell(number, event)

    def _cancel(self, pending: list[Any]) -> None:
        """End tasks, and wait until they have; they have where the connection is gone."""
        if not (pending and ray.is_initialized()):
            return
        for task in pending:
            with suppress(RayError):
                ray.cancel(task, force=True)
        with suppress(RayError):
            ray.wait(pending, num_returns=len(pending), timeout=ANSWER)

    def _nodes(self) -> list[Mapping[str, float]]:
        return [node["Resources"] for node in ray.nodes() if node["Alive"]]

    def _slots(self, node: Mapping[str, float]) -> int:
        """Tasks of the usual kind that a node can do at once."""
        most = node.get("CPU", 0) // self._cpus(self._gpus)
        return int(min(most, node.get("GPU", 0) // self._gpus) if self._gpus else most)

    def _cpus(self, gpus: float) -> int:
        """CPUs of a task; with GPUs at most their share of the node's, so that all GPUs can be used."""
        if not gpus:
            return self._threads
        shares = [node.get("CPU", 0) * gpus / node["GPU"] for node in self._nodes() if node.get("GPU")]
        return max(1, min(self._threads, int(max(shares, default=1))))

    def _asked(self, task: Task) -> str:
        counts = {"CPU": self._cpus(task.gpus), "GPU": task.gpus}
        asked = ", ".join(f"{n:g} {name}{'s' if n > 1 else ''}" for name, n in counts.items() if n)
        return asked + (f", {task.memory / 2**30:.1f} GiB" if task.memory else "")

    def _check_possible(self, task: Task) -> None:
        """RunError where no node has what a task asks for, even when nobody else uses it."""
        needs = {"CPU": self._cpus(task.gpus), "GPU": task.gpus, "memory": task.memory}
        nodes = self._nodes()
        if not any(all(node.get(name, 0) >= amount for name, amount in needs.items()) for node in nodes):
            most = max((int(node.get("CPU", 0)) for node in nodes), default=0)
            cure = "use --device cpu, or add a node with a GPU" if task.gpus else f"use --threads {most}"
            cure = "add a larger node" if task.memory or not most else cure
            raise RunError(
                f"{task.name}: no node of the cluster has {self._asked(task)} (most CPUs: {most}); {cure}"
            )
