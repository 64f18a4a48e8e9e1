"""Coded streams: what comes back, cuts at every level, golden bytes, damage."""

import base64
import json
from contextlib import suppress
from dataclasses import replace
from random import Random
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from make_stream_vectors import DATA, Case, cases

from sagesplat.core.errors import DataError
from sagesplat.core.gaussians import PARAMETERS, Gaussians
from sagesplat.core.second_opacity import SecondOpacities, blended
from sagesplat.formats.stream import MAX_COUNT, decode_stream, encode_stream, palette_of, starts_of_streams
from sagesplat.formats.stream_header import AS_GIVEN, SIZE, Precision, harmonics_of, turned_round
from sagesplat.formats.stream_palette import Palette, read_palette
from tests.conftest import random_gaussians
from tests.fuzz.mutate import BYTES

SIZES = [3, 3, 40, 200]
FINE = Precision(1 / 250, 1, 0.25, 1 / 64, (8, 8), 5.0)
WEIGHTS = (0.0, 0.0, 0.4, 1.0)


def visible(count: int = 200, **options: int) -> Gaussians:
    return random_gaussians(count, logit=4, **options)


def seconds(g: Gaussians, weights: tuple[float, ...] = WEIGHTS) -> SecondOpacities:
    return SecondOpacities(g.logit_opacities.flip(0) - 1, {3: weights})


def bytes_of(logits: torch.Tensor) -> torch.Tensor:
    return torch.round(torch.sigmoid(logits.double()) * 255)


def assert_equal(a: Gaussians, b: Gaussians) -> None:
    for name in PARAMETERS:
        torch.testing.assert_close(getattr(a, name), getattr(b, name), rtol=0, atol=0)


def covariances(g: Gaussians) -> torch.Tensor:
    q = torch.nn.functional.normalize(g.quats.double(), dim=1)
    w, x, y, z = q.unbind(1)
    rows = [
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], 1),
        torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], 1),
        torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], 1),
    ]
    axes = torch.stack(rows, 1) * g.log_scales.double().exp()[:, None]
    return axes @ axes.transpose(1, 2)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_everything_comes_back_within_half_a_step(degree: int):
    g = visible(degree=degree)
    coded = encode_stream(g, SIZES, precision=FINE, antialiased=True)
    found = decode_stream(coded.content, label_id=7)
    assert found.sizes == coded.sizes == tuple(SIZES)
    assert found.antialiased
    assert (found.gaussians.label_ids == 7).all()
    g, h = g.select(torch.from_numpy(coded.rows)), found.gaussians
    step = np.median(np.sort(g.log_scales.exp().numpy(), 1)[:, 1]) / 250
    torch.testing.assert_close(h.means, g.means, rtol=0, atol=0.51 * step)
    error = torch.sigmoid(h.logit_opacities) - torch.sigmoid(g.logit_opacities)
    assert error.abs().max() < 0.51 / 255
    torch.testing.assert_close(h.sh0, g.sh0, rtol=0, atol=0.51 * 0.25 / 38.25)
    torch.testing.assert_close(h.shN, g.shN, rtol=0, atol=0.51 / 128)
    sizes = g.log_scales.double().exp().amax(1)[:, None, None] ** 2
    assert ((covariances(h) - covariances(g)) / sizes).abs().max() < 0.04


def test_a_cut_after_a_level_is_the_prefix():
    coded = encode_stream(visible(), SIZES)
    everything = decode_stream(coded.content)
    for level, (end, size) in enumerate(zip(coded.ends, coded.sizes, strict=True), 1):
        for found in (decode_stream(coded.content[:end]), decode_stream(coded.content, level)):
            assert found.sizes == coded.sizes[:level]
            assert_equal(found.gaussians, everything.gaussians.slices([slice(0, size)]))
    assert decode_stream(coded.content[:SIZE]).sizes == ()


