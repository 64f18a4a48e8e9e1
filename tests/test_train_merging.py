"""Merging of Gaussians by moments, and what fits merged ones to renders."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from conftest import random_gaussians
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sagesplat.core.gaussians import Gaussians
from sagesplat.train.merging import Merged, _cheapest, _pairs, merge


def _cloud(count: int, **options: Any) -> Gaussians:
    """Of one category: others do not merge."""
    g = random_gaussians(count, **options)
    return replace(g, label_ids=torch.full_like(g.label_ids, 3))


def _merged(g: Gaussians, count: int, weights: np.ndarray | None = None) -> Merged:
    weights = np.ones(len(g), np.float32) if weights is None else weights
    return next(merge(g, weights, [count]))


def _moments(g: Gaussians) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Opacity times area, mean and covariance of each Gaussian, float64: the definition, slowly."""
    scales = np.exp(g.log_scales.double().numpy())
    axes = Rotation.from_quat(np.roll(g.quats.double().numpy(), -1, axis=1)).as_matrix() * scales[:, None]
    covs = axes @ axes.swapaxes(1, 2)
    a, b, c = (scales**2).T
    mass = torch.sigmoid(g.logit_opacities.double()).numpy() * np.sqrt(a * b + a * c + b * c)
    return mass, g.means.double().numpy(), covs


