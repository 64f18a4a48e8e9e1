"""Benchmarks run, and the torch rasteriser that they compare with shows the same image."""

import ast
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import torch
from conftest import pinhole, random_gaussians

from benchmarks import plain, segment
from sagesplat.raster import rasterize
from sagesplat.segment.masks import Taxonomy

ROOT = Path(__file__).parents[1]


def test_the_plain_rasteriser_shows_the_same():
    g, camera = random_gaussians(80, seed=2, degree=1), pinhole(70, 50)
    assert (plain.render(g, camera, degree=1) - rasterize(g, camera, sh_degree=1).rgb).abs().max() < 2e-3


def test_benchmarks_use_public_names_only():
    allowed = {"_fields", "_exit"}  # of NamedTuple, of os
    private = []
    for path in sorted((ROOT / "benchmarks").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            names = []
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith(
                ("sagesplat", "benchmarks")
            ):
                names = [*(node.module or "").split("."), *(n.name for n in node.names)]
            elif isinstance(node, ast.Attribute) and not (
                isinstance(node.value, ast.Name) and node.value.id in ("self", "cls")
            ):
                names = [node.attr]
            private += [
                f"{path.relative_to(ROOT)}:{getattr(node, 'lineno', 0)} {name}"
                for name in names
                if name.startswith("_") and not name.startswith("__") and name not in allowed
            ]
    assert private == []


def test_blending_ends_with_one_line_of_json():
    command = [
        sys.executable,
        "-m",
        "benchmarks",
        "blending",
        "--count",
        "200",
        "--size",
        "64",
        "--repeats",
        "1",
    ]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    result = json.loads(done.stdout.splitlines()[-1])
    assert result["threads_1"]["pairs"] > 10_000
    assert result["threads_1"]["share_of_peak_forward"] > 0  # above 1 where another process takes the core
    assert torch.isfinite(torch.tensor(result["scaling_forward"]))


def test_sheets_of_segmenters_show_the_photo_first_and_keep_their_width():
    photos, labels = [np.full((30, 40, 3), 200, np.uint8)], [np.zeros((30, 40), np.int16)]
    columns, names = {"given": labels, "a_network_of_a_rather_long_name": labels}, Taxonomy({0: "grass"})
    two = segment.sheet(photos, columns, names, 1.0)
    three = segment.sheet(photos, columns, names, 1.0, ("photo", photos))
    many = segment.sheet(photos, columns | dict.fromkeys("abcdefg", labels), names, 1.0)
    assert (two.width, three.width) == (504, 758)
    assert many.width <= segment.WIDTH
    assert three.getpixel((100, three.height // 2)) == (200, 200, 200)
    assert three.getpixel((400, three.height // 2)) == names.color(0)
