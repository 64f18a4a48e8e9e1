"""`python -m benchmarks runtime`: the others' rules on scenes of a few splats, curves, and a run's tables."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from benchmarks.runtime import __main__ as runtime
from benchmarks.runtime import playcanvas, spark
from benchmarks.runtime.levels import Pieces, for_targets, opened, within_budgets
from benchmarks.runtime.measure import fidelity
from benchmarks.runtime.walk import recorded
from sagesplat.adapt.observe import render_rgb
from sagesplat.core.gaussians import Gaussians
from sagesplat.formats.lod_meta_write import write_lod_meta
from sagesplat.scene.scene import Camera
from sagesplat.stages.methods import NestedLevels
from tests.conftest import random_gaussians

EYE = Camera(np.eye(4, dtype=np.float32), np.array([[20, 0, 20], [0, 20, 15], [0, 0, 1]], np.float32), 40, 30)
NARROWER = 15 / 20 / math.tan(math.pi / 8)  # the smaller half field of view, over that of 22.5 degrees


def box(x, y, z, side=2.0):
    return [[x - side / 2, y - side / 2, z - side / 2], [x + side / 2, y + side / 2, z + side / 2]]


def test_playcanvas_distances_are_to_boxes_and_longer_behind():
    bounds = np.array([box(0, 0, 0), box(0, 0, 5), box(0, 0, -5), box(6, 0, 0)])
    np.testing.assert_allclose(playcanvas.distances(bounds, EYE) / NARROWER, [0, 4, 1.5 * 4, 5])
    wide = np.array([*[box(0, 0, 5)] * 3, box(0, 0, 15, 22)])  # half of its side exceeds the others' by 10
    assert playcanvas.distances(wide, EYE)[3] / NARROWER == pytest.approx(15 - (11 - 0.75 * 10))


def test_playcanvas_levels_without_splats_are_the_next_finer_ones():
    counts = np.array([[9, 5, 2], [9, 0, 2], [0, 5, 2], [9, 5, 0], [0, 0, 0]])
    assert playcanvas.filled(counts).tolist() == [[0, 1, 2], [0, 0, 2], [1, 1, 2], [0, 1, -1], [-1] * 3]


def test_playcanvas_levels_end_at_multiples_of_one_distance_that_fits_the_budget():
    counts, distance = np.tile([100, 10, 1], (4, 1)), np.array([0, 1.0, 4.0, 50.0])

    def levels(budget):
        return playcanvas.chosen(distance, counts, budget).tolist()

    assert levels(3) == levels(4) == [2, 2, 2, 2]
    assert levels(400) == [0, 0, 0, 0]
    assert levels(111) == [0, 2, 2, 2]  # level 1 of the second would be one too many
    assert levels(201) == [0, 1, 2, 2]
    assert levels(210) == [0, 0, 2, 2]  # 1 / 3 is less than 4 / 9
    assert levels(211) == [0, 0, 1, 2]
    assert playcanvas.chosen(distance, counts, 201, multiplier=10).tolist() == [0, 1, 1, 2]


def test_spark_replaces_what_looks_largest_by_its_children():
    centre = np.array([[0, 0, 2], [0, 0, 2], [0, 0, -2], [0, 0, 2], [2, 0, 0]], np.float32)
    size = np.array([1, 0.5, 0.4, 0.3, 0.2], np.float32)
    first, children = np.array([1, 3, 0, 0, 0]), np.array([2, 2, 0, 0, 0])

    def rows(budget, limit=0.01):
        chosen, pages = spark.traverse(
            centre, size, first, children, np.zeros(3, np.float32), np.array([0, 0, 1], np.float32),
            (0.0, 0.0, 1.0, 1.0), budget, limit,
        )  # fmt: skip
        assert pages.tolist() == [True]
        return sorted(chosen.tolist())

    assert rows(1) == [0]
    assert rows(2) == [1, 2]
    assert rows(3) == rows(9) == [2, 3, 4]
    assert rows(9, limit=0.3) == [1, 2]  # none looks larger than that
    assert rows(9, limit=0.6) == [0]


def test_spark_looks_smaller_off_the_view_direction():
    angles = np.radians([0, 45, 52.5, 60, 75, 90, 180])
    centre = 2 * np.stack([np.sin(angles), 0 * angles, np.cos(angles)], 1).astype(np.float32)
    eye, ahead = np.zeros(3, np.float32), np.array([0, 0, 1], np.float32)
    cones = (math.cos(math.radians(45)), 0.5, 0.4, 0.2)
    size = np.full(7, 2, np.float32)
    looks = [spark.look_of(centre, size, i, eye, ahead, cones) for i in range(7)]
    cosine = np.cos(angles)
    inside = 0.4 + 0.6 * (cosine[2] - 0.5) / (cosine[1] - 0.5)
    np.testing.assert_allclose(looks, [1, 1, inside, 0.4, 0.2 + 0.2 * cosine[4] / 0.5, 0.2, 0.2], atol=1e-6)


def one_splat() -> Gaussians:
    return Gaussians(
        torch.tensor([[0.0, 0, 2]]), torch.tensor([[1.0, 0, 0, 0]]), torch.full((1, 3), math.log(0.4)),
        torch.tensor([20.0]), torch.full((1, 1, 3), 0.5 / 0.28209479), torch.zeros(1, 0, 3),
        torch.zeros(1, dtype=torch.int16),
    )  # fmt: skip


@pytest.mark.parametrize("power", [1.3, 2.0, 6.4, 15.0])
def test_spark_draws_opacities_above_1_as_many_layers(power):
    how = {"backend": "cpu", "antialiased": False}
    x, y = np.meshgrid(np.arange(40) + 0.5 - 20, np.arange(30) + 0.5 - 15)
    plain = np.exp(-(x**2 + y**2) / 2 / ((0.4 * 20 / 2) ** 2 + 0.3))
    stored = np.array([math.sqrt(1 + math.e * math.log(power))])
    drawn = render_rgb(spark.wide(one_splat(), stored, EYE, False), EYE, **how)
    np.testing.assert_allclose(drawn[..., 0], 1 - (1 - plain) ** power, atol=0.04)


def test_spark_filters_opacities_before_it_draws_them():
    small = one_splat()
    small.log_scales.fill_(math.log(0.02))
    expected = render_rgb(small, EYE, antialiased=True, backend="cpu")
    drawn = render_rgb(spark.wide(small, np.ones(1), EYE, True), EYE, antialiased=False, backend="cpu")
    assert 0 < expected.max() < 0.5
    np.testing.assert_allclose(drawn, expected, atol=1e-4)


def packed(low: np.ndarray, high: np.ndarray | float = 0.0) -> np.ndarray:
    halves = [np.broadcast_to(x, len(low)).astype(np.float16).view(np.uint16) for x in (low, high)]
    return halves[0] | halves[1].astype(np.uint32) << 16


def test_a_tree_of_spark_is_read():
    g = random_gaussians(2, degree=1)
    g.log_scales.copy_(g.log_scales.half().float())
    means = np.concatenate([g.means.numpy().mean(0, keepdims=True), g.means.numpy()]).astype(np.float32)
    scales = np.concatenate([[[0.5, 0.4, 0.3]], g.log_scales.numpy()])
    opacity, colour = np.array([1.25, 0.5, 0.25]), np.full(3, 0.75)
    turns = [512 | 512 << 10 | 2048 << 20, 0, 0]  # the first: by 90 degrees about z
    arrays = {
        "ext0": np.column_stack([means.view(np.uint32), packed(opacity)]),
        "ext1": np.column_stack(
            [packed(colour, colour), packed(colour, scales[:, 0]), packed(scales[:, 1], scales[:, 2]), turns]
        ),
        "lodTree": np.column_stack(
            [packed(means[:, 0], means[:, 1]), packed(means[:, 2], np.array([3, 2, 1])), [2, 0, 0], [1, 0, 0]]
        ),
    }
    tree = spark.decoded({name: array.astype(np.uint32) for name, array in arrays.items()}, g)
    assert tree.opacity.tolist() == [2, 0.5, 0.25]
    assert (tree.first.tolist(), tree.children.tolist(), tree.size.tolist()) == (
        [1, 0, 0],
        [2, 0, 0],
        [3, 2, 1],
    )
    np.testing.assert_allclose(tree.splats.log_scales, scales, atol=1e-3)
    np.testing.assert_allclose(tree.splats.quats[0].abs(), [0.707, 0, 0, 0.707], atol=2e-3)
    x, y, z = np.exp(g.log_scales.numpy().astype(np.float64)).T
    p = 1.6075
    mass = [0.5, 0.25] * ((x * y) ** p + (x * z) ** p + (y * z) ** p) ** (1 / p)
    expected = (mass[:, None, None] * g.shN.numpy()).sum(0) / mass.sum()
    np.testing.assert_allclose(tree.splats.shN[0], expected, rtol=1e-4)
    np.testing.assert_array_equal(tree.splats.shN[1:], g.shN)


def test_a_run_is_measured_on_the_same_walk_each_time(finished_run, tmp_path, capsys):
    runtime.main((finished_run,), folder=tmp_path, every=40)
    out = capsys.readouterr().out.splitlines()
    assert [line.split(":")[0] for line in out[:2]] == ["no rows of PlayCanvas", "no rows of Spark"]
    methods = json.loads(out[-1])["run"]["methods"]
    assert list(methods) == ["equal levels", "ours"]
    assert methods["equal levels"]["finest"] == 1
    assert methods["ours"]["finest"] > 0.95  # what it takes to be out of sight stays low
    assert methods["equal levels"]["first_s"][0] > methods["equal levels"]["first_s"][1] > 0
    walk = tmp_path / "run" / "walk.json"
    made = walk.read_bytes()
    assert len(json.loads(made)["w2c"]) == 3
    job = opened(finished_run)
    cameras = recorded(job, walk, 5, 1.0, 40)
    assert walk.read_bytes() == made
    asked = methods["ours"]["asked"]
    assert [one["target"] for one in asked] == list(runtime.TARGETS)
    assert 0.8 < asked[2]["kept"] <= 1
    assert asked[2]["kept_lowest"] <= asked[2]["kept"]
    assert asked[2]["first_bytes"] <= asked[2]["bytes"]
    shares = (0.05, 0.3, 1.0)
    levels, counts = within_budgets(job, cameras, shares), NestedLevels(job).cell_costs.count
    assert levels.shape == (3, len(shares), len(job.cells.ids))
    assert (np.diff(levels.sum(2), axis=1) >= 0).all()
    assert levels.min() == 1  # all are in sight
    taken = counts[np.arange(levels.shape[2]), levels - 1].sum(2)
    assert (taken <= np.maximum(np.array(shares) * counts[:, -1].sum(), counts[:, 0].sum())).all()


def test_within_few_splats_cells_out_of_sight_are_left_out(finished_run):
    job = opened(finished_run)
    away = np.eye(4, dtype=np.float32)
    away[0, 0] = away[2, 2] = -1  # turned round
    camera = job.scene.views[0].camera.neutral
    cameras = [camera, replace(camera, w2c=away @ camera.w2c)]
    lowest = NestedLevels(job).cell_costs.count
    share = (lowest[:, 0].sum() - 1) / lowest[:, -1].sum()
    unseen = ~(NestedLevels(job).expect(cameras).share > 0)
    assert unseen.any()
    levels = within_budgets(job, cameras, (share,))[:, 0]
    np.testing.assert_array_equal((levels == 0).any(1), unseen.any(1))
    assert not (levels == 0)[~unseen].any()


def test_what_has_come_counts_in_all_levels_that_hold_it(finished_run):
    job = opened(finished_run)
    pieces, costs = Pieces(job), NestedLevels(job).cell_costs.transfer_bytes
    np.testing.assert_array_equal(pieces.among(np.ones(len(pieces.nbytes), bool)), costs)
    assert not pieces.among(np.zeros(len(pieces.nbytes), bool)).any()
    first = pieces.of_composition(dict.fromkeys(job.cells.ids.tolist(), 1))
    np.testing.assert_array_equal(pieces.among(first), np.broadcast_to(costs[:, :1], costs.shape))
    camera = job.scene.views[0].camera.neutral
    levels = for_targets(job, pieces, [camera, camera], (0.8, 0.95))
    np.testing.assert_array_equal(levels[0], levels[1])
    assert (levels[0, 0] <= levels[0, 1]).all()


def test_streamed_sog_of_playcanvas_is_drawn_by_its_budget(finished_run, tmp_path):
    job = opened(finished_run)
    levels = [job.ladder.load(level) for level in (job.ladder.levels[-1], job.ladder.levels[0])]
    levels = [job.by_cell.load(level) for level in (job.ladder.levels[-1], job.ladder.levels[0])]
    write_lod_meta(tmp_path / "sog", levels, job.cells.label_of, antialiased=job.antialiased)
    budgets = [1, len(levels[0]) - 1, len(levels[0])]
    method = playcanvas.StreamedSog(
        "sog", tmp_path / "sog" / "lod-meta.json", budgets, "cpu", job.antialiased
    )
    camera = job.scene.views[0].camera.neutral
    at = job.references.at(camera)
    ids = job.cells.ids
    found = [(one, fidelity(one.image, at.image, at.label_ids, ids)[0]) for one in method.shown(0, camera)]
    counts = [one.count for one, _ in found]
    assert counts[0] == len(levels[1]) < counts[1] < counts[2] == len(levels[0])
    assert found[0][1] < found[1][1] < found[2][1] > 0.97
    assert found[2][0].needed.sum() < len(method.piece_bytes)
