from dataclasses import fields, replace
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
from sagesplat.formats.labels import sidecar
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


def strict_rows(path: Path) -> np.ndarray:
    """What readers of a fixed layout make of a file: the count in the third line, then rows of 62 floats."""
    with path.open("rb") as file:
        lines = []
        while (line := file.readline().decode().rstrip("\n")) != "end_header":
            lines.append(line)
        body = file.read()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    element, vertex, count = lines[2].split()
    assert (element, vertex) == ("element", "vertex")
    properties = [line.split()[1:] for line in lines if line.startswith("property")]
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    names += [f"f_rest_{i}" for i in range(45)]
    names += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    assert properties == [["float", name] for name in names]
    assert len(body) == int(count) * 62 * 4
    return np.frombuffer(body, "<f4").reshape(int(count), 62)


def split(path: Path) -> tuple[bytes, bytes]:
    head, _, body = path.read_bytes().partition(b"end_header\n")
    return head, body


def foreign(path: Path, columns: dict[str, np.ndarray], order: str = "<", extra: str = "") -> None:
    kinds = {
        "f2": "half",
        "f4": "float",
        "f8": "double",
        "i4": "int",
        "u1": "uchar",
        "u2": "ushort",
        "u4": "uint",
    }
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
    shN = floats(bases, 3)
    shN[:, -1:] = 1  # a degree of zeros is left out
    written = Gaussians(
        means=floats(3),
        quats=quats,
        log_scales=floats(3),
        logit_opacities=floats(),
        sh0=floats(1, 3),
        shN=shN,
        label_ids=torch.from_numpy(labels),
    )
    for inside in (False, True):
        write_ply(tmp_path / "a.ply", written, labels_inside=inside)
        if count:
            assert same(written, read_ply(tmp_path / "a.ply"))


def test_more_rows_than_a_block(tmp_path):
    written = make(10_000, 3)
    write_ply(tmp_path / "a.ply", written)
    assert same(written, read_ply(tmp_path / "a.ply"))


@pytest.mark.parametrize("bases", [0, 3, 8, 15])
def test_readers_of_the_published_layout_read_it(tmp_path, bases):
    g = make(5, bases)
    write_ply(tmp_path / "a.ply", g, {67: "dining table"}, antialiased=True)
    rows = strict_rows(tmp_path / "a.ply")
    np.testing.assert_array_equal(rows[:, :3], g.means)
    assert (rows[:, 3:6] == 0).all()
    np.testing.assert_array_equal(rows[:, 6:9], g.sh0[:, 0])
    rest = rows[:, 9:54].reshape(5, 3, 15)  # all of red first
    np.testing.assert_array_equal(rest[:, :, :bases], g.shN.transpose(1, 2))
    assert (rest[:, :, bases:] == 0).all()
    np.testing.assert_array_equal(rows[:, 54], g.logit_opacities)
    np.testing.assert_array_equal(rows[:, 55:58], g.log_scales)
    np.testing.assert_array_equal(rows[:, 58:], g.quats)
    assert read_ply(tmp_path / "a.ply").sh_degree == g.sh_degree
    assert read_splat(tmp_path / "a.ply").antialiased


def test_labels_are_beside_or_inside(tmp_path):
    path, names = tmp_path / "a.ply", {3: "vase", 67: "dining  table"}
    g = replace(make(5, 15), label_ids=torch.tensor([3, 3, -1, 67, 67], dtype=torch.int16))
    for inside in (False, True):
        write_ply(path, g, names, labels_inside=inside)
        assert sidecar(path).exists() != inside
        assert same(read_ply(path), g)
        splat = read_splat(path)
        assert same(splat.gaussians, g)
        assert splat.names == {3: "vase", 67: "dining table" if inside else "dining  table"}
    head, body = split(path)
    lines = head.decode().splitlines()
    assert lines[2] == "element vertex 5"
    assert [line for line in lines if line.startswith("comment label")] == [
        "comment label 3 vase",
        "comment label 67 dining table",
    ]
    assert lines[2 + 62 + 1] == "property short label"
    assert len(body) == 5 * (62 * 4 + 2)
    write_ply(path, g)
    write_ply(path, replace(g, label_ids=torch.full((5,), -1, dtype=torch.int16)))
    assert not sidecar(path).exists()