def test_streams_that_lie_one_after_the_other_are_found_without_decoding_them():
    g = visible()
    some = [
        encode_stream(g, SIZES, second=seconds(g)).content,
        encode_stream(visible(0), [0]).content,
        encode_stream(visible(20), [20]).content,
    ]
    content, starts = b"".join(some), [0, len(some[0]), len(some[0] + some[1])]
    assert starts_of_streams(content) == starts
    assert starts_of_streams(content[: starts[2] + SIZE]) == starts
    assert starts_of_streams(content[: starts[1] - 1]) == [0]
    assert starts_of_streams(b"") == []
    for wrong, words in (
        (content[:-1] + b"\0SGST", "damaged stream"),
        (some[1] + b"X" * 50, "not a sagesplat-stream"),
        (content[: starts[1] + 40], "not a sagesplat-stream"),
        (some[1] + content[:4] + b"\2" + content[5:], "of version 2"),
        (content[:SIZE] + b"\xff" * 9, "no number"),
    ):
        with pytest.raises(DataError, match=words):
            starts_of_streams(wrong)


def test_a_cut_within_a_level_is_an_error():
    coded = encode_stream(visible(20, degree=1), [1, 10, 20])
    for end in set(range(0, len(coded.content), 3)) - {SIZE, *coded.ends}:
        with pytest.raises(DataError, match="damaged stream"):
            decode_stream(coded.content[:end])
    with pytest.raises(DataError):
        decode_stream(coded.content[: coded.ends[0]], 2)
    with pytest.raises(DataError, match="1 bytes after"):
        decode_stream(coded.content + b"\0")


def test_invisible_gaussians_are_left_out():
    g = visible(10, degree=0)
    g.logit_opacities[[0, 4]] = -6.0
    coded = encode_stream(g, [1, 5, 10])
    assert coded.sizes == (0, 3, 8)
    assert sorted(coded.rows.tolist()) == [1, 2, 3, 5, 6, 7, 8, 9]
    assert len(decode_stream(coded.content).gaussians) == 8


def test_both_opacities_come_back_and_are_blended_by_level():
    g = visible(degree=0)
    second = seconds(g)
    coded = encode_stream(g, SIZES, second=second, precision=FINE)
    found = decode_stream(coded.content, label_id=7)
    assert found.second
    assert coded.weights == found.second.weights[7] == (0.0, 0.0, 0.4, 1.0)
    rows = torch.from_numpy(coded.rows)
    firsts, lasts = g.logit_opacities[rows], second.logits[rows]
    firsts = torch.cat([firsts[:40], lasts[40:]])  # those of the last level have one
    torch.testing.assert_close(bytes_of(found.gaussians.logit_opacities), bytes_of(firsts))
    torch.testing.assert_close(bytes_of(found.second.logits), bytes_of(lasts))
    for level, weight in enumerate(WEIGHTS, 1):
        cut = decode_stream(coded.content[: coded.ends[level - 1]])
        count = SIZES[level - 1]
        wanted = blended(found.gaussians.logit_opacities[:count], found.second.logits[:count], weight)
        torch.testing.assert_close(cut.shown().logit_opacities, wanted)
        assert_equal(cut.gaussians, found.gaussians.slices([slice(0, count)]))


def test_second_opacities_cost_little_and_are_sent_with_the_first_level_that_needs_them():
    g = visible(3000, degree=0)
    one = encode_stream(g, [500, 1000, 2000, 3000])
    weights = {0: (0.0, 0.0, 0.5, 1.0)}
    two = encode_stream(g, [500, 1000, 2000, 3000], second=SecondOpacities(g.logit_opacities, weights))
    sizes, more = (np.diff(coded.ends, prepend=0) for coded in (one, two))
    assert (np.abs(more - sizes)[[0, 1, 3]] < 30).all()
    assert 0 < more[2] - sizes[2] < 2000 * 5 / 8 + 20


def test_gaussians_that_no_level_shows_are_left_out():
    g = visible(8, degree=0)
    g.logit_opacities[:] = torch.tensor([3.0, 3.0, -9.0, -9.0, 3.0, -9.0, 3.0, -9.0])
    second = SecondOpacities(torch.tensor([-9.0, 3.0, -9.0, 3.0, -9.0, 3.0, 3.0, -9.0]), {0: (0.0, 0.9, 1.0)})
    coded = encode_stream(g, [4, 5, 8], second=second)
    assert sorted(coded.rows.tolist()) == [0, 1, 3, 5, 6]  # 4 is nearly what it is in full: nothing
    assert coded.sizes == (3, 3, 5)
    assert coded.weights == (pytest.approx(0.9, abs=1 / 255), pytest.approx(0.9, abs=1 / 255), 1.0)


