"""Lists of numbers in documents: what is packed comes back, and damage is told."""

import json
from base64 import b64decode, b64encode

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sagesplat.viewer.numbers import LISTS, packed, unpacked

_numbers = st.lists(st.integers(-(2**30), 2**30) | st.integers(-9, 9), max_size=40)
_lists = _numbers | st.lists(_numbers, max_size=12)
_entries = st.dictionaries(st.sampled_from([*LISTS]), _lists)
_documents = _entries.flatmap(
    lambda own: st.lists(_entries, max_size=4).map(lambda cells: {"id": 3, **own, "cells": cells})
)


@given(_documents)
@settings(max_examples=30)  # each has thousands of numbers
def test_what_is_packed_comes_back(document):
    sent = json.loads(json.dumps(packed(document)))
    assert unpacked(sent) == document
    assert [*unpacked(sent)] == [*document]


def test_small_numbers_take_few_bytes():
    document = {"terms": [[i % 3 - 1 for i in range(1000)]] * 6, "rows": [*range(0, 2000, 2)]}
    assert len(b64decode(packed(document)["numbers"])) < 1400  # 6,000 numbers of 1.58 bits, 1,000 of 1


def test_no_number_of_more_than_32_bits():
    with pytest.raises(ValueError, match="more than 32 bits"):
        packed({"rows": [0, 2**40]})


@given(st.integers(0, 20), st.binary(min_size=1, max_size=9))
def test_numbers_that_are_cut_off_or_go_on(at, more):
    whole = packed({"rows": [1, 5, 9, 200], "cells": [{"terms": [[3, -3], [0, 70_000]] * 9}]})
    content = b64decode(whole["numbers"])
    for one in (content[:at], content + more, b"\0" + content):
        with pytest.raises(ValueError, match=r"damaged|cut off|bytes of coded|impossible"):
            unpacked({**whole, "numbers": b64encode(one).decode()})


@pytest.mark.parametrize("length", [-1, 2**22 + 1, 10**20])
def test_lengths_are_limited(length):
    with pytest.raises(ValueError, match="at most 4194304"):
        unpacked({"rows": length, "numbers": ""})
