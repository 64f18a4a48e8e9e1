"""The benchmark of round trips: it says what is missing, and counts errors in steps."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from benchmarks.formats import _exact, _matched, _sog, _spz, errors, found, labelled, verdict
from sagesplat.core.errors import BackendUnavailable


def script(path: Path, says: str) -> Path:
    path.write_text(f"#!/bin/sh\necho {says}\n")
    path.chmod(0o755)
    return path


def test_it_says_what_is_missing(tmp_path, monkeypatch):
    with pytest.raises(BackendUnavailable, match=r"none: cannot be run \(No such file"):
        found(tmp_path / "none")
    with pytest.raises(BackendUnavailable, match=r"v2\.7\.0.* is not splat-transform 3; it needs Node 22"):
        found(script(tmp_path / "old", "splat-transform v2.7.0"))
    assert found(script(tmp_path / "new", "splat-transform v3.7.0")).command == (str(tmp_path / "new"),)
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(BackendUnavailable, match="install Node 22"):
        found(None)


def test_rows_are_found_again_and_errors_are_in_steps():
    g = labelled(300, 2)
    order = torch.randperm(300, generator=torch.Generator().manual_seed(1))
    read = g.select(order)
    assert _matched(read, g).tolist() == order.tolist()
    for steps in (_exact, _spz(12), _sog):
        assert max(value for name, value in errors(read, g, steps).items() if name != "rows") < 1e-6
    moved = replace(read, means=read.means + 2.0**-13, log_scales=read.log_scales + 1 / 16)
    shown = errors(moved, g, _spz(12))
    assert shown["rows"] == 300
    assert shown["positions"] == pytest.approx(0.5, abs=0.01)
    assert shown["scales"] == pytest.approx(1, abs=0.01)
    assert verdict({"a": {"b": shown}})["scales"] == shown["scales"]
