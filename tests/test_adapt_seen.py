"""Levels as one camera sees them, against those of the ladder."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from conftest import pinhole, random_gaussians

from sagesplat.adapt.ladder import PrefixLadder
from sagesplat.adapt.observe import RenderedLabels
from sagesplat.adapt.seen import SeenRecords, seen_from, seen_levels
from sagesplat.core.errors import DataError
from sagesplat.core.second_opacity import SecondOpacities
from sagesplat.formats.levels import write_set
from sagesplat.raster import Workspace, cpu, in_sight, most_painted, rasterize


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
    how = {"backend": "cpu", "antialiased": antialiased, "workspace": Workspace()}
    seen, fast = seen_levels(ladder, camera, **how), seen_from(ladder, camera, **how).kept()
    assert isinstance(fast, SeenRecords)
    assert fast.nbytes == (56 if two else 44) * len(seen.gaussians) + 4 * len(
        fast.drawn.ids
    )  # and its lists of tiles
    assert 0 < seen.nbytes == 60 * len(seen.gaussians) < 60 * 300
    assert seen.gaussians.sh_degree == 0 < g.sh_degree
    some = [{3: 2, 7: 1}, {3: 2, 7: 2}]  # the others are not asked for
    fewer = seen_from(ladder, camera, compositions=some, **how)
    assert fewer.nbytes < fast.nbytes
    for levels in some:
        np.testing.assert_array_equal(fewer.render(levels).copy(), fast.render(levels))
        assert (fewer.label_ids(levels) == fast.label_ids(levels)).all()
    for levels in ({3: 1, 7: 1}, {3: 3, 7: 2}, {7: 3, 3: 2}, {3: 3, 7: 3}, {7: 1}):
        expected, actual = (
            rasterize(one.compose(levels), camera, antialiased=antialiased).rgb for one in (ladder, seen)
        )
        np.testing.assert_allclose(actual, expected, atol=2e-6)
        np.testing.assert_allclose(seen.render(levels), expected.clamp(0, 1), atol=2e-6)
        np.testing.assert_allclose(fast.render(levels), expected.clamp(0, 1), atol=5e-6)
        assert len(seen.compose(levels)) <= len(ladder.compose(levels))
        labels = RenderedLabels(ladder.compose(levels), "cpu", antialiased).render(camera)
        assert (seen.label_ids(levels) == labels).all()
        assert (fast.label_ids(levels) == labels).mean() > 0.999  # what is equal but for rounding


def test_projecting_some_at_a_time_changes_no_bit(monkeypatch):
    g, camera = random_gaussians(300, seed=4), pinhole(70, 50)
    at_once = cpu.seen(g, camera, Workspace())
    monkeypatch.setattr(cpu, "_PROJECTED", 67)  # the last part has 32
    in_parts = cpu.seen(g, camera, Workspace())
    assert 0 < len(at_once[0]) < 300
    for one, other in zip((*at_once[:2], at_once[2].ids), (*in_parts[:2], in_parts[2].ids), strict=True):
        np.testing.assert_array_equal(one, other)
    g.means[200] = np.nan
    with pytest.raises(DataError, match="row 200"):
        cpu.seen(g, camera, Workspace())


def test_what_is_in_sight_is_what_has_a_radius():
    g, camera = random_gaussians(200), pinhole(40, 30)
    seen = in_sight(g, camera)
    assert (seen == (rasterize(g, camera).radii > 0)).all()
    assert 0 < seen.sum() < 200


@pytest.mark.parametrize("size", [(40, 30), (33, 47)])
def test_labels_that_paint_most_are_those_of_features(size):
    g, columns = random_gaussians(150, logit=2.0), torch.arange(150) % 5
    painted = most_painted(g, pinhole(*size), columns, 6)
    expected = most_painted(g, pinhole(*size), columns, 6, backend="reference")
    assert painted.shape == expected.shape == size[::-1]
    assert (painted == expected).mean() > 0.999  # what is equal but for rounding
    assert len(np.unique(painted)) == 5
    nothing = most_painted(g.select(torch.zeros(150, dtype=torch.bool)), pinhole(*size), columns[:0], 6)
    assert (nothing == 0).all()


def test_the_label_image_of_one_category_is_what_does_not_shine_through():
    g = replace(random_gaussians(200), label_ids=torch.full((200,), 4, dtype=torch.int16))
    labels, camera = RenderedLabels(g, "cpu"), pinhole(50, 40)
    image, painted = labels.picture(camera)
    assert (painted == labels.render(camera)).mean() > 0.999  # what is equal but for rounding
    assert set(np.unique(painted).tolist()) == {-1, 4}
    np.testing.assert_allclose(image, labels.paint(camera), atol=2e-6)
