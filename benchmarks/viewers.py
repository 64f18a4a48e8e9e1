"""Exports in the engines of others: PlayCanvas and Spark in Chromium, against our renders of the same levels.

A page draws one file from one camera, with the engine's own settings but for these: Spark sorts by depth, as
3DGS does, and is told where a run was trained without antialiasing, which it does by itself; PlayCanvas is
told which level of a streamed SOG to show. PlayCanvas gets files of `--rasterize-mode playcanvas`. Those for
Spark are as the run was trained.
"""

import base64
import io
import json
import math
import shutil
import tempfile
import threading
import urllib.parse
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import torch
import tyro
from PIL import Image

from benchmarks.common import finish
from sagesplat.core.gaussians import Gaussians
from sagesplat.formats.lod_meta import LOD_META
from sagesplat.formats.splats import num_lods
from sagesplat.metrics.image import psnr
from sagesplat.raster import rasterize
from sagesplat.run.job import Job
from sagesplat.scene.scene import Camera
from sagesplat.stages.api import open_run
from sagesplat.stages.export import export_scene
from tests.browser import launch, open_page

if TYPE_CHECKING:
    from playwright.sync_api import Browser

Engine = Literal["playcanvas", "spark"]
FORMATS: dict[Engine, tuple[str, ...]] = {
    "playcanvas": (".ply", ".compressed.ply", ".sog", ".glb", LOD_META),
    "spark": (".ply", ".spz", ".sog", ".splat", ".rad"),
}
PACKAGES = {"playcanvas": "playcanvas", "spark": "@sparkjsdev/spark", "three": "three"}  # in node_modules
# to the axes that engines show a format in; those of a PLY are shown as they are
_AXES = {".spz": (1.0, -1.0, -1.0), ".glb": (-1.0, -1.0, 1.0)}
_SECONDS = 180.0  # that a page has for its picture: software draws


class _Silent(SimpleHTTPRequestHandler):
    def log_message(self, format: str, *args: Any) -> None:
        """Nothing: requests are no output."""


@dataclass(frozen=True)
class Viewers:
    """A browser, and what is served to it."""

    browser: "Browser"
    folder: Path
    url: str

    def draw(
        self, engine: Engine, file: Path, camera: Camera, *, antialiased: bool = False, lod: int = 0
    ) -> np.ndarray:
        """The picture [H, W, 3] in [0, 1] of a splat file; the camera's principal point is in the middle."""
        link = self.folder / "files"
        link.unlink(missing_ok=True)
        link.symlink_to(file.parent.resolve(), target_is_directory=True)
        axes = next((axes for suffix, axes in _AXES.items() if file.name.endswith(suffix)), (1.0, 1.0, 1.0))
        pose = np.linalg.inv(camera.w2c.astype(np.float64)) @ np.diag([1.0, -1, -1, 1])
        asked = {
            "viewer": engine, "url": f"./files/{file.name}", "width": camera.width, "height": camera.height,
            "fov": 2 * math.degrees(math.atan(camera.height / 2 / float(camera.K[1, 1]))),
            "near": 0.01, "far": 1000, "matrix": (np.diag([*axes, 1.0]) @ pose).T.ravel().tolist(),
            "antialiased": antialiased, "lod": lod,
        }  # fmt: skip
        page = f"{self.url}#{urllib.parse.quote(json.dumps(asked))}"
        with open_page(page, (camera.width, camera.height), browser=self.browser) as opened:
            opened.wait_for("Boolean(window.picture || window.failure)", _SECONDS)
            if failure := opened.page.evaluate("window.failure ?? null"):
                raise RuntimeError(f"{engine}, {file.name}: {failure}")
            encoded = opened.page.evaluate("window.picture").split(",")[1]
        return np.asarray(Image.open(io.BytesIO(base64.b64decode(encoded))).convert("RGB"), np.float32) / 255


