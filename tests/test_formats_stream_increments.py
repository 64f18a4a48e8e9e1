"""Increments as ranges of coded streams: what is written, listed and read back."""

import hashlib
import json
from dataclasses import asdict, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import torch
from conftest import random_gaussians

from sagesplat.core.errors import DataError
from sagesplat.core.gaussians import Gaussians
from sagesplat.core.second_opacity import SecondOpacities, blended
from sagesplat.formats.increments import Increment, full_scene, read_increments, read_index, shown, totals
from sagesplat.formats.stream import palette_of, starts_of_streams
from sagesplat.formats.stream_header import AS_GIVEN
from sagesplat.formats.stream_increments import Streams, read_streams, write_streams
from sagesplat.io.typed import convert_as

SIZES = {0: (3, 3, 10, 20, 20), 2: (0, 4, 6, 6, 15), 5: (1, 2, 2, 2, 2)}
NAMES = {0: "grass", 2: "car", 5: "sky"}
WEIGHTS = (0.0, 0.0, 0.2, 0.6, 1.0)
ALONE = {0: 0, 2: 2, 5: 5}  # each category is one cell
CELLS = {0: 7, 5: 7, 2: 9}


def some() -> tuple[Gaussians, SecondOpacities]:
    labels = torch.tensor([0] * 20 + [2] * 15 + [5] * 2, dtype=torch.int16)
    g = replace(random_gaussians(37, degree=1, logit=3), label_ids=labels)
    g.logit_opacities[[1, 36]] = -9.0
    seconds = g.logit_opacities - 1
    seconds[[2, 36]] = -9.0
    seconds[1] = 2.0
    return g, SecondOpacities(seconds, dict.fromkeys(SIZES, WEIGHTS))


@pytest.fixture
def written(tmp_path: Path) -> Streams:
    g, second = some()
    return write_streams(tmp_path, g, SIZES, NAMES, label_of=ALONE, second=second)


def test_increments_are_ranges_that_fill_the_file_of_their_category(tmp_path, written):
    assert read_index(tmp_path) == written.increments
    assert {one.format for one in written.increments} == {"stream"}
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(
        {"index.json", *(one.uri for one in written.increments)}
    )
    assert [(one.label_id, one.level, one.count) for one in written.increments] == [
        (0, 1, 3), (0, 3, 7), (0, 4, 10), (2, 2, 4), (2, 3, 2), (2, 5, 9), (5, 1, 1),
    ]  # fmt: skip
    assert written.sizes == {0: SIZES[0], 2: SIZES[2], 5: (1, 1, 1, 1, 1)}  # one of the sky is not to be seen
    assert sorted(written.rows.tolist()) == list(range(36))
    for label in SIZES:
        mine = shown(written.increments, label, 5)
        content = (tmp_path / mine[0].uri).read_bytes()
        assert mine[0].uri.startswith(f"{NAMES[label]}-{hashlib.sha256(content).hexdigest()[:12]}.sgst")
        ends = [0, *(one.offset + one.nbytes for one in mine)]
        assert [one.offset for one in mine] == ends[:-1]
        assert ends[-1] == len(content)
        parts = [content[low:high] for low, high in pairwise(ends)]
        assert [hashlib.sha256(part).hexdigest() for part in parts] == [one.sha256 for one in mine]
    assert totals(written.increments, [0, 2, 5], 5, "count").tolist() == [
        list(n) for n in written.sizes.values()
    ]


def test_the_newest_increment_says_how_its_category_looks(tmp_path, written):
    g, second = some()
    for label, level, weight in (
        (0, 1, 0.0),
        (0, 2, 0.0),
        (0, 4, 1.0),
        (0, 5, 1.0),
        (2, 3, 0.6),
        (2, 5, 1.0),
    ):
        mine = shown(written.increments, label, level)
        assert mine[-1].weight == pytest.approx(weight, abs=1e-9)
        found = read_increments(tmp_path, mine)
        rows = torch.from_numpy(written.rows)
        rows = rows[(g.label_ids == label)[rows]][: len(found)]
        wanted = torch.sigmoid(blended(g.logit_opacities[rows], second.logits[rows], weight))
        assert (torch.sigmoid(found.logit_opacities) - wanted).abs().max() < 0.06  # bytes are blended
        assert (found.label_ids == label).all()
        assert (found.means - g.means[rows]).abs().max() < 0.1
    (last,) = read_increments(tmp_path, written.increments[2:3]).counts().items()
    assert last == (0, 10)  # of a level alone


