from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import random_gaussians

from sagesplat.adapt.ladder import PrefixLadder, read_prefixes
from sagesplat.core.errors import DataError
from sagesplat.formats.increments import read_increments, read_index, shown, totals, write_increments
from sagesplat.formats.levels import write_set
from sagesplat.formats.ply import read_ply, write_ply
from sagesplat.formats.splats import read_splat


def test_increments_of_long_and_like_names_are_files_of_their_own(tmp_path):
    g = random_gaussians(12, degree=0)
    g = replace(g, label_ids=torch.arange(12, dtype=torch.int16) % 4)
    names = {0: "🚗" * 100, 1: "Tree", 2: "tree", 3: "x" * 100}
    sizes = dict.fromkeys(names, (1, 3))
    listed = write_increments(tmp_path / "out", g, sizes, names, label_of={cell: cell for cell in sizes})
    assert read_index(tmp_path / "out") == listed
    assert len({increment.uri for increment in listed}) == 8
    assert {increment.uri.rsplit("-", 2)[0] for increment in listed} == {
        "--0",
        "tree--1",
        "tree--2",
        "x" * 60 + "--3",
    }


SIZES = {0: (2, 5, 9, 20), 1: (3, 3, 8, 8), 2: (4, 8, 12, 16)}
REPLACES = {0: (3,), 2: (2, 4)}


def ladder_of_replacing_levels(folder: Path) -> PrefixLadder:
    """Category 0 begins again at level 3, category 2 at 2 and at 4, category 1 never."""
    g = replace(random_gaussians(44), label_ids=torch.tensor([0] * 20 + [1] * 8 + [2] * 16).short())
    write_set(folder / "ladder.npz", g, 1, SIZES, replaces=REPLACES, exact=True)
    return read_prefixes(folder / "ladder.npz")


def test_a_level_may_replace_those_below(tmp_path):
    ladder = ladder_of_replacing_levels(tmp_path)
    assert ladder.replaces == REPLACES
    assert ladder.starts == {0: (0, 0, 5, 5), 1: (0, 0, 0, 0), 2: (0, 4, 4, 12)}
    assert [ladder.counts[0, k] for k in ladder.levels] == [2, 5, 4, 15]
    assert [ladder.size(k) for k in ladder.levels] == [9, 12, 20, 27]
    g = ladder.gaussians
    assert torch.equal(
        ladder.compose({0: 4, 1: 2, 2: 3}).means, g.means[[*range(5, 20), *range(20, 23), *range(32, 40)]]
    )
    assert torch.equal(ladder.load(2, [0]).means, g.means[:5])


def test_what_a_level_is_made_of_and_costs_begins_with_the_newest_that_replaces(tmp_path):
    ladder = ladder_of_replacing_levels(tmp_path)
    names = {0: "a", 1: "b", 2: "c"}
    listed = write_increments(
        tmp_path / "out", ladder.gaussians, SIZES, names, label_of={cell: cell for cell in SIZES},
        replaces=REPLACES,
        kind=lambda label, level: "ply" if label == 2 and level > 1 else "spz",
    )  # fmt: skip
    assert read_index(tmp_path / "out") == listed
    assert [(c.label_id, c.level) for c in listed if c.refine == "REPLACE"] == [(0, 3), (2, 2), (2, 4)]
    assert {c.format for c in listed if c.label_id == 2} == {"spz", "ply"}
    counts = [[ladder.counts[label, k] for k in ladder.levels] for label in names]
    assert totals(listed, list(names), 4, "count").tolist() == counts
    assert totals(listed[::-1], list(names), 4, "count").tolist() == counts
    for label in names:
        for level in ladder.levels:
            files = shown(listed, label, level)
            assert sum(c.count for c in files) == ladder.counts[label, level]
            sent, wanted = read_increments(tmp_path / "out", files), ladder.load(level, [label])
            assert torch.equal(sent.label_ids, wanted.label_ids)
            if label == 2 and level > 1:  # PLY: nothing is lost
                assert all(
                    torch.equal(a, b) for a, b in zip(vars(sent).values(), vars(wanted).values(), strict=True)
                )


@pytest.mark.parametrize("levels", [(1,), (3,), (0,), (5,)])
def test_a_level_that_cannot_replace_is_refused(tmp_path, levels):
    """The first one, one that adds nothing, and ones that are not there."""
    g = replace(random_gaussians(9), label_ids=torch.zeros(9, dtype=torch.int16))
    sizes = {0: (1, 4, 4, 9)}
    with pytest.raises(ValueError, match="cannot replace those below"):
        write_increments(tmp_path / "out", g, sizes, {0: "a"}, label_of={0: 0}, replaces={0: levels})
    write_set(tmp_path / "ladder.npz", g, 1, sizes, replaces={0: levels})
    with pytest.raises(DataError, match=r"ladder\.npz: impossible replacing levels .*; delete it and run"):
        read_prefixes(tmp_path / "ladder.npz")


@pytest.mark.parametrize("values", [np.array([2.0]), np.array(2), np.full(9, 2), np.array([2, -1])])
@pytest.mark.parametrize("array", ["replaces", "sizes"])
def test_damaged_sizes_and_replacing_levels_are_one_line(tmp_path, array, values):
    g = replace(random_gaussians(9), label_ids=torch.zeros(9, dtype=torch.int16))
    write_set(tmp_path / "ladder.npz", g, 1, {0: (1, 4, 9)}, replaces={0: (2,)})
    arrays = dict(np.load(tmp_path / "ladder.npz")) | {f"0/{array}": values}
    np.savez(tmp_path / "ladder.npz", **arrays)
    with pytest.raises(
        DataError, match=r"ladder\.npz: (level sizes|not nested levels|impossible replacing levels)"
    ):
        read_prefixes(tmp_path / "ladder.npz")


def test_an_index_that_refines_otherwise_is_refused(tmp_path):
    g = replace(random_gaussians(4), label_ids=torch.zeros(4, dtype=torch.int16))
    write_increments(tmp_path, g, {0: (1, 4)}, {0: "a"}, label_of={0: 0}, replaces={0: (2,)})
    text = (tmp_path / "index.json").read_text()
    for wrong in ('"SWAP"', "1", "null", '["REPLACE"]'):
        (tmp_path / "index.json").write_text(text.replace('"REPLACE"', wrong))
        with pytest.raises(DataError, match="not an index of increments"):
            read_index(tmp_path)


@pytest.mark.parametrize("kind", ["ply", "spz"])
def test_files_say_how_they_were_trained(tmp_path, kind):
    g = random_gaussians(4, degree=0)
    g = replace(g, label_ids=torch.zeros(4, dtype=torch.int16))
    for antialiased in (True, False):
        listed = write_increments(
            tmp_path / "out", g, {0: (4,)}, {0: "a"}, label_of={0: 0}, kind=kind, antialiased=antialiased
        )
        assert read_splat(tmp_path / "out" / listed[0].uri).antialiased is antialiased


def test_a_ply_of_any_names_reads_back(tmp_path):
    g = random_gaussians(3)
    write_ply(tmp_path / "a.ply", g, {-1: "a\nend_header", 3: "\ud800", 184: "日" * 5000})
    assert len(read_ply(tmp_path / "a.ply")) == 3
