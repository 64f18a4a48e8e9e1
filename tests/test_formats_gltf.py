"""glTF with splats: where nodes put them, buffers inside and beside, SPZ inside, and what is refused."""

import base64
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from sagesplat.core.errors import DataError
from sagesplat.core.transform import transformed
from sagesplat.formats.splats import read_splat
from sagesplat.formats.spz import decode_spz, encode_spz
from tests.conftest import random_gaussians
from tests.fuzz.readers.foreign_splats import glb, gltf
from tests.test_formats_spz import rotations

HALF_TURN = np.diag([-1.0, -1.0, 1.0])


def put(path: Path, document: dict[str, Any], content: bytes) -> Path:
    path.write_bytes(glb(document, content))
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
        ("nodes.0.scale", [1, 2, 1], "scales its axes differently"),
        ("nodes.0.scale", [-1, 1, 1], "mirrors"),
        ("nodes.0.children", [0], "in its tree twice"),
        ("nodes.0.translation", [10**400, 0, 0], "OverflowError"),
        ("accessors.0.count", 10**9, "1000000000 values, more than fit"),
        ("accessors.1.sparse", {}, "sparse"),
        ("accessors.2.count", 3, "3 values of KHR_gaussian_splatting:SCALE for 4 positions"),
        ("bufferViews.0.byteStride", 1, "more than fit"),
        ("buffers", [{"uri": "../b.bin"}], "is not in its folder"),
        ("meshes.0.primitives.0.extensions", {}, "no primitives with KHR_gaussian_splatting"),
        (
            "meshes.0.primitives.0.extensions.KHR_gaussian_splatting.colorSpace",
            "lin_rec709_display",
            "not supported",
        ),
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
