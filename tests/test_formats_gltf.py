"""glTF with splats: where nodes put them, buffers inside and beside, SPZ inside, and what is refused."""

import base64
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from sagesplat.core.errors import DataError
from sagesplat.core.transform import transformed
from sagesplat.formats.splats import read_splat, write_splat
from sagesplat.formats.spz import decode_spz, encode_spz
from tests.conftest import random_gaussians
from tests.fuzz.readers.foreign_splats import glb, gltf
from tests.test_formats_spz import rotations

HALF_TURN = np.diag([-1.0, -1.0, 1.0])


def put(path: Path, document: dict[str, Any], content: bytes | bytearray) -> Path:
    path.write_bytes(glb(document, bytes(content)))
    return path


def near(read: Any, expected: Any, atol: float = 1e-5) -> None:
    for name in ("means", "log_scales", "logit_opacities", "sh0", "shN"):
        torch.testing.assert_close(getattr(read, name), getattr(expected, name), atol=atol, rtol=1e-4)
    torch.testing.assert_close(rotations(read.quats), rotations(expected.quats), atol=1e-5, rtol=0)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_axes_are_left_up_front(tmp_path, degree):
    g = random_gaussians(40, degree=degree, seed=1)
    splat = read_splat(put(tmp_path / "a.png", *gltf(transformed(g, HALF_TURN))))
    assert splat.kind == "glTF"
    near(splat.gaussians, g)
    assert torch.equal(splat.gaussians.means, g.means)


def test_where_nodes_put_them(tmp_path):
    g = random_gaussians(40, seed=2)
    quarter = {"translation": [1, 2, 3], "rotation": [0, 0, 0.5**0.5, 0.5**0.5], "scale": [2, 2, 2]}
    document, content = gltf(g, **quarter)
    document["nodes"] += [{"children": [0], "matrix": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 10, 0, 0, 1]}]
    document["scenes"] = [{"nodes": [1]}]
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    expected = transformed(g, HALF_TURN @ turn, 2.0, HALF_TURN @ [11, 2, 3])
    near(read_splat(put(tmp_path / "a.glb", document, content)).gaussians, expected)


def test_turned_splats_have_turned_colours():
    g = random_gaussians(5, seed=3)
    axis, angle = np.array([2, -1, 3]) / 14**0.5, 0.7
    cross = np.cross(np.eye(3), -axis)
    rotation = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    from sagesplat.core.sh import bases

    turned = transformed(g, rotation)
    direction = np.array([0.3, 0.8, -((1 - 0.73) ** 0.5)])
    before, after = (np.array(bases(*d)[1:]) for d in (direction, rotation @ direction))
    np.testing.assert_allclose(
        np.einsum("k,nkc->nc", after, turned.shN), np.einsum("k,nkc->nc", before, g.shN), atol=1e-5
    )
    unit = turned.quats / turned.quats.norm(dim=1, keepdim=True)
    w, x, y, z = unit.double().numpy().T
    first_axis = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], 1)
    w, x, y, z = (g.quats / g.quats.norm(dim=1, keepdim=True)).double().numpy().T
    original = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], 1)
    np.testing.assert_allclose(first_axis, original @ rotation.T, atol=1e-5)


def test_buffers_beside_and_inside(tmp_path):
    g = random_gaussians(9, degree=1)
    document, content = gltf(g)
    (tmp_path / "b c.bin").write_bytes(content)
    direct = read_splat(put(tmp_path / "a.glb", document, content)).gaussians
    data = "data:application/octet-stream;base64," + base64.b64encode(content).decode()
    for uri in ("b%20c.bin", data):
        (tmp_path / "a.gltf").write_text(json.dumps(document | {"buffers": [{"uri": uri}]}))
        assert torch.equal(read_splat(tmp_path / "a.gltf").gaussians.shN, direct.shN)


def test_opacities_of_bytes(tmp_path):
    g = random_gaussians(50, degree=0)
    g.logit_opacities[0], g.logit_opacities[1] = 20, -20
    splat = read_splat(put(tmp_path / "a.glb", *gltf(g, byte_opacities=True)))
    assert splat.dropped == {"invisible": 1}
    expected = g.logit_opacities.sigmoid()[torch.arange(50) != 1]
    torch.testing.assert_close(splat.gaussians.logit_opacities.sigmoid(), expected, atol=0.5 / 255, rtol=0)


