"""3D instances of the built-in garden, whose objects are known, and how fast labels are lifted.

Truth of a Gaussian is the modelled object of the surface point nearest to its centre, among those that the
photos show: it does not depend on what is measured. Gaussians that can hardly be seen do not count
(`_all`: with them); those that got no instance count as a class of their own.
"""

import multiprocessing
import resource
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from scipy.ndimage import binary_dilation, binary_erosion
from scipy.optimize import linear_sum_assignment
from scipy.spatial import KDTree

from sagesplat.adapt.observe import RenderedLabels
from sagesplat.core.config import LabelsConfig, MasksConfig, PosesConfig, SceneConfig, TrainConfig
from sagesplat.core.gaussians import Gaussians, concat
from sagesplat.demo.cameras import demo_cameras
from sagesplat.demo.capture import cached_capture
from sagesplat.demo.objects import render_objects
from sagesplat.demo.world import HOUSE
from sagesplat.raster import set_threads
from sagesplat.run.job import Job
from sagesplat.run.run_dir import RunDir
from sagesplat.scene.scene import Camera, Points, Scene, View
from sagesplat.segment.instances import import_instances, instance_path, read_instances
from sagesplat.segment.masks import Masks, Taxonomy
from sagesplat.stages.label import lift_labels, make_masks
from sagesplat.stages.scene import open_scene
from sagesplat.stages.train import train_levels
from sagesplat.train.instances import Instances, gather, label

WANTED = ("potted plant", "vase", "dining table", "tree-merged")
OPAQUE = 0.1  # opacity from which on a Gaussian counts
RADIUS = 3  # px by which masks are eroded or dilated
GAUSSIANS, VIEWS, LABELS, WIDTH, HEIGHT = 200_000, 185, 40, 512, 384  # of the lifting bar

Corrupt = Callable[[np.ndarray, np.random.Generator], np.ndarray]


def measure(out: Path, steps: int, seed: int) -> dict[str, float]:
    """ARI with shuffled and corrupted masks, mIoU of unseen views, seconds and GB of lifting."""
    job = _trained(out, steps)
    g = job.snapshots.load(job.snapshots.levels[-1])
    truth = _truth_of(job.scene, g)
    opaque = (torch.sigmoid(g.logit_opacities) >= OPAQUE).numpy()
    result: dict[str, float] = {
        "gaussians": len(g),
        "opaque": int(opaque.sum()),
        "objects": len(set(truth[truth >= 0].tolist())),
    }
    for name, corrupt in (("shuffled", shuffled), ("corrupted", corrupted)):
        found = _found(job, g, corrupt, np.random.default_rng(seed))
        mine = (truth >= 0) & opaque
        instances = np.where(np.isin(found.label_ids, list(found.parents)), found.label_ids, -1)
        result[f"ari_{name}"] = adjusted_rand_index(truth[mine], instances[mine])
        result[f"ari_{name}_all"] = adjusted_rand_index(truth[truth >= 0], instances[truth >= 0])
        result[f"miou_unseen_{name}"] = _unseen_iou(job, g, found)
        result[f"instances_{name}"] = len(found.parents)
    return result | lifting(g)


def _trained(out: Path, steps: int) -> Job:
    """The garden, trained; an earlier training in `out` is used again."""
    job = Job(RunDir(out), lambda _: None)
    config = TrainConfig(max_steps=steps, level_every=steps)
    open_scene(job, cached_capture(), SceneConfig(), PosesConfig(), MasksConfig(), LabelsConfig())
    make_masks(job, MasksConfig())
    lift_labels(job)
    train_levels(job, config, 0)
    import_instances(job.scene, cached_capture() / "masks", job.run.photo_instances)
    return job


def _truth_of(scene: Scene, g: Gaussians) -> np.ndarray:
    """The object of each Gaussian, -1 where it has none of a wanted category."""
    seen = [render_objects(view.camera) for view in scene.views]
    objects = np.concatenate([found.ravel() for found, _ in seen])
    points = np.concatenate([points.reshape(-1, 3) for _, points in seen])
    near = np.isfinite(points).all(1) & (np.abs(points).max(1) < 1e3)
    rows = KDTree(points[near]).query(g.means.numpy())[1]
    truth = objects[near][rows]
    return np.where(truth == HOUSE, -1, truth)


def _found(job: Job, g: Gaussians, corrupt: Corrupt, rng: np.random.Generator) -> Instances:
    """3D instances from the training views' masks, corrupted."""
    views = job.scene.train_ids.tolist()
    images = {job.scene.views[row].name: corrupt(_instances(job, job.scene.views[row]), rng) for row in views}
    wanted = [i for i, name in job.masks.taxonomy.names.items() if name in WANTED]
    sightings = gather(
        g, job.scene, job.masks, lambda view: images[view.name], views, wanted, antialiased=job.antialiased
    )
    return label(g, sightings, job.masks.taxonomy)


def _instances(job: Job, view: View) -> np.ndarray:
    return read_instances(instance_path(job.run.photo_instances, view))


