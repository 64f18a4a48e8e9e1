"""Tiles: the depth order, the list of intersections, and rendering only some of them."""

from typing import Any

import numpy as np
import pytest
import torch
from conftest import pinhole, random_gaussians, render_with_gradients
from hypothesis import given, settings
from hypothesis import strategies as st

from sagesplat.kernels.workspace import Workspace
from sagesplat.raster import tiles
from sagesplat.raster.cpu import _Options, _project

BACKGROUND = torch.tensor([0.2, 0.3, 0.4])


@settings(max_examples=50, derandomize=True)
@given(st.lists(st.integers(0, 2**32 - 1), max_size=60), st.integers(0, 31), st.integers(1, 4))
def test_order_in_a_tile_is_a_stable_sort(keys, shift, times):
    found = np.array(keys * times, np.uint32) >> np.uint32(shift)  # many ties; short lists and long ones
    order, other = np.empty((2, len(found)), np.uint64)
    places = tiles.stable_order(found, order, other)[: len(found)] & np.uint64(0xFFFFFFFF)
    np.testing.assert_array_equal(places, np.argsort(found, kind="stable"))


def test_intersections_are_exact_sorted_and_consistent():
    g, camera = random_gaussians(200, seed=8, log_scale=-1.5), pinhole(75, 50)
    means, quats, log_scales, logits, sh0, shN = (p.numpy() for p in g.parameters().values())
    options = _Options(camera, 3, False, None, Workspace())
    records, depths, radii = _project(options, (means, quats, log_scales, logits, sh0, shN))
    mask = np.ones(5 * 4, bool)
    found = tiles.intersect(records, depths, radii, camera.width, camera.height, mask, Workspace())
    assert sorted(found.row_order) == [0, 1, 2, 3]
    assert found.starts[0] == 0
    assert found.starts[-1] == len(found.ids) == found.offsets[-1]
    assert sorted(found.slots) == list(range(len(found.ids)))
    owner = np.repeat(np.arange(200), np.diff(found.offsets))
    np.testing.assert_array_equal(owner[found.slots], found.ids)
    for tile in range(20):
        ids = found.ids[found.starts[tile] : found.starts[tile + 1]]
        assert (np.diff(depths[ids]) >= 0).all()
        x0, y0 = tile % 5 * 16, tile // 5 * 16
        # brute force between the centres of its outer pixels, finer than pixels
        x, y = np.meshgrid(*(np.linspace(s + 0.5, s + 15.5, 61) for s in (x0, y0)))
        mx, my, a, b, c, log_opacity = (records[:, k, None, None].astype(float) for k in range(6))
        q = log_opacity + a * (x - mx) ** 2 + b * (x - mx) * (y - my) + c * (y - my) ** 2
        visible = np.flatnonzero((q.max((1, 2)) >= np.log2(1 / 255)) & (radii > 0))
        assert np.isin(visible, ids).all()
        surplus = np.setdiff1d(ids, visible)  # only what a grid of a quarter pixel can miss
        assert (q[surplus].max((1, 2)) > np.log2(1 / 255) - 0.3).all()


@pytest.mark.parametrize("keep", ["some", "none"])
def test_masked_tiles_show_the_background_and_take_no_gradient(keep):
    g, camera = random_gaussians(150, seed=9, degree=1), pinhole(70, 50)
    features = torch.rand(150, 2, generator=torch.Generator().manual_seed(0))
    mask = np.zeros((4, 5), bool)
    if keep == "some":
        mask[[0, 1, 2, 3], [1, 2, 4, 0]] = True
        mask[1, 3] = True
    pixels = torch.from_numpy(np.repeat(np.repeat(mask, 16, 0), 16, 1)[:50, :70].copy())
    options: dict[str, Any] = {"features": features, "background": BACKGROUND}
    part, grads = render_with_gradients(g, camera, tile_mask=mask, **options)
    full, wanted = render_with_gradients(g, camera, pixels=pixels.float(), **options)
    assert (part.rgb[~pixels] == BACKGROUND).all()
    assert (part.alpha[~pixels] == 0).all()
    assert torch.equal(part.rgb[pixels], full.rgb[pixels])
    assert torch.equal(part.alpha[pixels], full.alpha[pixels])
    assert part.features is not None
    assert full.features is not None
    assert torch.equal(part.features[pixels], full.features[pixels])
    for name, grad in grads.items():
        assert (grad - wanted[name]).abs().max() <= 1e-6 * wanted[name].abs().max(), name
    if keep == "none":
        assert all((grad == 0).all() for grad in grads.values())
