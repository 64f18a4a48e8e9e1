"""Instances of photos, parents of instances, and Gaussians by name."""

from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from sagesplat.core.errors import LabelError, RunError
from sagesplat.core.gaussians import Gaussians
from sagesplat.formats.splats import read_splat, write_splat
from sagesplat.io.files import write_json
from sagesplat.segment.instances import read_instances, wanted_ids, write_instances
from sagesplat.segment.parents import read_parents, write_parents
from sagesplat.segment.select import select, select_mask

NAMES = {62: "chair", 184: "tree-merged", 201: "chair 1", 202: "chair 2"}
PARENTS = {201: "chair", 202: "chair"}


def gaussians(ids: list[int]) -> Gaussians:
    n = len(ids)
    quats = torch.zeros(n, 4)
    quats[:, 0] = 1
    return Gaussians(
        torch.rand(n, 3), quats, torch.zeros(n, 3) - 3, torch.zeros(n), torch.zeros(n, 1, 3),
        torch.zeros(n, 0, 3), torch.tensor(ids, dtype=torch.int16),
    )  # fmt: skip


@settings(max_examples=20)
@given(numbers=st.lists(st.integers(-1, 4), min_size=6, max_size=6))
def test_instances_come_back_as_the_same_partition(numbers: list[int], tmp_path_factory) -> None:
    path = tmp_path_factory.mktemp("instances") / "a.png"
    before = np.array(numbers, np.int16).reshape(2, 3)
    write_instances(path, before)
    after = read_instances(path, (2, 3))
    assert ((before < 0) == (after < 0)).all()
    assert (np.equal.outer(before, before) == np.equal.outer(after, after)).all()
    assert set(after[after >= 0].tolist()) == set(range(len(set(numbers) - {-1})))


def test_instance_files_of_another_size_or_kind_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    Image.new("RGB", (3, 2)).save(path)
    with pytest.raises(LabelError, match="mode RGB"):
        read_instances(path)
    write_instances(path, np.zeros((2, 3), np.int16))
    with pytest.raises(LabelError, match="3 x 2 pixels where the photo has 4 x 2"):
        read_instances(path, (2, 4))


def test_categories_are_named_one_by_one_or_all_at_once() -> None:
    assert wanted_ids({62: "chair", 184: "tree-merged", 201: "ivy"}, ("things",)) == [62, 201]
    assert wanted_ids({62: "chair", 184: "tree-merged"}, ("*",)) == [62, 184]
    with pytest.raises(LabelError, match="no category 'sofa'; there are chair"):
        wanted_ids({62: "chair"}, ("sofa",))


def test_parents_are_kept_and_checked(tmp_path: Path) -> None:
    path = tmp_path / "parents.json"
    write_parents(path, {"chair 1": "chair"})
    assert read_parents(path) == {"chair 1": "chair"}
    write_json(path, {"format": "sagesplat-parents", "version": 1, "parents": {"a": "b", "b": "c"}})
    with pytest.raises(RunError, match="an instance itself"):
        read_parents(path)
    write_parents(path, {})
    assert read_parents(path) == {}


@pytest.mark.parametrize("name", ["a.ply", "a.spz", "a.sog"])
def test_names_and_parents_come_back_from_every_format(tmp_path: Path, name: str) -> None:
    g = gaussians([62, 184, 201, 201, 202])
    write_splat(tmp_path / name, g, NAMES, parents=PARENTS)
    splat = read_splat(tmp_path / name)
    assert (splat.names, splat.parents) == (NAMES, PARENTS)
    assert sorted(splat.gaussians.label_ids.tolist()) == [62, 184, 201, 201, 202]
    write_splat(tmp_path / name, g, NAMES)
    assert read_splat(tmp_path / name).parents == {}


def test_the_dictionary_beside_a_ply_names_labels_whose_comments_were_dropped(tmp_path: Path) -> None:
    path, g = tmp_path / "a.ply", gaussians([62, 201])
    write_splat(path, g, NAMES, parents=PARENTS)
    lines = path.read_bytes().split(b"\n")
    path.write_bytes(b"\n".join(line for line in lines if not line.startswith(b"comment ")))
    splat = read_splat(path)
    assert splat.names == {62: "chair", 201: "chair 1"}
    assert (splat.parents, splat.gaussians.label_ids.tolist()) == ({201: "chair"}, [62, 201])


def test_a_category_selects_its_instances_too() -> None:
    g = gaussians([62, 184, 201, 202, 202])
    assert select_mask(g, "chair", NAMES, PARENTS).tolist() == [True, False, True, True, True]
    assert len(select(g, "chair 2", NAMES, PARENTS)) == 2
    assert len(select(g, "chair 2, tree-merged", NAMES)) == 3
    with pytest.raises(LabelError, match="did you mean chair 1"):
        select(g, "chair1", NAMES)
