"""Ctrl-C, SIGTERM and SIGHUP: each ends the program in order, with one line, however often it comes.

A signal becomes an exception in the main thread, so that `finally` and `with` blocks release locks, remove
temporary files and end child processes. Standard library only: it is imported before everything else.
"""

import atexit
import math
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import Any, NoReturn

_NAMES = ("SIGINT", "SIGTERM", "SIGHUP")  # Windows has no SIGHUP
_HANDLED = [getattr(signal, name) for name in _NAMES if hasattr(signal, name)]
_SAME = 3.0  # seconds in which further signals are the same wish: they must not cut off the cleaning up
_RETRY = 0.05  # seconds until an exception that went astray is raised again
_KEPT = "finished stages and checkpoints are kept: run the same command again to resume"


class Stopped(KeyboardInterrupt):
    """A signal asks this process to end.

    A class of our own for Ctrl-C too: after a plain KeyboardInterrupt that passed through an `exec`, as in
    imports, Python kills itself at the end, though it was caught.
    """

    def __init__(self, number: int):
        self.number = number
        super().__init__(signal.Signals(number).name)


class Left(SystemExit):
    """The program was stopped: the line that says so is printed, and nothing is left to be done."""


class _Stop:
    """The handler of all signals."""

    def __init__(self) -> None:
        self.number: int = signal.SIGINT  # of the newest that was not ignored
        self.ending = False  # the outcome is known: nothing is left to interrupt
        self.deferring = self.waiting = False  # see `deferred`
        self.watched = False  # see `answered_at_once`
        self._since = -math.inf

    def __call__(self, number: int, frame: FrameType | None) -> None:
        if self.watched:
            return
        now = time.monotonic()
        if now - self._since < _SAME:
            return
        self._since = now
        if self.ending:  # and something hangs
            os._exit(_exit_code(number))
        self.number = number
        if self.deferring and not self.waiting:
            self.waiting = True
            return
        self.throw()

    def throw(self, *_: object) -> NoReturn:
        raise Stopped(self.number)

    def end(self) -> None:
        """From now on signals change nothing, unless the process still hangs after some seconds."""
        self.ending, self._since = True, time.monotonic()
        atexit.register(_ignore)  # the interpreter's own end would restore the defaults


_stop = _Stop()


@contextmanager
def handled() -> Iterator[None]:
    """Raise `Stopped` for signals in the block; after it they change nothing.

    For the main thread of a program whose last block this is: where it was stopped, the process ends with
    it. Signals that are ignored stay so, as those of a process that `nohup` or a shell in the background
    started.
    """
    for number in _HANDLED:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _stop)
    sys.unraisablehook = _raising_again(sys.unraisablehook)
    try:
        yield
    except Left as left:
        _stop.end()
        _exit_at_once(left)
    finally:
        _stop.end()


def _exit_at_once(left: Left) -> NoReturn:
    """End the process without the interpreter's own end: freeing torch and joining threads takes a second."""
    with suppress(Exception):
        atexit._run_exitfuncs()  # those of libraries that clean up: Ray's, multiprocessing's
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError):
            stream.flush()
    os._exit(left.code if isinstance(left.code, int) else 1)


def _raising_again(before: Any) -> Any:
    """A hook that raises signals again which came in a destructor or callback, where Python drops them."""

    def hook(dropped: "sys.UnraisableHookArgs") -> None:
        if _stop.ending and issubclass(dropped.exc_type, MemoryError):
            return  # the line that says so is printed already
        if not isinstance(dropped.exc_value, KeyboardInterrupt):
            before(dropped)
        elif hasattr(signal, "setitimer") and not _stop.ending:
            signal.signal(signal.SIGALRM, _stop.throw)
            signal.setitimer(signal.ITIMER_REAL, _RETRY)

    return hook


def _ignore() -> None:
    for number in _HANDLED:
        signal.signal(number, signal.SIG_IGN)


@contextmanager
def deferred() -> Iterator[None]:
    """Raise signals of the block at its end, or where another comes seconds later.

    For what leaves processes behind where its start is cut off. Handlers that a library brings are undone.
    """
    handlers = {number: signal.getsignal(number) for number in _HANDLED}
    _stop.deferring = True
    try:
        yield
    finally:
        _stop.deferring = False
        for number, handler in handlers.items():
            with suppress(ValueError):  # not the main thread, where nobody else could set them either
                signal.signal(number, handler)
    if _stop.waiting:
        _stop.throw()


@contextmanager
def answered_at_once() -> Iterator[None]:
    """End the process on a signal of the block, even where it waits in C code and no handler would run.

    For blocks that leave nothing to clean up: not even `finally` is reached. Nothing changes where signals
    are not ours: outside of `handled`, and in other threads.
    """
    ours = [number for number in _HANDLED if signal.getsignal(number) is _stop]
    if not ours or threading.current_thread() is not threading.main_thread():
        yield
        return
    woken, wakes = socket.socketpair()
    wakes.setblocking(False)

    def watch() -> None:
        while number := woken.recv(1):
            if number[0] in ours:
                _say(number[0])
                os._exit(_exit_code(number[0]))

    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    before = signal.set_wakeup_fd(wakes.fileno())
    _stop.watched = True
    try:
        yield
    finally:
        signal.set_wakeup_fd(before)
        wakes.close()
        watcher.join()
        woken.close()
        _stop.watched = False


def leave(error: KeyboardInterrupt | SystemError) -> NoReturn:
    """End the program with the line and the exit code of a signal; other errors are raised again.

    C code, such as numba's dispatcher, wraps what the handler raised within it in a SystemError.
    """
    stop: BaseException | None = error
    while not isinstance(stop, KeyboardInterrupt):
        if stop is None:
            raise error
        stop = stop.__cause__ or stop.__context__
    number = stop.number if isinstance(stop, Stopped) else signal.SIGINT
    _say(number)
    raise Left(_exit_code(number))


def _say(number: int) -> None:
    name = signal.Signals(number).name
    line = "interrupted" if number == signal.SIGINT else f"ended by {name}"
    if name == "SIGHUP":
        line += " (its terminal was closed; nohup or tmux keeps a run)"
    with suppress(OSError):  # the terminal that was closed
        print(f"sagesplat: {line}; {_KEPT}", file=sys.stderr, flush=True)


def _exit_code(number: int) -> int:
    """What shells report of a program that a signal ended, but 2 for Ctrl-C, as for all that users do."""
    return 2 if number == signal.SIGINT else 128 + number
