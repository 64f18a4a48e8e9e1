"""Items side by side: order, failures, threads, and the same bits as one after the other."""

import os
import subprocess
import sys
import threading

import numba
import numpy as np
import pytest
import torch
from numba.core import config

from sagesplat.kernels import threads
from sagesplat.kernels.threads import dealt, side_by_side
from sagesplat.kernels.workspace import Workspace
from sagesplat.metrics.image import ssim_map


@pytest.fixture
def two_threads():
    if config.NUMBA_NUM_THREADS < 2:  # type: ignore
        pytest.skip("numba was started with one thread: `pytest -m threads` has two")
    before = numba.get_num_threads(), torch.get_num_threads()
    numba.set_num_threads(2)
    torch.set_num_threads(2)
    yield
    numba.set_num_threads(before[0])
    torch.set_num_threads(before[1])


def test_results_come_in_order_and_none_are_lost():
    assert list(side_by_side(lambda x: x * x, range(20))) == [x * x for x in range(20)]
    assert list(side_by_side(str, [])) == []
    assert list(side_by_side(str, [3])) == ["3"]


def test_a_failure_ends_it():
    with pytest.raises(ZeroDivisionError):
        list(side_by_side(lambda x: 1 // (x - 5), range(100)))


@pytest.mark.threads
def test_images_are_compared_at_once_with_the_same_bits(two_threads):
    rng = np.random.default_rng(0)
    pairs = [rng.random((2, 150, 200, 3), np.float32) for _ in range(12)]
    alone = [ssim_map(*pair) for pair in pairs]
    counts, both = set(), threading.Barrier(2)

    def compare(row):
        if row in (1, 2):  # the first that are divided: in one thread the other would never come
            both.wait(timeout=60)
        counts.add(numba.get_num_threads())
        return ssim_map(*pairs[row])

    found = list(side_by_side(compare, range(len(pairs))))
    assert all(np.array_equal(a, b) for a, b in zip(alone, found, strict=True))
    assert counts == {1, 2}, "the first alone with both threads, the others with one each"
    assert numba.get_num_threads() == 2
    assert torch.get_num_threads() == 2


@pytest.mark.threads
def test_a_thread_pool_that_cannot_be_shared_is_not(two_threads, monkeypatch):
    monkeypatch.setattr(threads.parallel, "threading_layer", lambda: "workqueue")
    _, *others = side_by_side(lambda _: threading.get_ident(), range(8))
    assert set(others) == {threading.get_ident()}


def test_no_item_takes_more_threads_than_its_caller_may():
    script = (
        "import numba, torch; from sagesplat.kernels.threads import side_by_side\n"
        "numba.set_num_threads(2); torch.set_num_threads(2)\n"
        "print(max(side_by_side(lambda _: numba.get_num_threads(), range(4))))"
    )
    settings = {**os.environ, "NUMBA_NUM_THREADS": "4"}
    done = subprocess.run([sys.executable, "-c", script], env=settings, capture_output=True, text=True)
    assert done.stdout == "2\n", done.stderr


def test_each_thread_has_its_own_workspace():
    space, arrays = Workspace(), []
    mine = space.take("a", 3)
    other = threading.Thread(target=lambda: arrays.append(space.take("a", 3)))
    other.start()
    other.join()
    assert not np.shares_memory(mine, arrays[0])
    assert np.shares_memory(mine, space.take("a", 3))


@pytest.mark.parametrize("count", [1, 2, 15, 16, 17, 31, 368, 1000])
def test_each_item_is_dealt_once(count: int):
    assert sorted(dealt(place, count) for place in range(count)) == list(range(count))


def test_stretches_of_places_have_items_from_all_over():
    count, threads = 1000, 4
    for begin in range(0, count, count // threads):
        items = np.sort([dealt(place, count) for place in range(begin, begin + count // threads)])
        assert np.diff(items).max() <= 16
        assert items[0] < 16
        assert items[-1] >= count - 16
