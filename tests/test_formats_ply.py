from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import random_gaussians
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from sagesplat.core.errors import DataError
from sagesplat.core.gaussians import Gaussians
from sagesplat.formats.ply import read_ply, write_ply
from sagesplat.formats.splats import read_splat

FLOATS = st.floats(width=32, allow_nan=False, allow_infinity=False)


def make(count: int, bases: int, seed: int = 0) -> Gaussians:
    draw = torch.Generator().manual_seed(seed)
    shapes = {"means": (3,), "quats": (4,), "log_scales": (3,), "logit_opacities": (), "sh0": (1, 3)}
    tensors = {name: torch.randn(count, *shape, generator=draw) for name, shape in shapes.items()}
    labels = torch.randint(-1, 300, (count,), generator=draw).to(torch.int16)
    return Gaussians(**tensors, shN=torch.randn(count, bases, 3, generator=draw), label_ids=labels)


def same(a: Gaussians, b: Gaussians) -> bool:
    pairs = [(getattr(a, f.name), getattr(b, f.name)) for f in fields(Gaussians)]
    return all(
        x.dtype == y.dtype and x.numpy().tobytes() == y.contiguous().numpy().tobytes() for x, y in pairs
    )


def split(path: Path) -> tuple[bytes, bytes]:
    head, _, body = path.read_bytes().partition(b"end_header\n")
    return head, body


def foreign(path: Path, columns: dict[str, np.ndarray], order: str = "<", extra: str = "") -> None:
    kinds = {"f4": "float", "f8": "double", "i4": "int", "u1": "uchar", "u2": "ushort", "u4": "uint"}
    names = "".join(f"property {kinds[c.dtype.str[1:]]} {name}\n" for name, c in columns.items())
    form = "binary_little_endian" if order == "<" else "binary_big_endian"
    count = len(next(iter(columns.values())))
    header = f"ply\nformat {form} 1.0\ncomment by hand\nelement vertex {count}\n{names}{extra}end_header\n"
    rows = np.empty(count, [(name, order + c.dtype.str[1:]) for name, c in columns.items()])
    for name, column in columns.items():
        rows[name] = column
    path.write_bytes(header.encode() + rows.tobytes())


def columns_of(g: Gaussians) -> dict[str, np.ndarray]:
    """A scene in another tool's order, without normals and without labels."""
    rest = g.shN.numpy().transpose(2, 1, 0).reshape(-1, len(g))  # [colour, coefficient]
    parts = {"rot": g.quats.T, "scale": g.log_scales.T, "f_rest": rest, "f_dc": g.sh0[:, 0].T}
    named = {f"{key}_{i}": np.asarray(c) for key, part in parts.items() for i, c in enumerate(part)}
    axes = dict(zip("zyx", np.asarray(g.means.T)[::-1], strict=True))
    return {**named, **axes, "opacity": g.logit_opacities.numpy()}


@settings(max_examples=40)
@given(data=st.data(), count=st.integers(0, 9), bases=st.sampled_from([0, 3, 8, 15]))
def test_read_back_bit_for_bit(tmp_path, data, count, bases):
    def floats(*shape: int) -> torch.Tensor:
        return torch.from_numpy(data.draw(npst.arrays(np.float32, (count, *shape), elements=FLOATS)))

    quats = floats(4)
    quats[:, 0] = 1.0
    labels = data.draw(npst.arrays(np.int16, count, elements=st.integers(-1, 32767)))
    written = Gaussians(
        means=floats(3),
        quats=quats,
        log_scales=floats(3),
        logit_opacities=floats(),
        sh0=floats(1, 3),
        shN=floats(bases, 3),
        label_ids=torch.from_numpy(labels),
    )
    write_ply(tmp_path / "a.ply", written)
    assert same(written, read_ply(tmp_path / "a.ply"))


def test_more_rows_than_a_block(tmp_path):
    written = make(10_000, 3)
    write_ply(tmp_path / "a.ply", written)
    assert same(written, read_ply(tmp_path / "a.ply"))


