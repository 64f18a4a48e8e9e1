"""What sagesplat writes as SOG and streamed SOG is read back within the formats' steps, with its labels."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial import KDTree

from sagesplat.core.errors import DataError
from sagesplat.core.gaussians import Gaussians
from sagesplat.formats.labels import sidecar
from sagesplat.formats.lod_meta_write import write_lod_meta
from sagesplat.formats.sog_write import sog_order, write_sog
from sagesplat.formats.splats import num_lods, read_splat
from tests.conftest import random_gaussians
from tests.test_formats_splats import make


def near(read: Gaussians, g: Gaussians, shN: float) -> None:
    """Whether values are within a SOG's steps: of codebooks, a 127th of the range."""

    def step(values: torch.Tensor) -> float:
        return float(values.max() - values.min()) / 127 + 1e-5

    logs = g.means.sign() * g.means.abs().log1p()
    error = (read.means.sign() * read.means.abs().log1p() - logs).abs()
    assert float(error.max()) <= float((logs.amax(0) - logs.amin(0)).max()) / 65535
    unit = torch.nn.functional.normalize
    assert float((unit(read.quats, dim=1) * unit(g.quats, dim=1)).sum(1).abs().min()) > 0.9998
    assert float((read.log_scales - g.log_scales).abs().max()) < step(g.log_scales)
    assert float((read.sh0 - g.sh0).abs().max()) < step(g.sh0)
    assert float((read.logit_opacities.sigmoid() - g.logit_opacities.sigmoid()).abs().max()) < 0.0021
    assert read.shN.shape == g.shN.shape
    if g.shN.numel():
        assert float((read.shN - g.shN).square().mean().sqrt()) <= shN * float(g.shN.std())


@pytest.mark.parametrize(
    ("degree", "name"), [(0, "a.sog"), (1, "a/meta.json"), (2, "a.sog"), (3, "b/meta.json")]
)
def test_read_back(tmp_path, degree, name):
    g = random_gaussians(3000, degree=degree, seed=degree)
    g = replace(g, label_ids=torch.arange(3000, dtype=torch.int16) % 3 - 1)
    (tmp_path / name).parent.mkdir(exist_ok=True)
    size = write_sog(tmp_path / name, g, {0: "tree", 1: "sky", 2: "none"}, antialiased=degree == 3)
    splat = read_splat(tmp_path / name)
    assert (splat.kind, splat.names, splat.antialiased) == ("SOG", {0: "tree", 1: "sky"}, degree == 3)
    inside = [p for p in (tmp_path / name).parent.iterdir() if not p.name.endswith("labels.json")]
    assert sum(path.stat().st_size for path in inside) == size
    g = g.select(torch.from_numpy(sog_order(g)))
    assert torch.equal(splat.gaussians.label_ids, g.label_ids)
    near(splat.gaussians, g, 0.55)  # noise is what palettes are worst at


def test_the_same_input_gives_the_same_bytes(tmp_path):
    g = random_gaussians(500, degree=1)
    for name in ("a.sog", "b.sog"):
        write_sog(tmp_path / name, g)
    assert (tmp_path / "a.sog").read_bytes() == (tmp_path / "b.sog").read_bytes()


def test_few_different_values_are_kept_exactly(tmp_path):
    g = random_gaussians(2000, degree=2)
    g = replace(
        g,
        log_scales=(g.log_scales * 20).round() / 16,
        sh0=(g.sh0 * 20).round() / 16,
        shN=g.shN[torch.arange(2000) % 9].mul(8).round() / 8,
    )
    write_sog(tmp_path / "a.sog", g)
    read, g = read_splat(tmp_path / "a.sog").gaussians, g.select(torch.from_numpy(sog_order(g)))
    for name in ("log_scales", "sh0", "shN"):
        assert torch.equal(getattr(read, name), getattr(g, name)), name


def test_labels_of_an_earlier_file_go(tmp_path):
    g = random_gaussians(9)
    write_sog(tmp_path / "a.sog", replace(g, label_ids=torch.zeros(9, dtype=torch.int16)), {0: "tree"})
    assert sidecar(tmp_path / "a.sog").exists()
    write_sog(tmp_path / "a.sog", replace(g, label_ids=torch.full((9,), -1, dtype=torch.int16)))
    assert not sidecar(tmp_path / "a.sog").exists()


@pytest.mark.parametrize("count", [1, 2, 17])
def test_few_gaussians(tmp_path, count):
    g = make(count, 15)
    write_sog(tmp_path / "a.sog", g)
    near(read_splat(tmp_path / "a.sog").gaussians, g.select(torch.from_numpy(sog_order(g))), 0.6)


def test_what_cannot_be_written(tmp_path):
    g = make(4, 3)
    g.shN[1, 1, 1] = float("inf")
    for wrong, message in ((g, "1 values of shN are NaN"), (make(0, 0), "0 Gaussians; a SOG holds 1 to")):
        with pytest.raises(DataError, match=rf"a\.sog: {message}"):
            write_sog(tmp_path / "a.sog", wrong)
    g = make(4, 3)
    g.quats[2] = 0
    with pytest.raises(DataError, match="1 Gaussians have a rotation of zeros"):
        write_sog(tmp_path / "a.sog", g)
    with pytest.raises(DataError, match="a level without Gaussians"):
        write_lod_meta(tmp_path / "a", [make(4, 0), make(0, 0)])
    assert list(tmp_path.iterdir()) == []


def test_levels_of_detail(tmp_path):
    fine = replace(random_gaussians(900, degree=1), label_ids=torch.arange(900, dtype=torch.int16) % 2)
    levels = [fine, fine.select(torch.arange(0, 900, 4)), fine.select(torch.arange(3))]
    size = write_lod_meta(tmp_path / "a", levels, {0: "tree", 1: "sky"}, leaf=200)
    assert size == sum(path.stat().st_size for path in (tmp_path / "a").rglob("*.*"))
    assert num_lods(tmp_path / "a") == 3
    document = json.loads((tmp_path / "a" / "lod-meta.json").read_text())
    assert document["counts"] == [900, 225, 3]
    leaves, nodes = [], [document["tree"]]
    while nodes:
        node = nodes.pop()
        nodes += node.get("children", [])
        leaves += [node] if "lods" in node else []
    assert max(leaf["lods"]["0"]["count"] for leaf in leaves) <= 200
    assert len(leaves) == 8
    for lod, g in enumerate(levels):
        splat = read_splat(tmp_path / "a", lod)
        assert splat.names == {label: ("tree", "sky")[label] for label in g.counts()}
        read = splat.gaussians
        distances, rows = KDTree(g.means.numpy()).query(read.means.numpy())
        assert distances.max() < 0.001
        assert len(np.unique(rows)) == len(g)
        assert torch.equal(read.label_ids, g.label_ids[rows])
    first = leaves[0]
    rows = slice(first["lods"]["0"]["offset"], first["lods"]["0"]["offset"] + first["lods"]["0"]["count"])
    inside = read_splat(tmp_path / "a" / document["filenames"][first["lods"]["0"]["file"]]).gaussians.means[
        rows
    ]
    assert (inside.amin(0) >= torch.tensor(first["bound"]["min"])).all()
    assert (inside.amax(0) <= torch.tensor(first["bound"]["max"])).all()
