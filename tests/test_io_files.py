"""Files are replaced whole or not at all."""

import errno
import os
import re
import shutil
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from sagesplat.core.errors import RunError
from sagesplat.io.files import atomic_folder, atomic_path, read_json, unwritable, write_json, write_text


def test_json_round_trip_in_the_order_given(tmp_path):
    path = tmp_path / "new" / "folder" / "a.json"
    write_json(path, {"b": [1, 2.5], "a": "ä"})
    assert read_json(path) == {"b": [1, 2.5], "a": "ä"}
    assert list(read_json(path)) == ["b", "a"]
    assert path.read_text().endswith("\n")
    assert [p.name for p in path.parent.iterdir()] == ["a.json"]
    assert stat.S_IMODE(path.stat().st_mode) == 0o644  # a temporary file would be private


@pytest.mark.parametrize("error", [ValueError("no"), KeyboardInterrupt()])
def test_a_failure_leaves_the_old_file_and_no_other(tmp_path, error):
    path = tmp_path / "a.txt"
    write_text(path, "old")

    def fail():
        with atomic_path(path) as temporary:
            assert temporary.parent == path.parent
            assert temporary.suffix == ".txt"  # numpy and Pillow go by it
            temporary.write_text("half")
            raise error

    with pytest.raises(type(error)):
        fail()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def full_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: shutil._ntuple_diskusage(9, 9, 0))  # type: ignore[attr-defined]


def test_a_full_disk_is_seen_where_the_error_has_no_number(tmp_path: Path, monkeypatch) -> None:
    """numpy's `tofile`, and shutil's list of what it could not copy."""
    full_disk(monkeypatch)
    with pytest.raises(RunError, match=r"a\.npy: no space left, the disk is full; free \d+ MB"):  # noqa: SIM117
        with atomic_path(tmp_path / "a.npy"):
            raise OSError("1920000 requested and 307072 written")
    with pytest.raises(RunError, match=r"a: no space left, the disk is full"), atomic_folder(tmp_path / "a"):
        raise shutil.Error([("from", "to", "[Errno 28] No space left on device: 'from' -> 'to'")])
    assert list(tmp_path.iterdir()) == []


def test_an_error_of_writing_names_its_file(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    with pytest.raises(OSError, match="File too large") as caught, atomic_path(path):
        raise OSError(errno.EFBIG, "File too large")
    assert caught.value.filename == str(path)
    (tmp_path / "file").touch()
    for impossible in (tmp_path / "file/a.txt", Path("/proc/a.txt")):
        with pytest.raises(OSError) as caught, atomic_path(impossible):  # noqa: PT011 (of each system's own)
            pass
        assert "tmp-" not in str(caught.value.filename)


@pytest.mark.parametrize(
    ("error", "says"),
    [
        (OSError(errno.ENOSPC, "No space"), r"\(the disk is full\); free some space"),
        (
            OSError(errno.EROFS, "Read-only file system"),
            r"\(Read-only file system\); choose a place that can",
        ),
        (PermissionError(errno.EACCES, "Permission denied"), r"\(Permission denied\); check its rights"),
        (shutil.Error([("a", "b", "no")]), r"\(\[\('a', 'b', 'no'\)\]\); choose another place"),
    ],
)
def test_what_cannot_be_written_is_one_true_line(tmp_path: Path, error: OSError, says: str) -> None:
    assert re.fullmatch(
        rf"{re.escape(str(tmp_path))}: cannot be written {says}.*", unwritable(tmp_path, error)
    )


WRITES = """
import sys
from pathlib import Path
from sagesplat.core.errors import RunError
from sagesplat.io.files import atomic_folder
try:
    with atomic_folder(Path(sys.argv[1])) as fresh:
        for name in "abc":
            (fresh / name).write_text(sys.argv[2])
        print("writing", flush=True)
        sys.stdin.read()
except RunError as error:
    print(error, flush=True)
"""


def test_one_of_three_writers_of_a_folder_has_it(tmp_path: Path) -> None:
    """The others are told who; the folder is whole, and the first one's."""
    folder, here = tmp_path / "out", os.environ | {"PYTHONPATH": os.pathsep.join(map(str, sys.path))}
    writers, said = [], []
    for number in "123":
        command = [sys.executable, "-c", WRITES, str(folder), number]
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True, "env": here}
        writers.append(subprocess.Popen(command, **pipes))  # type: ignore
        said.append(writers[-1].stdout.readline())
    assert said[0] == "writing\n"
    who = (
        rf"{re.escape(str(folder))}: process {writers[0].pid} on .* \(`-c .*`, since .*\) writes there; wait"
    )
    assert all(re.match(who, line) for line in said[1:])
    with pytest.raises(RunError, match=f"process {writers[0].pid} "):
        replaced(folder, "mine")
    for writer in writers:
        writer.communicate()
        assert writer.returncode == 0
    assert {path.name: path.read_text() for path in folder.iterdir()} == dict.fromkeys("abc", "1")
    assert list(tmp_path.iterdir()) == [folder]
    replaced(folder, "mine")
    assert [path.name for path in folder.iterdir()] == ["mine"]


