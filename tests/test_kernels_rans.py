"""The entropy coder: round trips of any symbols, lengths near the entropy, damage."""

from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sagesplat.kernels.rans import TOTAL, Reader, Tables, Writer
from tests.conftest import damage

COUNTS = {"wide": np.ones((3, 200), np.int64), "few": np.array([[0, 5, 0, 1, 0]])}
Block = tuple[list[tuple[int, int]], list[int], list[tuple[int, int]]]

blocks: st.SearchStrategy[Block] = st.tuples(
    st.lists(st.tuples(st.integers(0, 2), st.integers(0, 199)), max_size=20),
    st.lists(st.sampled_from([1, 3]), max_size=20),
    st.lists(
        st.integers(0, 14).flatmap(lambda n: st.tuples(st.just(n), st.integers(0, 2**n - 1))), max_size=9
    ),
)


def pairs(values: list[tuple[int, int]]) -> np.ndarray:
    return np.array(values, np.int64).reshape(-1, 2).T.copy()  # rows that kernels know, compiled already


def code(coder: Writer | Reader, block: Block, *, reading: bool) -> list[np.ndarray]:
    (rows, wide), (widths, values) = pairs(block[0]), pairs(block[2])
    few = np.array(block[1], np.int64)
    found = [
        coder.symbols("wide", rows, None if reading else wide),
        coder.symbols("few", 0 * few, None if reading else few),
        coder.bits(widths, None if reading else values),
    ]
    coder.end_block()
    return found


@settings(max_examples=50)
@given(st.lists(blocks, min_size=1, max_size=4))
def test_what_was_coded_is_read(coded: list[Block]):
    writer = Writer(Tables(COUNTS))
    values = [value for block in coded for value in code(writer, block, reading=False)]
    reader = Reader(Tables(COUNTS), writer.payload())
    found = [value for block in coded for value in code(reader, block, reading=True)]
    reader.finish()
    for expected, value in zip(values, found, strict=True):
        np.testing.assert_array_equal(value, expected)


@settings(max_examples=50)
@given(st.lists(blocks, min_size=1, max_size=2), st.data())
def test_damage_ends_as_a_value_error(coded: list[Block], data: st.DataObject):
    writer = Writer(Tables(COUNTS))
    for block in coded:
        code(writer, block, reading=False)
    with suppress(ValueError):
        reader = Reader(Tables(COUNTS), damage(writer.payload(), data))
        for block in coded:
            code(reader, block, reading=True)
        reader.finish()


def test_a_table_learns_what_is_frequent():
    tables = Tables(COUNTS)
    values = np.random.default_rng(0).geometric(0.3, 20_000).clip(0, 199)
    writer, zero = Writer(tables), np.zeros(100, np.int64)
    for some in np.split(values, 200):
        writer.symbols("wide", zero, some)
        writer.end_block()
    share = np.bincount(values) / len(values)
    entropy = -(share[share > 0] * np.log2(share[share > 0])).sum()
    assert len(writer.payload()) * 8 / len(values) < 1.03 * entropy


@pytest.mark.parametrize("largest", [1, 10, 2**20])
def test_frequencies_have_one_sum_and_leave_out_what_cannot_be(largest: int):
    tables = Tables({"t": np.array([[0, 1, largest, 0, largest], [0, 0, 1, 0, 0]])})
    frequencies = np.diff(tables.ends["t"])
    assert (frequencies.sum(1) == TOTAL).all()
    assert (frequencies > 0).tolist() == [
        [False, True, True, False, True],
        [False, False, True, False, False],
    ]


def test_a_symbol_that_cannot_be_is_not_written():
    writer = Writer(Tables(COUNTS))
    writer.symbols("few", np.zeros(1, np.int64), np.array([2]))
    with pytest.raises(ValueError, match="cannot code"):
        writer.payload()


@pytest.mark.parametrize("payload", [b"", b"abc", b"\0\0\0\0", b"\xff\xff\xff\xff"])
def test_an_impossible_beginning_is_refused(payload: bytes):
    with pytest.raises(ValueError, match=r"coded values|first state"):
        Reader(Tables(COUNTS), payload)


def test_what_is_left_over_is_refused():
    writer = Writer(Tables(COUNTS))
    writer.bits(np.full(9, 14), np.arange(9))
    reader = Reader(Tables(COUNTS), writer.payload() + b"\0")
    reader.bits(np.full(9, 14))
    with pytest.raises(ValueError, match="damaged"):
        reader.finish()