def test_the_ladder_has_both_opacities_of_what_was_written(tmp_path, written):
    g, second = read_streams(tmp_path, written.increments)
    assert second is not None
    assert len(second.logits) == len(g) == 36
    assert list(second.weights[2]) == pytest.approx((0.0, 0.0, 0.6, 0.6, 1.0))
    assert list(second.weights[5]) == [1.0] * 5  # of what all levels show
    full = read_increments(tmp_path, full_scene(written.increments))
    assert torch.equal(full.logit_opacities, second.logits)
    assert torch.equal(full.means, g.means)


def test_without_second_opacities_the_index_has_no_weights(tmp_path):
    g, _ = some()
    made = write_streams(tmp_path, g, SIZES, NAMES, label_of=ALONE)
    index = json.loads((tmp_path / "index.json").read_text())
    assert index["format"] == "stream"
    usual = {"label_id", "cell", "level", "uri", "count", "nbytes", "gpu_bytes", "sha256"}
    assert [set(one) - usual for one in index["chunks"][:2]] == [set(), {"offset"}]
    assert read_streams(tmp_path, made.increments)[1] is None
    assert write_streams(tmp_path, g, SIZES, NAMES, label_of=ALONE).increments == made.increments
    assert 5 in made.sizes


def test_a_category_that_nobody_sees_has_no_stream(tmp_path):
    g, _ = some()
    g.logit_opacities[g.label_ids == 2] = -9.0
    made = write_streams(tmp_path, g, SIZES, NAMES, label_of=ALONE)
    assert set(made.sizes) == {0, 5}
    assert not list(tmp_path.glob("car*"))


def test_cells_of_a_category_share_a_file_and_each_is_read_without_the_others(tmp_path):
    g, second = some()
    made = write_streams(tmp_path, g, SIZES, {7: "grass", 9: "sky"}, label_of=CELLS, second=second)
    assert read_index(tmp_path) == made.increments
    assert [(one.label_id, one.cell, one.level, one.count) for one in made.increments] == [
        (7, 0, 1, 3), (7, 0, 3, 7), (7, 0, 4, 10), (7, 5, 1, 1), (9, 2, 2, 4), (9, 2, 3, 2), (9, 2, 5, 9),
    ]  # fmt: skip
    assert made.sizes == {0: SIZES[0], 5: (1, 1, 1, 1, 1), 2: SIZES[2]}
    grass = next(tmp_path.glob("grass-*.sgst"))
    content = grass.read_bytes()
    assert len(list(tmp_path.glob("*.sgst"))) == 2
    ranges = [(one.offset, one.nbytes) for one in made.increments if one.uri == grass.name]
    assert [low + count for low, count in ranges] == [low for low, _ in ranges[1:]] + [len(content)]

    everything, rows = read_increments(tmp_path, full_scene(made.increments)), torch.from_numpy(made.rows)
    assert torch.equal(everything.label_ids, g.label_ids[rows])
    _, second = read_streams(tmp_path, made.increments)
    assert second is not None
    assert second.weights.keys() == {0, 2, 5}
    named = read_increments(tmp_path, made.increments, by_category=True)
    assert named.counts() == {7: 21, 9: 15}

    for cell in (0, 5):  # whatever another cell has for levels, or has lost
        grass.write_bytes(content if cell == 5 else content[: ranges[3][0]])
        for level in range(1, 6):
            found = read_increments(tmp_path, shown(made.increments, cell, level))
            mine = everything.means[everything.label_ids == cell]
            assert torch.equal(found.means, mine[: made.sizes[cell][level - 1]])
    assert totals(made.increments, [0, 2, 5], 5, "count").tolist() == [
        list(made.sizes[cell]) for cell in (0, 2, 5)
    ]


def test_cells_cost_a_few_bytes_more_than_the_category(tmp_path):
    g = random_gaussians(6000, degree=1, logit=3)
    g = replace(g, label_ids=(torch.arange(6000) % 3).short(), shN=g.shN * (g.shN.abs() > 0.2))
    sizes = dict.fromkeys(range(3), (40, 200, 1000, 2000))
    cells = write_streams(tmp_path, g, sizes, {}, label_of=dict.fromkeys(sizes, 0)).increments
    one = replace(g, label_ids=torch.zeros_like(g.label_ids))
    whole = write_streams(tmp_path, one, {0: (120, 600, 3000, 6000)}, {}, label_of={0: 0}).increments
    assert sum(c.nbytes for c in cells) < 1.04 * sum(c.nbytes for c in whole)
    assert len({c.uri for c in cells}) == 1


