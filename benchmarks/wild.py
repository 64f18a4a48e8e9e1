"""Disturbed captures with and without their remedies, on the path and off it, where the truth is known.

Each row trains a scene as `sagesplat run` does, up to the stages that follow training. On the path the test
photos are measured as they were taken, without the pixels of figures. Off the path the photos of the truth
(`demo/off_path.py`) are measured where the photos of the path show the scene.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float32
from PIL import Image
from scipy.ndimage import gaussian_filter

from sagesplat.adapt.observe import as_unit, render_rgb
from sagesplat.core.config import CleanConfig, LabelsConfig, MasksConfig, SceneConfig, TrainConfig
from sagesplat.core.gaussians import Gaussians
from sagesplat.demo.capture import make_capture
from sagesplat.demo.wild import EVERYTHING, EXPOSURE, FIGURES, NOTHING, POSES, VIGNETTING, Wild
from sagesplat.formats.levels import read_level
from sagesplat.metrics.color_correct import color_correct_affine
from sagesplat.metrics.image import psnr, squared_error_map, ssim_map
from sagesplat.run.job import Job
from sagesplat.run.run_dir import RunDir
from sagesplat.scene.images import Photos
from sagesplat.scene.nerfstudio import load_transforms
from sagesplat.scene.scene import Camera, Scene
from sagesplat.segment.masks import Taxonomy
from sagesplat.stages.clean import clean_levels
from sagesplat.stages.label import lift_labels, make_masks
from sagesplat.stages.scene import open_scene
from sagesplat.stages.train import train_levels

Say = Callable[[str], None]
PLAIN: dict[str, Any] = {"exposure": "off", "sky": "off"}  # training settings without any remedy


class Row(NamedTuple):
    """A disturbance, and what is done about it."""

    wild: Wild
    train: dict[str, Any]  # settings of training
    ignore: str = ""  # categories that do not belong to the scene
    clean: bool = False  # floaters are removed after training
    vignetting: bool = False  # photos are corrected


FEWER = Wild(keep=0.45)  # 27 photos, of which 23 train
ROWS = {
    "clean": Row(NOTHING, PLAIN),
    "clean, auto": Row(NOTHING, {}),
    "exposure": Row(EXPOSURE, PLAIN),
    "exposure, auto": Row(EXPOSURE, {}),
    "vignetting": Row(VIGNETTING, PLAIN),
    "vignetting, auto": Row(VIGNETTING, {}),
    "vignetting, corrected": Row(VIGNETTING, {}, vignetting=True),
    "figures": Row(FIGURES, PLAIN),
    "figures, ignore": Row(FIGURES, PLAIN, "person"),
    "figures without masks": Row(replace(FIGURES, figure_masks=False), PLAIN),
    "figures without masks, outliers": Row(replace(FIGURES, figure_masks=False), PLAIN | {"outliers": True}),
    "poses": Row(POSES, PLAIN),
    "poses, refined": Row(POSES, PLAIN | {"poses": True}),
    "fewer": Row(FEWER, PLAIN),
    "half circle": Row(Wild(half_circle=True), PLAIN),
    "half circle, sky": Row(Wild(half_circle=True), PLAIN | {"sky": "auto"}),
    "half circle, sky, clean": Row(Wild(half_circle=True), PLAIN | {"sky": "auto"}, clean=True),
    "everything": Row(EVERYTHING, PLAIN),
    "everything, remedies": Row(EVERYTHING, {"poses": True}, "person", clean=True, vignetting=True),
}
OFF_PATH_VIEWS = 40
BLUR, OFF = 4.0, 0.1  # px and colour in [0, 1]: floaters and mist outlast a blur, missing detail does not


class Measured(NamedTuple):
    """Quality of one image on the pixels that count."""

    psnr: float
    cc_psnr: float  # colour-corrected, as gsplat's
    ssim: float
    mist: float  # share of pixels that are off by more than 0.1 where both images are blurred


def measure(folder: Path, names: tuple[str, ...], steps: int, seed: int, say: Say) -> dict[str, Any]:
    """Train and measure rows; captures and runs stay in `folder`, and what is done is not done again."""
    results = {}
    for name in names:
        row = ROWS[name]
        if missing := sorted(row.train.keys() - TrainConfig.__dataclass_fields__.keys()):
            say(f"{name}: left out, this checkout has no --train.{missing[0]}")
            continue
        results[name] = _measure(folder, name, row, steps, seed)
        say(_line(name, results[name]))
    return results


def _measure(folder: Path, name: str, row: Row, steps: int, seed: int) -> dict[str, Any]:
    wild = replace(row.wild, off_path=OFF_PATH_VIEWS)
    capture = folder / "captures" / f"{name.partition(',')[0].replace(' ', '-')}-{seed}"
    if not capture.exists():
        make_capture(capture, seed=seed, wild=wild)
    path = folder / "runs" / f"{name.replace(', ', '-').replace(' ', '-')}-{seed}-{steps}"
    job = Job(RunDir(path), lambda event: None)
    config = replace(TrainConfig(), max_steps=steps, **row.train)
    open_scene(job, capture, SceneConfig(vignetting=row.vignetting))
    make_masks(job, MasksConfig(), LabelsConfig(ignore=row.ignore))
    lift_labels(job)
    train_levels(job, config, seed)
    if row.clean:
        clean_levels(job, CleanConfig())
    g = read_level(job.trained)
    truth = load_transforms(capture / "truth")
    result: dict[str, Any] = {"gaussians": len(g), "train_views": len(job.scene.train_ids)}
    result["test"] = _means(on_path(job, g, capture))
    undisturbed = RunDir(folder / "runs" / f"clean-{seed}-{steps}")
    only_figures = wild.figures and replace(wild, figures=0, off_path=0).quiet
    if only_figures and undisturbed.levels.exists():  # its model, on the same photos and pixels
        plain = read_level(Job(undisturbed, job.emit).trained)
        result["test_undisturbed"] = _means(on_path(job, plain, capture))
    to_run = alignment(truth, job.scene) if wild.pose_shift else np.eye(4)
    off, by_category = off_path(g, capture, to_run, job.antialiased)
    result["off_path"], result["off_path_by_category"] = _means(off), by_category
    if wild.pose_shift:
        scenes = job.given_scene, job.scene
        result["position_error"] = [position_error(truth, scene) for scene in scenes]
    return result


def on_path(job: Job, g: Gaussians, capture: Path) -> Iterator[Measured]:
    """The test views without their exposure, on pixels that no figure hides."""
    for row in job.scene.test_ids.tolist():
        view = job.scene.views[row]
        counts = np.array(Image.open(capture / "truth" / "figures" / view.name)) == 0
        image = render_rgb(g, view.camera.neutral, backend=job.backend, antialiased=job.antialiased)
        yield _compared(image, as_unit(job.photos[row]), counts)[0]


def off_path(
    g: Gaussians, capture: Path, to_run: np.ndarray, antialiased: bool
) -> tuple[list[Measured], dict[str, list[float]]]:
    """Pictures off the path, and PSNR and SSIM over the pixels of each category; `to_run`: truth to run."""
    folder = capture / "truth" / "off_path"
    scene, rows, sums = load_transforms(folder, test_every=0), list[Measured](), dict[int, np.ndarray]()
    names, photos = Taxonomy.read(folder / "masks" / "labels.json").names, Photos(scene.views)
    for i, view in enumerate(scene.views):
        name = view.image_path.name
        counts, label = (np.array(Image.open(folder / below / name)) for below in ("seen", "masks"))
        camera = replace(view.camera, w2c=_moved(view.camera, to_run))
        image = render_rgb(g, camera, backend="auto", antialiased=antialiased)
        found, errors, ssim = _compared(image, as_unit(photos[i]), counts > 0)
        rows.append(found)
        for label_id in np.unique(label[counts > 0]).tolist():
            mine = (counts > 0) & (label == label_id)
            total = np.array([errors[mine].sum(), ssim[mine].sum(), mine.sum()], float)
            sums[label_id] = sums.get(label_id, np.zeros(3)) + total
    return rows, {names[k]: [float(psnr(e / n)), s / n] for k, (e, s, n) in sorted(sums.items())}


def _compared(
    image: Float32[np.ndarray, "H W 3"], photo: Float32[np.ndarray, "H W 3"], counts: Bool[np.ndarray, "H W"]
) -> tuple[Measured, Float32[np.ndarray, "H W"], Float32[np.ndarray, "H W"]]:
    """Quality on the pixels that count, the others being the same in both; maps of squared error and SSIM."""
    photo = np.where(counts[..., None], photo, image)
    errors, ssim = squared_error_map(image, photo), ssim_map(image, photo)
    corrected = squared_error_map(color_correct_affine(image, photo), photo)
    means = float(psnr(errors[counts].mean())), float(psnr(corrected[counts].mean()))
    blurred = gaussian_filter(image - photo, (BLUR, BLUR, 0))
    mist = (blurred**2).mean(-1)[counts] > OFF**2
    return Measured(*means, float(ssim[counts].mean()), float(mist.mean())), errors, ssim


def _means(found: Iterator[Measured] | list[Measured]) -> dict[str, float]:
    return dict(zip(Measured._fields, np.mean(list(found), 0).tolist(), strict=True))


def alignment(truth: Scene, scene: Scene) -> np.ndarray:
    """The similarity [4, 4] from the truth's world to that of a run, by training cameras (Umeyama 1991)."""
    a, b = (
        np.stack([s.views[i].camera.position for i in scene.train_ids]).astype(float) for s in (truth, scene)
    )
    x, y = a - a.mean(0), b - b.mean(0)
    u, s, vt = np.linalg.svd(y.T @ x)
    flip = np.diag([1, 1, np.sign(np.linalg.det(u @ vt))])
    found = np.eye(4)
    found[:3, :3] = (s * flip.diagonal()).sum() / (x**2).sum() * u @ flip @ vt
    found[:3, 3] = b.mean(0) - found[:3, :3] @ a.mean(0)
    return found


