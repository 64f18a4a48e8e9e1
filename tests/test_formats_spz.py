"""SPZ files: bytes by hand, a file of another writer, both axes by rendering, hostile bytes."""

import struct
import zlib
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st

from sagesplat.core.errors import DataError
from sagesplat.core.gaussians import PARAMETERS, Gaussians
from sagesplat.core.sh import bases
from sagesplat.core.transform import placed
from sagesplat.formats.quantisation import (
    COLOUR_STEP,
    PER_COLOUR,
    PER_LOG_SCALE,
    SCALE_STEP,
    in_buckets,
    in_steps,
    rounded,
)
from sagesplat.formats.spz import (
    MAX_COUNT,
    decode_spz,
    encode_spz,
    read_spz,
    read_spz_splat,
    write_spz,
)
from sagesplat.raster import rasterize
from sagesplat.raster.reference import rotation_matrices
from sagesplat.scene.scene import Camera
from tests.conftest import damage, pinhole, random_gaussians

DATA = Path(__file__).parent / "data"


def pack(raw: bytes) -> bytes:
    packer = zlib.compressobj(9, zlib.DEFLATED, 31)
    return packer.compress(raw) + packer.flush()


def header(count: int, *, version: int = 3, degree: int = 0, bits: int = 12, flags: int = 0) -> bytes:
    return struct.pack("<4sIIBBBB", b"NGSP", version, count, degree, bits, flags, 0)


def one(**changes: list) -> Gaussians:
    """A Gaussian at the origin, or what the changes make of it."""
    values = {
        "means": [0.0, 0.0, 0.0],
        "quats": [1.0, 0.0, 0.0, 0.0],
        "log_scales": [0.0, 0.0, 0.0],
        "sh0": [[0.0, 0.0, 0.0]],
        "shN": np.zeros((0, 3)).tolist(),
        **changes,
    }
    tensors = {key: torch.tensor([value], dtype=torch.float32) for key, value in values.items()}
    shN = tensors.pop("shN").reshape(1, -1, 3)
    logits = tensors.pop("logit_opacities", torch.zeros(1)).reshape(1)
    return Gaussians(
        **tensors, shN=shN, logit_opacities=logits, label_ids=torch.full((1,), -1, dtype=torch.int16)
    )


def rotations(quats: torch.Tensor) -> torch.Tensor:
    """Unit quaternions whose first component that counts is positive."""
    unit = quats.double() / quats.double().norm(dim=1, keepdim=True)
    return unit * unit.gather(1, unit.abs().argmax(1, keepdim=True)).sign()


def test_the_bytes_of_one_gaussian():
    g = one(
        means=[1.0, -2.0, 0.25],
        quats=[0.5, -0.5, 0.1, 0.7],
        log_scales=[-10.0, 0.0, 20.0],
        logit_opacities=[0.0],
        sh0=[[0.0, 2.0, -9.0]],
        shN=[[0.1, -0.1, 2.0], [0.0, 0.0, 0.0], [-2.0, 0.5, 0.06]],
    )
    raw = zlib.decompress(encode_spz(g, fractional_bits=12, antialiased=True, frame="rdf"), 31)
    # |q| = 1; the largest is z, number 2; x, y, w follow, times 511 sqrt 2
    rotation = 2 << 30 | (512 | 361) << 20 | 72 << 10 | 361
    expected = b"NGSP" + struct.pack("<IIBBBB", 3, 1, 1, 12, 1, 0)
    expected += bytes([0x00, 0x10, 0x00, 0x00, 0xE0, 0xFF, 0x00, 0x04, 0x00])
    expected += bytes([128, 128, 204, 0, 0, 160, 255]) + struct.pack("<I", rotation)
    expected += bytes([144, 112, 255, 128, 128, 128, 0, 192, 136])
    assert raw == expected


