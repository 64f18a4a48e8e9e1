"""Kernels' disk cache: what makes it stale, and what does not."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

FILES = {
    "constants.py": "STEP = 1\nTABLE = (1, 2)\n",
    "helper.py": """
from shapes.constants import STEP
from sagesplat.kernels.jit import njit

@njit(cache=True)
def helper(x):
    return x + STEP
""",
    "plain.py": """
from numba.extending import register_jitable

@register_jitable
def half(x):
    return x / 2
""",
    "intrinsics.py": """
from numba import types
from numba.extending import intrinsic

@intrinsic
def three(context):
    def generate(context, builder, sig, values):
        return context.get_constant(types.int64, 3)
    return types.int64(), generate
""",
    "kernel.py": """
import numpy as np
from sagesplat.kernels.jit import njit
from shapes import plain
from shapes.intrinsics import three
from shapes.helper import helper

@njit(cache=True)
def kernel(x):
    return helper(x) + three() + plain.half(LATER[0])

LATER = np.array([8.0])
""",
}
CODE = """
from shapes.kernel import kernel
print(kernel(10), sum(kernel.stats.cache_hits.values()))
"""


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """A package of a kernel that uses others, a constant, an intrinsic and a module of other files."""
    folder = tmp_path / "shapes"
    folder.mkdir()
    for name, text in ({"__init__.py": ""} | FILES).items():
        (folder / name).write_text(text)
    return folder


def result(package: Path) -> tuple[float, bool]:
    """What the kernel returns in a process of its own, and whether it came from the cache."""
    paths = os.pathsep.join([str(package.parent), *sys.path])
    environment = {name: value for name, value in os.environ.items() if not name.startswith("NUMBA")}
    done = subprocess.run(
        [sys.executable, "-c", CODE], env=environment | {"PYTHONPATH": paths, "PYTHONDONTWRITEBYTECODE": "1"},
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    value, hits = done.stdout.split()
    return float(value), bool(int(hits))


@pytest.mark.slow
def test_a_change_in_any_file_that_a_kernel_uses_compiles_it_again(package: Path) -> None:
    assert result(package) == (18, False)
    assert result(package) == (18, True)
    for name, old, new, wanted in (
        ("constants.py", "STEP = 1", "STEP = 2", 19),  # a constant of a kernel that this one calls
        ("intrinsics.py", "int64, 3", "int64, 4", 20),
        ("plain.py", "x / 2", "x / 4", 18),
    ):
        path = package / name
        path.write_text(path.read_text().replace(old, new))
        assert result(package) == (wanted, False), name
    (package / "constants.py").write_text("STEP = 2\nTABLE = (1, 3)\n")  # which no kernel uses
    assert result(package) == (18, True)


def test_without_a_folder_to_write_kernels_are_compiled_in_memory(package, monkeypatch):
    from numba.core import caching

    from sagesplat.kernels.jit import njit

    def refused(self: object) -> None:
        raise PermissionError

    monkeypatch.setattr(caching._CacheLocator, "ensure_cache_path", refused)
    assert njit(_twice, cache=True)(4) == 8


def _twice(x):
    return 2 * x