def shuffled(instances: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The same instances with other numbers."""
    order = rng.permutation(int(instances.max()) + 1).astype(np.int16)
    return np.where(instances < 0, instances, order[instances])


def corrupted(instances: np.ndarray, rng: np.random.Generator, share: float = 0.3) -> np.ndarray:
    """Of the masks, each with this probability: eroded or dilated, cut in two, dropped; and shuffled."""
    result = np.full_like(instances, -1)
    disc = np.hypot(*np.mgrid[-RADIUS : RADIUS + 1, -RADIUS : RADIUS + 1]) <= RADIUS
    count = 0
    for number in rng.permutation(int(instances.max()) + 1):
        mask = instances == number
        erode, dilate, split, drop = rng.random(4) < share
        if drop or not mask.any():
            continue
        mask = np.asarray(binary_erosion(mask, disc) if erode else mask, bool)
        mask = np.asarray(binary_dilation(mask, disc) if dilate else mask, bool)
        result[mask] = count
        if split and mask.any():
            v, u = np.nonzero(mask)
            angle = rng.uniform(0, np.pi)
            along = u * np.cos(angle) + v * np.sin(angle)
            half = along > np.quantile(along, rng.uniform(0.3, 0.7))
            result[v[half], u[half]] = count + 1
        count += 2
    return shuffled(result, rng)


def adjusted_rand_index(a: np.ndarray, b: np.ndarray) -> float:
    """Agreement of two partitions: 1 where they are the same, about 0 by chance (Hubert and Arabie 1985)."""
    _, a = np.unique(a, return_inverse=True)
    _, b = np.unique(b, return_inverse=True)
    rows, columns = int(a.max()) + 1, int(b.max()) + 1
    table = np.bincount(a * columns + b, minlength=rows * columns).reshape(rows, columns).astype(float)

    def pairs(counts: np.ndarray) -> float:
        return float((counts * (counts - 1) / 2).sum())

    both, of_a, of_b = pairs(table), pairs(table.sum(1)), pairs(table.sum(0))
    chance, most = of_a * of_b / max(pairs(np.array([len(a)])), 1), (of_a + of_b) / 2
    return 1.0 if most == chance else (both - chance) / (most - chance)


def _unseen_iou(job: Job, g: Gaussians, found: Instances) -> float:
    """Mean IoU of the objects over the test views, whose label images are not looked at."""
    painted = RenderedLabels(replace(g, label_ids=torch.from_numpy(found.label_ids)), "auto", job.antialiased)
    ids = np.array(sorted(found.parents), np.int64)
    rows = job.scene.test_ids.tolist()
    true = np.stack([render_objects(job.scene.views[row].camera)[0] for row in rows])
    shown = np.stack([painted[job.scene.views[row]] for row in rows])
    objects = np.array([i for i in np.unique(true) if i >= 0 and i != HOUSE])
    iou = np.array([[_iou(true == o, shown == i) for i in ids] for o in objects])
    matched = linear_sum_assignment(-iou)
    return float(iou[matched].sum() / len(objects))


def _iou(a: np.ndarray, b: np.ndarray) -> float:
    union = (a | b).sum()
    return float((a & b).sum() / union) if union else 0.0


def lifting(g: Gaussians) -> dict[str, float]:
    """Seconds and peak memory of lifting 40 labels a view from 185 views onto 200,000 Gaussians, 512 px."""
    random = torch.Generator().manual_seed(0)
    times = -(-GAUSSIANS // len(g))
    large = concat(
        [
            replace(g, means=g.means + 0.01 * torch.randn(g.means.shape, generator=random))
            for _ in range(times)
        ]
    )
    large = large.select(torch.randperm(len(large), generator=random)[:GAUSSIANS])
    middles = large.means[:: len(large) // LABELS][:LABELS].numpy()
    nearest = KDTree(middles).query(large.means.numpy())[1]
    large = replace(large, label_ids=torch.from_numpy(nearest.astype(np.int16)))
    cameras = demo_cameras(VIEWS, WIDTH, HEIGHT, 0)
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        images = pool.apply(_draw, (large, cameras))
    with multiprocessing.get_context("spawn").Pool(1) as pool:  # its peak memory is that of lifting alone
        return pool.apply(_lift, (large, cameras, images))


def _draw(g: Gaussians, cameras: list[Camera]) -> list[np.ndarray]:
    painted = RenderedLabels(g)
    return [painted.render(camera) for camera in cameras]


class _Images(Masks):
    """Label images in memory: one category everywhere."""

    def __init__(self) -> None:
        super().__init__(Path(), Taxonomy({1: "thing"}))

    def __getitem__(self, view: View) -> np.ndarray:
        return np.ones((view.camera.height, view.camera.width), np.int16)


def _lift(g: Gaussians, cameras: list[Camera], images: list[np.ndarray]) -> dict[str, float]:
    set_threads(2)
    views = tuple(View(f"{i}.png", camera, Path(f"{i}.png")) for i, camera in enumerate(cameras))
    none = np.zeros(0, np.int64)
    xyz, uv = np.zeros((0, 3), np.float32), np.zeros((0, 2), np.float32)
    points = Points(xyz, xyz.astype(np.uint8), none, none.astype(np.int32), uv)
    scene = Scene("", Path(), views, points)
    by_name = {view.name: image for view, image in zip(views, images, strict=True)}
    g = replace(g, label_ids=torch.ones_like(g.label_ids))

    def lift(rows: range) -> Instances:
        sightings = gather(g, scene, _Images(), lambda view: by_name[view.name], rows, [1])
        return label(g, sightings, Taxonomy({1: "thing"}))

    lift(range(2))  # compiled
    begin, cpu = time.perf_counter(), time.process_time()
    found = lift(range(VIEWS))
    return {
        "lifting_s": time.perf_counter() - begin,
        "lifting_cpu_s": time.process_time() - cpu,
        "lifting_gb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6,
        "lifting_instances": len(found.parents),
    }
