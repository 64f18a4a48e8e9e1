"""What sagesplat writes for other viewers keeps its categories and flags."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from sagesplat.core.errors import DataError
from sagesplat.formats.splats import read_splat
from sagesplat.formats.splats_write import write_splat, written_as
from tests.conftest import random_gaussians


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("suffix", [".ply", ".spz", ".SOG"])
def test_categories_and_flags_are_kept(tmp_path, suffix, antialiased):
    g = random_gaussians(60, degree=1)
    g = replace(g, label_ids=(torch.arange(60) // 25 - 1).to(torch.int16))
    path = tmp_path / f"a{suffix}"
    write_splat(path, g, {0: "tree", 1: "Blume ☘"}, antialiased=antialiased)
    splat = read_splat(path)
    assert splat.names == {0: "tree", 1: "Blume ☘"}
    assert splat.antialiased == antialiased
    assert splat.gaussians.counts() == g.counts() == {-1: 25, 0: 25, 1: 10}
    for label in (0, 1):
        ours, read = g.of_labels([label]), splat.gaussians.of_labels([label])
        assert torch.allclose(ours.means.mean(0), read.means.mean(0), atol=5e-3)


def test_other_names_are_refused(tmp_path):
    with pytest.raises(DataError, match=r"a\.glb: .* use \.ply, \.spz, \.sog or lod-meta\.json"):
        write_splat(tmp_path / "a.glb", random_gaussians(3))
    with pytest.raises(DataError, match="several levels"):
        write_splat(tmp_path / "lod-meta.json", random_gaussians(3))
    assert written_as(Path("x/lod-meta.json")) == "lod-meta.json"
    assert list(tmp_path.iterdir()) == []
