"""Files that nobody should trust: no crash, no hang, no more memory than the file's size allows.

tests/fuzz/readers lists the readers, tests/fuzz/hostile.py says what they may take, and
`python -m tests.fuzz` tries more.
"""

import io
import re
import struct
import time
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from random import Random

import numpy as np
import pytest

from sagesplat.core.errors import DataError, SageError
from sagesplat.io.npz import Npz
from tests.fuzz.fuzz_reader import CORPUS
from tests.fuzz.hostile import MIB, Finding, Reader, check, honest_memory, watchdog
from tests.fuzz.mutate import BYTES, mutate
from tests.fuzz.readers import READERS

ROOT = Path(__file__).parents[1]
ALL = pytest.mark.parametrize("reader", READERS, ids=lambda reader: reader.name)
# infinite numbers, which are values; an archive whose member is zeros alone
ACCEPTED = {
    *("observations/overflow.csv", "zip/bomb.zip"),
    *("lock/nested.json", "video-frames/long-name.json"),  # as if there were none
}
Prepare = Callable[[Reader], "Prepared"]


@dataclass(frozen=True)
class Prepared:
    """A reader's folder, its sound files, and what it may take."""

    folder: Path
    samples: list[bytes]
    honest: float


@pytest.fixture(scope="module")
def prepare(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Prepare]:
    """What a reader needs, made once; it has read its sound files once, too. Time is of no account here."""
    known: dict[str, Prepared] = {}

    def of(reader: Reader) -> Prepared:
        if reader.name not in known:
            honest, _ = honest_memory(reader, tmp_path_factory.mktemp(reader.name))
            folder = tmp_path_factory.mktemp(reader.name)
            samples = reader.make(folder, 1)
            for content in samples:
                reader.read(folder, content)
            known[reader.name] = Prepared(folder, samples, honest)
        return known[reader.name]

    with pytest.MonkeyPatch.context() as patch, watchdog():
        patch.setattr("tests.fuzz.hostile.SECONDS", 300.0)
        yield of


def wrong(reader: Reader, of: Prepared, content: bytes, *, measure: bool = True) -> Finding | None:
    """A finding that a second reading has too: memory of what is loaded at first use is none."""
    finding = check(reader, of.folder, content, of.honest, measure=measure)
    return finding and check(reader, of.folder, content, of.honest, measure=measure)


@ALL
def test_damaged_files_are_refused_in_one_line(reader: Reader, prepare: Prepare):
    """Sound files are read within the bound; so is a file damaged in each way, or it is refused."""
    of, rng = prepare(reader), Random(7)
    damaged = [damage(of.samples[0], rng) for damage in dict.fromkeys(BYTES)]
    contents = [*of.samples, *damaged, mutate(of.samples[-1], of.samples, rng)]
    found = [wrong(reader, of, content) for content in contents]
    assert found == [None] * len(contents)


