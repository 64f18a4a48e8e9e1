import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from sagesplat.adapt.evaluate import Evaluation, read_evaluation
from sagesplat.adapt.observe import Observations, read_observations
from sagesplat.core.errors import DataError


@settings(max_examples=30)
@given(data=st.data(), count=st.integers(0, 6))
@pytest.mark.parametrize(("kind", "read"), [(Observations, read_observations), (Evaluation, read_evaluation)])
def test_tables_read_back_identical(tmp_path, kind, read, data, count):
    types = [np.dtype(f.type.dtypes[0]) for f in dataclasses.fields(kind)]  # type: ignore
    table = kind(*(data.draw(npst.arrays(t, count)) for t in types))
    table.write_csv(tmp_path / "t.csv")
    back = read(tmp_path / "t.csv")
    for field, dtype in zip(dataclasses.fields(kind), types, strict=True):
        column = getattr(back, field.name)
        assert column.dtype == dtype
        np.testing.assert_array_equal(column, getattr(table, field.name))


@pytest.mark.parametrize(
    "content", [None, b"", b"target,view\n1,2\n", b"\xff\xfe\x00", "ragged", "words", "huge"]
)
def test_a_damaged_table_is_named(tmp_path, content):
    path = tmp_path / "t.csv"
    names = [f.name for f in dataclasses.fields(Evaluation)]
    cells = {"ragged": ["1"], "words": ["one"] * len(names), "huge": ["99999999999"] * len(names)}
    if isinstance(content, str):
        path.write_text(f"{','.join(names)}\n{','.join(cells[content])}\n")
    elif content is not None:
        path.write_bytes(content)
    with pytest.raises(DataError, match="sagesplat evaluate") as caught:
        read_evaluation(path)
    assert str(path) in str(caught.value)