def test_the_values_of_one_gaussian():
    rotation = 3 << 30 | (512 | 361) << 20 | 0 << 10 | 361  # w left out: x < 0, y = 0, z > 0
    body = bytes([0, 0x10, 0, 0, 0xE0, 0xFF, 1, 0, 0x80]) + bytes([51, 128, 0, 255, 0, 160, 255])
    g = decode_spz(pack(header(1) + body + struct.pack("<I", rotation)), 7, frame="rdf")
    assert g.means[0].tolist() == [1.0, -2.0, (1 - 2**23) / 4096]
    assert g.logit_opacities.sigmoid() == pytest.approx(0.2)
    assert g.sh0[0, 0].numpy() == pytest.approx([0.5 / 255 / 0.15, -0.5 / 0.15, 0.5 / 0.15])
    assert g.log_scales[0].tolist() == [-10.0, 0.0, 5.9375]
    third = 361 / 511 * 0.5**0.5
    assert g.quats[0].numpy() == pytest.approx([(1 - 2 * third**2) ** 0.5, -third, 0, third])
    assert g.shN.shape == (1, 0, 3)
    assert g.label_ids.tolist() == [7]


def test_version_2_keeps_three_parts_of_a_rotation():
    body = bytes(9) + bytes([128, 128, 128, 128, 160, 160, 160]) + bytes([0, 127, 128])
    g = decode_spz(pack(header(1, version=2) + body), frame="rdf")
    assert g.quats[0].numpy() == pytest.approx([0, -1, -1 / 255, 1 / 255], abs=1e-6)


def test_a_file_of_gsply_reads_as_it_reads_it():
    """tests/data/gsply.spz and .npz: gsply 0.4.6 (MIT) wrote the one and read it back for the other."""
    g = read_spz(DATA / "gsply.spz", frame="rdf")
    with np.load(DATA / "gsply.npz") as golden:
        for key in PARAMETERS:
            assert np.allclose(getattr(g, key).numpy(), golden[key], rtol=0, atol=2e-5), key


@settings(max_examples=60)
@given(
    seed=st.integers(0, 2**31),
    count=st.integers(0, 30),
    degree=st.integers(0, 3),
    extent=st.floats(1e-3, 1e6),
    frame=st.sampled_from(["rub", "rdf"]),
)
def test_round_trip_within_half_a_step(seed, count, degree, extent, frame):
    g = random_gaussians(count, seed=seed, degree=degree)
    g = replace(g, means=(g.means - torch.tensor([0, 0, 4.0])) * extent)
    content = encode_spz(g, frame=frame)
    back = decode_spz(content, frame=frame)
    step = 2.0 ** -zlib.decompress(content, 31)[13]
    assert back.sh_degree == degree
    assert (back.label_ids == -1).all()
    assert ((back.means - g.means).abs() <= step * 0.501 + g.means.abs() * 1e-6).all()
    assert ((back.log_scales - g.log_scales.clamp(-10, 5.9375)).abs() <= 1 / 32 + 1e-5).all()
    assert ((back.logit_opacities.sigmoid() - g.logit_opacities.sigmoid()).abs() <= 0.5 / 255 + 1e-5).all()
    assert ((back.sh0 - g.sh0.clamp(-0.5 / 0.15, 0.5 / 0.15)).abs() <= 0.5 / 38.25 + 1e-5).all()
    assert ((rotations(back.quats) * rotations(g.quats)).sum(1).abs() > 1 - 1e-5).all()
    assert ((back.shN[:, :3] - g.shN[:, :3]).abs() <= 1 / 32 + 1e-6).all()
    assert ((back.shN[:, 3:] - g.shN[:, 3:]).abs() <= 1 / 16 + 1e-6).all()


def test_a_second_round_changes_no_byte():
    content = encode_spz(random_gaussians(200), fractional_bits=12)
    assert encode_spz(decode_spz(content), fractional_bits=12) == content


def turned(camera: Camera) -> Camera:
    """The same camera in a world whose y and z point the other way."""
    w2c = camera.w2c.copy()
    w2c[:, 1:3] *= -1
    return replace(camera, w2c=w2c)


def test_a_turned_scene_looks_the_same_to_a_turned_camera():
    g = random_gaussians(150, seed=3)
    g = replace(g, shN=g.shN * 3)  # so that a wrong sign shows
    content = encode_spz(g)
    there, here = decode_spz(content, frame="rdf"), decode_spz(content)
    assert torch.equal(there.means, here.means * torch.tensor([1.0, -1.0, -1.0]))
    expected = rasterize(here, pinhole()).rgb
    assert torch.allclose(rasterize(there, turned(pinhole())).rgb, expected, atol=1e-4)
    for base in range(15):  # every sign counts
        signs = torch.ones(15, 1)
        signs[base] = -1
        wrong = rasterize(replace(there, shN=there.shN * signs), turned(pinhole())).rgb
        assert (wrong - expected).abs().max() > 0.01


