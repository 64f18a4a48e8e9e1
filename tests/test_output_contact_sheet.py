"""The contact sheet of viewpoints: a picture for each, at most so many, whatever their names are."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import orbit, random_gaussians
from PIL import Image

from sagesplat.output.contact_sheet import MOST, contact_sheet

UP = np.array([0.0, -1.0, 0.0])


@pytest.mark.parametrize("views", [1, MOST + 5])
def test_a_picture_of_each_viewpoint_and_two_maps(tmp_path, views):
    contact_sheet(tmp_path / "v.png", random_gaussians(60), orbit(views), UP, ["scene", "why"])
    pixels = np.asarray(Image.open(tmp_path / "v.png").convert("RGB"))
    rows = -(-min(views, MOST) // 10)
    assert pixels.shape[1] == 1400
    assert 420 + 100 * rows < pixels.shape[0] < 520 + 120 * rows
    dark = (pixels[-100:, :] < 10).all(2).mean(0) > 0.3  # renders are on black
    assert dark.any()


def test_names_and_a_cloud_without_extent(tmp_path):
    g = random_gaussians(5)
    g = replace(g, means=g.means * 0 + g.means[:1])
    names = ["庭园$", "a" * 90]
    contact_sheet(tmp_path / "v.png", g, orbit(2), UP, ["庭园 $x_1$"], names)
    assert (tmp_path / "v.png").stat().st_size > 5000


def test_renders_that_are_there_are_taken(tmp_path):
    red = np.full((60, 80, 3), (255, 0, 0), np.uint8)
    Image.fromarray(red).save(tmp_path / "red.png")
    made = [tmp_path / "red.png"] * 3
    contact_sheet(tmp_path / "v.png", random_gaussians(60), orbit(3), UP, rendered=made)
    pixels = np.asarray(Image.open(tmp_path / "v.png").convert("RGB")).astype(int)
    assert ((pixels - [255, 0, 0] == 0).all(2)).sum() > 3 * 100 * 80