def with_spz(g: Any) -> tuple[dict[str, Any], bytes]:
    document, content = gltf(g)[0], encode_spz(g)
    inside = {"extensions": {"KHR_gaussian_splatting_compression_spz_2": {"bufferView": 0}}}
    document["meshes"][0]["primitives"][0]["extensions"] = {"KHR_gaussian_splatting": inside}
    return document | {"bufferViews": [{"buffer": 0, "byteLength": len(content)}]}, content


def test_an_spz_inside(tmp_path):
    g = random_gaussians(30, seed=4)
    splat = read_splat(put(tmp_path / "a.glb", *with_spz(g)))
    near(splat.gaussians, decode_spz(encode_spz(g)), atol=1e-6)


def covariances(g: Any) -> np.ndarray:
    q = (g.quats / g.quats.norm(dim=1, keepdim=True)).double().numpy()
    w, x, y, z = q.T
    rows = [[1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)]]
    rows += [[2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)]]
    rows += [[2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)]]
    axes = np.moveaxis(np.array(rows), -1, 0) * g.log_scales.double().exp().numpy()[:, None]
    return axes @ axes.transpose(0, 2, 1)


@pytest.mark.parametrize("scale", [[2, 2, 3], [1, 1, -1], [-2, 1, 0.5]])
def test_nodes_that_mirror_or_stretch(tmp_path, scale):
    from sagesplat.core.sh import bases

    g = random_gaussians(30, seed=5)
    turn = {"rotation": [0, 0, 0.5**0.5, 0.5**0.5], "translation": [1, 2, 3]}
    read = read_splat(put(tmp_path / "a.glb", *gltf(g, scale=scale, **turn))).gaussians
    rotation = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    linear = HALF_TURN @ rotation @ np.diag(scale)
    np.testing.assert_allclose(read.means, g.means.numpy() @ linear.T + HALF_TURN @ [1, 2, 3], atol=1e-5)
    np.testing.assert_allclose(covariances(read), linear @ covariances(g) @ linear.T, atol=1e-5)
    direction = np.array([0.3, 0.8, -((1 - 0.73) ** 0.5)])
    turned = HALF_TURN @ rotation @ np.diag(np.sign(scale)) @ direction
    before, after = (np.array(bases(*d)[1:]) for d in (direction, turned))
    np.testing.assert_allclose(
        np.einsum("k,nkc->nc", after, read.shN), np.einsum("k,nkc->nc", before, g.shN), atol=1e-5
    )


def test_a_mesh_in_several_nodes(tmp_path):
    g = random_gaussians(20, degree=1, seed=6)
    document, content = gltf(g)
    document["nodes"].append({"mesh": 0, "translation": [5, 0, 0]})
    document["scenes"] = [{"nodes": [0, 1]}]
    read = read_splat(put(tmp_path / "a.glb", document, content)).gaussians
    means = transformed(g, HALF_TURN).means
    expected = torch.cat([means, means + torch.tensor([-5.0, 0, 0])])
    assert sorted(read.means.tolist()) == sorted(expected.tolist())


@pytest.mark.parametrize("based", [True, False])
def test_sparse_accessors(tmp_path, based):
    g = random_gaussians(5, degree=0, seed=3)
    document, content = gltf(g)
    document["bufferViews"] += [
        {"buffer": 0, "byteOffset": len(content) + at, "byteLength": n} for at, n in ((0, 4), (4, 8))
    ]
    content += np.array([1, 4], "<u2").tobytes() + np.array([0.25, 0.75], "<f4").tobytes()
    opacities = document["accessors"][3]
    opacities["sparse"] = {
        "count": 2, "indices": {"bufferView": 5, "componentType": 5123}, "values": {"bufferView": 6},
    }  # fmt: skip
    if not based:  # then the others are zeros: these Gaussians are not drawn
        del opacities["bufferView"]
    splat = read_splat(put(tmp_path / "a.glb", document, content))
    expected = g.logit_opacities.sigmoid()
    expected[[1, 4]] = torch.tensor([0.25, 0.75])
    expected = expected if based else expected[[1, 4]]
    torch.testing.assert_close(splat.gaussians.logit_opacities.sigmoid(), expected)
    opacities["sparse"]["indices"]["componentType"] = 5126
    with pytest.raises(DataError, match="not a glTF with splats that is read"):
        read_splat(put(tmp_path / "a.glb", document, content))