def test_the_decoded_scene_looks_like_the_scene():
    g = random_gaussians(150, seed=4)
    image, decoded = (rasterize(x, pinhole()).rgb for x in (g, decode_spz(encode_spz(g, sh_bits=(8, 8)))))
    assert (image - decoded).square().mean() < 1e-4


def test_same_bytes_every_time(tmp_path):
    g = random_gaussians(50)
    size = write_spz(tmp_path / "a.spz", g, antialiased=True)
    content = (tmp_path / "a.spz").read_bytes()
    assert content == encode_spz(g, antialiased=True)
    assert size == len(content)
    assert content[4:8] == bytes(4)  # no time in the gzip header
    assert len(read_spz(tmp_path / "a.spz", 3).of_labels([3])) == 50


def test_coarse_files_hold_what_training_draws_and_are_smaller():
    g = random_gaussians(2000, degree=3)
    fine, coarse = encode_spz(g), encode_spz(g, coarse=True)
    assert len(coarse) < 0.93 * len(fine)
    back = decode_spz(coarse)
    drawn = rounded(g, (5, 4))
    for name in ("sh0", "log_scales", "shN"):
        assert torch.allclose(getattr(back, name), getattr(drawn, name), atol=1e-6), name
    assert (torch.sigmoid(back.logit_opacities) - torch.sigmoid(g.logit_opacities)).abs().max() < 2.01 / 255
    alike = (rotations(back.quats) * rotations(g.quats)).sum(1).abs()
    assert torch.rad2deg(2 * torch.arccos(alike.clamp(max=1))).max() < 2
    half_a_step = torch.exp(g.log_scales).sort(1)[0][:, 1].quantile(0.1) / 4
    assert (back.means - g.means).abs().max() <= half_a_step


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_rounding_some_rows_is_rounding_all_of_them_bit_for_bit(degree):
    g = random_gaussians(500, degree=degree)
    g = replace(g, shN=3 * g.shN)  # some beyond what buckets hold
    rows = torch.from_numpy(np.random.default_rng(0).permutation(500)[:200])
    whole, some = rounded(g, (5, 4)), rounded(g, (5, 4), rows)
    for name, value in whole.select(rows).parameters().items():
        assert torch.equal(getattr(some, name), value), name
    assert torch.equal(whole.shN, in_buckets(g.shN, (5, 4)))
    assert torch.equal(whole.log_scales, in_steps(g.log_scales, SCALE_STEP / PER_LOG_SCALE))
    assert torch.equal(whole.sh0, (in_steps(g.sh0 * PER_COLOUR + 127.5, COLOUR_STEP) - 127.5) / PER_COLOUR)
    assert torch.equal(some.label_ids, g.label_ids[rows])


@pytest.mark.parametrize("sh_bits", [(5, 4), (8, 8)])
def test_harmonics_of_zero_stay_zero_and_cost_nothing(sh_bits):
    g = random_gaussians(2000)
    without = replace(g, shN=torch.zeros_like(g.shN))
    content = encode_spz(without, sh_bits=sh_bits)
    assert (decode_spz(content).shN == 0).all()
    assert len(content) - len(encode_spz(replace(g, shN=g.shN[:, :0]))) < 2000 * 45 / 200


def test_positions_take_the_bits_that_fit():
    def bits(g: Gaussians, wanted: int | None = None) -> int:
        return zlib.decompress(encode_spz(g, fractional_bits=wanted), 31)[13]

    assert bits(one(means=[3000.0, 0, 0], log_scales=[-9.0, -9.0, -9.0])) == 11  # the extent
    assert bits(one(means=[3.0, 0, 0], log_scales=[-9.0, -9.0, 0.0])) == 16  # an eighth of exp(-9)
    assert bits(one(log_scales=[9.0, 9.0, 9.0])) == 1
    assert bits(one(), 0) == 0
    far = one(means=[2.0**23 - 1, 0, 1 - 2.0**23])
    assert torch.equal(decode_spz(encode_spz(far)).means, far.means)
    with pytest.raises(DataError, match=r"a\.spz: positions reach 1e\+08.*scale the scene down"):
        encode_spz(one(means=[1e8, 0, 0]), name="a.spz")
    with pytest.raises(DataError, match="positions up to 5 allow 0 to 20"):
        encode_spz(one(means=[5.0, 0, 0]), fractional_bits=21)