def test_a_level_takes_the_weight_of_the_last_one_that_shows_the_same():
    g = visible(6, degree=0)
    g.logit_opacities[3:], second = -9.0, SecondOpacities(torch.full((6,), 2.0), {0: (0.0, 1.0)})
    second.logits[3:] = -9.0
    coded = encode_stream(g, [3, 6], second=second)
    assert coded.weights == (1.0, 1.0)
    found = decode_stream(coded.content, 1).shown()
    torch.testing.assert_close(torch.sigmoid(found.logit_opacities), torch.full((3,), 224 / 255))


def test_second_opacities_of_others_are_refused():
    g = visible(5, degree=0)
    for second in (
        SecondOpacities(g.logit_opacities[:4], {0: (0.0, 1.0)}),
        SecondOpacities(g.logit_opacities, {0: (0.0, 0.5, 1.0)}),
        SecondOpacities(g.logit_opacities, {0: (0.0, 1.0), 1: (0.0, 1.0)}),
    ):
        with pytest.raises(ValueError, match=r"second opacities|cells"):
            encode_stream(g, [2, 5], second=second)
    with pytest.raises(DataError, match="second opacities"):
        encode_stream(g, [2, 5], second=SecondOpacities(g.logit_opacities * torch.nan, {0: (0.0, 1.0)}))


def test_a_trained_model_needs_few_bytes():
    g = visible(3000)
    g = replace(g, shN=g.shN * (g.shN.abs() > 0.15))
    assert len(encode_stream(g, [3000]).content) / 3000 < 18


@pytest.mark.parametrize("case", cases(), ids=lambda case: case["name"])
def test_golden_streams_stay_byte_for_byte(case: Case):
    stored = {one["name"]: one for one in json.loads(DATA.read_text(encoding="utf-8"))}[case["name"]]
    assert case["content"] == stored["content"]
    assert case.get("palette") == stored.get("palette")
    assert [list(case["ends"]), list(case["sizes"])] == [stored["ends"], stored["sizes"]]
    for name, values in stored["gaussians"].items():
        np.testing.assert_allclose(case["gaussians"][name], values, atol=1e-6)
    assert case.get("weights") == stored.get("weights")
    for values, wanted in zip(case.get("levels", []), stored.get("levels", []), strict=True):
        np.testing.assert_allclose(values, wanted, atol=1e-6)


@settings(max_examples=25)
@given(
    st.integers(0, 3),
    st.lists(st.integers(0, 40), min_size=1, max_size=6).map(sorted),
    st.floats(-12, 12),
    st.sampled_from([1e-12, 1e-3, 1.0, 1e6, 1e16]),
)
def test_any_gaussians_come_back(degree: int, sizes: list[int], logit: float, extent: float):
    g = random_gaussians(sizes[-1], degree=degree, logit=logit)
    g = replace(g, means=g.means * extent, log_scales=g.log_scales * 6, sh0=g.sh0 * 50, shN=g.shN * 20)
    coded = encode_stream(g, sizes)
    found = decode_stream(coded.content)
    assert found.sizes == coded.sizes
    assert all(torch.isfinite(value).all() for value in found.gaussians.parameters().values())
    kept, reach = g.means[torch.from_numpy(coded.rows)], float(g.means.abs().max()) if len(g) else 0
    off = (found.gaussians.means - kept).abs().max() if len(kept) else 0
    assert off <= max(1e-4 * reach, 0.1 * float(g.log_scales.exp().max()) if len(g) else 0)


@pytest.mark.parametrize("field", PARAMETERS)
def test_nan_and_infinity_are_refused(field: str):
    g = visible(3)
    getattr(g, field).view(-1)[0] = float("nan")
    with pytest.raises(DataError, match=f"tree: .* {field}"):
        encode_stream(g, [3], name="tree")


