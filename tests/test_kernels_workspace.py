"""Memory that calls share."""

import numpy as np
import pytest

from sagesplat.kernels.workspace import Workspace


def test_what_fits_is_used_again_and_what_does_not_is_made_anew() -> None:
    space = Workspace()
    large = space.take("a", 4, 6)
    assert np.shares_memory(space.take("a", 5, 2), large)
    assert space.take("a", 50, 2).shape == (50, 2)
    assert not np.shares_memory(space.take("b", 4, 6), space.take("a", 4, 6))
    large = space.take("a", 3)
    large[:] = 7
    assert not space.zeros("a", 3).any()


@pytest.mark.parametrize("dtype", [np.float64, np.int32, bool])
def test_another_dtype_under_one_name_gets_memory_of_its_own(dtype: type) -> None:
    space = Workspace()
    floats = space.take("a", 8)
    assert floats.dtype == np.float32
    others = space.take("a", 8, dtype=dtype)
    assert others.dtype == dtype
    assert not np.shares_memory(floats, others)
