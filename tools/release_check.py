"""What has to be true before a release: `make release-check`, which builds the packages first.

    python tools/release_check.py [--quick]

Prints a line per check; exit code 1 where one fails. --quick leaves out the demo from the wheel and the site.
"""

import argparse
import datetime
import json
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
DIST = ROOT / "dist"


def read(name: str) -> str:
    return (ROOT / name).read_text(encoding="utf-8")


def git(*words: str) -> str:
    done = subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=True)
    return done.stdout.strip()


def version() -> str:
    (found,) = re.findall(r'^__version__ = "(.+)"$', read("src/sagesplat/__init__.py"), re.MULTILINE)
    return found


def versions() -> str:
    """The version is the same everywhere."""
    other = {
        "CITATION.cff": re.findall(r"^version: (.+)$", read("CITATION.cff"), re.MULTILINE)[0],
        "web/package.json": json.loads(read("web/package.json"))["version"],
    }
    wrong = [f"{name} says {text}" for name, text in other.items() if text != version()]
    assert not wrong, ", ".join(wrong)
    return version()


def changelog() -> str:
    """The newest entry is this version's, with a date."""
    newest = re.findall(r"^## \[(.+)\] - (.+)$", read("CHANGELOG.md"), re.MULTILINE)[0]
    assert newest[0] == version(), f"the newest entry is {newest[0]}"
    datetime.date.fromisoformat(newest[1])  # ValueError for "unreleased"
    return " ".join(newest)


def clean_checkout() -> str:
    """Nothing is left to commit."""
    status = subprocess.run(
        ["git", "status", "--short"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert not status.stdout.strip(), status.stdout.strip().replace("\n", ", ")
    head = subprocess.run(["git", "rev-parse", "--short", "HEAD"], cwd=ROOT, capture_output=True, text=True)
    return head.stdout.strip()


def packages() -> str:
    """sdist, wheel and npm package of this version are in dist/, and newer than the last commit."""
    names = [
        f"sagesplat-{version()}.tar.gz",
        f"sagesplat-{version()}-py3-none-any.whl",
        f"sagesplat-viewer-{version()}.tgz",
    ]
    when = int(git("log", "-1", "--format=%ct"))
    for name in names:
        path = DIST / name
        assert path.is_file(), f"{path} is missing; make packages npm-package"
        assert path.stat().st_mtime >= when, f"{path} is older than the last commit"
    return ", ".join(f"{name} {(DIST / name).stat().st_size / 1e6:.1f} MB" for name in names)


def installed(quick: bool) -> str:
    """The wheel in an environment of its own, without extras, in an empty folder."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        binaries = folder / "venv" / ("Scripts" if os.name == "nt" else "bin")
        env = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}

        def run(*words: str | Path, code: int = 0) -> str:
            done = subprocess.run(words, cwd=folder, env=env, capture_output=True, text=True, check=False)
            assert done.returncode == code, f"{' '.join(map(str, words))}: {done.stderr[-500:]}"
            return done.stdout + done.stderr

        run(sys.executable, "-m", "venv", "venv")
        wheel = DIST / f"sagesplat-{version()}-py3-none-any.whl"
        python, sagesplat = binaries / "python", binaries / "sagesplat"
        run(python, "-m", "pip", "install", "--constraint", ROOT / "constraints.txt", wheel)
        assert version() in run(sagesplat, "--version")
        assert "usage: sagesplat" in run(python, "-m", "sagesplat", "--help")
        (folder / "photos").mkdir()  # without labels: a network is needed first
        photo = "Image.new('RGB', (64, 48)).save(f'photos/{name}.png')"
        run(python, "-c", f"from PIL import Image\nfor name in 'abc': {photo}")
        missing = run(sagesplat, "run", "photos", "out", code=2)
        assert "install 'sagesplat[poses,hf]'" in missing, missing
        if not quick:
            run(sagesplat, "demo")
            assert (folder / "runs/demo/nested/report/index.html").is_file()
            missing = run(sagesplat, "view", "runs/demo", code=2)
            assert "install 'sagesplat[view]'" in missing, missing
            run(sagesplat, "bundle", "runs/demo", "site")
    return "help only" if quick else "help, demo, bundle"


def site() -> str:
    """The documentation builds without a warning."""
    if not (ROOT / "docs" / "conf.py").exists():
        return "no docs/conf.py: nothing to build"
    with tempfile.TemporaryDirectory() as folder:
        words = [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", "-b", "html", "docs", folder]
        done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr[-500:]
    return "no warning"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true")
    quick = parser.parse_args().quick
    checks: dict[str, Callable[[], str]] = {
        "versions": versions,
        "changelog": changelog,
        "checkout": clean_checkout,
        "packages": packages,
        "wheel": lambda: installed(quick),
    }
    if not quick:
        checks["site"] = site
    failed = 0
    for name, check in checks.items():
        try:
            print(f"✓ {name:10} {check()}", flush=True)
        except (AssertionError, ValueError, OSError, subprocess.CalledProcessError) as problem:
            failed += 1
            print(f"✗ {name:10} {problem}", flush=True)
    print("Left to do: tag, upload dist/, put the site online." if not failed else f"{failed} checks failed.")
    raise SystemExit(min(failed, 1))


if __name__ == "__main__":
    main()
