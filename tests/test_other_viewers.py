"""What is exported looks the same in the engines of others, from npm: Spark, and PlayCanvas where it is."""

from dataclasses import replace
from pathlib import Path

import browser as chromium
import numpy as np
import pytest
import torch

from benchmarks.viewers import FORMATS, PACKAGES, Engine, centred, ours, viewers
from sagesplat.formats.lod_meta import LOD_META
from sagesplat.formats.lod_meta_write import write_lod_meta
from sagesplat.formats.splats import write_splat
from sagesplat.metrics.image import psnr
from sagesplat.raster.classic import for_playcanvas
from tests.conftest import pinhole, random_gaussians

pytestmark = pytest.mark.slow  # a browser, whose software draws

MODULES = Path(__file__).parent.parent / "web" / "node_modules"


@pytest.mark.parametrize("engine", ["spark", "playcanvas"])
def test_the_picture_is_ours(tmp_path: Path, engine: Engine) -> None:
    if why := chromium.missing():
        pytest.skip(why)
    if not (MODULES / PACKAGES[engine]).is_dir():
        pytest.skip(f"needs {PACKAGES[engine]} (npm install --no-save {PACKAGES[engine]} in web/)")
    camera = centred(pinhole(320, 240))
    fine = random_gaussians(400, degree=2, log_scale=-2.6, logit=1.0)
    fine = replace(fine, sh0=fine.sh0 * 0.5)  # colours that bytes hold
    levels = [
        replace(g, label_ids=torch.zeros(len(g), dtype=torch.int16))
        for g in (fine, fine.select(torch.arange(90)))
    ]
    wanted = [ours(g, camera, False) for g in levels]
    written = [for_playcanvas(g, [camera]) if engine == "playcanvas" else g for g in levels]
    write_lod_meta(tmp_path / "streamed", written, {0: 0})
    found = {}
    with viewers(MODULES) as drawn:
        for kind in FORMATS[engine]:
            for lod, g in enumerate(written):
                file = tmp_path / "streamed" / LOD_META if kind == LOD_META else tmp_path / f"{lod}{kind}"
                if kind == ".splat":  # no harmonics
                    continue
                if kind != LOD_META:
                    write_splat(file, g)
                image = drawn.draw(engine, file, camera, lod=lod)
                found[kind, lod] = float(psnr(float(np.square(image - wanted[lod]).mean())))
    assert {one: db for one, db in found.items() if db < 35} == {}
