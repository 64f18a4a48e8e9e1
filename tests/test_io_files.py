"""Files are replaced whole or not at all."""

import errno
import stat

import pytest

from sagesplat.core.errors import RunError
from sagesplat.io.files import atomic_path, read_json, write_json, write_text


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


def test_a_full_disk_is_one_line(tmp_path):
    path = tmp_path / "a.txt"
    with pytest.raises(RunError, match=r"a\.txt: no space left, the disk is full; free \d+ MB") as caught:  # noqa: SIM117
        with atomic_path(path):
            raise OSError(errno.ENOSPC, "No space left on device")
    assert "\n" not in str(caught.value)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("content", [None, b"", b"{", b"\xff\xfe", b'{"a": }'])
def test_json_that_cannot_be_read_is_one_line(tmp_path, content):
    path = tmp_path / "a.json"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(RunError, match=r"a\.json: (no such file|not readable as JSON)") as caught:
        read_json(path)
    assert "\n" not in str(caught.value)