@pytest.mark.parametrize("key", PARAMETERS)
def test_nan_and_inf_are_refused(tmp_path, key):
    g = random_gaussians(5)
    getattr(g, key).view(-1)[3] = float("inf")
    with pytest.raises(DataError, match=rf"a\.spz: 1 values of {key} are NaN or infinite"):
        write_spz(tmp_path / "a.spz", g)
    assert not list(tmp_path.iterdir())


def test_a_rotation_of_zeros_is_refused():
    with pytest.raises(DataError, match="1 Gaussians have a rotation of zeros"):
        encode_spz(one(quats=[0.0, 0, 0, 0]))


@settings(max_examples=60)
@given(values=st.lists(st.floats(width=32, allow_nan=False, allow_infinity=False), min_size=62, max_size=62))
def test_any_finite_values_are_written_or_refused(values):
    flat = torch.tensor(values, dtype=torch.float32)
    quats = torch.where(flat[3:7].any(), flat[3:7], torch.ones(4))
    g = Gaussians(
        means=flat[None, :3].clamp(-8e6, 8e6),
        quats=quats[None],
        log_scales=flat[None, 7:10],
        logit_opacities=flat[10:11],
        sh0=flat[None, None, 11:14],
        shN=flat[None, 14:59].reshape(1, 15, 3),
        label_ids=torch.zeros(1, dtype=torch.int16),
    )
    back = decode_spz(encode_spz(g))
    assert all(p.isfinite().all() for p in back.parameters().values())


GOOD = encode_spz(random_gaussians(12, degree=1))


@settings(max_examples=300)
@given(data=st.data(), inside=st.booleans())
def test_damaged_bytes_give_gaussians_or_a_data_error(data, inside):
    content = pack(damage(zlib.decompress(GOOD, 31), data)) if inside else damage(GOOD, data)
    with suppress(DataError):
        g = decode_spz(content)
        assert all(p.isfinite().all() for p in g.parameters().values())
        assert g.quats.any(1).all()


BODY = bytes(20)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"ply\nformat", "not gzip, or damaged"),
        (pack(b"ply\nformat binary_little_endian 1.0\n"), "not an SPZ file; unpack it with gunzip"),
        (pack(header(1, version=5) + BODY), "SPZ version 5 is not supported"),
        (pack(header(1, version=1) + BODY), "not the 1 Gaussians announced"),
        (pack(header(1, flags=4) + BODY), "an LOD tree"),
        (pack(header(1, flags=2) + BODY + b"1234567"), "damaged"),
        (header(MAX_COUNT, version=4) + bytes(16), "10000000 Gaussians announced, more than fit"),
        (pack(header(1, degree=5) + BODY), "SH degree 5"),
        (pack(header(1) + BODY[1:]), "not the 1 Gaussians announced"),
        (pack(header(10) + bytes(10**7)), "not the 10 Gaussians announced"),  # a bomb: read no further
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_other_files_are_refused(tmp_path, content, message):
    (tmp_path / "a.spz").write_bytes(content)
    with pytest.raises(DataError, match=rf"a\.spz: .*{message}"):
        read_spz(tmp_path / "a.spz")


def seen(g: Gaussians, direction: np.ndarray) -> np.ndarray:
    """Colours [N, 3] in a direction, without the constant one."""
    return np.einsum("k,nkc->nc", np.array(bases(*direction)[1 : 1 + g.shN.shape[1]]), g.shN)


# Of the extension SPZ_ADOBE_coordinate_system: where x, y and z point to, from 1 on.
AXES = ["ldb", "rdb", "lub", "rub", "ldf", "rdf", "luf", "ruf"]
AXES += ["lfd", "rfd", "lfu", "rfu", "lbd", "rbd", "lbu", "rbu"]


