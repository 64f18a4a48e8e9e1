"""The checker of shapes, which `CHECK_SHAPES=0` turns off."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from conftest import random_gaussians
from jaxtyping import Float32, Int64, TypeCheckError, jaxtyped
from shapes import check, checked_modules


@jaxtyped(typechecker=check)
def _sums(
    x: Float32[np.ndarray, "N C"], rows: Int64[np.ndarray, " N"] | None = None, other: Any = 0
) -> tuple[Float32[np.ndarray, " N"], dict[str, Float32[np.ndarray, " C"]]]:
    return x.sum(1), {"columns": x.sum(0)[: 2 if other else None]}


X = np.zeros((4, 3), np.float32)


def test_what_fits_passes() -> None:
    assert _sums(X, np.arange(4))[0].shape == (4,)
    assert _sums(X, None, other="")[0].shape == (4,)


@pytest.mark.parametrize(
    "arguments", [(X.astype(float),), (X[0],), (X, np.arange(3)), (X, np.arange(4.0)), (X, None, 1)]
)
def test_other_shapes_and_dtypes_do_not(arguments: tuple[Any, ...]) -> None:
    with pytest.raises(TypeCheckError):
        _sums(*arguments)


def test_dataclasses_are_checked() -> None:
    g = random_gaussians(3)
    for means in (torch.zeros(3, 2), torch.zeros(4, 3), torch.zeros(3, 3, dtype=torch.int64)):
        with pytest.raises(TypeCheckError):
            replace(g, means=means)


def test_modules_with_kernels_are_left_out() -> None:
    modules = checked_modules()
    assert {"sagesplat.core.gaussians", "sagesplat.raster", "sagesplat.segment.masks"} <= modules
    assert not modules & {"sagesplat.segment.crf", "sagesplat.raster.project", "sagesplat.demo.noise"}
