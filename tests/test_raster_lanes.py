"""Kernels with vectors of the width that other machines use."""

import os
import shutil
import subprocess
import sys
from pathlib import Path
from types import FunctionType

import pytest

import sagesplat
from sagesplat.kernels.jit import fingerprint
from sagesplat.kernels.simd import LANES, load, load8, load16

TESTS = (
    "test_raster_cpu.py::test_agrees_with_the_oracle",
    "test_metrics_ssim_cpu.py::test_tiles_that_leave_the_loss",
)


@pytest.mark.slow
def test_the_other_width_agrees_with_the_oracle(tmp_path, request):
    """In a copy of the package and its cache: only kernels with vectors of that width are compiled."""
    unfinished = shutil.ignore_patterns("static", "*.tmp.*")
    shutil.copytree(Path(sagesplat.__file__).parent, tmp_path / "sagesplat", ignore=unfinished)
    environment = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"}
    environment["SAGESPLAT_LANES"] = {8: "16", 16: "8"}[LANES]
    environment["PYTHONPATH"] = os.pathsep.join([str(tmp_path), *sys.path])
    command = [sys.executable, "-m", "pytest", "-q", "-k", "not stand-in and not device", *TESTS]
    done = subprocess.run(
        command, env=environment, cwd=request.path.parent, capture_output=True, text=True, timeout=1800
    )
    assert done.returncode == 0, done.stdout
    assert " passed" in done.stdout


def test_a_kernel_of_another_width_has_another_fingerprint() -> None:
    def kernel(x):
        return load(x, 0)

    eight, sixteen = (
        fingerprint(FunctionType(kernel.__code__, {"load": other, "__name__": "sagesplat.kernel"}))
        for other in (load8, load16)
    )
    assert eight != sixteen