def test_what_cannot_be_encoded():
    g = visible(3)
    for sizes in ([], [2], [2, 1, 3], [-1, 3], [1] * 255 + [3]):
        with pytest.raises(ValueError, match="levels"):
            encode_stream(g, sizes)
    with pytest.raises(DataError, match="rotation of zeros"):
        encode_stream(replace(g, quats=0 * g.quats), [3])
    with pytest.raises(DataError, match="scale the scene down"):
        encode_stream(replace(g, means=g.means * 1e20), [3])


@pytest.mark.parametrize("wrong", [{"opacity": 300}, {"log_scale": 0.0}, {"sh_bits": (9, 9)}])
def test_a_precision_that_the_format_does_not_have(wrong: dict[str, Any]):
    with pytest.raises(ValueError, match=r"the format|are there"):
        Precision(**wrong)


@pytest.mark.parametrize(
    ("at", "value", "words"),
    [
        (0, b"X", "not a sagesplat-stream"),
        (4, b"\2", "a stream of version 2, and not 3; use the version of sagesplat that wrote it"),
        (5, b"\x08", "unknown flags 8"),
        (5, b"\4", "no palette"),
        (7, b"\0", "0 levels"),
        (24, b"\0\0\xc0\x7f", "impossible steps"),
        (12, b"\0\0\x80\x7f", "impossible steps"),
    ],
)
def test_impossible_headers(at: int, value: bytes, words: str):
    content = bytearray(encode_stream(visible(5), [5]).content)
    content[at : at + len(value)] = value
    with pytest.raises(DataError, match=words):
        decode_stream(bytes(content), name="x.sgst")


def test_more_gaussians_than_bytes_can_hold():
    count = MAX_COUNT
    content = encode_stream(visible(5), [5]).content[:SIZE]
    number = bytes([count & 127 | 128, count >> 7 & 127 | 128, count >> 14 & 127 | 128, count >> 21])
    with pytest.raises(DataError, match=f"{count} Gaussians in 10"):
        decode_stream(content + number + b"\x0a" + b"\x55" * 10)


def test_a_thousand_mutations_are_errors_or_gaussians():
    rng, read = Random(0), 0
    contents = [base64.b64decode(case["content"]) for case in cases() if len(case["content"]) < 1000]
    assert any(content[5] & 2 for content in contents)
    for i in range(1000):
        content = contents[i % len(contents)]
        for _ in range(rng.randint(1, 3)):
            content = rng.choice(BYTES)(content, rng)
        with suppress(DataError):
            found = decode_stream(content).gaussians
            read += 1
            assert all(torch.isfinite(value).all() for value in found.parameters().values())
    assert read < 500


def test_equal_gaussians_take_the_least_bytes():
    g = visible(1, degree=0)
    g.quats[:], g.log_scales[:] = torch.tensor([1.0, 0, 0, 0]), -3.0
    g = g.select(torch.zeros(20_000, dtype=torch.int64))
    coded = encode_stream(g, [20_000])
    assert 10 < 20_000 / len(coded.content) < 97
    assert len(decode_stream(coded.content).gaussians) == 20_000


def test_what_was_decoded_is_encoded_without_further_loss():
    once = decode_stream(encode_stream(visible(), SIZES).content).gaussians
    coded = encode_stream(once, SIZES)
    again, once = decode_stream(coded.content).gaussians, once.select(torch.from_numpy(coded.rows))
    torch.testing.assert_close(again.shN, once.shN, rtol=0, atol=0)
    torch.testing.assert_close(again.log_scales, once.log_scales, rtol=0, atol=0)
    torch.testing.assert_close(again.sh0, once.sh0, rtol=0, atol=1e-5)
    torch.testing.assert_close(again.logit_opacities, once.logit_opacities, rtol=0, atol=1e-5)


@pytest.mark.parametrize("level", [0, 4, -1])
def test_levels_that_a_stream_does_not_have(level: int):
    with pytest.raises(DataError, match="of 3"):
        decode_stream(encode_stream(visible(9), [1, 2, 9]).content, level)