@contextmanager
def viewers(*packages: Path) -> Iterator[Viewers]:
    """Engines of some folders `node_modules`, ready to draw."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        (folder / "index.html").symlink_to(Path(__file__).with_suffix(".html"))
        for name, inside in PACKAGES.items():
            found = [path / inside for path in packages if (path / inside).is_dir()]
            if found:
                (folder / name).symlink_to(found[0].resolve(), target_is_directory=True)
        server = ThreadingHTTPServer(("127.0.0.1", 0), partial(_Silent, directory=temporary))
        threading.Thread(target=server.serve_forever, daemon=True).start()
        try:
            with launch() as browser:
                yield Viewers(browser, folder, f"http://127.0.0.1:{server.server_address[1]}/")
        finally:
            server.shutdown()
            server.server_close()


def centred(camera: Camera) -> Camera:
    """The camera as engines have them: square pixels, the principal point in the middle, black behind."""
    focal, width, height = float(camera.K[1, 1]), camera.width, camera.height
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], np.float32)
    return replace(camera, K=K, background=(0, 0, 0), exposure=None)


def ours(g: Gaussians, camera: Camera, antialiased: bool) -> np.ndarray:
    """Our picture [H, W, 3] in [0, 1]."""
    with torch.no_grad():
        return rasterize(g, camera, antialiased=antialiased).rgb.clamp(0, 1).numpy()


def measure(
    job: Job, engines: dict[Engine, Path], levels: Sequence[int], views: int, side: int, folder: Path
) -> Iterator[dict[str, Any]]:
    """Rows of engine, format, level and dB: that of the mean squared error over the views."""
    ids = job.scene.train_ids[np.linspace(0, len(job.scene.train_ids) - 1, views + 2).astype(int)[1:-1]]
    cameras = [centred(job.scene.views[int(i)].camera.within(side)) for i in ids]
    levels = sorted(levels or job.ladder.levels, reverse=True)
    with viewers(*engines.values()) as drawn:
        streamed = folder / "streamed" / LOD_META
        if "playcanvas" in engines:
            export_scene(job, streamed, level=None, labels=[], target=None, levels=levels)
            if num_lods(streamed) != len(levels):
                raise ValueError("levels that show the same; name fewer with --levels")
        for lod, level in enumerate(levels):
            g = job.ladder.load(level)
            wanted = [ours(g, camera, job.antialiased) for camera in cameras]
            pairs: list[tuple[Engine, str]] = [(one, kind) for one in engines for kind in FORMATS[one]]
            for engine, kind in pairs:
                if kind == ".splat" and bool(g.shN.any()):
                    continue  # it holds no harmonics
                file = streamed if kind == LOD_META else folder / f"{engine}-{level}{kind}"
                antialiased = engine == "spark" and job.antialiased
                if kind != LOD_META:
                    mode = "playcanvas" if engine == "playcanvas" else "antialiased" if antialiased else None
                    export_scene(job, file, level=level, labels=[], target=None, rasterize_mode=mode)
                found = [
                    drawn.draw(engine, file, camera, antialiased=antialiased, lod=lod) for camera in cameras
                ]
                error = np.mean([np.square(a - b).mean() for a, b in zip(found, wanted, strict=True)])
                yield {"engine": engine, "format": kind, "level": level, "dB": float(psnr(float(error)))}


def main(
    run: tyro.conf.Positional[Path],
    playcanvas: Path | None = None,
    spark: Path | None = None,
    levels: tuple[int, ...] = (),
    views: int = 2,
    side: int = 480,
    write: bool = False,
) -> None:
    """A run's exports in PlayCanvas's engine and in Spark: dB to our renders, by format and level.

    Args:
        run: run folder.
        playcanvas: a folder node_modules with playcanvas.
        spark: one with @sparkjsdev/spark and three.
        levels: numbers of levels (default: all).
        views: training views, evenly spaced.
        side: of the pictures, at most [px].
        write: keep the figures in benchmarks/results/cpu.
    """
    given: dict[Engine, Path | None] = {"playcanvas": playcanvas, "spark": spark}
    engines: dict[Engine, Path] = {
        engine: path for engine, path in given.items() if path and (path / PACKAGES[engine]).is_dir()
    }
    rows = []
    folder = Path(tempfile.mkdtemp())
    try:
        for row in measure(open_run(run).job, engines, levels, views, side, folder):
            rows.append(row)
            print(f"{row['engine']:11}{row['format']:15}{row['level']:>5}{row['dB']:8.2f} dB", flush=True)
    finally:
        shutil.rmtree(folder)
    least = {engine: min(row["dB"] for row in rows if row["engine"] == engine) for engine in engines}
    finish("viewers", {"run": run.name, "side": side, "least_dB": least, "rows": rows}, write)


if __name__ == "__main__":
    tyro.cli(main, prog="python -m benchmarks.viewers")
