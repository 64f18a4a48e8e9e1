"""Signals end a program in order, with one line, whenever and however often they come."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from sagesplat.core.signals import _exit_code

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="Windows has no such signals")
KEPT = "finished stages and checkpoints are kept: run the same command again to resume"
LINES = {
    signal.SIGINT: f"sagesplat: interrupted; {KEPT}\n",
    signal.SIGTERM: f"sagesplat: ended by SIGTERM; {KEPT}\n",
    signal.SIGHUP: "sagesplat: ended by SIGHUP (its terminal was closed; nohup or tmux keeps a run); "
    f"{KEPT}\n",
}
# A command in the place of sagesplat's: what it does is the program's first argument. `told()` returns once
# the test has sent its signals. Whether signals are the same wish does not depend on the clock.
PROGRAM = """
import sys, time, types
from pathlib import Path
from sagesplat.__main__ import program

def main():
    def ready():
        print("ready", flush=True)
    def rest():  # Python does not see a signal that comes just before a sleep begins until it is over
        while True:
            time.sleep(0.05)
    exec(sys.argv[1], {"ready": ready, "rest": rest, "told": sys.stdin.read, "folder": Path(sys.argv[2])})

sys.modules["sagesplat.cli"] = types.SimpleNamespace(main=main)
program()
"""
ONE_WISH = "import sagesplat.core.signals as s; s._SAME = 1e9\n"
EACH_A_WISH = "import sagesplat.core.signals as s; s._SAME = 0\n"
WRITES = """
import time
from sagesplat.io.files import atomic_path
from sagesplat.io.lock import locked
with locked(folder), atomic_path(folder / "a.txt") as path:
    path.write_text("half")
    try:
        ready()
        rest()
    finally:
        ready()
        told()
        print("cleaned", flush=True)
"""


def hears_signals() -> None:
    """In the child: tests that run in a shell's background begin with signals ignored."""
    for number in LINES:
        signal.signal(number, signal.SIG_DFL)


def started(code: str, folder: Path, **options) -> subprocess.Popen[str]:
    """A program that does this, after it said that it is ready."""
    here = os.environ | {"PYTHONPATH": os.pathsep.join(map(str, sys.path))}
    process = subprocess.Popen(  # type: ignore
        [sys.executable, "-c", PROGRAM, code, str(folder)],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=here,
        **{"preexec_fn": hears_signals, **options},
    )  # fmt: skip
    is_ready(process)
    return process  # type: ignore


def is_ready(process: subprocess.Popen[str]) -> None:
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"


def ended(process: subprocess.Popen[str]) -> tuple[int, str, str]:
    """Exit code and what was said, after the program was told that all signals were sent."""
    out, errors = process.communicate(timeout=600)
    return process.returncode, out, errors


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_five_quick_signals_are_one_line_and_cleaning_up_is_not_cut_off(
    tmp_path: Path, number: signal.Signals
) -> None:
    process = started(ONE_WISH + WRITES, tmp_path)
    process.send_signal(number)
    is_ready(process)  # to clean up
    for _ in range(4):
        process.send_signal(number)
    assert ended(process) == (_exit_code(number), "cleaned\n", LINES[number])
    assert [path.name for path in tmp_path.iterdir()] == [".lock"]


AT_THE_END = """
import threading, time
def wait():
    while threading.main_thread().is_alive():
        time.sleep(0.01)
    ready()
    THEN
threading.Thread(target=wait).start()
"""


@pytest.mark.parametrize(
    "code",
    ["import atexit; atexit.register(lambda: (ready(), told()))", AT_THE_END.replace("THEN", "told()")],
)
def test_a_signal_after_the_work_changes_nothing(tmp_path: Path, code: str) -> None:
    process = started(ONE_WISH + code, tmp_path)
    for number in LINES:
        process.send_signal(number)
    assert ended(process) == (0, "", "")


