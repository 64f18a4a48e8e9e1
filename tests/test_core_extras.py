"""The command that installs what is missing reaches the environment that misses it."""

import sys
import tomllib
from pathlib import Path

import pytest

from sagesplat.cli.doctor import EXTRAS
from sagesplat.core import extras
from sagesplat.core.extras import install

ROOT = Path(__file__).parents[1]


def test_the_command_fits_the_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "executable", str(tmp_path / ".venv" / "bin" / "python"))
    monkeypatch.setattr(extras, "distributions", lambda name: iter([name]))
    monkeypatch.setattr(extras.shutil, "which", lambda name: "/usr/bin/pip")  # another Python's
    assert install("sagesplat[hf]") == ".venv/bin/python -m pip install 'sagesplat[hf]'"
    monkeypatch.setattr(extras.shutil, "which", lambda name: str(tmp_path / ".venv" / "bin" / "pip"))
    assert install("sagesplat[hf]") == "pip install 'sagesplat[hf]'"
    monkeypatch.setattr(extras, "distributions", lambda name: iter([]))  # an environment of uv's
    monkeypatch.setattr(sys, "executable", "/a tool/bin/python")
    monkeypatch.setattr(sys, "prefix", str(tmp_path))
    assert install("--upgrade", "pillow") == "uv pip install --python '/a tool/bin/python' --upgrade pillow"
    (tmp_path / "pipx_metadata.json").touch()
    assert install("sagesplat[view]") == "pipx runpip sagesplat install 'sagesplat[view]'"


def test_the_doctor_knows_every_extra() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    named = project["optional-dependencies"]
    assert set(EXTRAS) == set(named) - {"cuda", "dev", "docs"}
    for extra, (package, _) in EXTRAS.items():
        assert any(line.startswith(package) for line in named[extra])