def test_two_become_their_mixture() -> None:
    g = _cloud(2, logit=-2.0)
    mass, means, covs = _moments(g)
    share = mass / mass.sum()
    mean = share @ means
    apart = means - mean
    cov = np.einsum("i,ijk->jk", share, covs + apart[:, :, None] * apart[:, None])
    one = _merged(g, 1).gaussians
    got_mass, got_mean, got_cov = _moments(one)
    np.testing.assert_allclose(got_mean[0], mean, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(got_cov[0], cov, rtol=1e-3, atol=1e-7)
    np.testing.assert_allclose(got_mass[0], mass.sum(), rtol=1e-3)
    np.testing.assert_allclose(one.sh0[0, 0], share @ g.sh0[:, 0].numpy(), rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(one.shN[0], np.einsum("i,ijk->jk", share, g.shN.numpy()), rtol=1e-3, atol=1e-5)


def test_opacity_is_at_most_one() -> None:
    g = _cloud(2, logit=6.0)
    g = replace(g, means=torch.zeros(2, 3), log_scales=g.log_scales[:1].expand(2, 3).clone())
    assert 0.999 < float(torch.sigmoid(_merged(g, 1).gaussians.logit_opacities[0])) < 1


def test_those_that_stay_keep_every_bit() -> None:
    g = _cloud(60)
    found = _merged(g, 45)
    assert len(found.gaussians) == 45
    parts = np.bincount(found.into, minlength=45)
    assert (parts.sum(), parts.min()) == (60, 1)
    alone = np.flatnonzero(parts == 1)
    before = np.array([np.flatnonzero(found.into == row)[0] for row in alone])
    for name, value in found.gaussians.parameters().items():
        assert torch.equal(value[torch.from_numpy(alone)], getattr(g, name)[torch.from_numpy(before)]), name


def test_what_looks_the_same_merges_first() -> None:
    """Two red ones beside two blue ones: each with its own."""
    g = _cloud(4, degree=0, logit=1.0)
    x = torch.tensor([0.0, 0.1, 0.2, 0.3])
    red, blue = torch.tensor([1.5, -1.5, -1.5]), torch.tensor([-1.5, -1.5, 1.5])
    g = replace(
        g,
        means=torch.stack([x, 0 * x, 0 * x], 1),
        log_scales=torch.full((4, 3), -2.5),
        sh0=torch.stack([red, red, blue, blue])[:, None],
    )
    into = _merged(g, 2).into
    assert into[0] == into[1] != into[2] == into[3]


def test_what_nobody_sees_merges_first() -> None:
    g = _cloud(4, degree=0)
    x = torch.tensor([0.0, 0.2, 3.0, 3.2])
    g = replace(g, means=torch.stack([x, 0 * x, 0 * x], 1), log_scales=torch.full((4, 3), -2.0))
    g = replace(g, sh0=torch.tensor([1.0, -1.0, 1.0, -1.0])[:, None, None].expand(4, 1, 3).clone())
    into = _merged(g, 3, np.array([1, 1, 0, 0], np.float32)).into
    assert into[2] == into[3]
    assert into[0] != into[1]


@settings(max_examples=25)
@given(st.integers(1, 40), st.data())
def test_counts_are_reached_and_all_is_finite(count: int, data: st.DataObject) -> None:
    g = _cloud(count, seed=count, degree=data.draw(st.sampled_from([0, 1, 3])))
    if data.draw(st.booleans()):  # all in one place
        g = replace(g, means=torch.zeros(count, 3))
    if data.draw(st.booleans()):  # flat, or needles
        g = replace(g, log_scales=g.log_scales + torch.tensor([0.0, -20.0, data.draw(st.floats(-20, 0))]))
    weights = np.zeros(count, np.float32) if data.draw(st.booleans()) else np.ones(count, np.float32)
    wanted = sorted(data.draw(st.lists(st.integers(1, count), min_size=1, max_size=3)), reverse=True)
    for number, found in zip(wanted, merge(g, weights, wanted), strict=True):
        assert len(found.gaussians) == found.into.max() + 1 == number
        assert all(torch.isfinite(p).all() for p in found.gaussians.parameters().values())
        assert found.gaussians.quats.norm(dim=1).min() > 0.1


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_the_unit_does_not_matter(scale: float) -> None:
    g = _cloud(50)
    larger = replace(g, means=g.means * scale, log_scales=g.log_scales + float(np.log(scale)))
    assert (_merged(g, 20).into == _merged(larger, 20).into).mean() > 0.8  # ties apart


def test_categories_do_not_merge() -> None:
    g = replace(random_gaussians(40), label_ids=torch.tensor([3, 184] * 20, dtype=torch.int16))
    found = _merged(g, 10)
    for row, into in enumerate(found.into):
        assert found.gaussians.label_ids[into] == g.label_ids[row]
    assert len(_merged(g, 1).gaussians) == 2


@settings(max_examples=40)
@given(st.integers(0, 1000), st.integers(2, 60), st.integers(1, 6))
def test_every_pair_of_neighbours_once(seed: int, count: int, near: int) -> None:
    rng = np.random.default_rng(seed)
    rows = np.stack([rng.choice(count, min(near, count), replace=False) for _ in range(count)])
    first, second = _pairs(rows.astype(np.int32))
    found = list(zip(first.tolist(), second.tolist(), strict=True))
    assert len(set(found)) == len(found)
    wanted = {(min(i, j), max(i, j)) for i, row in enumerate(rows.tolist()) for j in row if i != j}
    assert set(found) == wanted


@settings(max_examples=40)
@given(st.integers(0, 1000), st.integers(2, 200), st.booleans())
def test_the_cheapest_pairs_are_those_of_all_pairs_in_order(seed: int, count: int, ties: bool) -> None:
    """Sorting some at a time takes the same pairs as going through all of them by cost."""
    rng = np.random.default_rng(seed)
    first = rng.integers(0, count - 1, 6 * count)
    second = rng.integers(first + 1, count)
    cost = rng.integers(0, 5, len(first)).astype(float) if ties else rng.random(len(first))
    for most in (1, count // 3 + 1, count):
        used, wanted = set[int](), list[int]()
        for pair in np.argsort(cost, kind="stable").tolist():
            if len(wanted) < most and not used & {int(first[pair]), int(second[pair])}:
                used |= {int(first[pair]), int(second[pair])}
                wanted.append(pair)
        assert _cheapest(cost, first, second, count, most).tolist() == wanted


def test_pairs_of_unknown_cost_come_last() -> None:
    first, second = np.arange(0, 8, 2), np.arange(1, 9, 2)
    cost = np.array([np.nan, 1.0, np.inf, 0.5])
    assert _cheapest(cost, first, second, 8, 2).tolist() == [3, 1]
    assert set(_cheapest(cost, first, second, 8, 4).tolist()) == {0, 1, 2, 3}
    assert len(_cheapest(np.full(4, np.nan), first, second, 8, 4)) == 4
