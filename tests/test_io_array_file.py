"""Arrays that are kept in a temporary file."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from sagesplat.io import array_file
from sagesplat.io.array_file import ArrayFile


def test_what_is_added_is_read_in_any_order_by_any_thread():
    rng, file = np.random.default_rng(0), ArrayFile()
    pairs = [
        (rng.random((n, 3), np.float32), rng.integers(0, 99, (2, n)).astype(np.int16)[:, ::2])
        for n in range(40)
    ]
    with ThreadPoolExecutor(4) as pool:
        stored = list(pool.map(lambda pair: file.add(*pair), pairs))
        found = list(pool.map(file.read, stored[::-1]))[::-1]
    for pair, again in zip(pairs, found, strict=True):
        for one, other in zip(pair, again, strict=True):
            np.testing.assert_array_equal(one, other, strict=True)


def test_without_room_what_was_there_stays(monkeypatch: pytest.MonkeyPatch):
    class Full:
        def __init__(self, file):
            self.file, self.left = file, 100

        def __getattr__(self, name):
            return getattr(self.file, name)

        def write(self, data):
            if not self.left:
                raise OSError(28, "No space left on device")
            taken, self.left = data[: self.left], self.left - len(data[: self.left])
            return self.file.write(taken)

    made = array_file.TemporaryFile
    monkeypatch.setattr(array_file, "TemporaryFile", lambda buffering: Full(made(buffering=buffering)))
    file, values = ArrayFile(), np.arange(20, dtype=np.float32)
    stored = file.add(values)
    with pytest.raises(OSError, match="No space"):
        file.add(values)
    np.testing.assert_array_equal(file.read(stored), [values])
