"""The Gaussians type: rows stay together."""

from dataclasses import fields
from typing import Any

import pytest
import torch
from conftest import random_gaussians

from sagesplat.core.errors import DataError
from sagesplat.core.gaussians import PARAMETERS, Gaussians, concat


def assert_rows(actual: Gaussians, g: Gaussians, rows: list[int]) -> None:
    assert len(actual) == len(rows)
    for field in fields(Gaussians):
        assert torch.equal(getattr(actual, field.name), getattr(g, field.name)[rows]), field.name


def test_select_keeps_every_field_of_a_row():
    g = random_gaussians(10)
    assert_rows(g.select(torch.tensor([4, 4, 1])), g, [4, 4, 1])
    mask = torch.zeros(10, dtype=torch.bool)
    mask[[2, 7]] = True
    assert_rows(g.select(mask), g, [2, 7])
    assert_rows(g.select(~mask & mask), g, [])


def test_labels_are_counted_and_selected():
    g = random_gaussians(10)  # labels -1, 3, 184 in turn
    assert g.counts() == {-1: 4, 3: 3, 184: 3}
    assert_rows(g.of_labels([184, -1]), g, [0, 2, 3, 5, 6, 8, 9])
    assert_rows(g.of_labels([99]), g, [])
    assert_rows(g.of_labels([]), g, [])
    assert sum(len(g.of_labels([label])) for label in g.counts()) == len(g)
    assert g.of_labels([]).counts() == {}


@pytest.mark.parametrize(("bases", "degree"), [(0, 0), (3, 1), (8, 2), (15, 3)])
def test_degree_and_occupancy(bases, degree):
    g = random_gaussians(7, degree=degree)
    assert g.shN.shape == (7, bases, 3)
    assert g.sh_degree == degree
    assert g.nbytes == 7 * 62 * 4  # the paper counts 62 float32 whatever the degree
    assert tuple(g.parameters()) == PARAMETERS


def test_concat_keeps_order_and_pads_harmonics():
    a, b = random_gaussians(4, seed=1, degree=1), random_gaussians(3, seed=2, degree=3)
    both = concat([a, b])
    assert both.sh_degree == 3
    assert_rows(both.select(torch.arange(4, 7)), b, [0, 1, 2])
    assert torch.equal(both.shN[:4, :3], a.shN)
    assert (both.shN[:4, 3:] == 0).all()
    assert torch.equal(both.label_ids, torch.cat([a.label_ids, b.label_ids]))
    assert both.label_ids.dtype == torch.int16


def test_detach_shares_memory_without_a_graph():
    g = random_gaussians(3)
    leaves = {name: p.requires_grad_() for name, p in g.parameters().items()}
    detached = g.detach()
    for name, p in detached.parameters().items():
        assert not p.requires_grad
        assert p.data_ptr() == leaves[name].data_ptr()


def trained(g: Gaussians) -> Any:
    return torch.nn.ParameterDict({name: torch.nn.Parameter(t) for name, t in g.to_gsplat().items()})


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_the_dictionary_of_gsplats_trainer_is_read_and_given_back(degree):
    g = random_gaussians(7, degree=degree)
    found = Gaussians.from_gsplat(trained(g), g.label_ids)
    assert_rows(found, g, list(range(7)))
    assert not any(tensor.requires_grad for tensor in found.parameters().values())
    assert set(Gaussians.from_gsplat(trained(g).state_dict()).label_ids.tolist()) == {-1}
    doubles = {name: tensor.double() for name, tensor in g.to_gsplat().items()}
    assert torch.equal(Gaussians.from_gsplat(doubles).sh0, g.sh0)


def test_its_names_are_gsplats_own(tmp_path):
    """gsplat writes what it takes by these names; the file holds the same Gaussians."""
    gsplat = pytest.importorskip("gsplat", minversion="1.5")
    from sagesplat.formats.splats import read_splat

    g = random_gaussians(7, degree=3)
    tensors = g.to_gsplat() | {"sh0": g.sh0, "shN": g.shN}
    gsplat.export_splats(**tensors, format="ply", save_to=str(tmp_path / "gsplat.ply"))
    found = read_splat(tmp_path / "gsplat.ply").gaussians
    for name, tensor in g.parameters().items():
        assert torch.allclose(getattr(found, name), tensor, atol=1e-6), name


@pytest.mark.parametrize("prefix", ["", "gauss_params.", "_model.gauss_params."])
def test_the_dictionary_of_nerfstudio_is_read(prefix):
    g = random_gaussians(7, degree=3)
    names = {"sh0": "features_dc", "shN": "features_rest"}
    shapes = {"sh0": (7, 3), "opacities": (7, 1)}
    splats = {
        prefix + names.get(name, name): tensor.reshape(shapes.get(name, tensor.shape))
        for name, tensor in g.to_gsplat().items()
    }
    found = Gaussians.from_gsplat({**splats, "_model.camera_optimizer.pose_adjustment": torch.zeros(3, 6)})
    for name, tensor in g.parameters().items():
        assert torch.equal(getattr(found, name), tensor), name


def test_what_is_no_3dgs_is_one_line():
    g = random_gaussians(7, degree=1)
    for change, says in (
        (
            {"scales": g.log_scales[:, :2]},
            r"splats: scales is of shape \[7, 2\]; give N Gaussians as 3DGS has them",
        ),
        ({"shN": torch.zeros(7, 4, 3)}, r"splats: shN is of shape \[7, 4, 3\]"),
        ({"means": torch.zeros(())}, r"splats: means is of shape \[\]"),
        ({"sh0": None}, r"splats: no tensors sh0; give gsplat's means"),
    ):
        with pytest.raises(DataError, match=says):
            Gaussians.from_gsplat({**g.to_gsplat(), **change})  # pyright: ignore[reportArgumentType]
    with pytest.raises(DataError, match="no tensors means, quats, scales, opacities, sh0, shN"):
        Gaussians.from_gsplat({})
