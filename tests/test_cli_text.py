"""Segmentation by text as typed, with tiny networks of random weights: masks, run, adopt."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from conftest import Call, random_gaussians
from text_networks import save

from sagesplat.demo.capture import make_capture
from sagesplat.formats.ply import write_ply

PROMPTS = "stone fountain; ivy; wooden bench"
SMALL = (
    "--train.max-steps", "20", "--nest.steps", "6", "--nest.levels", "3", "--nest.base-steps", "3",
    "--sample.views", "6", "--sample.calibration-views", "6", "--target-fidelity", "0.6", "--threads", "1",
)  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A capture, and networks in folders of their own."""
    folder = tmp_path_factory.mktemp("text")
    make_capture(folder / "capture", views=8, width=64, height=48)
    for kind in ("dino", "sam2", "clipseg"):
        (folder / kind).mkdir()
        save(folder / kind, kind)
    return folder


def names_of(path: Path) -> list[str]:
    return list(json.loads((path / "labels.json").read_text())["labels"].values())


def test_a_run_by_text(folder: Path, tmp_path: Path, command: Call) -> None:
    networks = ("--model", folder / "dino", "--mask-model", folder / "sam2", "--prompt-threshold", "0.01")
    words = ("--segmenter", "text", "--prompts", PROMPTS, *networks)
    code, said = command("run", folder / "capture", tmp_path / "run", *words, *SMALL)
    assert code == 0, said
    assert "best scores: stone fountain 1.00, ivy 1.00" in " ".join(said.split())  # of random weights
    assert set(names_of(tmp_path / "run" / "masks")) <= set(PROMPTS.split("; "))
    assert (tmp_path / "run" / "nested" / "report" / "index.html").exists()


@pytest.mark.slow
def test_a_splat_by_text(folder: Path, tmp_path: Path, command: Call) -> None:
    g = random_gaussians(300, degree=1, logit=2.0)
    write_ply(tmp_path / "ball.ply", replace(g, label_ids=torch.full_like(g.label_ids, -1)))
    words = ("--prompts", PROMPTS, "--prompt-model", folder / "clipseg", "--prompt-threshold", "0.01")
    small = (
        "--fit",
        "none",
        "--views",
        "14",
        "--size",
        "48",
        "36",
        "--shares",
        "0.3",
        "1",
        "--kind",
        "object",
    )
    code, said = command("adopt", tmp_path / "ball.ply", tmp_path / "run", *words, *small, *SMALL[8:])
    assert code == 0, said
    assert set(names_of(tmp_path / "run" / "masks")) <= set(PROMPTS.split("; "))
