"""Levels on disk: how much they lose, how small they are, and what a damaged one says."""

import zipfile
from dataclasses import replace

import numpy as np
import pytest
import torch
from conftest import LABELS, random_gaussians

from sagesplat.core.errors import DataError
from sagesplat.core.gaussians import PARAMETERS
from sagesplat.formats.levels import read_header, read_level, write_level, write_set


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_round_trip_within_the_quantisation(tmp_path, degree):
    g = random_gaussians(600, degree=degree)
    path = write_level(tmp_path / "levels", 1200, g, recovering=True, sh_degree=degree)
    assert path == tmp_path / "levels" / "001200.npz"
    assert [p.name for p in path.parent.iterdir()] == [path.name]
    back = read_level(path)
    order = torch.argsort(g.label_ids, stable=True)  # a level lists its categories one after the other
    g = g.select(order)
    assert torch.equal(back.label_ids, g.label_ids)
    assert back.label_ids.dtype == torch.int16
    assert torch.equal(back.means, g.means)
    unit = torch.nn.functional.normalize(g.quats, dim=-1)
    assert (back.quats - unit).abs().max() < 2e-5
    for name in ("log_scales", "logit_opacities", "sh0"):
        value = getattr(g, name)
        assert ((getattr(back, name) - value).abs() <= value.abs() * 2**-11 + 1e-7).all(), name
    assert back.shN.shape == g.shN.shape
    for label in LABELS if degree else ():
        of = g.label_ids == label
        largest = g.shN[of].abs().amax(0)
        assert ((back.shN[of] - g.shN[of]).abs() <= largest / 100).all()  # steps of the square root, 1/127
        tiny = g.shN[of].abs() < largest / 100
        assert tiny.any()
        assert ((back.shN[of] - g.shN[of]).abs()[tiny] <= largest.expand(tiny.shape)[tiny] / 1000).all()
    for p in back.parameters().values():
        assert p.dtype == torch.float32


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_an_exact_level_is_identical_bit_for_bit(tmp_path, degree):
    g = random_gaussians(60, degree=degree)
    g.quats[0] = torch.tensor([3.0, -0.0, 1e-20, -7.5])  # as they came, of any length
    g.log_scales[1] = torch.tensor([-40.0, 1e-7, 12.3456789])
    g.sh0[2] = -0.0
    path = write_level(tmp_path, 7, g, recovering=False, sh_degree=degree, exact=True)
    write_set(tmp_path / "set.npz", g, 7, exact=True)
    g = g.select(torch.argsort(g.label_ids, stable=True))
    for back in (read_level(path), read_level(tmp_path / "set.npz")):
        for name in (*PARAMETERS, "label_ids"):
            assert getattr(back, name).numpy().tobytes() == getattr(g, name).numpy().tobytes(), name
    assert (tmp_path / "set.npz").stat().st_size < len(g) * (14 + 3 * g.shN.shape[1]) * 4 + 12_000


def test_header_and_single_categories(tmp_path):
    g = random_gaussians(100)
    path = write_level(tmp_path, 42, g, recovering=True, sh_degree=3)
    header = read_header(path)
    assert (header.path, header.step, header.recovering, header.sh_degree) == (path, 42, True, 3)
    assert header.counts == g.counts() == {-1: 34, 3: 33, 184: 33}
    whole = read_level(path)
    for label in LABELS:
        part, expected = read_level(path, [label]), whole.of_labels([label])
        for name in (*PARAMETERS, "label_ids"):
            assert torch.equal(getattr(part, name), getattr(expected, name))
    assert read_level(path, [184, 3]).counts() == {3: 33, 184: 33}
    for nothing in ([], [77]):
        empty = read_level(path, nothing)
        assert len(empty) == 0
        assert empty.sh_degree == 3
        assert empty.label_ids.dtype == torch.int16


def test_other_categories_are_not_touched(tmp_path):
    """A composition reads what it takes: damage elsewhere in the file goes unnoticed."""
    path = write_level(tmp_path, 1, random_gaussians(300), recovering=False, sh_degree=3)
    with zipfile.ZipFile(path) as archive:
        info = archive.getinfo("184/shN.npy")
    data = bytearray(path.read_bytes())
    data[info.header_offset + 500] ^= 0xFF
    path.write_bytes(data)
    assert len(read_level(path, [-1, 3])) == 200
    with pytest.raises(
        DataError, match=r"000001\.npz: a broken level .*; delete it and run `sagesplat nest`"
    ):
        read_level(path, [184])


def test_a_level_without_gaussians(tmp_path):
    nothing = random_gaussians(0, degree=2)
    path = write_level(tmp_path, 1, nothing, recovering=False, sh_degree=2)
    assert read_header(path).counts == {}
    assert len(read_level(path)) == 0


def test_size_on_disk(tmp_path):
    g = random_gaussians(20_000)
    path = write_level(tmp_path, 30_000, g, recovering=False, sh_degree=3)
    assert path.stat().st_size / len(g) <= 80
    small = write_level(tmp_path, 1, g, recovering=False, sh_degree=0)
    assert small.stat().st_size / len(g) <= 35


@pytest.mark.parametrize("name", ["means", "log_scales", "logit_opacities", "sh0"])
def test_not_finite_is_refused(tmp_path, name):
    g = random_gaussians(30)
    parameter = getattr(g, name).clone()
    parameter.view(30, -1)[7, 0] = float("inf")
    path = write_level(tmp_path, 3, replace(g, **{name: parameter}), recovering=False, sh_degree=3)
    with pytest.raises(DataError, match=rf"000003\.npz: {name} holds NaN or Inf; delete"):
        read_level(path)


def test_not_a_level(tmp_path):
    missing = tmp_path / "000001.npz"
    other, no_meta = tmp_path / "000002.npz", tmp_path / "000003.npz"
    other.write_text("hello")
    np.savez(no_meta, **{"3/means": np.zeros((2, 3))})  # type: ignore[arg-type]
    for path in (missing, other, no_meta):
        with pytest.raises(DataError, match=rf"{path.name}: not a"):
            read_level(path)


def test_harmonics_not_yet_in_use_are_left_out(tmp_path):
    path = write_level(tmp_path, 5, random_gaussians(30), recovering=False, sh_degree=1)
    assert read_level(path).shN.shape == (30, 3, 3)
    assert read_header(path).sh_degree == 1
