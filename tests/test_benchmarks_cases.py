"""`python -m benchmarks cases`: what becomes of a folder of inputs."""

import json
from pathlib import Path

import pytest
from conftest import random_gaussians
from test_scene_colmap import PINHOLE, capture

from benchmarks import cases
from sagesplat.formats.ply import write_ply

SHARED = Path(__file__).resolve().parents[2] / "shared" / "cases"


def test_each_case_is_read_refused_or_at_fault(tmp_path, capsys, monkeypatch):
    capture(tmp_path / "capture", [PINHOLE])
    capture(tmp_path / "damaged", [PINHOLE])
    (tmp_path / "damaged/sparse/0/cameras.bin").write_bytes(b"12")
    (tmp_path / "splats").mkdir()
    write_ply(tmp_path / "splats/a.ply", random_gaussians(12))
    (tmp_path / "splats/b.ply").write_bytes(b"ply\n")
    cases.main(tmp_path)
    *lines, last = capsys.readouterr().out.splitlines()
    assert [line.split()[:2] for line in lines] == [
        ["capture", "read"], ["damaged", "refused"], ["splats/a.ply", "read"], ["splats/b.ply", "refused"],
    ]  # fmt: skip
    assert "5 of 5 photos have poses" in lines[0]
    assert "12 Gaussians" in lines[2]
    assert json.loads(last) == {
        "cases": 3, "read": 1, "refused": 2, "fault": 0,
        "refused cases": ["damaged", "splats"], "fault cases": [],
    }  # fmt: skip

    def fail(*_: object) -> None:
        raise KeyError("x")

    monkeypatch.setattr(cases, "load_scene", fail)
    with pytest.raises(SystemExit) as ended:
        cases.main(tmp_path)
    assert ended.value.code == 1
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["fault"] == 2


def test_a_folder_without_cases(tmp_path):
    with pytest.raises(SystemExit, match="no folders in it"):
        cases.main(tmp_path)


@pytest.mark.slow
def test_no_case_is_at_fault(capsys):
    if not SHARED.is_dir():
        pytest.skip("needs ../shared/cases beside the checkout")
    cases.main(SHARED)
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["fault"] == 0
