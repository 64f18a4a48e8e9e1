"""Coded streams that decoders are held to: `python tests/make_stream_vectors.py` writes them.

A case of tests/data/streams.json has the bytes of a stream as base64, where each level ends in them and how
many Gaussians there are up to it, and what they are decoded to, in right, up, back, to 1e-6: means, quats
(w x y z), log_scales, opacities, sh0 and shN (coefficient by coefficient, red, green, blue). With two
opacities `opacities` are the first ones, `seconds` the second ones, `weights` those of the second ones at
each level in 1/255, and `levels` the opacities of all Gaussians up to each level where it is the newest one.
`palette` has the bytes of the palette that a stream needs.
"""

import base64
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from sagesplat.core.gaussians import Gaussians
from sagesplat.core.second_opacity import SecondOpacities
from sagesplat.formats.stream import decode_stream, encode_stream
from sagesplat.formats.stream_header import Precision, harmonics_of, turned_round
from sagesplat.formats.stream_palette import Palette

DATA = Path(__file__).parent / "data" / "streams.json"
OLD = Precision(1 / 8, 6, rotation=0.0, least=0.5)
GIVEN = replace(OLD, sh_bits=(7, 6), sh_range=4.0)
Case = dict[str, Any]


def waves(count: int, degree: int) -> Gaussians:
    """Gaussians of sines, which are the same everywhere; one in seven is not visible."""

    def wave(speed: float, *shape: int) -> torch.Tensor:
        at = np.arange(count * int(np.prod(shape)), dtype=np.float64)
        return torch.from_numpy(np.sin(speed * at + 0.3).reshape(count, *shape).astype(np.float32))

    logits = 3 * wave(1.7, 1)[:, 0]
    logits[6::7] = -9
    bases = (degree + 1) ** 2 - 1
    return Gaussians(
        means=2 * wave(0.9, 3),
        quats=wave(2.3, 4),
        log_scales=2 * wave(1.1, 3) - 4,
        logit_opacities=logits,
        sh0=1.5 * wave(0.7, 1, 3),
        shN=0.6 * wave(1.9, bases, 3) * (wave(0.37, bases, 1) > 0.4),
        label_ids=torch.full((count,), -1, dtype=torch.int16),
    )


def far_off(count: int) -> Gaussians:
    """Waves with values that need escapes: far from all others in place, size and colour."""
    g = waves(count, 1)
    g.means[3], g.log_scales[5], g.sh0[8] = 900.0, torch.tensor([-30.0, 9.0, -3.0]), 40.0
    g.shN[9, 1] = torch.tensor([1.0, -1.0, 0.9])
    return g


def few_rows(count: int, degree: int) -> Gaussians:
    """Waves with five different rows of harmonics, of which one is beyond 1."""
    g = waves(count, degree)
    return replace(g, shN=3 * g.shN[:5][torch.arange(count) ** 2 % 7 % 5])


def cases() -> list[Case]:
    """All cases of streams.json."""
    return [
        case("degree 0", waves(5, 0), [2, 5]),
        case("degree 1, an empty level", waves(20, 1), [6, 6, 20]),
        case("degree 2, other steps", waves(24, 2), [24], Precision(1 / 30, 3, 1.3, 0.07, (6, 5), 2.0, 0.5)),
        case("degree 3, several blocks", waves(60, 3), [1, 20, 60]),
        case("degree 1, many blocks", waves(210, 1), [8, 20, 70, 210]),
        case("escapes", far_off(20), [4, 20], replace(OLD, log_scale=0.05, sh_bits=(8, 8))),
        case("none", waves(0, 3), [0]),
        case("two opacities", waves(60, 1), [3, 20, 45, 60], Precision(), (0.0, 0.0, 0.4, 1.0)),
        case(
            "two opacities, empty levels", waves(40, 0), [0, 20, 20, 40, 40], Precision(), (0, 0, 0.3, 0.7, 1)
        ),
        case("a palette, degree 2", few_rows(60, 2), [5, 5, 60], GIVEN, palette=True),
        case("a palette, two opacities", few_rows(40, 3), [9, 40], GIVEN, (0.0, 0.4), palette=True),
    ]


def case(
    name: str,
    g: Gaussians,
    sizes: list[int],
    precision: Precision = OLD,
    weights: tuple[float, ...] = (),
    *,
    palette: bool = False,
) -> Case:
    """A stream and what it decodes to."""
    second = SecondOpacities(g.logit_opacities.flip(0) - 1, {-1: weights}) if weights else None
    rows = palette_of(g, precision) if palette else None
    coded = encode_stream(g, sizes, second=second, precision=precision, palette=rows)
    decoded = decode_stream(coded.content, palette=rows)
    found = turned_round(decoded.gaussians)
    values = {name: value for name, value in found.parameters().items() if name != "logit_opacities"}
    values["opacities"] = torch.sigmoid(found.logit_opacities.double())
    made: Case = {
        "name": name,
        "content": base64.b64encode(coded.content).decode(),
        "ends": coded.ends,
        "sizes": coded.sizes,
        "gaussians": {name: _plain(value) for name, value in values.items()},
    }
    if rows:
        made["palette"] = base64.b64encode(rows.encoded()).decode()
    if decoded.second:
        made["weights"] = [round(255 * weight) for weight in coded.weights]
        made["gaussians"]["seconds"] = _plain(torch.sigmoid(decoded.second.logits.double()))
        levels = [decode_stream(coded.content, k, palette=rows) for k in range(1, 1 + len(sizes))]
        newest = [one.shown().logit_opacities for one in levels]
        made["levels"] = [_plain(torch.sigmoid(logits.double())) for logits in newest]
    return made


def palette_of(g: Gaussians, precision: Precision) -> Palette:
    """All rows of harmonics of Gaussians."""
    harmonics = harmonics_of(turned_round(g).shN, precision.sh_bits, precision.sh_range)
    return Palette(g.sh_degree, precision.sh_bits, np.unique(harmonics, axis=0))


def _plain(values: torch.Tensor) -> list[float]:
    return np.round(values.double().numpy().ravel(), 7).tolist()


if __name__ == "__main__":
    lines = [json.dumps(one, separators=(",", ":")) for one in cases()]
    DATA.write_text("[\n" + ",\n".join(lines) + "\n]\n", encoding="utf-8")