def test_a_program_that_hangs_at_its_end_can_still_be_ended(tmp_path: Path) -> None:
    process = started(EACH_A_WISH + AT_THE_END.replace("THEN", "time.sleep(3600)"), tmp_path)
    process.send_signal(signal.SIGTERM)
    assert ended(process) == (143, "", "")


@pytest.mark.parametrize(
    "code",
    [
        # a callback of the garbage collector, which drops exceptions
        "class Slow:\n    def __del__(self):\n        ready()\n        rest()\nSlow()\nrest()",
        # Python ends itself by SIGINT where a plain KeyboardInterrupt passed through an `exec`
        "exec('ready(); rest()', globals())",
        # C code that goes on though an exception is set, as numba's dispatcher did
        "try:\n    ready()\n    rest()\nexcept KeyboardInterrupt as stop:\n    raise SystemError from stop",
    ],
)
def test_no_signal_goes_astray(tmp_path: Path, code: str) -> None:
    process = started(code, tmp_path)
    process.send_signal(signal.SIGINT)
    assert ended(process) == (2, "", LINES[signal.SIGINT])


def test_an_error_of_c_code_without_a_signal_is_not_hidden(tmp_path: Path) -> None:
    code, _, says = ended(started("ready(); raise SystemError('f: bad argument')", tmp_path))
    assert code == 1
    assert says.endswith("SystemError: f: bad argument\n")


STARTS = """
import signal, time
from sagesplat.core.signals import deferred
with deferred():
    ready()
    while not s._stop.waiting:
        time.sleep(0.01)
    ready()
    told()  # the test reads one line at a time
    print("begun", flush=True)
    signal.signal(signal.SIGTERM, lambda *_: exit(9))  # as libraries do
rest()
"""


def test_what_must_not_be_half_begun_is_finished_first(tmp_path: Path) -> None:
    process = started(EACH_A_WISH + STARTS, tmp_path)
    process.send_signal(signal.SIGTERM)
    is_ready(process)
    assert ended(process) == (143, "begun\n", LINES[signal.SIGTERM])


WAITS = """
import ctypes, time
from sagesplat.core.signals import answered_at_once
with answered_at_once():
    pass
with answered_at_once():
    lock, mutex = ctypes.CDLL(None).pthread_mutex_lock, ctypes.create_string_buffer(64)
    lock(mutex)
    ready()
    lock(mutex)  # for ever, and no signal cuts it off
"""


@pytest.mark.skipif(sys.platform != "linux", reason="mutexes of other systems are not so simple")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_is_answered_while_the_main_thread_waits_in_c(
    tmp_path: Path, number: signal.Signals
) -> None:
    process = started(WAITS, tmp_path)
    process.send_signal(number)
    assert ended(process) == (_exit_code(number), "", LINES[number])


def test_what_nohup_and_shells_ignore_stays_ignored(tmp_path: Path) -> None:
    def ignore() -> None:
        for number in (signal.SIGHUP, signal.SIGINT):
            signal.signal(number, signal.SIG_IGN)

    process = started("ready(); told()", tmp_path, preexec_fn=ignore)
    process.send_signal(signal.SIGHUP)
    process.send_signal(signal.SIGINT)
    assert ended(process) == (0, "", "")


def test_imports_are_interrupted_in_one_line_too(tmp_path: Path) -> None:
    """The first module that the command line imports says when."""
    (tmp_path / "tyro.py").write_text("import time\nprint('ready', flush=True)\nwhile True: time.sleep(0.05)")
    here = os.environ | {"PYTHONPATH": os.pathsep.join([str(tmp_path), *map(str, sys.path)])}
    with subprocess.Popen(
        [sys.executable, "-m", "sagesplat", "info", "."],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=here, preexec_fn=hears_signals,
    ) as process:  # fmt: skip
        is_ready(process)
        process.send_signal(signal.SIGINT)
        assert ended(process) == (2, "", LINES[signal.SIGINT])