def test_damage_is_one_line(tmp_path, written):
    one = written.increments[1]
    path = tmp_path / one.uri
    for wrong in (
        replace(one, offset=one.offset + 1),
        replace(one, nbytes=one.nbytes + 9),
        replace(one, count=1),
    ):
        with pytest.raises(DataError, match=rf"{one.uri}: (other levels|a damaged stream)"):
            read_increments(tmp_path, [wrong])
    path.write_bytes(path.read_bytes()[:-1])
    assert len(read_increments(tmp_path, written.increments[:2])) == 10  # what is there is read
    with pytest.raises(DataError, match=f"{one.uri}: a damaged stream"):
        read_increments(tmp_path, written.increments[:3])
    path.unlink()
    with pytest.raises(
        DataError, match=rf"{one.uri}: cannot be read .*; delete that folder and run `sagesplat nest`"
    ):
        read_streams(tmp_path, written.increments)


@pytest.mark.parametrize(
    "wrong",
    [{"offset": -1}, {"offset": 2**53}, {"offset": 1.0}, {"offset": True}, {"weight": 1.1}, {"weight": "1"},
     {"weight": float("nan")}, {"weight": True}, {"uri": "a-01-x.spz", "offset": 4}],
)  # fmt: skip
def test_impossible_entries(wrong):
    good = Increment(0, 7, 1, "a-x.sgst", 3, 40, 120, "0" * 64, offset=4, weight=0.5)
    assert convert_as(asdict(good), Increment) == good
    with pytest.raises(ValueError, match=r"offset|weight"):
        convert_as({**asdict(good), **wrong}, Increment)


REPLACED = {0: (3,), 2: (2, 5)}  # by cell; the sky's levels add up


def replacing(folder: Path, **more: Any) -> tuple[Gaussians, Streams]:
    """A ladder of which some levels replace those below, and how it is written."""
    g, _ = some()
    sizes = {0: (3, 3, 10, 20, 20), 2: (1, 4, 6, 6, 15), 5: (1, 2, 2, 2, 2)}
    labels = {0: 7, 2: 7, 5: 9}
    return g, write_streams(
        folder, g, sizes, {7: "grass", 9: "sky"}, label_of=labels, replaces=REPLACED, **more
    )


def test_a_set_that_replaces_is_a_stream_of_its_own(tmp_path):
    g, made = replacing(tmp_path)
    assert read_index(tmp_path) == made.increments
    assert [(one.cell, one.level) for one in made.increments if one.refine == "REPLACE"] == [
        (0, 3), (2, 2), (2, 5),
    ]  # fmt: skip
    grass, sky = ([one for one in made.increments if one.label_id == label] for label in (7, 9))
    assert len({one.uri for one in grass}) == len({one.uri for one in sky}) == 1
    by_place = sorted(grass, key=lambda one: one.offset)  # the lowest sets of all cells come first
    assert [(one.cell, one.level) for one in by_place] == [
        (0, 1),
        (2, 1),
        (0, 3),
        (0, 4),
        (2, 2),
        (2, 3),
        (2, 5),
    ]
    content, ends = (tmp_path / grass[0].uri).read_bytes(), [one.offset + one.nbytes for one in by_place]
    assert [one.offset for one in by_place] == [0, *ends[:-1]]
    assert ends[-1] == len(content)
    everything, rows = read_increments(tmp_path, made.increments), torch.from_numpy(made.rows)
    assert torch.equal(everything.label_ids, g.label_ids[rows])
    assert (everything.means - g.means[rows]).abs().max() < 0.05
    ends = {cell: [0, *sizes] for cell, sizes in made.sizes.items()}
    counts = totals(made.increments, list(made.sizes), 5, "count")
    for row, cell in enumerate(made.sizes):
        mine = everything.of_labels([cell])
        for level in range(1, 6):
            found = read_increments(tmp_path, shown(made.increments, cell, level))
            first = max([0, *(ends[cell][k - 1] for k in REPLACED.get(cell, ()) if k <= level)])
            assert torch.equal(found.means, mine.means[first : ends[cell][level]])
            assert len(found) == counts[row, level - 1]
    last = read_increments(tmp_path, [one for one in made.increments if (one.cell, one.level) == (0, 4)])
    assert len(last) == 10  # of a stream that begins at level 3