def test_a_far_node_is_an_offset(tmp_path):
    """Translations such as those in UTM are in doubles; float32 positions would be rounded to 0.5."""
    g = random_gaussians(50, degree=1, seed=4)
    near = read_splat(put(tmp_path / "near.glb", *gltf(g)))
    far = read_splat(put(tmp_path / "far.glb", *gltf(g, translation=[412346.1, 188.2, -5312345.3])))
    assert np.abs(np.subtract(far.offset, [-412346.1, -188.2, -5312345.3])).max() < 5
    by = torch.from_numpy(np.subtract([-412346.1, -188.2, -5312345.3], far.offset))
    torch.testing.assert_close(far.gaussians.means.double(), near.gaussians.means + by, atol=1e-5, rtol=0)


def test_only_the_first_buffer_is_the_binary_chunk(tmp_path):
    document, content = gltf(random_gaussians(9, degree=0))
    for view in document["bufferViews"]:
        view["buffer"] = 1
        view["extensions"] = {"KHR_meshopt_compression": {"buffer": 0}}
    fallback = {"byteLength": len(content), "extensions": {"KHR_meshopt_compression": {"fallback": True}}}
    document["buffers"].append(fallback)
    with pytest.raises(DataError, match="buffer 1 has no content: KHR_meshopt_compression"):
        read_splat(put(tmp_path / "a.glb", document, content))
    (tmp_path / "buffers").mkdir()
    (tmp_path / "buffers" / "b.bin").write_bytes(content)
    fallback["uri"] = "buffers/b.bin"  # a fallback that is there
    assert len(read_splat(put(tmp_path / "a.glb", document, content)).gaussians) == 9


