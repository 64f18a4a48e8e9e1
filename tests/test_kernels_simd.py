"""Vectors in kernels against numpy."""

import numpy as np
import pytest
from numba import njit

from sagesplat.kernels import simd
from sagesplat.kernels.simd import (
    ceil,
    count,
    double,
    exp2,
    floor,
    fma,
    gather,
    largest,
    load8,
    load16,
    load_blue,
    load_green,
    load_red,
    log2,
    maximum,
    minimum,
    scatter,
    single,
    splat16,
    spread16,
    sqrt,
    store,
    store_totals,
    total,
    where,
)

RNG = np.random.default_rng(0)
A, B = (RNG.normal(size=16).astype(np.float32) for _ in range(2))


@njit
def _arithmetic(a, b, out):
    x, y = load16(a, 0), load16(b, 0)
    store(out, 0, x + y * 2 - 1.5 / x)
    store(out, 16, minimum(x, y) + maximum(x, 0.25))
    store(out, 32, where((x > y) & (x <= 1), -x, 7.0))
    store(out, 48, fma(x, y, splat16(3)))
    store(out, 64, floor(x) - ceil(y))
    x += spread16(b, 5)
    store(out, 80, x)
    return total(y), largest(y), count(load8(a, 0) >= load8(b, 0)), count(load8(a, 0) < 0)


def test_operators():
    out = np.empty(96, np.float32)
    added, most, at_least, negative = _arithmetic(A, B, out)
    expected = [
        A + B * 2 - 1.5 / A,
        np.minimum(A, B) + np.maximum(A, 0.25),
        np.where((A > B) & (A <= 1), -A, 7),
        A * B + 3,
        np.floor(A) - np.ceil(B),
        A + B[5],
    ]
    np.testing.assert_allclose(out.reshape(6, 16), expected, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(added, B.sum(), rtol=1e-5)
    assert most == B.max()
    assert at_least == (A[:8] >= B[:8]).sum()
    assert negative == (A[:8] < 0).sum()


def test_minimum_and_maximum_are_numpys_outside_of_kernels():
    np.testing.assert_array_equal(simd.minimum(A, B), np.minimum(A, B))
    np.testing.assert_array_equal(simd.maximum(A, B), np.maximum(A, B))


@njit
def _powers(q, power):
    for i in range(0, len(q), 16):
        store(power, i, exp2(load16(q, i)))


@njit
def _doubles(q, power, logarithm, root):
    for i in range(0, len(q), 8):
        x = double(load8(q, i))
        store(power, i, single(exp2(x)))
        store(logarithm, i, single(log2(exp2(x))))
        store(root, i, single(sqrt(x * x)))


def test_exponentials_and_logarithms():
    q = np.linspace(-120, 120, 16_000).astype(np.float32)
    exact = 2.0 ** q.astype(np.float64)
    power, logarithm, root = (np.empty_like(q) for _ in range(3))
    _powers(q, power)
    np.testing.assert_allclose(power, exact, rtol=2.5e-7)
    _doubles(q, power, logarithm, root)
    np.testing.assert_allclose(power, exact, rtol=6e-8)
    np.testing.assert_allclose(logarithm, q, rtol=1e-7, atol=1e-9)
    np.testing.assert_array_equal(root, np.abs(q))


@njit
def _memory(rows, out, columns):
    for k in range(3):
        scatter(out, 2 - k, 3, gather(rows, k, 3))
    store(columns, 0, load_red(rows, 0))
    store(columns, 16, load_green(rows, 0))
    store(columns, 32, load_blue(rows, 0))


def test_rows_of_three():
    rows = RNG.normal(size=(16, 3)).astype(np.float32)
    out, columns = np.zeros((8, 3), np.float32), np.empty(48, np.float32)
    _memory(rows, out, columns)
    np.testing.assert_array_equal(out, rows[:8, ::-1])
    np.testing.assert_array_equal(columns.reshape(3, 16), rows.T)


@njit
def _sums(x, out):
    store_totals(
        out, 1, load16(x, 0), load16(x, 16), load16(x, 32), load16(x, 48), load16(x, 64), load16(x, 80),
        load16(x, 96), load16(x, 112),
    )  # fmt: skip


@njit
def _sums_of_eight(x, out):
    store_totals(
        out, 1, load8(x, 0), load8(x, 8), load8(x, 16), load8(x, 24), load8(x, 32), load8(x, 40),
        load8(x, 48), load8(x, 56),
    )  # fmt: skip


@pytest.mark.parametrize(("sums", "lanes"), [(_sums, 16), (_sums_of_eight, 8)])
def test_eight_sums_at_once(sums, lanes):
    x, out = RNG.normal(size=8 * lanes).astype(np.float32), np.zeros(10, np.float32)
    sums(x, out)
    np.testing.assert_allclose(out[1:9], x.reshape(8, lanes).sum(1), rtol=1e-5, atol=1e-5)
    assert out[0] == out[9] == 0