@pytest.mark.slow
@ALL
def test_prefixes_and_some_hundred_mutations_are_refused_in_one_line(reader: Reader, prepare: Prepare):
    of, rng = prepare(reader), Random(8)
    content = of.samples[0]
    contents = [content[:size] for size in range(0, len(content), max(1, len(content) // 12))]
    contents += [mutate(rng.choice(of.samples), of.samples, rng) for _ in range(300)]
    found = [
        check(reader, of.folder, content, of.honest, measure=i % 8 == 0) for i, content in enumerate(contents)
    ]
    assert [finding.text for finding in found if finding] == []


@pytest.mark.parametrize(
    "path", sorted(CORPUS.glob("*/*")), ids=lambda path: path.relative_to(CORPUS).as_posix()
)
def test_what_once_failed(path: Path, prepare: Prepare):
    reader = next(reader for reader in READERS if reader.name == path.parent.name)
    of = prepare(reader)
    assert wrong(reader, of, path.read_bytes()) is None
    if path.relative_to(CORPUS).as_posix() not in ACCEPTED:
        with pytest.raises(SageError):
            reader.read(of.folder, path.read_bytes())


def test_every_reader_has_a_corpus_or_none_of_its_files_failed():
    assert {path.name for path in CORPUS.iterdir()} <= {reader.name for reader in READERS}
    assert sum(path.stat().st_size for path in CORPUS.glob("*/*")) < MIB


class Unchecked(DataError):
    """An error whose text is what it was made of."""

    def __str__(self) -> str:
        return str(self.args[0])


def finding_of(read: Callable[[Path, bytes], object], honest: float = 0.25) -> Finding | None:
    reader = Reader("x", ".x", lambda *_: [], read, base=0)
    with watchdog():
        return check(reader, Path(), b"12345678" * 512, honest)


def test_the_oracle_sees_what_it_is_for():
    def fail(error: BaseException) -> Callable[[Path, bytes], object]:
        def read(_: Path, content: bytes) -> None:
            raise error

        return read

    assert finding_of(lambda _, content: len(content)) is None
    assert finding_of(fail(DataError("x: wrong; do this")), 2) is None
    for text in ("x\ny", "x" * 9999, "", "\ud800", "x\x1b[1m"):
        assert "not one line" in (finding_of(fail(Unchecked(text))) or Finding("", "")).text
    assert "KeyError" in (finding_of(fail(KeyError("x"))) or Finding("", "")).kind
    assert (finding_of(lambda _, content: np.zeros(len(content))) or Finding("", "")).kind == "memory"
    assert finding_of(lambda _, content: np.zeros(len(content)), 2.25) is None
    assert (finding_of(lambda *_: np.float32(1) / np.float32(0)) or Finding("", "")).text.startswith(
        "Runtime"
    )


def test_what_takes_too_long_is_ended(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("tests.fuzz.hostile.SECONDS", 0.2)
    finding = finding_of(lambda *_: time.sleep(1000))
    assert finding is not None
    assert "Hang" in finding.kind


def archive(path: Path, arrays: dict[str, np.ndarray], compression: int = zipfile.ZIP_STORED) -> Path:
    with zipfile.ZipFile(path, "w", compression) as file:
        for name, array in arrays.items():
            body = io.BytesIO()
            np.lib.format.write_array(body, array)
            file.writestr(f"{name}.npy", body.getvalue())
    return path


def test_arrays_come_back(tmp_path: Path):
    arrays = {
        "a": np.arange(6, dtype=np.float32).reshape(2, 3),
        "t": np.array("text"),
        "e": np.zeros((4, 0, 3)),
    }
    arrays["f"] = np.asfortranarray(arrays["a"])
    with Npz(archive(tmp_path / "a.npz", arrays)) as file:
        assert file.names == list(arrays)
        for name, array in arrays.items():
            np.testing.assert_array_equal(file[name], array)
            assert file[name].shape == array.shape
        with pytest.raises(KeyError):
            file["x"]
    with pytest.raises(FileNotFoundError):
        Npz(tmp_path / "b.npz")


def test_compressed_arrays_are_refused(tmp_path: Path):
    path = archive(tmp_path / "a.npz", {"a": np.zeros(10_000)}, zipfile.ZIP_DEFLATED)
    with pytest.raises(ValueError, match=r"'a\.npy' is compressed"):
        Npz(path)


def test_members_that_overlap_are_refused(tmp_path: Path):
    """Many entries of the directory on the same bytes would read more than the file holds."""
    path = archive(tmp_path / "a.npz", {"a": np.zeros(5_000), "b": np.zeros(1)})
    content = path.read_bytes()
    at = content.index(b"PK\1\2")
    (size,) = struct.unpack("<H", content[at + 28 : at + 30])
    entry = content[at : at + 46 + size]
    entries = b"".join(entry.replace(b"a.npy", b"%c.npy" % (97 + i)) for i in range(20))
    end = struct.pack("<4sHHHHIIH", b"PK\5\6", 0, 0, 20, 20, len(entries), at, 0)
    path.write_bytes(content[:at] + entries + end)
    with pytest.raises(ValueError, match="larger than the file"):
        Npz(path)


def test_nothing_unpickles():
    """No pickle of anybody's: numpy and torch are told so at every call, and the module is not used."""
    calls = {r"\bnp\.load\(": "allow_pickle=False", r"\btorch\.load\(": "weights_only=True"}
    for path in (ROOT / "src").rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        assert not re.search(r"^\s*(import|from) (pickle|dill|joblib|shelve|marshal)\b", text, re.M), path
        for call, wanted in calls.items():
            for match in re.finditer(call, text):
                assert wanted in text[match.start() : match.start() + 120], path
