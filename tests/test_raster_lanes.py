"""Kernels with vectors of the width that other machines use."""

import os
import subprocess
import sys

from sagesplat.kernels.simd import LANES

TESTS = (
    "test_raster_cpu.py::test_agrees_with_the_oracle",
    "test_metrics_ssim_cpu.py::test_tiles_that_leave_the_loss",
)


def test_the_other_width_agrees_with_the_oracle(tmp_path, request):
    other = {8: "16", 16: "8"}[LANES]
    environment = {**os.environ, "SAGESPLAT_LANES": other, "NUMBA_CACHE_DIR": str(tmp_path)}
    command = [sys.executable, "-m", "pytest", "-q", "-k", "not stand-in and not device", *TESTS]
    done = subprocess.run(
        command, env=environment, cwd=request.path.parent, capture_output=True, text=True, timeout=600
    )
    assert done.returncode == 0, done.stdout
    assert " passed" in done.stdout
