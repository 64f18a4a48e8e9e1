"""What sagesplat writes as SOG and streamed SOG is read back within the formats' steps, with its labels."""

import json
import zipfile
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial import KDTree

from sagesplat.core.errors import DataError
from sagesplat.core.gaussians import Gaussians
from sagesplat.formats.labels import sidecar
from sagesplat.formats.lod_meta_write import write_lod_meta, write_ssog
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
        write_lod_meta(tmp_path / "a", [make(4, 0), make(0, 0)], {-1: -1, 0: 0})
    assert list(tmp_path.iterdir()) == []


def test_levels_of_detail_have_cells_as_their_tree(tmp_path):
    cells = torch.arange(900, dtype=torch.int16) % 3  # two of the tree, between them one of the sky
    label_of, names = {0: 5, 1: 2, 2: 5}, {5: "tree", 2: "sky"}
    fine = replace(random_gaussians(900, degree=1), label_ids=cells)
    levels = [fine, fine.select(torch.arange(0, 900, 4)), fine.select(torch.tensor([0, 2]))]
    size = write_lod_meta(tmp_path / "a", levels, label_of, names, parents={5: "plant"}, largest=600)
    assert size == sum(path.stat().st_size for path in (tmp_path / "a").rglob("*.*"))
    assert num_lods(tmp_path / "a") == 3
    document = json.loads((tmp_path / "a" / "lod-meta.json").read_text())
    head = ["version", "asset", "count", "counts", "lodLevels", "filenames", "tree"]
    assert list(document) == head  # as splat-transform 3.8 has it: no null for an environment, no errors
    assert document["counts"] == [900, 225, 2]
    assert document["filenames"] == [f"{name}/meta.json" for name in ("0_0", "0_1", "1_0", "2_0")]
    categories = document["tree"]["children"]
    assert [(node["name"], len(node["children"])) for node in categories] == [("sky", 1), ("tree", 2)]
    leaves = [leaf for node in categories for leaf in node["children"]]
    parts = [[leaf["lods"].get(str(lod)) for leaf in leaves] for lod in range(3)]  # of cells 1, 0, 2
    assert parts[0] == [{"file": f, "offset": at, "count": 300} for f, at in ((0, 0), (0, 300), (1, 0))]
    assert parts[1] == [{"file": 2, "offset": 75 * i, "count": 75} for i in range(3)]
    assert parts[2] == [None, *({"file": 3, "offset": i, "count": 1} for i in range(2))]
    for lod, g in enumerate(levels):
        splat = read_splat(tmp_path / "a", lod)
        labels = torch.tensor([label_of[cell] for cell in g.label_ids.tolist()], dtype=torch.int16)
        assert splat.names == {label: names[label] for label in set(labels.tolist())}
        assert splat.parents == {5: "plant"}
        distances, rows = KDTree(g.means.numpy()).query(splat.gaussians.means.numpy())
        assert distances.max() < 0.001
        assert len(np.unique(rows)) == len(g)
        assert torch.equal(splat.gaussians.label_ids, labels[rows])
        for leaf, cell in zip(leaves, (1, 0, 2), strict=True):  # viewers cull by the bound, at any level
            own = g.means[g.label_ids == cell]
            assert (own >= torch.tensor(leaf["bound"]["min"])).all()
            assert (own <= torch.tensor(leaf["bound"]["max"])).all()
            entry = leaf["lods"].get(str(lod))
            if entry:
                file = tmp_path / "a" / document["filenames"][entry["file"]]
                inside = read_splat(file).gaussians.means[entry["offset"] : entry["offset"] + entry["count"]]
                assert KDTree(own.numpy()).query(inside.numpy())[0].max() < 0.001
    for node in (*categories, document["tree"]):
        below = [child["bound"] for child in node["children"]]
        assert node["bound"]["min"] == np.min([bound["min"] for bound in below], 0).tolist()
        assert node["bound"]["max"] == np.max([bound["max"] for bound in below], 0).tolist()


def test_the_bound_of_a_cell_holds_the_boxes_of_its_gaussians(tmp_path):
    g = replace(make(1, 0), means=torch.tensor([[1.0, 2, 3]]), log_scales=torch.tensor([[1.0, 2, 0.5]]).log())
    g = replace(g, quats=torch.tensor([[1.0, 0, 0, 0]]))
    half = 0.5**0.5
    turned = replace(g, quats=torch.tensor([[half, 0, 0, half]]))  # x and y change places
    g, turned = (replace(some, label_ids=torch.zeros(1, dtype=torch.int16)) for some in (g, turned))
    write_lod_meta(tmp_path / "a", [g], {0: 0})
    bound = json.loads((tmp_path / "a" / "lod-meta.json").read_text())["tree"]["bound"]
    assert bound["min"] == pytest.approx([-2, -4, 1.5])
    assert bound["max"] == pytest.approx([4, 8, 4.5])
    write_lod_meta(tmp_path / "b", [g, turned], {0: 0})
    bound = json.loads((tmp_path / "b" / "lod-meta.json").read_text())["tree"]["bound"]
    assert bound["min"] == pytest.approx([-5, -4, 1.5], abs=1e-5)
    assert bound["max"] == pytest.approx([7, 8, 4.5], abs=1e-5)


def test_a_streamed_sog_in_one_file_is_the_folder_stored(tmp_path):
    fine = replace(random_gaussians(300, degree=1), label_ids=(torch.arange(300) % 3).to(torch.int16))
    levels, label_of, names = [fine, fine.select(torch.arange(0, 300, 5))], {0: 5, 1: 2, 2: 5}, {5: "tree"}
    size = write_ssog(tmp_path / "a.ssog", levels, label_of, names, parents={5: "plant"}, antialiased=True)
    assert size == (tmp_path / "a.ssog").stat().st_size
    write_ssog(tmp_path / "b.ssog", levels, label_of, names, parents={5: "plant"}, antialiased=True)
    assert (tmp_path / "a.ssog").read_bytes() == (tmp_path / "b.ssog").read_bytes()
    write_lod_meta(tmp_path / "c", levels, label_of, names, parents={5: "plant"}, antialiased=True)
    with zipfile.ZipFile(tmp_path / "a.ssog") as archive:
        assert {info.compress_type for info in archive.infolist()} == {zipfile.ZIP_STORED}
        inside = {info.filename: archive.read(info) for info in archive.infolist()}
    files = [path for path in (tmp_path / "c").rglob("*") if path.is_file()]
    assert inside == {path.relative_to(tmp_path / "c").as_posix(): path.read_bytes() for path in files}
    for lod in range(num_lods(tmp_path / "a.ssog")):
        one, other = (read_splat(tmp_path / name, lod) for name in ("a.ssog", "c"))
        assert torch.equal(one.gaussians.means, other.gaussians.means)
        assert torch.equal(one.gaussians.label_ids, other.gaussians.label_ids)
        assert (one.names, one.parents, one.antialiased) == ({5: "tree"}, {5: "plant"}, True)
    with pytest.raises(DataError, match=r"d\.ssog: a level without Gaussians"):
        write_ssog(tmp_path / "d.ssog", [fine.select(torch.arange(0))], label_of)
    assert not (tmp_path / "d.ssog").exists()