@pytest.mark.parametrize("content", [None, b"{", b"\xff\xfe"])
def test_json_that_cannot_be_read_is_one_line(tmp_path, content):
    path = tmp_path / "a.json"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(RunError, match=r"a\.json: (no such file|not readable as JSON)"):
        read_json(path)


def replaced(folder: Path, name: str) -> None:
    """Replace a folder by one with a file of this name."""
    with atomic_folder(folder) as fresh:
        (fresh / name).write_text(name)


@pytest.mark.parametrize("failing", [1, 2])
def test_a_folder_that_cannot_be_swapped_stays_as_it_was(tmp_path: Path, monkeypatch, failing: int) -> None:
    """The first rename takes the earlier folder aside, the second brings the new one in."""
    folder, rename, times = tmp_path / "a", Path.rename, 0
    replaced(folder, "old")

    def fails(self: Path, target: Path) -> Path:
        nonlocal times
        times += 1
        if times == failing:
            raise PermissionError(errno.EACCES, "held by another program")
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", fails)
    with pytest.raises(PermissionError):
        replaced(folder, "new")
    assert [path.name for path in folder.iterdir()] == ["old"]
    assert list(tmp_path.iterdir()) == [folder]


KILLED_IN_A_SWAP = """
import os, signal, sys
from pathlib import Path
from sagesplat.io.files import atomic_folder
rename = Path.rename
def dies_after(self, target):
    rename(self, target)
    os.kill(os.getpid(), signal.SIGKILL)
with atomic_folder(Path(sys.argv[1])) as fresh:
    (fresh / "new").write_text("new")
    Path.rename = dies_after
"""


@pytest.mark.skipif(sys.platform == "win32", reason="kills are POSIX only")
@pytest.mark.parametrize("then", ["fails", "works"])
def test_a_kill_in_the_middle_of_a_swap_loses_nothing(tmp_path: Path, then: str) -> None:
    folder = tmp_path / "a"
    replaced(folder, "old")
    here = os.environ | {"PYTHONPATH": os.pathsep.join(map(str, sys.path))}
    ended = subprocess.run([sys.executable, "-c", KILLED_IN_A_SWAP, str(folder)], env=here)
    assert ended.returncode == -9
    assert not folder.exists()
    assert [path.name for path in tmp_path.rglob("old")] == ["old"]  # beside it
    if then == "fails":
        with pytest.raises(ZeroDivisionError), atomic_folder(folder):
            _ = 1 / 0
    else:
        replaced(folder, "newer")
    assert [path.name for path in folder.iterdir()] == [{"fails": "old", "works": "newer"}[then]]
    assert list(tmp_path.iterdir()) == [folder]


def test_files_of_long_names_and_texts_of_any_path(tmp_path: Path) -> None:
    path = tmp_path / ("日" * 83 + ".txt")
    write_text(path, "caf\udce9")
    assert path.read_text(encoding="utf-8") == "caf\\udce9"
    assert list(tmp_path.iterdir()) == [path]
