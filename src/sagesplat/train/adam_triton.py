"""Adam over rows on a GPU, in Triton: one kernel per parameter, the same step as `optim.py`."""

from collections.abc import Callable
from typing import Any, cast

import torch
import triton  # pyright: ignore[reportMissingImports] - installed with torch where there is a GPU
import triton.language as tl  # pyright: ignore[reportMissingImports]
from torch import Tensor

# cast: without Triton pyright takes a kernel for its function; count: rows come and go, that compiles nothing
_jit = cast(Callable[..., Any], triton.jit(do_not_specialize=["count"]))
_BLOCK = 1024
_BETA1, _BETA2, _EPS = tl.constexpr(0.9), tl.constexpr(0.999), tl.constexpr(1e-15)


@_jit
def _update(
    parameter, grad, exp_avg, exp_avg_sq, trainable, count, rate, correction,
    WIDTH: tl.constexpr, COLUMNS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """`count` values: the first COLUMNS of every row of WIDTH."""
    at = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    here = at < count
    row = at // COLUMNS
    if trainable is not None:
        here &= tl.load(trainable + row, mask=here, other=0) != 0
    if COLUMNS != WIDTH:
        at = row * WIDTH + at % COLUMNS
    g = tl.load(grad + at, mask=here)
    m = _BETA1 * tl.load(exp_avg + at, mask=here) + (1 - _BETA1) * g
    v = _BETA2 * tl.load(exp_avg_sq + at, mask=here) + (1 - _BETA2) * g * g
    p = tl.load(parameter + at, mask=here) - rate * m / (tl.sqrt(v) * correction + _EPS)
    tl.store(exp_avg + at, m, mask=here)
    tl.store(exp_avg_sq + at, v, mask=here)
    tl.store(parameter + at, p, mask=here)


def adam_step(
    parameter: Tensor,  # [N, ...] float32, contiguous, changed in place
    grad: Tensor,
    exp_avg: Tensor,  # moments, contiguous, changed in place
    exp_avg_sq: Tensor,
    *,
    lr: float,
    step: int,  # 1 for the first
    trainable: Tensor | None,  # bool [N]; None: all rows
    columns: int | None = None,
) -> None:
    """One Adam step (Kingma and Ba, betas 0.9 and 0.999, eps 1e-15 as 3DGS); other rows keep every bit.

    `columns`: update only this many values at the start of each row; the others never had a gradient.
    """
    width = parameter[:1].numel()
    columns = width if columns is None else columns
    count = len(parameter) * columns
    if count:
        _update[(triton.cdiv(count, _BLOCK),)](
            parameter.detach().view(-1), grad.detach().contiguous(), exp_avg.view(-1), exp_avg_sq.view(-1),
            None if trainable is None else trainable.contiguous().view(torch.uint8),
            count, float(lr / (1 - 0.9**step)), (1 - 0.999**step) ** -0.5,
            WIDTH=width, COLUMNS=columns, BLOCK=_BLOCK,
        )  # fmt: skip
