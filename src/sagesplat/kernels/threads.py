"""How work is divided among threads.

Independent items run side by side, each in a thread whose kernels take its share of the threads.

A view's image is small: kernels that divide it among threads wait for each other, and what is between them
runs on one core. Kernels release the GIL (see `jit`) and a `Workspace` is another in each thread.
"""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import TypeVar

import numba
import torch
from numba.np.ufunc import parallel

from sagesplat.kernels.jit import njit

Item = TypeVar("Item")
Result = TypeVar("Result")

_COLUMNS = 16  # that items are dealt to, one after another


def side_by_side(function: Callable[[Item], Result], items: Sequence[Item]) -> Iterator[Result]:
    """The results of `function`, in the order of the items, as they come; the first failure ends it.

    It takes as many threads as kernels otherwise would. `function` must not change what other calls read.
    """
    threads = min(numba.get_num_threads(), max(len(items) - 1, 1))
    if threads == 1:
        yield from map(function, items)
        return
    every, of_torch = numba.get_num_threads(), torch.get_num_threads()

    def limited(most: int, item: Item) -> Result:
        """A thread begins with all threads of the machine, whatever the one that starts it may take."""
        numba.set_num_threads(most)
        torch.set_num_threads(most)
        return function(item)

    pool = ThreadPoolExecutor(threads)
    try:
        # by itself: kernels are compiled, and numba starts its threads; its `Workspace` serves later items
        yield pool.submit(limited, every, items[0]).result()
        several = partial(limited, every // threads)
        yield from pool.map(several, items[1:]) if _concurrent() else map(function, items[1:])
    finally:
        pool.shutdown(cancel_futures=True)
        torch.set_num_threads(of_torch)  # what later threads begin with


def _concurrent() -> bool:
    """Whether several threads may call parallel kernels at once: numba's own thread pool ends the process."""
    try:
        return parallel.threading_layer() != "workqueue"
    except ValueError:  # no kernel has run
        return False


@njit(error_model="numpy", cache=True)
def dealt(place, count):
    """The item at a place of a kernel's loop over `count`: each thread's stretch has some from all over.

    Neighbours in the list are neighbours in space, so its stretches differ in how much a view shows of them.
    """
    rows, rest = count // _COLUMNS, count % _COLUMNS
    longer = rest * (rows + 1)  # places of the columns that have one more
    if place < longer:
        return place % (rows + 1) * _COLUMNS + place // (rows + 1)
    return (place - longer) % rows * _COLUMNS + rest + (place - longer) // rows
