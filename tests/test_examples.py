"""The examples as a user runs them: they import `sagesplat` alone, work, and fail in one line."""

import json
import re
import runpy
import shutil
import sys
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from conftest import random_gaussians
from PIL import Image

from sagesplat import read_ply, read_splat
from sagesplat.viewer.built import package_viewer
from tools.notebooks import NOTEBOOKS, execute

EXAMPLES = Path(__file__).parents[1] / "examples"


def run(name: str, *words: object) -> str:
    """What a script prints; in this process, as one of its own begins with torch's import."""
    (script,) = EXAMPLES.glob(f"{name}_*.py")
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(StringIO()) as out:
        patch.setattr(sys, "argv", [str(script), *map(str, words)])
        runpy.run_path(str(script), run_name="__main__")
    return out.getvalue()


@pytest.fixture(scope="module")
def finished(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    folder = tmp_path_factory.mktemp("run") / "run"
    words = ("--target-ssim", 0.4, "--max-steps", 60, "--nest-steps", 20)
    return folder, run("01", capture, folder, *words)


def test_a_run_from_python_shows_its_stages_and_plans(capture, finished):
    folder, text = finished
    assert "train: " in text
    assert "SSIM 0.4: " in text
    again = run("01", capture, folder, "--target-ssim", 0.4, "--max-steps", 60, "--nest-steps", 20)
    assert "train: up to date" in again
    assert again[again.index("\n\nSSIM") :] == text[text.index("\n\nSSIM") :]


def test_a_plan_for_a_viewer_is_written_and_grows_with_the_target(finished, tmp_path):
    folder, _ = finished
    counts = []
    for target in (0.5, 0.95):
        ply = tmp_path / f"{target}.ply"
        text = run("02", folder, "view_001.png", ply, "--target-fidelity", target, "--back", 0.01)
        counts.append(int(text.splitlines()[-1].split()[1].replace(",", "")))
        assert len(read_ply(ply)) == counts[-1]
        assert "vase " in text
    assert 0 < counts[0] < counts[1]
    far = run("02", folder, "view_001.png", tmp_path / "far.ply", "--back", 1000)
    assert "no promise" in far
    assert "nan" not in far


def test_a_render_has_the_size_that_was_asked_for(capture, finished, tmp_path):
    ply, png = finished[0] / "nested" / "composed.ply", tmp_path / "out.png"
    run("03", ply, capture, "view_001.png", png, "--width", 32)
    image = Image.open(png)
    assert image.size == (32, 24)
    assert np.asarray(image).std() > 0


def test_a_web_page_has_its_bundle_and_what_is_promised(finished, tmp_path):
    run("05", finished[0], tmp_path / "site", "--target-fidelity", 0.5)
    page = (tmp_path / "site" / "index.html").read_text()
    assert 'src="scene/?ui=0&target=0.5"' in page
    assert page.count("<td>level ") == 8
    assert "nan" not in page
    assert (tmp_path / "site" / "scene" / "manifest.json").is_file()


@pytest.mark.slow
def test_a_splat_of_gsplats_trainer_becomes_levels_that_are_measured(tmp_path):
    g = random_gaussians(300, degree=1, logit=2.0)
    splats = torch.nn.ParameterDict({name: torch.nn.Parameter(t) for name, t in g.to_gsplat().items()})
    torch.save({"step": 1, "splats": splats.state_dict()}, tmp_path / "ckpt.pt")
    small = ("--views", 14, "--width", 48)
    text = run("06", tmp_path / "ckpt.pt", tmp_path / "run", tmp_path / "small.spz", *small)
    for said in ("nest: ", "run: nested levels", "fidelity 0.9 ", "Levels against run level "):
        assert said in text
    count = int(text.splitlines()[-1].split()[-2].replace(",", ""))
    assert 0 < len(read_splat(tmp_path / "small.spz").gaussians) == count <= 300
    assert (tmp_path / "run" / "measured" / "levels.csv").is_file()


SIZES = "VIEWS, WIDTH, HEIGHT, STEPS, NEST_STEPS = 10, 48, 36, 20, 10"
FEW = "RUN, TARGETS, STEPS_BACK = 'runs/first', [0.5, 0.9], [0.0, 1.0]"


def notebook(name: str) -> dict[str, Any]:
    return json.loads((NOTEBOOKS / name).read_text(encoding="utf-8"))


def printed(notebook: dict[str, Any]) -> str:
    return "".join(line for cell in notebook["cells"] for out in cell.get("outputs", [])
                   for line in out.get("text", []))  # fmt: skip


@pytest.mark.slow
def test_the_notebook_of_a_first_scene(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    first = notebook("01_first_scene.ipynb")
    execute(first, SIZES)
    assert "train: " in printed(first)
    assert len(read_ply(Path("planned.ply"))) > 0
    scripts = sum(path.stat().st_size for path in package_viewer().glob("assets/*.js"))
    assert Path("scene.html").stat().st_size > scripts > 5e5  # the scene is in it too


@pytest.mark.slow
def test_the_notebook_of_promises(finished, tmp_path, monkeypatch):
    shutil.copytree(finished[0], tmp_path / "runs" / "first")
    monkeypatch.chdir(tmp_path)
    second = notebook("02_planning_with_promises.ipynb")
    names = execute(second, FEW)
    assert names["by_target"] == sorted(names["by_target"])
    assert 0 <= names["kept"] <= names["promised"]
    assert "test views" in printed(second)


@pytest.mark.slow
def test_the_notebook_of_levels_of_a_splat(finished, tmp_path, monkeypatch):
    shutil.copytree(finished[0], tmp_path / "runs" / "first")
    monkeypatch.chdir(tmp_path)
    third = notebook("03_levels_of_your_splat.ipynb")
    names = execute(third, "RUN, SIZE, VIEWS = 'runs/first', (64, 48), 14")
    assert torch.equal(names["gaussians"].means, names["full"].means)
    assert "Levels against adopted level " in printed(third)
    assert third["cells"][-1]["outputs"][0]["data"]["text/plain"] == [repr(names["run"].show())]
    assert Path("planned.sog").stat().st_size > 0


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("01", ("absent", "run")),
        ("02", ("absent", "a.png", "out.ply")),
        ("03", ("absent.ply", "absent", "a.png", "out.png")),
        ("05", ("absent", "site")),
        ("06", ("absent.ply", "run", "out.ply")),
    ],
)
def test_what_is_not_there_is_one_line(name, words, tmp_path, capfd):
    with pytest.raises(SystemExit) as stopped:
        run(name, *(tmp_path / word if word != "a.png" else word for word in words))
    error = str(stopped.value)
    assert re.match(rf"{name}_\w+\.py: ", error)
    assert "\n" not in error
    assert str(tmp_path) in error
    assert capfd.readouterr().err == ""
