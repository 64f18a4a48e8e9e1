"""What the base model begins with: merged, it looks like what it stands for, and the sky stays far away."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from conftest import random_gaussians, write_capture

from sagesplat.raster import rasterize
from sagesplat.train.base_model import merged_start
from sagesplat.train.sky import Shell

SKY, TREE = 187, 184


@pytest.fixture(scope="module")
def trained():
    g = random_gaussians(400, seed=5, degree=1, log_scale=-2.0, logit=1.0)
    return replace(g, label_ids=torch.full_like(g.label_ids, TREE))


@pytest.fixture(scope="module")
def scene(trained, tmp_path_factory):
    return write_capture(tmp_path_factory.mktemp("base") / "capture", trained)


def test_it_looks_like_the_whole_better_than_as_many_of_it(trained, scene):
    views = scene.train_ids.tolist()
    start = merged_start(trained, scene, views, 80)
    assert len(start) == 80
    some = trained.select(torch.arange(0, 400, 5))

    def error(g):
        pairs = ((rasterize(one, scene.views[row].camera).rgb for one in (g, trained)) for row in views)
        return float(np.mean([float((a - b).abs().mean()) for a, b in pairs]))

    assert error(start) < 0.7 * error(some)
    again = merged_start(trained, scene, views, 80)
    assert all(torch.equal(a, b) for a, b in zip(vars(start).values(), vars(again).values(), strict=True))


def test_what_merged_of_the_sky_lies_on_the_shell(trained, scene):
    shell = Shell(np.zeros(3, np.float32), 50.0, 2.0, (SKY,))
    labels = torch.where(torch.arange(400) < 100, SKY, TREE).to(torch.int16)
    far = torch.where((labels == SKY)[:, None], shell.place(trained.means), trained.means)
    start = merged_start(
        replace(trained, means=far, label_ids=labels), scene, scene.train_ids.tolist(), 60, shell=shell
    )
    assert torch.equal(start.label_ids == SKY, shell.holds(start.means))
    assert 0 < int((start.label_ids == SKY).sum()) < 60
