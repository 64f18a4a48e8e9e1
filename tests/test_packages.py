"""The versions of packages: what users may have, and what the tests ran with."""

import re
import tomllib
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
REQUIRED = [
    Requirement(text)
    for texts in (PROJECT["dependencies"], *PROJECT["optional-dependencies"].values())
    for text in texts
]
SAFE = {  # the first versions without a hole that strangers reach; pyproject.toml says which
    "torch": "2.10",
    "onnxruntime": "1.27",
    "pillow": "13",
    "jinja2": "3.1.6",
    "starlette": "1.3.1",
    "h11": "0.16",
    "pi-heif": "1.3",
}


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


@pytest.mark.parametrize("name", SAFE)
def test_minimum_versions_have_no_known_holes(name: str) -> None:
    minimum = min(
        Version(one.version)
        for requirement in REQUIRED
        if canonicalize_name(requirement.name) == name
        for one in requirement.specifier
        if one.operator in (">=", "==")
    )
    assert minimum >= Version(SAFE[name])
    try:
        assert Version(version(name)) >= minimum
    except PackageNotFoundError:
        pytest.skip(f"{name} is not installed")