def few_rows(count: int, rows: int, degree: int = 2) -> Gaussians:
    """Gaussians with so many different rows of harmonics, some of them beyond 1."""
    g = visible(count, degree=degree)
    return replace(g, shN=6 * g.shN[:rows][torch.arange(count) % rows])


def palette_for(g: Gaussians, precision: Precision) -> Palette | None:
    harmonics = harmonics_of(turned_round(g).shN, precision.sh_bits, precision.sh_range)
    return Palette.of(harmonics, precision.sh_bits)


def test_few_rows_of_harmonics_are_a_palette_which_is_smaller_and_says_the_same():
    g = few_rows(3000, 100)
    precision = AS_GIVEN[1]
    palette = palette_for(g, precision)
    assert palette is not None
    assert len(palette.rows) == 100
    alone = encode_stream(g, [9, 9, 3000], precision=precision)
    coded = encode_stream(g, [9, 9, 3000], precision=precision, palette=palette)
    found = decode_stream(coded.content, palette=read_palette(palette.encoded()))
    for key, value in decode_stream(alone.content).gaussians.parameters().items():
        assert torch.equal(found.gaussians.parameters()[key], value), key
    assert float(found.gaussians.shN.abs().max()) > 1.5
    assert len(coded.content) + len(palette.encoded()) < 0.6 * len(alone.content)
    first = decode_stream(coded.content[: coded.ends[0]], palette=palette)
    assert torch.equal(first.gaussians.shN, found.gaussians.shN[:9])


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_harmonics_that_hardly_repeat_are_coded_one_by_one(degree: int):
    assert palette_for(visible(300, degree=degree), AS_GIVEN[1]) is None
    assert palette_for(visible(0, degree=degree), AS_GIVEN[1]) is None


def test_frequent_rows_come_first():
    g = few_rows(400, 2, degree=1)
    g = replace(g, shN=torch.where((torch.arange(400) % 5 == 0)[:, None, None], g.shN[:1], g.shN[1:2]))
    palette = palette_for(g, AS_GIVEN[1])
    assert palette is not None
    assert palette.entries(palette.rows[[1, 0]]).tolist() == [1, 0]
    assert palette.entries(harmonics_of(turned_round(g).shN, AS_GIVEN[1].sh_bits, 256.0))[:6].tolist() == [
        1,
        0,
        0,
        0,
        0,
        1,
    ]
    with pytest.raises(ValueError, match="not in the palette"):
        palette.entries(palette.rows + 1)


def test_a_stream_needs_the_palette_of_its_file():
    g = few_rows(60, 5)
    palette = palette_for(g, AS_GIVEN[1])
    assert palette is not None
    content = encode_stream(g, [60], precision=AS_GIVEN[1], palette=palette).content
    other = Palette(2, (5, 4), palette.rows)
    for wrong, words in (
        (None, "no palette"),
        (other, "of other harmonics"),
        (Palette(2, AS_GIVEN[1].sh_bits, palette.rows[:2]), "row 4 of a palette of 2"),
    ):
        with pytest.raises(DataError, match=words):
            decode_stream(content, palette=wrong)
    with pytest.raises(ValueError, match="of other harmonics"):
        encode_stream(g, [60], palette=palette)


@pytest.mark.parametrize(
    ("at", "value", "words"),
    [
        (4, 2, "version 2"),
        (5, 0, "degree 0"),
        (5, 4, "degree 4"),
        (6, 9, "steps 9"),
        (8, 0, "0 rows"),
        (10, 2, "a palette of 131"),
        (14, 1, "cut off"),
        (8, 4, "damaged"),
        (20, 255, "damaged"),
    ],
)
def test_damaged_palettes(at: int, value: int, words: str):
    palette = palette_for(few_rows(60, 5), AS_GIVEN[1])
    assert palette is not None
    content = bytearray(palette.encoded())
    content[at] = value
    with pytest.raises(DataError, match=words):
        palette_of(bytes(content), name="x.sgst")
    with pytest.raises(DataError, match="cut off"):
        palette_of(palette.encoded()[:-1])
    assert palette_of(b"") is None
