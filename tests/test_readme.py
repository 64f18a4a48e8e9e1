"""What the README says can be typed: every line of its code blocks is parsed, and run where that is quick."""

import re
import shlex
import shutil
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest

from sagesplat import cli, read_spz
from sagesplat.cli.parse import arguments

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```(\w+)\n(.*?)^```$", README, re.MULTILINE | re.DOTALL)
LINES = [line for kind, text in BLOCKS if kind == "sh" for line in text.splitlines() if line.strip()]
(SNIPPET,) = (text for kind, text in BLOCKS if kind == "python")
QUICK = {"plan", "compose", "export", "bundle"}  # on a small run


def words_of(line: str) -> list[str]:
    return shlex.split(line, comments=True)


def test_every_block_is_tested() -> None:
    assert {kind for kind, _ in BLOCKS} == {"sh", "python"}
    assert {words_of(line)[0] for line in LINES} == {"make", "pip", "sagesplat"}
    assert len(README.split()) < 1000, "a README is one screen and some; the rest belongs in docs/"


@pytest.mark.parametrize("line", LINES)
def test_a_line_is_one_that_the_program_understands(line, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    program, command, *words = words_of(line)
    if program == "make":
        assert re.search(rf"^{command}:", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    elif program == "pip":
        project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
        extras = re.fullmatch(r"\.\[([\w,]+)\]", words[0])
        assert command == "install"
        assert extras
        assert set(extras[1].split(",")) <= set(project["optional-dependencies"])
    else:
        assert arguments(command, cli.commands()[command], words)
        assert re.search(r"# .*(\d s|\d min|seconds|Ctrl-C)", line), "says how long it takes, and on what"


def test_quick_lines_run_in_their_order(finished_run, tmp_path, monkeypatch, capsys) -> None:
    for name in ("demo", "scene"):
        shutil.copytree(finished_run, tmp_path / "runs" / name)
    monkeypatch.chdir(tmp_path)
    ran = 0
    for line in LINES:
        words = words_of(line)
        if words[1] in QUICK:
            monkeypatch.setattr(sys, "argv", words)
            cli.main()  # SystemExit where it fails
            ran += 1
    assert ran >= 5
    assert "budget" in (tmp_path / "runs/demo/nested/plan.json").read_text()
    assert len(read_spz(Path("small.spz"))) > 0
    assert Path("site/index.html").is_file()
    assert Path("courtyard.html").stat().st_size > 1e6
    capsys.readouterr()


def test_the_snippet_runs(finished_run, tmp_path, monkeypatch) -> None:
    shutil.copytree(finished_run, tmp_path / "runs" / "demo")
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    exec(compile(SNIPPET, "README.md", "exec"), names)
    image = np.asarray(names["image"])
    camera = names["camera"]
    assert image.shape == (camera.height, camera.width, 3)  # type: ignore
    assert np.isfinite(image).all()
    assert image.std() > 0


def test_a_run_has_what_the_readme_says(finished_run) -> None:
    rows = re.findall(r"^\| (`nested/.*?) \|", README, re.MULTILINE)
    names = [name for row in rows for name in re.findall(r"`([^`]+)`", row)]
    assert len(names) >= 4
    for name in names:
        assert (finished_run / name).exists(), name