def position_error(truth: Scene, scene: Scene) -> float:
    """Mean distance of training cameras from the true ones after alignment, as a share of the extent."""
    to_scene = alignment(truth, scene)
    off = [
        to_scene[:3, :3] @ truth.views[i].camera.position + to_scene[:3, 3] - scene.views[i].camera.position
        for i in scene.train_ids
    ]
    return float(np.linalg.norm(off, axis=1).mean() / truth.extent)


def _moved(camera: Camera, to_run: np.ndarray) -> np.ndarray:
    """w2c of a camera of the truth in the run's world."""
    scale = np.cbrt(np.linalg.det(to_run[:3, :3]))
    w2c = camera.w2c.astype(float)
    rotation = w2c[:3, :3] @ to_run[:3, :3].T / scale
    w2c[:3, :3], w2c[:3, 3] = rotation, -rotation @ (to_run[:3, :3] @ camera.position + to_run[:3, 3])
    return w2c.astype(np.float32)


def _line(name: str, result: dict[str, Any]) -> str:
    test, off = result["test"], result["off_path"]
    line = (
        f"{name:32} test {test['psnr']:6.2f} dB (cc {test['cc_psnr']:6.2f}) {test['ssim']:.3f}   "
        f"off path {off['psnr']:6.2f} dB (cc {off['cc_psnr']:6.2f}) {off['ssim']:.3f}"
        f" mist {off['mist']:.2%}"
    )
    if "test_undisturbed" in result:
        plain = result["test_undisturbed"]
        line += f"   undisturbed model on the same pixels {plain['psnr']:.2f} dB, {plain['ssim']:.3f}"
    if "position_error" in result:
        before, after = result["position_error"]
        line += f"   positions off by {before:.3%}, then {after:.3%}"
    return line