def test_of_a_set_that_is_hardly_to_be_seen_one_gaussian_stays(tmp_path):
    g, _ = some()
    g.logit_opacities[3:10] = -9.0
    sizes = {0: (3, 10, 20)}
    grass = g.of_labels([0])
    made = write_streams(tmp_path, grass, sizes, {}, label_of={0: 0}, replaces={0: (2, 3)})
    assert made.sizes == {0: (2, 3, 13)}  # one of the first level was not to be seen before
    assert len(read_increments(tmp_path, shown(made.increments, 0, 2))) == 1


def test_the_last_set_is_kept_as_finely_as_asked(tmp_path):
    g, made = replacing(tmp_path / "exact", last=None)
    kinds = {(one.cell, one.level): one.format for one in made.increments}
    assert kinds == {
        (0, 1): "stream", (0, 3): "ply", (0, 4): "ply", (2, 1): "stream", (2, 2): "stream",
        (2, 3): "stream", (2, 5): "ply", (5, 1): "ply", (5, 2): "ply",
    }  # fmt: skip
    found = read_increments(tmp_path / "exact", shown(made.increments, 0, 5))
    assert torch.equal(found.means, g.means[3:20])
    assert torch.equal(found.shN, g.shN[3:20])
    assert len(read_increments(tmp_path / "exact", shown(made.increments, 2, 4))) == 5
    off = []
    for name, precision in (("coarse", AS_GIVEN[0]), ("fine", AS_GIVEN[-1])):
        g, made = replacing(tmp_path / name, last=precision)
        top = read_increments(tmp_path / name, shown(made.increments, 2, 5))
        mine = torch.from_numpy(made.rows[(made.rows >= 26) & (made.rows < 35)])
        off.append(float((top.shN - g.shN[mine]).abs().mean()))
    assert off[1] < off[0] / 2


def test_cells_share_the_palette_of_their_file(tmp_path):
    g = random_gaussians(2000, degree=1, logit=2)
    g = replace(g, shN=g.shN[torch.arange(2000) % 90], label_ids=(torch.arange(2000) % 2).short())
    sizes, labels = {0: (40, 400, 1000), 1: (40, 400, 1000)}, {0: 7, 1: 7}
    more: dict[str, Any] = {"label_of": labels, "replaces": {0: (2,), 1: (2,)}, "last": AS_GIVEN[1]}
    made = write_streams(tmp_path, g, sizes, {}, **more)
    (uri,) = {one.uri for one in made.increments}
    content = (tmp_path / uri).read_bytes()
    palette, starts = palette_of(content), starts_of_streams(content)
    assert palette is not None
    assert len(palette.rows) == 90
    assert starts == sorted(one.offset for one in made.increments if one.level < 3)
    assert starts[0] == len(palette.encoded())  # no increment has it
    assert sum(one.nbytes for one in made.increments) == len(content) - starts[0]
    for cell in (0, 1):
        found = read_increments(tmp_path, shown(made.increments, cell, 3))
        kept = torch.from_numpy(made.rows[made.rows % 2 == cell])
        wanted = g.shN[kept[(kept >= 80)]]
        assert len(found) == len(wanted)
        assert (found.shN - wanted).abs().max() <= 1 / 64
    own = g.select(torch.arange(2000))
    own.shN.copy_(random_gaussians(2000, degree=1).shN)
    write_streams(tmp_path, own, sizes, {}, **more)
    assert palette_of((tmp_path / read_index(tmp_path)[0].uri).read_bytes()) is None


def test_what_lies_far_off_makes_files_of_a_set(tmp_path):
    g, _ = some()
    g.means[19] = 1e7
    made = write_streams(
        tmp_path, g.of_labels([0]), {0: (3, 10, 20)}, {}, label_of={0: 0}, replaces={0: (2, 3)}
    )
    assert [one.format for one in made.increments] == ["stream", "stream", "ply"]
    assert torch.equal(read_increments(tmp_path, made.increments[-1:]).means, g.means[10:20])


def test_levels_that_cannot_replace_are_refused(tmp_path):
    g, _ = some()
    for levels in ((1,), (2,), (4,)):
        with pytest.raises(ValueError, match="cannot replace"):
            write_streams(
                tmp_path, g.of_labels([0]), {0: (3, 3, 20)}, {}, label_of={0: 0}, replaces={0: levels}
            )