@pytest.mark.parametrize("bases", [0, 3, 8, 15])
@pytest.mark.parametrize("order", ["<", ">"])
def test_other_tools(tmp_path, bases, order):
    g = make(50, bases)
    columns = {"red": np.zeros(50, np.uint8), **columns_of(g)}
    columns["opacity"] = columns["opacity"].astype(np.float64)
    g.quats[:] = g.quats.half()
    columns |= {f"rot_{i}": g.quats[:, i].numpy().astype(np.float16) for i in range(4)}
    faces = "element face 3\nproperty list uchar int vertex_indices\nproperty float x\n"
    foreign(tmp_path / "a.ply", columns, order, faces)
    read = read_ply(tmp_path / "a.ply")
    assert (read.label_ids == -1).all()
    assert read.sh_degree == g.sh_degree
    assert same(read, Gaussians(**{**vars(g), "label_ids": torch.full((50,), -1, dtype=torch.int16)}))


def smoothed(g: Gaussians, width: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Log scales and logits as Mip-Splatting's paper has them, in its own terms."""
    variances = np.exp(g.log_scales.numpy().astype(np.float64)) ** 2
    wider = variances + width[:, None] ** 2
    opacities = 1 / (1 + np.exp(-g.logit_opacities.numpy().astype(np.float64)))
    opacities *= np.sqrt(variances.prod(1) / wider.prod(1))
    return np.log(np.sqrt(wider)), np.log(opacities / (1 - opacities))


@pytest.mark.parametrize("form", ["<", ">", "text", "double"])
@pytest.mark.parametrize("name", ["filter_3D", "filter_3d"])
def test_the_filter_of_mip_splatting_is_folded_in(tmp_path, form, name):
    g = make(30, 3)
    width = np.random.default_rng(0).uniform(0, 2, 30).astype(np.float32)
    width[0] = 0
    columns = {name: width, **columns_of(g)}
    if form == "text":
        as_text(tmp_path / "a.ply", columns)
    else:
        kind = np.float64 if form == "double" else np.float32
        columns = {key: column.astype(kind) for key, column in columns.items()}
        foreign(tmp_path / "a.ply", columns, ">" if form == ">" else "<")
    splat = read_splat(tmp_path / "a.ply")
    log_scales, logits = smoothed(g, width.astype(np.float64))
    np.testing.assert_allclose(splat.gaussians.log_scales, log_scales, atol=1e-5)
    np.testing.assert_allclose(splat.gaussians.logit_opacities, logits, atol=1e-5, rtol=1e-5)
    np.testing.assert_allclose(splat.gaussians.log_scales[0], g.log_scales[0], atol=1e-6)
    assert splat.notes == (f"{name} (Mip-Splatting) is a part of the scales and opacities now",)


def as_text(path: Path, columns: dict[str, np.ndarray], before: str = "", rows: str = "") -> None:
    count = len(next(iter(columns.values())))
    lines = ["ply", "format ascii 1.0", *before.splitlines(), f"element vertex {count}"]
    lines += [*(f"property float {name}" for name in columns), "end_header", *rows.splitlines()]
    table = np.stack(list(columns.values()), 1)
    lines += [" ".join(repr(float(value)) for value in row) for row in table]
    path.write_text("\n".join(lines) + "\n")


def test_text_and_elements_before_the_vertices(tmp_path):
    g = make(20, 8)
    columns = columns_of(g)
    bare = replace(g, label_ids=torch.full((20,), -1, dtype=torch.int16))
    lists = "element face 2\nproperty uchar flag\nproperty list uchar int vertex_indices\n"
    lists += "element nothing 3\nelement camera 1\nproperty double fx\n"
    as_text(tmp_path / "a.ply", columns, lists, "7 3 0 1 2\n8 0\n500.5")
    assert same(read_ply(tmp_path / "a.ply"), bare)
    for order in "<>":
        foreign(tmp_path / "a.ply", columns, order)
        head, body = split(tmp_path / "a.ply")
        head = head.replace(b"element vertex", lists.encode() + b"element vertex")
        first = np.array([0, 1, 2], order + "i4").tobytes()
        rows = b"\7\3" + first + b"\x08\0" + np.array([500.5], order + "f8").tobytes()
        (tmp_path / "a.ply").write_bytes(head + b"end_header\n" + rows + body)
        assert same(read_ply(tmp_path / "a.ply"), bare)
        (tmp_path / "a.ply").write_bytes(head + b"end_header\n" + rows[:4])
        refused(tmp_path / "a.ply", "ends in its element face")
        (tmp_path / "a.ply").write_bytes(head.replace(b"face 2", b"face 9") + b"end_header\n" + rows[:1])
        refused(tmp_path / "a.ply", "ends in its element face")


def test_comments_of_any_length(tmp_path):
    g = make(5, 0)
    foreign(tmp_path / "a.ply", columns_of(g))
    content = (tmp_path / "a.ply").read_bytes()
    for size in (1015, 1016, 1017, 5000):
        long = content.replace(b"comment by hand", b"comment " + b"x" * size)
        (tmp_path / "a.ply").write_bytes(long)
        assert torch.equal(read_ply(tmp_path / "a.ply").means, g.means)


def test_degree_4_is_cut_and_colours_are_read(tmp_path):
    g = make(9, 15)
    columns = columns_of(g)
    rest = np.random.default_rng(0).normal(size=(3, 24, 9)).astype(np.float32)
    rest[:, :15] = g.shN.numpy().transpose(2, 1, 0)
    columns |= {f"f_rest_{i}": column for i, column in enumerate(rest.reshape(72, 9))}
    foreign(tmp_path / "a.ply", columns)
    splat = read_splat(tmp_path / "a.ply")
    assert torch.equal(splat.gaussians.shN, g.shN)
    assert splat.notes == ("harmonics of degree 4 are left out; degrees 0 to 3 are kept",)
    plain = {name: column for name, column in columns.items() if not name.startswith("f_")}
    bytes_ = {name: np.arange(9, dtype=np.uint8) * (i + 9) for i, name in enumerate(("red", "green", "blue"))}
    for colours in (bytes_, {name: column.astype(np.float64) / 255 for name, column in bytes_.items()}):
        foreign(tmp_path / "a.ply", plain | colours)
        splat = read_splat(tmp_path / "a.ply")
        expected = np.stack(list(bytes_.values()), 1) / 255
        np.testing.assert_allclose(splat.gaussians.sh0[:, 0] * 0.28209479 + 0.5, expected, atol=1e-6)
        assert splat.notes == ("colours are red, green and blue: it has no f_dc",)


def test_what_is_not_read_is_named_once(tmp_path):
    more: dict[str, np.ndarray] = {f"obj_dc_{i}": np.zeros(3, np.float32) for i in range(16)}
    more |= {
        "confidence": np.ones(3, np.float32),
        "nx": np.zeros(3, np.float32),
        "red": np.zeros(3, np.uint8),
    }
    foreign(tmp_path / "a.ply", columns_of(make(3, 3)) | more)
    splat = read_splat(tmp_path / "a.ply")
    assert splat.notes == ("properties that are not read: confidence, obj_dc_* (16)",)


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
        (b"binary_little_endian", b"ascii", "not readable as a PLY file"),
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
    assert sorted(tmp_path.iterdir()) == [path, sidecar(path)]


@pytest.mark.parametrize(
    ("comments", "up"),
    [
        (("Generated by Nerstudio 1.1.5", "Vertical Axis: z"), "z"),  # as it misspells itself
        (("Generated by Nerfstudio 1.2.0", "Vertical axis: z"), "z"),
        (("Exported from Brush", "Vertical axis: y"), "auto"),
        (("Vertical Axis: z",), "auto"),
        (("generated by NERFSTUDIO", "Vertical  Axis:Z"), "z"),
        (("Generated by Nerfstudio 1.2.0",), "auto"),
    ],
)
def test_up_is_believed_where_nerfstudio_wrote_it(tmp_path, comments, up):
    write_ply(tmp_path / "a.ply", random_gaussians(5))
    content = (tmp_path / "a.ply").read_bytes()
    lines = b"".join(f"comment {comment}\n".encode() for comment in comments)
    (tmp_path / "a.ply").write_bytes(content.replace(b"element vertex", lines + b"element vertex", 1))
    assert read_splat(tmp_path / "a.ply").up == up
