import io
import tracemalloc
from pathlib import Path
from typing import Any

import pytest
import torch

from sagesplat.io.tensors import read_tensors

CORPUS = Path(__file__).parent / "data" / "hostile" / "deeplab"


def read(path: Path) -> Any:
    with path.open("rb") as file:
        return read_tensors(file)


@pytest.mark.parametrize("new", [True, False])
def test_what_torch_saves_is_read(tmp_path: Path, new: bool):
    state = {"a": torch.arange(6.0).reshape(2, 3), "b": torch.tensor(7), "name": "x", "step": 2**40}
    torch.save(state, tmp_path / "a.pth", _use_new_zipfile_serialization=new)
    found = read(tmp_path / "a.pth")
    assert found.keys() == state.keys()
    assert torch.equal(found["a"], state["a"])
    assert (found["b"], found["name"], found["step"]) == (torch.tensor(7), "x", 2**40)


def test_compressed_members_are_refused():
    with pytest.raises(ValueError, match="compressed"):
        read(CORPUS / "bomb.pth")


def test_a_length_that_is_announced_is_not_allocated():
    tracemalloc.start()
    with pytest.raises(Exception, match="decode"):
        read(CORPUS / "announced-text.pth")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2**20


def test_what_is_no_tensor_is_refused_without_advice_to_run_it(tmp_path: Path):
    content = io.BytesIO()
    torch.save({"a": Path("x")}, content)
    (tmp_path / "a.pth").write_bytes(content.getvalue())
    with pytest.raises(ValueError, match=r"Unsupported global|GLOBAL") as error:
        read(tmp_path / "a.pth")
    assert "weights_only" not in str(error.value).partition("was not")[0]
    assert "\n" not in str(error.value)