@pytest.mark.parametrize("value", range(1, 17))
def test_axes_are_those_that_the_file_names(tmp_path, value):
    g = random_gaussians(20, degree=2, seed=value)
    content = encode_spz(g, version=4, frame="rdf")
    record = struct.pack("<II", 0xADBE0003, 4)
    assert content.count(record + struct.pack("<I", 6)) == 1
    (tmp_path / "a.spz").write_bytes(
        content.replace(record + struct.pack("<I", 6), record + struct.pack("<I", value))
    )
    splat = read_spz_splat(tmp_path / "a.spz")
    stored, read = decode_spz(content, frame="rdf"), splat.gaussians
    assert bool(splat.notes) == (value in (9, 10, 15, 16))  # where SPZ's library has another sign
    ours = {"r": [1, 0, 0], "l": [-1, 0, 0], "d": [0, 1, 0], "u": [0, -1, 0], "f": [0, 0, 1], "b": [0, 0, -1]}
    matrix = np.eye(4)
    matrix[:3, :3] = np.array([ours[axis] for axis in AXES[value - 1]]).T
    np.testing.assert_allclose(read.means, stored.means.numpy() @ matrix[:3, :3].T, atol=1e-6)
    expected = placed(stored, matrix)
    torch.testing.assert_close(shapes(read), shapes(expected), atol=1e-5, rtol=1e-4)
    direction = np.array([0.3, 0.8, -((1 - 0.73) ** 0.5)])
    np.testing.assert_allclose(seen(read, matrix[:3, :3] @ direction), seen(stored, direction), atol=1e-5)


def shapes(g: Gaussians) -> torch.Tensor:
    axes = rotation_matrices(g.quats.double()) * g.log_scales.double().exp()[:, None]
    return axes @ axes.mT


def test_degree_4_is_cut_to_3(tmp_path):
    g = random_gaussians(9, degree=3, seed=4)
    raw = zlib.decompress(encode_spz(g), 31)
    at = 16 + 9 * 20
    wide = np.full((9, 24, 3), 7, np.uint8)
    wide[:, :15] = np.frombuffer(raw, np.uint8, 9 * 45, at).reshape(9, 15, 3)
    (tmp_path / "a.spz").write_bytes(pack(raw[:12] + b"\4" + raw[13:at] + wide.tobytes()))
    splat = read_spz_splat(tmp_path / "a.spz")
    assert torch.equal(splat.gaussians.shN, decode_spz(encode_spz(g)).shN)
    assert splat.notes == ("harmonics of degree 4 are left out; degrees 0 to 3 are kept",)


def test_version_1_has_half_floats():
    means = np.array([[1.5, -2.25, 1000], [0, 0.125, -3]], "<f2")
    body = (
        means.tobytes() + bytes([127, 128]) + bytes([127] * 6) + bytes([160] * 6) + bytes([255, 128, 128] * 2)
    )
    g = decode_spz(pack(header(2, version=1) + body), frame="rdf")
    assert g.means.tolist() == means.astype(float).tolist()
    np.testing.assert_allclose(g.quats[0], [0, 1, 1 / 255, 1 / 255], atol=1e-2)
    assert g.log_scales.tolist() == [[0.0] * 3] * 2


def test_extensions_of_version_3(tmp_path):
    g = random_gaussians(9, degree=1, seed=5)
    raw = zlib.decompress(encode_spz(g, frame="rdf"), 31)
    more = struct.pack("<III", 0x12340001, 4, 0) + struct.pack("<III", 0xADBE0003, 4, 6)
    (tmp_path / "a.spz").write_bytes(pack(raw[:14] + b"\2" + raw[15:] + more))
    assert torch.equal(
        read_spz_splat(tmp_path / "a.spz").gaussians.means, decode_spz(pack(raw), frame="rdf").means
    )


