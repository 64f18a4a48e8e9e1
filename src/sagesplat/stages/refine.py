"""Writes what training refined of the cameras, for everything after it."""

import math
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from sagesplat.adapt.observe import as_unit, measure_total, render_rgb
from sagesplat.core.config import TrainConfig
from sagesplat.core.errors import RunError
from sagesplat.core.events import Progress
from sagesplat.core.gaussians import Gaussians
from sagesplat.core.limits import Count, Number
from sagesplat.io.files import write_json
from sagesplat.io.typed import read_json_as
from sagesplat.raster import Workspace, device_of
from sagesplat.run.job import Job
from sagesplat.run.run_dir import RunDir
from sagesplat.scene.refined import given_cameras, with_cameras, write_refined
from sagesplat.scene.scene import Camera, Scene
from sagesplat.stages.refine_exposure import (
    ExposureFigures,
    exposure_figures,
    exposure_lines,
    with_exposures,
)
from sagesplat.train.events import Trained
from sagesplat.train.poses import PoseUpdate, diverged, fit_pose, pose_update, refined_cameras
from sagesplat.train.view_parameters import ViewParameters


@dataclass(frozen=True)
class PoseFigures:
    """What pose refinement did: of the training views, and of the test views as given and as fitted."""

    pixels: Number  # how far the image of a training view moved, root mean square over its points; their mean
    degrees: Number  # how far the training views turned, mean
    shift: Number  # how far they moved, mean, as a share of the scene's extent
    diverged: Count  # training views whose pose was put back
    fitted: Count  # held-out views whose pose was fitted to their photo
    held_out: Count  # all held-out views
    psnr: tuple[Number, Number] | None  # mean over the test views, given and fitted; None: no test views
    ssim: tuple[Number, Number] | None


@dataclass(frozen=True)
class Refined:
    """Content of refined.json: what was refined; None: nothing was."""

    poses: PoseFigures | None = None
    exposure: ExposureFigures | None = None


def write_cameras(job: Job, place: RunDir, config: TrainConfig, trained: Trained) -> list[str]:
    """Write the refined cameras; without any, remove those of an earlier training. Returns lines on them."""
    place.cameras.unlink(missing_ok=True)
    place.refined.unlink(missing_ok=True)
    if not trained.per_view:
        return []
    scene, cameras, lines = job.given_scene, given_cameras(job.given_scene), list[str]()
    made: dict[str, Any] = {}
    if "exposure" in trained.per_view:  # first: poses are fitted to photos of their exposure
        cameras = with_exposures(job, scene, cameras, config.antialiased, trained)
        scene = with_cameras(scene, cameras)
    if "pose" in trained.per_view:
        update = pose_update(scene, config.max_steps, max(config.batch, job.processes))
        poses, figures = _refined_poses(job, scene, config, update, trained)
        fitted = np.array([pose is not view.camera for pose, view in zip(poses, scene.views, strict=True)])
        fitted[scene.train_ids] = False
        cameras = replace(
            cameras, w2c=np.stack([camera.w2c for camera in poses]), fitted=fitted | cameras.fitted
        )
        made["poses"] = asdict(figures)
        lines += pose_lines(figures)
        if "exposure" in trained.per_view:
            scene = with_cameras(job.given_scene, cameras)
            cameras = with_exposures(job, scene, cameras, config.antialiased, trained)
    if "exposure" in trained.per_view:
        scene = with_cameras(job.given_scene, cameras)
        of_exposure = exposure_figures(job, scene, config.antialiased, trained)
        made["exposure"] = asdict(of_exposure)
        lines += exposure_lines(of_exposure)
    write_json(place.refined, made)
    write_refined(place.cameras, cameras)
    return lines


def _refined_poses(
    job: Job, scene: Scene, config: TrainConfig, update: PoseUpdate, trained: Trained
) -> tuple[list[Camera], PoseFigures]:
    """The cameras of all views, those of held-out ones fitted to their photos, and what that did."""
    parameters = trained.per_view["pose"]
    poses = refined_cameras(scene, update, parameters)
    held_out = np.setdiff1d(np.arange(len(poses)), scene.train_ids).tolist()
    g, space = trained.gaussians.to(device_of(job.backend)), Workspace()
    held_out = job.valid.rows(scene, held_out)
    for number, row in enumerate(held_out, 1):
        poses[row] = fit_pose(
            g, poses[row], job.photos[row], update.axes[row].double().numpy(), scene.scale, config,
            valid=job.valid[scene.views[row]], backend=job.backend, workspace=space,
        )  # fmt: skip
        job.emit(Progress("held-out poses", number, len(held_out)))
    given = [view.camera for view in scene.views]
    fitted = sum(poses[row] is not given[row] for row in held_out)
    before, after = (
        _quality(job, g, scene.test_ids, cameras, config.antialiased) for cameras in (given, poses)
    )
    figures = replace(
        _moves(scene, update, parameters), fitted=fitted, held_out=len(held_out),
        psnr=before and after and (before[0], after[0]), ssim=before and after and (before[1], after[1]),
    )  # fmt: skip
    return poses, figures


def _moves(scene: Scene, update: PoseUpdate, parameters: ViewParameters) -> PoseFigures:
    """How far the training views moved."""
    rows = torch.from_numpy(scene.train_ids)
    values = parameters.values[rows]
    turns, shifts = update.motions(values, rows).view(-1, 2, 3).norm(dim=-1).mean(0).tolist()
    focal = torch.tensor([float(scene.views[row].camera.K[0, 0]) for row in rows.tolist()])
    pixels = float((values.norm(dim=1) * focal).mean())
    count = int(diverged(parameters)[rows].sum())
    return PoseFigures(pixels, math.degrees(turns), shifts / scene.scale, count, 0, 0, None, None)


def _quality(
    job: Job, g: Gaussians, rows: np.ndarray, cameras: list[Camera], antialiased: bool
) -> tuple[float, float] | None:
    """Mean PSNR and SSIM over some rows of the scene's views; None without any."""
    found = []
    for row in job.valid.rows(job.given_scene, rows):
        image = render_rgb(g, cameras[row], backend=job.backend, antialiased=antialiased)
        view = job.given_scene.views[row]
        measured = measure_total(image, as_unit(job.photos[row]), job.valid[view])
        found.append((measured["psnr"], measured["ssim"]))
    means = np.mean(found, 0).tolist() if found else None
    return means and (means[0], means[1])


def pose_lines(figures: PoseFigures) -> list[str]:
    """What pose refinement did, in words."""
    lines = [
        f"poses of training views moved by {figures.pixels:.2f} px on average "
        f"({figures.degrees:.3f} degrees, {figures.shift:.2%} of the extent)"
    ]
    if figures.diverged:
        lines.append(f"{figures.diverged} poses diverged and were put back as given")
    if missed := figures.held_out - figures.fitted:
        lines.append(f"{missed} of {figures.held_out} held-out poses could not be fitted, and stay as given")
    if figures.psnr and figures.ssim:
        (given_psnr, psnr), (given_ssim, ssim) = figures.psnr, figures.ssim
        lines.append(
            f"test views: SSIM {ssim:.3f} / {psnr:.2f} dB with poses fitted to their photos, "
            f"{given_ssim:.3f} / {given_psnr:.2f} dB as given"
        )
    return lines


def read_refined_figures(path: Path) -> Refined:
    """What `write_cameras` wrote of poses and exposures. RunError for anything else."""
    if not path.exists():
        return Refined()
    return read_json_as(
        path, Refined, "what was refined", "run `sagesplat train` again with --force", RunError
    )
