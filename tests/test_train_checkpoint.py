"""Checkpoints: identical when read back, one line for everything else."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import damage, random_gaussians
from hypothesis import given, settings
from hypothesis import strategies as st

from sagesplat.core.errors import RunError
from sagesplat.core.gaussians import PARAMETERS
from sagesplat.train import checkpoint
from sagesplat.train.checkpoint import _checksum, read_checkpoint, write_checkpoint
from sagesplat.train.state import TrainState, initial_state
from sagesplat.train.view_parameters import ViewParameters


def some_state() -> TrainState:
    """A state in the middle of a run."""
    state = initial_state(random_gaussians(9, degree=1), seed=3)
    generator = torch.Generator().manual_seed(4)
    for moments in (state.exp_avg, state.exp_avg_sq):
        for p in moments.values():
            p += torch.rand(p.shape, generator=generator)
    state.grad_sum += torch.rand(9, generator=generator)
    state.grad_count += 3
    state.rng.standard_normal(5)
    state.queue, state.step, state.last_reset = [4, 1, 7], 1200, 1000
    state.per_view = {"pose": ViewParameters.zeros(8, 6), "exposure": ViewParameters.zeros(8, 12)}
    state.per_view["pose"].adam_step([3], torch.rand(1, 6, generator=generator), 0.1)
    return state


def test_writing_takes_a_small_part_of_the_time(monkeypatch):
    now = iter([0.0, 10.0, 12.0, 51.9, 52.0])  # asked, written from, to, asked, asked
    monkeypatch.setattr(checkpoint.time, "monotonic", lambda: next(now))
    monkeypatch.setattr(checkpoint, "write_checkpoint", lambda *_: None)
    pace = checkpoint.Pace()
    assert pace.due()
    pace.write(Path("x.npz"), some_state(), "")
    assert not pace.due()
    assert pace.due()


def test_round_trip_is_identical(tmp_path):
    state, path = some_state(), tmp_path / "run" / "checkpoint.npz"
    write_checkpoint(path, state, "these settings")
    back = read_checkpoint(path, "these settings")
    for name in (*PARAMETERS, "label_ids"):
        expected = getattr(state.gaussians, name)
        assert torch.equal(getattr(back.gaussians, name), expected)
        assert getattr(back.gaussians, name).dtype == expected.dtype
    for name in PARAMETERS:
        assert torch.equal(back.exp_avg[name], state.exp_avg[name])
        assert torch.equal(back.exp_avg_sq[name], state.exp_avg_sq[name])
    assert torch.equal(back.grad_sum, state.grad_sum)
    assert torch.equal(back.grad_count, state.grad_count)
    assert list(back.per_view) == ["exposure", "pose"]
    for kind, parameters in state.per_view.items():
        for name, tensor in vars(parameters).items():
            assert torch.equal(getattr(back.per_view[kind], name), tensor)
    assert (back.queue, back.step, back.last_reset) == ([4, 1, 7], 1200, 1000)
    assert back.rng.integers(0, 2**60) == state.rng.integers(0, 2**60)  # the same random future
    assert [p.name for p in path.parent.iterdir()] == [path.name]


def rewrite(path: Path, name: str, array: np.ndarray, version: int) -> None:
    """Replace an array and the version of a checkpoint, whose checksum holds again."""
    with np.load(path) as file:
        content = {n: file[n] for n in file.files if n != "meta"} | {name: array}
        meta = json.loads(str(file["meta"])) | {"version": version}
    meta["crc32"] = _checksum(meta, content)
    np.savez(path, **content, meta=np.array(json.dumps(meta)))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("name", "array", "version", "says"),
    [
        ("grad_sum", np.ones(9, np.float32), 99, r"checkpoint version 99, this sagesplat reads \d+; delete"),
        ("exp_avg/quats", np.full((9, 4), np.nan, np.float32), 3, r"exp_avg/quats holds NaN or Inf; delete"),
        ("view/pose/values", np.zeros((8, 5), np.float32), 3, "not a whole checkpoint"),
        ("view/pose/counts", np.full(8, -1), 3, "not a whole checkpoint"),
    ],
)
def test_what_cannot_be_resumed_is_one_line(tmp_path, name, array, version, says):
    path = tmp_path / "checkpoint.npz"
    write_checkpoint(path, some_state(), "a")
    with pytest.raises(RunError, match=r"other settings or inputs; delete checkpoint\.npz \(or add"):
        read_checkpoint(path, "b")
    rewrite(path, name, array, version)
    with pytest.raises(RunError, match=says):
        read_checkpoint(path, "a")


@pytest.mark.filterwarnings(
    "ignore::pytest.PytestUnraisableExceptionWarning"
)  # np.load leaves such files open
@settings(
    max_examples=100,
    derandomize=True,
)
@given(st.data())
def test_damage_is_one_line_or_harmless(tmp_path, data):
    path = tmp_path / "checkpoint.npz"
    if not path.exists():
        write_checkpoint(path, some_state(), "a")
        (tmp_path / "good").write_bytes(path.read_bytes())
    path.write_bytes(damage((tmp_path / "good").read_bytes(), data))
    try:
        state = read_checkpoint(path, "a")
    except RunError as error:
        message = str(error)
    else:
        message = f"{path} is harmless"
        assert state.step == 1200
        assert all(torch.isfinite(p).all() for p in state.gaussians.parameters().values())
    assert str(path) in message
    assert "\n" not in message