def test_version_3_keeps_labels_that_change_with_each_row(tmp_path):
    """Readers that know no records, such as Spark, see the same attributes before them."""
    g = replace(random_gaussians(6000, degree=0), label_ids=(torch.arange(6000) % 2 * 12345).to(torch.int16))
    write_spz(tmp_path / "a.spz", g, names={0: "tree", 12345: "sky"}, parents={0: "plant"})
    splat = read_spz_splat(tmp_path / "a.spz")
    assert torch.equal(splat.gaussians.label_ids, g.label_ids)
    assert (splat.kind, splat.names, splat.parents) == ("SPZ 3", {0: "tree", 12345: "sky"}, {0: "plant"})
    bare, kept = (
        zlib.decompress(content, 31) for content in (encode_spz(g), (tmp_path / "a.spz").read_bytes())
    )
    assert kept[16 : len(bare)] == bare[16:]
    assert (bare[14], kept[14]) == (0, 2)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_version_4_holds_what_version_3_does(degree):
    g = random_gaussians(200, degree=degree, seed=5)
    content = encode_spz(g, version=4, antialiased=True)
    assert content[:16] == header(200, version=4, degree=degree, flags=1, bits=content[13])[:15] + bytes(
        [5 + (degree > 0)]
    )
    three, four = decode_spz(encode_spz(g)), decode_spz(content)
    assert all(torch.equal(getattr(three, name), getattr(four, name)) for name in PARAMETERS)
    assert encode_spz(g, version=4, antialiased=True) == content


def test_version_4_keeps_labels_and_axes(tmp_path):
    g = random_gaussians(50, seed=6)
    g = replace(g, label_ids=torch.arange(50, dtype=torch.int16) // 20 - 1)
    write_spz(tmp_path / "a.spz", g, version=4, names={0: "tree", 7: "none"}, frame="luf")
    splat = read_spz_splat(tmp_path / "a.spz", frame="rdf")
    assert torch.equal(splat.gaussians.label_ids, g.label_ids)
    assert (splat.kind, splat.names) == ("SPZ 4", {0: "tree"})
    direct = decode_spz(encode_spz(g))
    assert all(torch.equal(getattr(splat.gaussians, name), getattr(direct, name)) for name in PARAMETERS[2:5])
    torch.testing.assert_close(splat.gaussians.means, direct.means, atol=1e-3, rtol=0)
    torch.testing.assert_close(rotations(splat.gaussians.quats), rotations(direct.quats), atol=0.01, rtol=0)
    torch.testing.assert_close(splat.gaussians.shN, direct.shN, atol=0.13, rtol=0)


def version_4(count: int = 1, *, extensions: bytes = b"", sizes: tuple[int, ...] = (9, 1, 3, 3, 4)) -> bytes:
    """Gaussians of zeros, with streams of these sizes."""
    streams = [zstandard.compress(bytes(size)) for size in sizes]
    head = struct.pack("<4sIIBBBBI12x", b"NGSP", 4, count, 0, 12, 2, len(sizes), 32 + len(extensions))
    table = b"".join(struct.pack("<QQ", len(s), size) for s, size in zip(streams, sizes, strict=True))
    return head + extensions + table + b"".join(streams)


def test_version_4_skips_what_others_added(tmp_path):
    (tmp_path / "a.spz").write_bytes(version_4(extensions=struct.pack("<II3s", 0x12340001, 3, b"abc")))
    assert len(read_spz_splat(tmp_path / "a.spz").gaussians) == 1


BOMB = zstandard.ZstdCompressor(write_content_size=False).compress(bytes(10**7))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (version_4(sizes=(9, 1, 3, 3)), "4 streams in place of 5"),
        (version_4(2), "9 bytes in place of 18"),
        (version_4() + b"x", "1 bytes after the last stream"),
        (version_4(extensions=struct.pack("<II", 1, 9)), "an extension is cut off"),
        (version_4(extensions=struct.pack("<II2s", 0x53470001, 2, b"{}")), "damaged labels"),
        (
            version_4()[:32] + struct.pack("<QQ", len(BOMB), 9) + version_4()[48:112] + BOMB,
            "damaged",
        ),  # a frame that does not say how large it is
    ],
)
def test_damaged_version_4(tmp_path, content, message):
    (tmp_path / "a.spz").write_bytes(content)
    with pytest.raises(DataError, match=rf"a\.spz: .*{message}"):
        read_spz_splat(tmp_path / "a.spz")


@pytest.mark.parametrize("size", [1e-30, 1.0, 1e30])
def test_rotations_of_any_length(size):
    g = one(quats=[size, -size, size / 2, 0.0])
    assert torch.allclose(rotations(decode_spz(encode_spz(g)).quats), rotations(g.quats), atol=2e-3)
