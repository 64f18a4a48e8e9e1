"""What fits merged Gaussians to renders, and the sets of lower levels."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from conftest import orbit, random_gaussians
from hypothesis import given
from hypothesis import strategies as st

from sagesplat.core.gaussians import concat, gather
from sagesplat.formats.levels import starts_of
from sagesplat.raster import rasterize
from sagesplat.scene.points import untracked
from sagesplat.scene.scene import Scene, View
from sagesplat.train.importance import importance
from sagesplat.train.lower_levels import (
    Set,
    assemble,
    by_label,
    counts_of_first,
    first_of_all,
    in_cells,
    joined,
    merged_rungs,
    size_of,
    split_sets,
    trained_sets,
    usable_shares,
    whole,
)
from sagesplat.train.refit import fit_to_renders, refit_coverage


def _scene(tmp_path) -> Scene:  # type: ignore[no-untyped-def]
    cameras = orbit(6)
    views = tuple(View(f"{i}.png", camera, tmp_path / f"{i}.png") for i, camera in enumerate(cameras))
    points = untracked(np.zeros((1, 3), np.float32), np.zeros((1, 3), np.uint8))
    return Scene("views", tmp_path, views, points, test_every=0)


def test_a_few_passes_bring_pictures_back(tmp_path) -> None:  # type: ignore[no-untyped-def]
    """Gaussians with wrong colours, sizes and places, and the pictures of the right ones."""
    truth = random_gaussians(40, degree=0, logit=1.0)
    truth = replace(truth, sh0=truth.sh0.clamp(-1, 1))
    cameras = [view.camera for view in _scene(tmp_path).views]
    images = [rasterize(truth, camera).rgb for camera in cameras]
    sizes = torch.exp(truth.log_scales).mean(1, keepdim=True)
    wrong = replace(
        truth, sh0=truth.sh0 * 0.5, log_scales=truth.log_scales + 0.2, means=truth.means + 0.3 * sizes
    )

    def error(g) -> float:  # type: ignore[no-untyped-def]
        pairs = zip(cameras, images, strict=True)
        return float(sum(((rasterize(g, camera).rgb - image) ** 2).mean() for camera, image in pairs))

    errors = [error(fit_to_renders(wrong, cameras, images, passes, 2.0)) for passes in (0, 1, 4, 10)]
    assert errors == sorted(errors, reverse=True)
    assert errors[-1] < 0.1 * errors[0]
    assert error(fit_to_renders(truth, cameras, images, 3)) < 1e-2 * errors[0]  # hardly moves what is right


def test_coverage_comes_back(tmp_path) -> None:  # type: ignore[no-untyped-def]
    scene = _scene(tmp_path)
    truth = random_gaussians(30, degree=0, logit=0.5)
    wanted = importance(truth, scene, range(6))
    faint = replace(truth, logit_opacities=truth.logit_opacities - 1.5)

    def error(g) -> float:  # type: ignore[no-untyped-def]
        return float(np.abs(importance(g, scene, range(6)) - wanted).sum())

    once = refit_coverage(faint, wanted, scene, range(6))
    assert error(once) < 0.6 * error(faint)
    assert error(refit_coverage(once, wanted, scene, range(6))) < error(once)


@given(st.lists(st.floats(0.001, 1), min_size=1, max_size=12), st.integers(1, 10_000))
def test_sizes_grow_and_end_with_all(shares: list[float], count: int) -> None:
    usable = usable_shares(shares, count)
    assert usable == tuple(sorted(set(usable)))
    assert usable[-1] == 1.0
    assert [size_of(share, count) for share in usable][-1] == count


def test_sets_hold_levels_of_similar_size() -> None:
    assert trained_sets([0.01, 0.02, 0.1, 0.2]) == [(0.01, 0.02), (0.1, 0.2)]
    assert trained_sets([0.5]) == [(0.5,)]


def test_a_ladder_of_merged_sets_and_originals() -> None:
    """Levels grow in each category, each but the first set replaces what is below, the last is all."""
    g = concat([random_gaussians(300, seed=1), random_gaussians(7, seed=2)])  # a small category, too
    g = replace(g, label_ids=torch.tensor([3] * 300 + [184] * 7, dtype=torch.int16))
    weights = np.random.default_rng(0).uniform(0, 1, len(g)).astype(np.float32)
    shares = (0.05, 0.1, 0.4)
    rungs = merged_rungs(g, weights, shares)
    assert [len(rung.gaussians) for rung in rungs] == [16, 31, 123]
    for rung in rungs:
        assert set(rung.gaussians.counts()) == {3, 184}
        stands = rung.stands_for[rung.gaussians.label_ids == 3].sum()
        np.testing.assert_allclose(stands, weights[:300].sum(), rtol=1e-4)
    counts = [rung.gaussians.counts() for rung in rungs]
    sets = [Set(rungs[1].gaussians, tuple(counts[:2])), whole(rungs[2].gaussians)]
    nested, spans = joined(sets, [np.arange(len(x.gaussians))[::-1] for x in sets])
    for level, wanted in enumerate(counts):
        shown = (spans.first <= level) & (level <= spans.last)
        assert nested.gaussians.select(torch.from_numpy(shown)).counts() == wanted
    order = np.lexsort((spans.order, spans.last, nested.gaussians.label_ids.numpy()))
    trained = split_sets(nested.gaussians.select(torch.from_numpy(order)), sets)
    most = first_of_all(g, 0.7, counts[-1]).counts()
    ladder = assemble([*trained, Set(g, (most, g.counts()))])
    for label, sizes in ladder.sizes.items():
        starts = starts_of(sizes, ladder.replaces[label])
        found = [end - start for start, end in zip(starts, sizes, strict=True)]
        assert found == [level[label] for level in (*counts, most, g.counts())]
        assert found == sorted(found)
        assert ladder.replaces[label] == (3, 4)


def test_cells_of_sets_have_every_level_and_the_same_gaussians(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sagesplat.train.cells.FEWEST", 20)
    g = random_gaussians(400, degree=0)
    low = g.select(torch.arange(0, 400, 10))
    most = {label: count // 2 for label, count in g.counts().items()}
    ladder = assemble([whole(low), Set(g, (most, g.counts()))])
    made, label_of = in_cells(ladder, 8)
    assert len(label_of) > 4
    assert set(made.gaussians.counts()) == set(label_of)
    for level in range(3):
        for label, sizes in ladder.sizes.items():
            assert (
                sum(made.sizes[cell][level] for cell in label_of if label_of[cell] == label) == sizes[level]
            )
    for sizes in made.sizes.values():
        assert 0 < sizes[0] < sizes[1]  # each set replaces the one before
    low_rows = np.concatenate([by_label(made.gaussians)[cell][: made.sizes[cell][0]] for cell in made.sizes])
    one, other = made.gaussians.means[torch.from_numpy(low_rows)], low.means
    assert np.array_equal(np.sort(one.numpy(), 0), np.sort(other.numpy(), 0))
    assert len(in_cells(ladder, 0)[1]) == len(g.counts())


def test_mixed_levels_of_cells_lie_between_the_two(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sagesplat.train.cells.FEWEST", 40)
    g = random_gaussians(400, degree=0)
    g, camera = replace(g, label_ids=torch.zeros_like(g.label_ids)), orbit(1)[0]
    (rung,) = merged_rungs(g, np.ones(len(g), np.float32), [0.25])
    ladder = assemble([whole(rung.gaussians), whole(g)])
    made, label_of = in_cells(ladder, 6)
    rows = by_label(made.gaussians)

    def image(levels: dict[int, int]) -> torch.Tensor:
        ends = {cell: (0, *made.sizes[cell]) for cell in levels}
        kept = [rows[cell][ends[cell][k - 1] : ends[cell][k]] for cell, k in levels.items()]
        return rasterize(made.gaussians.select(torch.from_numpy(np.concatenate(kept))), camera).rgb

    low, full = (image(dict.fromkeys(label_of, level)) for level in (1, 2))
    torch.testing.assert_close(low, rasterize(rung.gaussians, camera).rgb, atol=1e-5, rtol=0)
    torch.testing.assert_close(full, rasterize(g, camera).rgb, atol=1e-5, rtol=0)
    worst = float((low - full).square().mean())
    errors = [
        float((image({cell: 2 if cell < high else 1 for cell in label_of}) - full).square().mean())
        for high in range(1, len(label_of))
    ]
    # where cells of other levels meet, what overlaps can cost a little more than one cell's upgrade brings
    assert max(errors) < 1.05 * worst
    assert errors[-1] < 0.5 * worst


def test_gathered_are_those_of_concat_and_counted_ones_those_selected():
    low, g = random_gaussians(20, degree=0), random_gaussians(30, degree=2)
    rows = torch.tensor([7, 3, 3, 11]), torch.arange(30).flip(0)
    expected = concat([low.select(rows[0]), g.select(rows[1])])
    for name, values in vars(gather([(low, rows[0]), (g, rows[1])])).items():
        assert torch.equal(values, getattr(expected, name)), name
    for share in (0.1, 0.5, 1.0):
        assert counts_of_first(g, share, {0: 2}) == first_of_all(g, share, {0: 2}).counts()
