"""The versions of packages: what users may have, what the tests ran with; and what the wheel holds."""

import re
import subprocess
import sys
import tomllib
import zipfile
from importlib.metadata import distributions
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name
from packaging.version import Version

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
REQUIRED = [
    Requirement(text)
    for texts in (PROJECT["dependencies"], *PROJECT["optional-dependencies"].values())
    for text in texts
]


def constraints() -> dict[str, Version]:
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pairs = [re.fullmatch(r"([\w.-]+)==([\w.+-]+)", line) for line in lines if not line.startswith("#")]
    assert all(pairs), "constraints.txt has exact versions only"
    return {canonicalize_name(pair[1]): Version(pair[2]) for pair in pairs if pair}


@pytest.mark.parametrize("requirement", REQUIRED, ids=lambda requirement: requirement.name)
def test_the_constraints_satisfy_what_is_required(requirement: Requirement) -> None:
    pinned = constraints()
    assert requirement.specifier.contains(pinned[canonicalize_name(requirement.name)])
    assert any(one.operator in (">=", "==") for one in requirement.specifier), "needs a minimum"


def test_the_pinned_versions_run_on_the_lowest_python() -> None:
    """Pins are chosen on one Python: one that needs a later 3.11 breaks set-up on Debian 12's 3.11.2."""
    lowest = PROJECT["requires-python"].removeprefix(">=") + ".0"
    pinned = constraints()
    needs = {
        name: one.metadata["Requires-Python"]
        for one in distributions()
        if (name := canonicalize_name(one.metadata["Name"])) in pinned
        and pinned[name] == Version(one.version)
        and one.metadata["Requires-Python"]
    }
    assert needs
    assert {name: text for name, text in needs.items() if not SpecifierSet(text).contains(lowest)} == {}


@pytest.mark.slow
def test_sdist_and_wheel_hold_everything(tmp_path: Path) -> None:
    """The wheel is built from the sdist, and so proves that one too."""
    pytest.importorskip("hatchling", reason="needs the extra dev")

    def build(kind: str, source: Path) -> Path:
        command = [sys.executable, "-m", "hatchling", "build", "--target", kind, "--directory", str(tmp_path)]
        done = subprocess.run(command, cwd=source, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        (made,) = tmp_path.glob("*.tar.gz" if kind == "sdist" else "*.whl")
        return made

    # before Python 3.11.4 tarfile has no filters, and from 3.12 on it warns without
    subprocess.run(["tar", "-xf", build("sdist", ROOT), "-C", tmp_path], check=True)
    (unpacked,) = (path for path in tmp_path.iterdir() if path.is_dir())
    with zipfile.ZipFile(build("wheel", unpacked)) as wheel:
        names = set(wheel.namelist())
        about = next(wheel.read(name).decode() for name in names if name.endswith(".dist-info/METADATA"))
    source = ROOT / "src"
    here = {path.relative_to(source).as_posix() for path in source.rglob("*") if path.is_file()}
    here = {
        name for name in here if "__pycache__" not in name and not name.endswith((".pyc", ".nbi", ".nbc"))
    }
    assert {name for name in names if ".dist-info/" not in name} == here
    for part in (
        "sagesplat/py.typed",
        "sagesplat/viewer/static/index.html",
        "sagesplat/output/report.html.j2",
    ):
        assert part in names
    for notice in ("LICENSE", "THIRD_PARTY.md", "THIRD_PARTY_LICENSES.txt"):
        assert any(".dist-info/licenses/" in name and name.endswith(f"/{notice}") for name in names), notice
    for extra in PROJECT["optional-dependencies"]:
        assert f"Provides-Extra: {extra}\n" in about
    for name in (
        "Makefile",
        "constraints.txt",
        "README.md",
        "examples",
        "tests/conftest.py",
        "web/package.json",
    ):
        assert (unpacked / name).exists(), name
