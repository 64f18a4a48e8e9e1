"""Exposure of all views after a training, learned or fitted to held-out photos, and what it is worth."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float32

from sagesplat.adapt.observe import as_unit, measure_total, render_rgb
from sagesplat.core.gaussians import Gaussians
from sagesplat.core.limits import Number
from sagesplat.metrics.color_correct import color_correct_affine
from sagesplat.raster import Workspace, device_of
from sagesplat.run.job import Job
from sagesplat.scene.gains import exposure_values
from sagesplat.scene.refined import RefinedCameras
from sagesplat.scene.scene import Camera, Scene
from sagesplat.train.events import Trained
from sagesplat.train.exposure import fit_exposure, transforms

_HOW = ("plain", "exposed", "cc")


@dataclass(frozen=True)
class ExposureFigures:
    """What the colour transforms of the photos are worth, means over the test views; None: no test views.

    plain: without a transform; exposed: with the one fitted to the photo; cc: colour-corrected (gsplat).
    """

    range_ev: Number  # from the darkest to the brightest training photo, EV
    psnr: dict[str, Number] | None  # dB
    ssim: dict[str, Number] | None

    def __post_init__(self) -> None:
        if any(measured is not None and set(measured) != set(_HOW) for measured in (self.psnr, self.ssim)):
            raise ValueError("other measurements")


def with_exposures(
    job: Job, scene: Scene, cameras: RefinedCameras, antialiased: bool, trained: Trained
) -> RefinedCameras:
    """The cameras with the exposures of all views; `scene` has their poses."""
    exposure, fitted = transforms(trained.per_view["exposure"]), cameras.fitted.copy()
    g, space = trained.gaussians.to(device_of(job.backend)), Workspace()
    for row in job.valid.rows(scene, np.setdiff1d(np.arange(len(scene.views)), scene.train_ids)):
        image = render_rgb(
            g, scene.views[row].camera.neutral,
            backend=job.backend, antialiased=antialiased, workspace=space,
        )  # fmt: skip
        photo, valid = as_unit(job.photos[row]), job.valid[scene.views[row]]
        exposure[row], fitted[row] = fit_exposure(image, photo, valid), True
    return replace(cameras, exposure=exposure, fitted=fitted)


def exposure_figures(job: Job, scene: Scene, antialiased: bool, trained: Trained) -> ExposureFigures:
    """Measure the test views of a scene with refined cameras, with and without their exposure."""
    exposures = [scene.views[row].camera.exposure for row in scene.train_ids]
    ev = exposure_values(np.stack([np.eye(3, 4) if e is None else e for e in exposures]))
    g, space, found = trained.gaussians.to(device_of(job.backend)), Workspace(), []
    for row in job.valid.rows(scene, scene.test_ids):
        valid = job.valid[scene.views[row]]
        camera, photo = scene.views[row].camera, as_unit(job.photos[row])
        plain, exposed = (_image(job, g, one, antialiased, space) for one in (camera.neutral, camera))
        images = plain, exposed, color_correct_affine(plain, photo, valid)
        measured = [measure_total(image, photo, valid) for image in images]
        found.append([(of["psnr"], of["ssim"]) for of in measured])
    if not found:
        return ExposureFigures(float(np.ptp(ev)), None, None)
    decibels, ssim = np.mean(found, 0).T.tolist()
    return ExposureFigures(
        float(np.ptp(ev)), dict(zip(_HOW, decibels, strict=True)), dict(zip(_HOW, ssim, strict=True))
    )


def _image(
    job: Job, g: Gaussians, camera: Camera, antialiased: bool, space: Workspace
) -> Float32[np.ndarray, "H W 3"]:
    return render_rgb(g, camera, backend=job.backend, antialiased=antialiased, workspace=space).copy()


def exposure_lines(figures: ExposureFigures) -> list[str]:
    """The figures in words."""
    lines = [f"a colour transform for each photo: they span {figures.range_ev:.1f} EV"]
    if figures.psnr and figures.ssim:
        ssim, decibels = figures.ssim, figures.psnr
        lines.append(
            "test views: "
            f"SSIM {ssim['exposed']:.3f} / {decibels['exposed']:.2f} dB with colours fitted to their photos, "
            f"{ssim['plain']:.3f} / {decibels['plain']:.2f} dB plain, "
            f"cc_ssim {ssim['cc']:.3f} / cc_psnr {decibels['cc']:.2f} dB"
        )
    return lines
