"""Levels as one camera sees them, against those of the ladder."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from conftest import pinhole, random_gaussians

from sagesplat.adapt.ladder import PrefixLadder
from sagesplat.adapt.seen import SeenLevels, Sight
from sagesplat.core.second_opacity import SecondOpacities
from sagesplat.formats.levels import write_set
from sagesplat.raster import rasterize


@pytest.mark.parametrize("two", [False, True])
@pytest.mark.parametrize("antialiased", [False, True])
def test_compositions_render_alike(tmp_path, two, antialiased):
    g = random_gaussians(300, seed=2)
    g = replace(g, label_ids=torch.tensor([3] * 100 + [7] * 200, dtype=torch.int16))
    sizes = {3: (10, 40, 100), 7: (5, 100, 200)}
    second = SecondOpacities.of_levels(torch.randn(300) * 3, sizes) if two else None
    write_set(tmp_path / "ladder.npz", g, 1, sizes, second=second)
    ladder = PrefixLadder(tmp_path / "ladder.npz", sizes)
    camera = pinhole(70, 50)
    seen = Sight(ladder, "cpu", antialiased).of(camera)
    assert isinstance(seen, SeenLevels)
    assert len(seen.gaussians) < 300
    assert seen.gaussians.sh_degree == 0 < g.sh_degree
    for levels in ({3: 1, 7: 1}, {3: 3, 7: 2}, {7: 3, 3: 2}, {3: 3, 7: 3}, {7: 1}):
        expected, actual = (
            rasterize(one.compose(levels), camera, antialiased=antialiased).rgb for one in (ladder, seen)
        )
        np.testing.assert_allclose(actual, expected, atol=2e-6)
        assert len(seen.compose(levels)) <= len(ladder.compose(levels))
