"""Data-parallel training: several processes train one model, one per GPU (on a CPU for tests)."""

import multiprocessing
import signal
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from multiprocessing.connection import wait
from multiprocessing.process import BaseProcess
from multiprocessing.synchronize import Semaphore
from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist

from sagesplat.core.errors import RunError, SageError
from sagesplat.raster import set_threads
from sagesplat.train.events import Event
from sagesplat.train.group import Group
from sagesplat.train.trainer import train

_LOST_AFTER = 60.0  # seconds to wait for a process to end


def train_together(processes: int, threads: int, *args: Any, **options: Any) -> Iterator[Event]:
    """`train(*args, **options)` by several processes, which share `threads` CPU threads; the same events.

    A step looks at one photo per process, or at `config.batch` if that is more: the result is that of one
    process with such a batch. Raises `RunError` too where there are fewer GPUs, or a process dies.
    """
    cuda = options.get("backend") == "cuda"
    if cuda and processes > torch.cuda.device_count():
        there = torch.cuda.device_count()
        raise RunError(f"--processes {processes}: this machine has {there} GPUs; lower it")
    each = max(1, threads // processes)
    context = multiprocessing.get_context("spawn")
    with tempfile.TemporaryDirectory() as folder:
        meeting = Path(folder) / "meeting"
        ready = context.Semaphore(0)
        shared = processes, each, meeting, cuda, ready, args, options
        workers = [
            context.Process(target=_work, args=(rank, *shared), daemon=True) for rank in range(1, processes)
        ]
        with _without_ctrl_c():
            for worker in workers:
                worker.start()
        before = torch.get_num_threads()
        set_threads(each)
        try:
            for _ in workers:  # who waits in torch.distributed waits long for one that will not come
                while not ready.acquire(timeout=0.2):
                    if any(worker.exitcode for worker in workers):
                        raise RuntimeError
            with _joined(0, processes, meeting, cuda) as group:
                yield from train(*args, **options, group=group)
        except RuntimeError as error:  # what torch.distributed raises when somebody is gone
            if (lost := _lost(workers)) is None:
                raise
            raise RunError(f"{lost}; look at its message above, then run again") from error
        finally:
            set_threads(before)
            for worker in workers:
                worker.terminate()
                worker.join()


@contextmanager
def _without_ctrl_c() -> Iterator[None]:
    """Processes that begin in the block never get SIGINT, which terminals send to all: this one ends them."""
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _lost(workers: Sequence[BaseProcess]) -> str | None:
    """Which process is gone, in words; the connection to it is lost before it has ended."""
    wait([worker.sentinel for worker in workers], timeout=_LOST_AFTER)
    for rank, worker in enumerate(workers, 1):
        worker.join(5)
        if worker.exitcode:
            return f"process {rank} of {len(workers) + 1} ended with code {worker.exitcode}"
    return None


@contextmanager
def _joined(rank: int, size: int, meeting: Path, cuda: bool) -> Iterator[Group]:
    if cuda:
        torch.cuda.set_device(rank)
    dist.init_process_group(
        "nccl" if cuda else "gloo", init_method=meeting.as_uri(), rank=rank, world_size=size
    )
    try:
        yield Group(rank, size)
    finally:
        dist.destroy_process_group()


def _work(
    rank: int,
    size: int,
    threads: int,
    meeting: Path,
    cuda: bool,
    ready: Semaphore,
    args: tuple[Any, ...],
    options: dict[str, Any],
) -> None:
    ready.release()
    set_threads(threads)
    try:
        with _joined(rank, size, meeting, cuda) as group:
            for _ in train(*args, **options, group=group):
                pass
    except SageError as error:
        raise SystemExit(f"process {rank}: {error}") from None
