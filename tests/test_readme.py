"""What the README says can be typed: every line of its code blocks is parsed, and run where that is quick.

`pytest -m slow tests/test_readme.py` runs them all, in a checkout and an environment of their own.
"""

import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
import tomllib
import urllib.request
from pathlib import Path

import numpy as np
import pytest

from sagesplat import cli, read_spz
from sagesplat.cli.parse import arguments
from sagesplat.demo.capture import make_capture
from sagesplat.viewer.built import package_viewer

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
    assert len(README.split()) < 1150, "a README is one screen and some; the rest belongs in docs/"


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
    scripts = sum(path.stat().st_size for path in package_viewer().glob("assets/*.js"))
    assert Path("courtyard.html").stat().st_size > scripts > 5e5  # the scene is in it too
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


@pytest.mark.slow
def test_everything_as_typed(tmp_path: Path) -> None:
    """A quarter of an hour on two cores; needs a package index."""
    checkout = tmp_path / "sagesplat"
    listed = ["git", "ls-files", "--cached", "--others", "--exclude-standard"]
    done = subprocess.run(listed, cwd=ROOT, capture_output=True, text=True, check=True)
    for name in filter(lambda name: (ROOT / name).is_file(), done.stdout.splitlines()):
        (checkout / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, checkout / name)
    make_capture(tmp_path / "capture", views=16, width=160, height=120)
    shutil.copytree(tmp_path / "capture" / "images", checkout / "photos")
    subprocess.run([sys.executable, "-m", "venv", str(tmp_path / "venv")], check=True)
    unwanted = {"PYTHONPATH", "VIRTUAL_ENV", "NUMBA_NUM_THREADS", "OMP_NUM_THREADS"}
    env = {name: value for name, value in os.environ.items() if name not in unwanted}
    env["PATH"] = f"{tmp_path / 'venv' / 'bin'}{os.pathsep}{env['PATH']}"

    def run(line: str) -> subprocess.CompletedProcess[str]:
        print(line, flush=True)
        return subprocess.run(
            line, shell=True, cwd=checkout, env=env, capture_output=True, text=True, check=False
        )

    for line in LINES:
        if words_of(line)[0] == "make":  # of which this test is a part
            continue
        if words_of(line)[1] == "view":
            assert_it_serves(words_of(line), checkout, env)
            continue
        if words_of(line)[1] == "adopt":
            for suffix in ("", ".labels.json"):
                shutil.copy(
                    checkout / f"runs/demo/nested/composed.ply{suffix}", checkout / f"scene.ply{suffix}"
                )
        done = run(line)
        if done.returncode and words_of(line)[:3] == ["sagesplat", "run", "photos"]:
            assert "hf download" in done.stderr, done.stderr  # without a network: what to do is said
            continue
        assert done.returncode == 0, f"{line}\n{done.stdout[-2000:]}\n{done.stderr[-2000:]}"
    (checkout / "snippet.py").write_text(SNIPPET)
    done = run("python snippet.py")
    assert done.returncode == 0, done.stderr


def assert_it_serves(words: list[str], folder: Path, env: dict[str, str]) -> None:
    """`sagesplat view` says where it is, answers there, and ends with Ctrl-C."""
    env = env | {"BROWSER": "true", "PYTHONUNBUFFERED": "1"}
    with subprocess.Popen(words, cwd=folder, env=env, stdout=subprocess.PIPE, text=True) as server:
        assert server.stdout
        end = time.monotonic() + 1800
        url = None
        while url is None and time.monotonic() < end:
            url = re.search(r"http://[\w.:]+/", server.stdout.readline())
        assert url
        with urllib.request.urlopen(f"{url[0]}manifest.json") as answer:
            assert b"sagesplat-bundle" in answer.read()
        server.send_signal(signal.SIGINT)
        server.wait(600)
