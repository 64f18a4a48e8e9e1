from dataclasses import replace

import torch
from conftest import random_gaussians

from sagesplat.formats.increments import read_index, write_increments
from sagesplat.formats.ply import read_ply, write_ply


def test_increments_of_long_and_like_names_are_files_of_their_own(tmp_path):
    g = random_gaussians(12, degree=0)
    g = replace(g, label_ids=torch.arange(12, dtype=torch.int16) % 4)
    names = {0: "🚗" * 100, 1: "Tree", 2: "tree", 3: "x" * 100}
    sizes = dict.fromkeys(names, (1, 3))
    listed = write_increments(tmp_path / "out", g, sizes, names)
    assert read_index(tmp_path / "out") == listed
    assert len({increment.uri for increment in listed}) == 8
    assert {increment.uri.rsplit("-", 2)[0] for increment in listed} == {
        "--0",
        "tree--1",
        "tree--2",
        "x" * 60 + "--3",
    }


def test_a_ply_of_any_names_reads_back(tmp_path):
    g = random_gaussians(3)
    write_ply(tmp_path / "a.ply", g, {-1: "a\nend_header", 3: "\ud800", 184: "日" * 5000})
    assert len(read_ply(tmp_path / "a.ply")) == 3
