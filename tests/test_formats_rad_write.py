"""RAD as Spark reads it: places, encodings, and the labels beside the file."""

import json
import struct
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from sagesplat.core.errors import DataError
from sagesplat.core.sh import sh0_to_rgb
from sagesplat.formats.labels import sidecar
from sagesplat.formats.rad_write import write_rad
from sagesplat.formats.splats import write_splat
from tests.conftest import random_gaussians


def texts(content: bytes, magic: bytes, at: int) -> tuple[dict[str, Any], int]:
    """A JSON after its magic number and length, and where what follows begins."""
    assert content[at : at + 4] == magic
    (length,) = struct.unpack_from("<I", content, at + 4)
    return json.loads(content[at + 8 : at + 8 + length]), at + 8 + (length + 7) // 8 * 8


def columns(content: bytes) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """The first text, and the values [N, width] of each property of all chunks together."""
    head, start = texts(content, b"RAD0", 0)
    parts: dict[str, list[np.ndarray]] = {}
    for chunk in head["chunks"]:
        inside, at = texts(content, b"RADC", start + chunk["offset"])
        assert struct.unpack_from("<Q", content, at) == (inside["payloadBytes"],)
        assert at + 8 + inside["payloadBytes"] == start + chunk["offset"] + chunk["bytes"]
        assert chunk["offset"] % 8 == 0
        for one in inside["properties"]:
            begin = at + 8 + one["offset"]
            raw = zlib.decompress(content[begin : begin + one["bytes"]], -15)
            if one["encoding"] == "f32_lebytes":
                values = np.frombuffer(raw, np.uint8).reshape(4, -1).T.copy().view("<f4")[:, 0]
            else:
                values = np.frombuffer(raw, np.int8 if one["encoding"] == "s8" else "<f2").astype(np.float32)
            values = values * one["max"] / 127 if one["encoding"] == "s8" else values
            parts.setdefault(one["property"], []).append(values.reshape(-1, inside["count"]).T)
    return head, {name: np.concatenate(found) for name, found in parts.items()}


def test_a_rad_holds_what_was_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sagesplat.formats.rad_write._CHUNK", 400)
    g = random_gaussians(1000, degree=2)
    size = write_rad(tmp_path / "a.rad", g, {5: "tree"})
    content = (tmp_path / "a.rad").read_bytes()
    assert size == len(content)
    head, found = columns(content)
    assert (head["version"], head["type"], head["count"], head["maxSh"]) == (1, "gsplat", 1000, 2)
    assert (len(head["chunks"]), head["chunkSize"]) == (3, 400)
    np.testing.assert_array_equal(found["center"], g.means.numpy())
    np.testing.assert_allclose(found["alpha"][:, 0], g.logit_opacities.sigmoid().numpy(), rtol=1e-3)
    np.testing.assert_allclose(found["rgb"], sh0_to_rgb(g.sh0[:, 0]).numpy(), rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(found["scales"], g.log_scales.numpy(), rtol=1e-3, atol=1e-4)
    xyz = found["orientation"].astype(np.float64)
    w = np.sqrt((1 - np.square(xyz).sum(1)).clip(0))
    quats = torch.nn.functional.normalize(g.quats).numpy()
    assert np.abs((np.column_stack([w, xyz]) * quats).sum(1)).min() > 0.9995
    for name, band in (("sh1", g.shN[:, :3]), ("sh2", g.shN[:, 3:])):
        most = float(band.abs().max())
        np.testing.assert_allclose(found[name], band.flatten(1).numpy(), atol=0.51 * most / 127)
    assert sidecar(tmp_path / "a.rad").exists()


def test_what_a_rad_cannot_hold_is_refused(tmp_path: Path) -> None:
    g = random_gaussians(3, degree=0)
    with pytest.raises(DataError, match=r"a\.rad: no Gaussians"):
        write_splat(tmp_path / "a.rad", g.select(torch.arange(0)))
    with pytest.raises(DataError, match=r"a\.rad: 1 values of means"):
        write_splat(
            tmp_path / "a.rad",
            replace(g, means=g.means.index_put((torch.tensor([0]),), torch.tensor([float("nan"), 0, 0]))),
        )
    assert list(tmp_path.iterdir()) == []
