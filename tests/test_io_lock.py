"""Two processes never write into one run folder, and a lock does not outlive its process."""

import errno
import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from sagesplat.core.errors import RunError
from sagesplat.io import lock
from sagesplat.io.lock import locked

HOLDS = """
import sys, time
from pathlib import Path
from sagesplat.io.lock import locked
with locked(Path(sys.argv[1])):
    print("locked", flush=True)
    time.sleep(3600)
"""


@contextmanager
def held_by_another(folder: Path) -> Iterator[subprocess.Popen]:
    with subprocess.Popen([sys.executable, "-c", HOLDS, str(folder)], stdout=subprocess.PIPE) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == b"locked\n"
            yield process
        finally:
            process.kill()


def test_a_second_process_is_refused_until_the_first_is_gone(tmp_path: Path) -> None:
    run = tmp_path / "run"
    with held_by_another(run) as process:
        with pytest.raises(RunError) as caught, locked(run):
            pass
        line = str(caught.value)
        assert "\n" not in line
        assert line.startswith(f"{run}: process {process.pid} on ")
        assert re.search(r"\(`-c .*`, since 20\d\d-\d\d-\d\d .*\) works on it; wait for it or stop it", line)
        process.kill()
        process.wait()
        with locked(run):  # though its file is still there
            assert json.loads((run / lock.FILE).read_text())["pid"] == os.getpid()


def test_who_waits_gets_it_once_the_other_is_gone(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(lock, "_AGAIN", 0.05)
    with held_by_another(tmp_path) as process:
        with pytest.raises(RunError, match=f"process {process.pid} on"), locked(tmp_path, wait=0.2):
            pass
        monkeypatch.setattr(lock.time, "sleep", lambda _: (process.kill(), process.wait()))
        with locked(tmp_path, wait=30):
            assert json.loads((tmp_path / lock.FILE).read_text())["pid"] == os.getpid()


def test_one_process_may_enter_again(tmp_path: Path) -> None:
    first, second = ExitStack(), ExitStack()
    first.enter_context(locked(tmp_path))
    second.enter_context(locked(tmp_path / "." / ".." / tmp_path.name))
    first.close()  # in any order
    code = HOLDS.replace("time.sleep(3600)", "pass")
    refused = subprocess.run([sys.executable, "-c", code, str(tmp_path)], capture_output=True, text=True)
    assert f"process {os.getpid()} on" in refused.stderr
    second.close()
    subprocess.run([sys.executable, "-c", code, str(tmp_path)], capture_output=True, check=True)


@pytest.mark.parametrize("text", ["", "{", '"x"', "[]", '{"pid": 3}'])
def test_a_lock_without_a_name(tmp_path: Path, text: str, monkeypatch) -> None:
    def busy(handle: int) -> None:
        raise OSError(errno.EWOULDBLOCK, "busy")

    monkeypatch.setattr(lock, "_take", busy)
    (tmp_path / lock.FILE).write_text(text)
    with pytest.raises(RunError, match="another process works on it"), locked(tmp_path):
        pass


def test_a_disk_that_knows_no_locks_is_one_line(tmp_path: Path, monkeypatch) -> None:
    def unknown(handle: int) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(lock, "_take", unknown)
    with pytest.raises(
        RunError, match=r"\.lock: cannot be locked \(No locks available\); choose a run folder"
    ):
        locked(tmp_path).__enter__()