def values(document: dict[str, Any], content: bytearray, name: str) -> np.ndarray:
    """A writable view of a float attribute of a `bytearray`."""
    at = document["meshes"][0]["primitives"][0]["attributes"][name]
    view = document["bufferViews"][document["accessors"][at]["bufferView"]]
    return np.frombuffer(content, "<f4", view["byteLength"] // 4, view["byteOffset"])


@pytest.mark.parametrize("shift", [0, 3])
def test_logarithms_of_scales_and_logits(tmp_path, shift):
    g = random_gaussians(40, degree=0, seed=7)
    g = replace(g, log_scales=g.log_scales + shift)
    assert (g.log_scales < 0).any()
    document, content = gltf(g)
    content = bytearray(content)
    values(document, content, "KHR_gaussian_splatting:SCALE")[:] = g.log_scales.numpy().ravel()
    splat = read_splat(put(tmp_path / "a.glb", document, content))
    near(splat.gaussians, transformed(g, HALF_TURN))
    assert splat.notes == ("scales are logarithms, as drafts of KHR_gaussian_splatting had them",)
    values(document, content, "KHR_gaussian_splatting:OPACITY")[:] = g.logit_opacities.numpy()
    splat = read_splat(put(tmp_path / "a.glb", document, content))
    near(splat.gaussians, transformed(g, HALF_TURN))
    assert "opacities are logits: they are not between 0 and 1" in splat.notes
    values(document, content, "KHR_gaussian_splatting:SCALE")[0] = 1e9
    with pytest.raises(DataError, match="scales from"):
        read_splat(put(tmp_path / "a.glb", document, content))


def test_attributes_of_the_first_drafts(tmp_path):
    g = random_gaussians(12, degree=0, seed=8)
    document, content = gltf(g)
    primitive = document["meshes"][0]["primitives"][0]
    old = primitive["attributes"]
    colours = np.concatenate([g.sh0[:, 0] * 0.28209479 + 0.5, g.logit_opacities.sigmoid()[:, None]], 1)
    document["bufferViews"].append({"buffer": 0, "byteOffset": len(content), "byteLength": 16 * 12})
    document["accessors"].append({"bufferView": 5, "count": 12, "type": "VEC4", "componentType": 5126})
    primitive["attributes"] = {"POSITION": old["POSITION"], "COLOR_0": 5}
    primitive["attributes"] |= {
        f"_{key}": old[f"KHR_gaussian_splatting:{key}"] for key in ("ROTATION", "SCALE")
    }
    splat = read_splat(put(tmp_path / "a.glb", document, content + colours.astype("<f4").tobytes()))
    near(splat.gaussians, transformed(g, HALF_TURN))
    assert splat.notes == (
        "colours and opacities are those of COLOR_0, as drafts of KHR_gaussian_splatting had them",
    )
    document, content = with_spz(g)
    inside = {"KHR_spz_gaussian_splats_compression": {"bufferView": 0}}
    document["meshes"][0]["primitives"][0]["extensions"] = inside
    document["extensionsRequired"] = list(inside)
    near(read_splat(put(tmp_path / "a.glb", document, content)).gaussians, decode_spz(encode_spz(g)))


def test_quantised_attributes(tmp_path):
    """Positions of 16 bits with a node that scales them (KHR_mesh_quantization), and the others."""
    name, count, rng = "KHR_gaussian_splatting", 30, np.random.default_rng(1)
    positions = rng.integers(0, 65536, (count, 4), np.uint16)  # of 8 bytes a row
    rotations = rng.integers(-32767, 32768, (count, 4), np.int16)
    scales = rng.integers(1, 256, (count, 4), np.uint8)
    opacities = rng.integers(1, 65535, (count, 2), np.uint16)
    colours = rng.normal(size=(count, 3)).astype("<f4")
    content, views, accessors = b"", [], []
    for column, kind, component in (
        (positions, "VEC3", 5123), (rotations, "VEC4", 5122), (scales, "VEC3", 5121),
        (opacities, "SCALAR", 5123), (colours, "VEC3", 5126),
    ):  # fmt: skip
        views.append({"buffer": 0, "byteOffset": len(content), "byteLength": column.nbytes})
        views[-1]["byteStride"] = column.nbytes // count
        accessors.append({"bufferView": len(accessors), "count": count, "type": kind})
        accessors[-1] |= {"componentType": component, "normalized": component != 5126}
        content += column.tobytes()
    keys = ["POSITION", f"{name}:ROTATION", f"{name}:SCALE", f"{name}:OPACITY", f"{name}:SH_DEGREE_0_COEF_0"]
    document = gltf(random_gaussians(2))[0] | {"bufferViews": views, "accessors": accessors}
    document["meshes"][0]["primitives"][0]["attributes"] = {key: i for i, key in enumerate(keys)}
    document["extensionsRequired"] = ["KHR_mesh_quantization"]
    document["nodes"] = [{"mesh": 0, "scale": [8, 8, 8], "translation": [-4, -4, -4]}]
    document["buffers"] = [{"byteLength": len(content)}]
    g = read_splat(put(tmp_path / "a.glb", document, content)).gaussians
    expected = (positions[:, :3] / 65535 * 8 - 4) @ HALF_TURN.T
    np.testing.assert_allclose(g.means, expected, atol=1e-5)
    np.testing.assert_allclose(g.log_scales.exp(), scales[:, :3] / 255 * 8, rtol=1e-5)
    np.testing.assert_allclose(g.logit_opacities.sigmoid(), opacities[:, 0] / 65535, atol=1e-6)


def plainly(path: Path) -> dict[str, np.ndarray]:
    """The attributes of the first primitive of a .glb, by the words of glTF's specification alone."""
    content = path.read_bytes()
    assert content[:8] == b"glTF\2\0\0\0"
    assert int.from_bytes(content[8:12], "little") == len(content)
    size = int.from_bytes(content[12:16], "little")
    document, start = json.loads(content[20 : 20 + size]), 28 + size
    assert int.from_bytes(content[20 + size : 24 + size], "little") == document["buffers"][0]["byteLength"]
    found = {}
    for name, at in document["meshes"][0]["primitives"][0]["attributes"].items():
        accessor = document["accessors"][at]
        view = document["bufferViews"][accessor["bufferView"]]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        dtype = {5126: "<f4", 5121: "u1"}[accessor["componentType"]]
        column = np.frombuffer(content, dtype, accessor["count"] * width, start + view["byteOffset"])
        found[name] = column.reshape(-1, width)
    return found


@pytest.mark.parametrize("degree", [0, 2, 3])
def test_a_glb_is_written_as_the_extension_has_it(tmp_path, degree):
    g = random_gaussians(25, degree=degree, seed=9)
    labels = (torch.arange(25) // 10 - 1).to(torch.int16) * 200
    labels[:10] = -1
    g = replace(g, label_ids=labels)
    write_splat(
        tmp_path / "a.glb", g, {200: "chair 1", 0: "Wand ☘"}, parents={200: "chair"}, antialiased=True
    )
    name, there = "KHR_gaussian_splatting", plainly(tmp_path / "a.glb")
    np.testing.assert_allclose(there["POSITION"], g.means.numpy() * [-1, -1, 1])
    np.testing.assert_allclose(there[f"{name}:SCALE"], g.log_scales.exp(), rtol=1e-6)
    np.testing.assert_allclose(there[f"{name}:OPACITY"][:, 0], g.logit_opacities.sigmoid(), rtol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(there[f"{name}:ROTATION"], axis=1), 1, atol=1e-6)
    assert len([key for key in there if ":SH_" in key]) == (degree + 1) ** 2
    assert there["_FEATURE_ID_0"][:, 0].tolist() == [65535] * 10 + [0] * 10 + [200] * 5
    splat = read_splat(tmp_path / "a.glb")
    near(splat.gaussians, g)
    assert torch.equal(splat.gaussians.label_ids, labels)
    assert splat.names == {0: "Wand ☘", 200: "chair 1"}
    assert splat.parents == {200: "chair"}
    assert splat.antialiased
    assert not splat.notes


def change(document: dict[str, Any], key: str, value: Any) -> dict[str, Any]:
    """A copy with `value` at a path such as "nodes.0.matrix"."""
    document = json.loads(json.dumps(document))
    *path, last = key.split(".")
    place: Any = document
    for part in path:
        place = place[int(part) if isinstance(place, list) else part]
    place[last if isinstance(place, dict) else int(last)] = value
    return document


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("nodes.0.scale", [1, 0, 1], "flattens"),
        ("nodes.0.extensions", {"EXT_mesh_gpu_instancing": {}}, "EXT_mesh_gpu_instancing"),
        ("extensionsRequired", ["VENDOR_new"], "requires VENDOR_new, not supported"),
        ("extensionsRequired", ["EXT_meshopt_compression"], "requires EXT_meshopt_compression"),
        ("buffers", [], "entry 0 of 0"),
        ("accessors.0", {"count": 4, "type": "VEC3", "componentType": 5126}, "without a buffer view"),
        ("nodes.0.children", [0], "in its tree twice"),
        ("nodes.0.translation", [10**400, 0, 0], "OverflowError"),
        ("accessors.0.count", 10**9, "1000000000 values, more than fit"),
        ("accessors.1.sparse", {"count": 1}, "KeyError"),
        ("accessors.2.count", 3, "3 values of KHR_gaussian_splatting:SCALE for 4 positions"),
        ("bufferViews.0.byteStride", 1, "more than fit"),
        ("buffers", [{"uri": "../b.bin"}], "is not in its folder"),
        ("meshes.0.primitives.0.extensions", {}, "no primitives with KHR_gaussian_splatting"),
        (
            "meshes.0.primitives.0.extensions.KHR_gaussian_splatting.colorSpace",
            "lin_rec709_display",
            "colours 'lin_rec709_display' are not supported",
        ),
        ("meshes.0.primitives.0.extensions.KHR_gaussian_splatting.kernel", "cube", "kernel 'cube'"),
        ("meshes.0.primitives.0.attributes", {"POSITION": 0}, "no attribute KHR_gaussian_splatting:OPACITY"),
    ],
)
def test_what_is_refused(tmp_path, key, value, message):
    document, content = gltf(random_gaussians(4, degree=1))
    path = put(tmp_path / "a.glb", change(document, key, value), content)
    with pytest.raises(DataError) as caught:
        read_splat(path)
    assert str(path) in str(caught.value)
    assert message in str(caught.value)


def test_primitives_do_not_multiply_what_is_there(tmp_path):
    document, content = gltf(random_gaussians(40, degree=0))
    document["meshes"][0]["primitives"] *= 1000
    with pytest.raises(DataError, match="share their positions"):
        read_splat(put(tmp_path / "a.glb", document, content))
    document, content = with_spz(random_gaussians(40))
    document["meshes"][0]["primitives"] *= 2
    with pytest.raises(DataError, match="share their positions"):
        read_splat(put(tmp_path / "a.glb", document, content))