def test_layout_is_inrias(tmp_path):
    g = make(2, 15)
    write_ply(tmp_path / "a.ply", g, {67: "dining  table", 3: "vase"})
    head, body = split(tmp_path / "a.ply")
    lines = head.decode().splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    assert [line for line in lines if line.startswith("comment label")] == [
        "comment label 3 vase",
        "comment label 67 dining table",
    ]
    properties = [line.split()[2] for line in lines if line.startswith("property")]
    assert len(properties) == 63
    assert properties[:9] == ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    assert properties[9:54] == [f"f_rest_{i}" for i in range(45)]
    assert properties[54:] == [
        "opacity",
        "scale_0",
        "scale_1",
        "scale_2",
        *(f"rot_{i}" for i in range(4)),
        "label",
    ]
    assert len(body) == 2 * (62 * 4 + 2)
    row = np.frombuffer(body, "<f4", 62)
    assert (row[3:6] == 0).all()
    np.testing.assert_array_equal(row[9:24], g.shN[0, :, 0])  # all of red first
    np.testing.assert_array_equal(row[24:39], g.shN[0, :, 1])
    np.testing.assert_array_equal(row[58:62], g.quats[0])


@pytest.mark.parametrize("bases", [0, 3, 8, 15])
@pytest.mark.parametrize("order", ["<", ">"])
def test_other_tools(tmp_path, bases, order):
    g = make(50, bases)
    columns = {"red": np.zeros(50, np.uint8), **columns_of(g)}
    columns["opacity"] = columns["opacity"].astype(np.float64)
    faces = "element face 3\nproperty list uchar int vertex_indices\nproperty float x\n"
    foreign(tmp_path / "a.ply", columns, order, faces)
    read = read_ply(tmp_path / "a.ply")
    assert (read.label_ids == -1).all()
    assert read.sh_degree == g.sh_degree
    assert same(read, Gaussians(**{**vars(g), "label_ids": torch.full((50,), -1, dtype=torch.int16)}))


def test_damage_is_named_in_one_line(tmp_path):
    path, columns = tmp_path / "a.ply", columns_of(make(20, 0))
    x = columns["x"]
    zeros = {f"rot_{i}": 0 * x for i in range(4)}
    for wrong, words in (
        ({"x": np.array([np.nan, np.inf, -np.inf, *x[3:]])}, "3 values of x are NaN or infinite"),
        ({"x": np.full(20, 1e300)}, "20 values of x are NaN or infinite"),
        ({"f_rest_0": x}, "1 f_rest properties"),
        ({"label": np.full(20, 40_000, np.int32)}, "20 values of label are outside"),
        (zeros, "20 Gaussians have a rotation"),
    ):
        foreign(path, columns | wrong)
        refused(path, words)
    foreign(path, {name: values for name, values in columns.items() if name not in ("opacity", "rot_3")})
    refused(path, "2 splat properties missing (opacity, rot_3)")
    foreign(path, columns)
    content = path.read_bytes()
    for old, new, words in (
        (content[-7:], b"", "20 Gaussians announced, 19 present"),
        (b"binary_little_endian", b"ascii", "text PLY is not supported"),
        (content[60:], b"", "header breaks"),
        (content, bytes(range(256)), "not readable as a PLY file"),
        (b"vertex 20", b"vertex 99999999999999999999", "20 present"),
    ):
        path.write_bytes(content.replace(old, new))
        refused(path, words)


def refused(path: Path, words: str) -> None:
    with pytest.raises(DataError) as caught:
        read_ply(path)
    message = str(caught.value)
    assert words in message
    assert message.startswith(f"{path}: ")
    assert "\n" not in message


@pytest.mark.parametrize("name", ["nothing.ply", "."])
def test_no_file(tmp_path, name):
    with pytest.raises(DataError, match="cannot be read"):
        read_ply(tmp_path / name)


@pytest.mark.usefixtures("unchecked_shapes")
def test_a_failed_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "a.ply"
    write_ply(path, make(3, 0))
    before = path.read_bytes()
    broken = Gaussians(**{**vars(make(3, 0)), "sh0": torch.zeros(2, 1, 3)})
    with pytest.raises(RuntimeError):
        write_ply(path, broken)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    ("comments", "up"),
    [
        (("Generated by Nerstudio 1.1.5", "Vertical Axis: z"), "z"),  # as it misspells itself
        (("Generated by Nerfstudio 1.2.0", "Vertical axis: z"), "z"),
        (("Exported from Brush", "Vertical axis: y"), "auto"),
        (("Vertical Axis: z",), "auto"),
        (("Generated by Nerfstudio 1.2.0",), "auto"),
    ],
)
def test_up_is_believed_where_nerfstudio_wrote_it(tmp_path, comments, up):
    write_ply(tmp_path / "a.ply", random_gaussians(5))
    content = (tmp_path / "a.ply").read_bytes()
    lines = b"".join(f"comment {comment}\n".encode() for comment in comments)
    (tmp_path / "a.ply").write_bytes(content.replace(b"element vertex", lines + b"element vertex", 1))
    assert read_splat(tmp_path / "a.ply").up == up
