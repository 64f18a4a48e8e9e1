"""Tells instances apart: joins those of the photos through the Gaussians that they share.

Each 3D instance becomes a category of its own, in label images of all views: the stages from the nested
levels on need not know that it is one.
"""

import shutil
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import torch

from sagesplat.adapt.observe import RenderedLabels
from sagesplat.core.config import LabelsConfig, MasksConfig
from sagesplat.core.errors import LabelError, RunError
from sagesplat.core.events import Progress, Warned
from sagesplat.core.gaussians import Gaussians
from sagesplat.run.job import Job
from sagesplat.run.records import file_hash
from sagesplat.run.run_dir import RunDir
from sagesplat.run.stage import run_stage
from sagesplat.scene.scene import View
from sagesplat.segment.display_names import title_of
from sagesplat.segment.edit import edit_table, parse_names
from sagesplat.segment.instances import (
    FOLDER,
    import_instances,
    read_instances,
    wanted_ids,
)
from sagesplat.segment.lift import LiftedLabels, lift
from sagesplat.segment.masks import Masks, Taxonomy, mask_path, prepare_folder, write_mask
from sagesplat.segment.parents import write_parents
from sagesplat.stages.label import later_merges, segmenter_kind
from sagesplat.stages.scene import check_not_adopted
from sagesplat.train.instances import Instances, gather, label

_LISTED = 8  # instances that are named in a line


def find_photo_instances(job: Job, masks: MasksConfig, labels: LabelsConfig) -> None:
    """Import the instances of the photos, or check that the network found some: before hours of training."""
    run = job.run
    wanted_ids(Taxonomy.read(run.masks / "labels.json").names, parse_names(labels.instances, "instances"))
    if segmenter_kind(job.scene.path, masks) != "masks":
        if not any(mask_path(run.photo_instances, view).exists() for view in job.scene.views):
            raise RunError(
                f"{run.photo_instances}: no instances of any photo; the network has none, or segmented the "
                "photos without: add --force to segment them again, or leave out --labels.instances"
            )
        _check_seen(job)
        return
    source = masks.masks or job.scene.path / "masks"
    folders = {
        folder.name: file_hash(folder) for folder in (source, source.parent / FOLDER) if folder.is_dir()
    }

    def make() -> list[str]:
        shutil.rmtree(run.photo_instances, ignore_errors=True)
        found = import_instances(job.scene, source, run.photo_instances)
        return [f"{found} of {len(job.scene.views)} photos have instances"]

    run_stage(job, "photo_instances", folders, [run.scene], [run.photo_instances], make)
    _check_seen(job)


def _check_seen(job: Job) -> None:
    """RunError unless two training photos have instances: one that a single photo shows is none."""
    views = [job.scene.views[row] for row in job.scene.train_ids.tolist()]
    seen = sum(mask_path(job.run.photo_instances, view).exists() for view in views)
    if seen < 2:
        raise RunError(
            f"{job.run.photo_instances}: instances of {seen} of {len(views)} training photos; give those of "
            "two at least that show the same, or leave out --labels.instances"
        )


def make_instances(job: Job, masks: MasksConfig, labels: LabelsConfig) -> None:
    """Find the 3D instances of some categories; draw label images of all views and label the points.

    Where none are asked for, those of an earlier command become parts of their categories again; RunError
    without --force.
    """
    run = job.run
    check_not_adopted(run)
    if not labels.instances:
        if run.instances.exists():
            if not job.force:
                raise RunError(
                    f"{run.instances}: instances were told apart; name the same --labels.instances, or add "
                    "--force to fold them back into their categories"
                )
            _remove(run)
        return
    find_photo_instances(job, masks, labels)
    wanted = parse_names(labels.instances, "instances")
    merge = later_merges(run, labels)
    outputs = [run.instances / "labels.json", run.instance_labels]
    stages = ["masks", "train", "fuse"]

    def make() -> list[str]:
        _remove(run)
        masks = job.category_masks
        ids = wanted_ids(masks.taxonomy.names, wanted)
        g = job.load_last_level()
        found = _find(job, g, masks, ids)
        taxonomy, table = edit_table(found.taxonomy, merge=merge)
        parents = {int(table[i]): p for i, p in found.parents.items() if table[i] not in masks.taxonomy.names}
        _draw(job, replace(g, label_ids=torch.from_numpy(found.label_ids)), masks, found, table, taxonomy)
        lifted = lift(job.scene, Masks(run.instances, taxonomy), views=set(job.scene.train_ids.tolist()))
        before = LiftedLabels.read(run.labels, len(job.scene.points.xyz))
        within = _within(lifted.label_ids, before.label_ids, parents)
        lifted = replace(lifted, label_ids=within, ignored=before.ignored)
        lifted.write(run.instance_labels)
        write_parents(run.parents, {taxonomy.names[i]: taxonomy.names[p] for i, p in parents.items()})
        taxonomy.write(run.instances / "labels.json")
        return [_line(table[found.label_ids], taxonomy, parents)]

    settings = {"instances": ",".join(wanted), "merge": ",".join(f"{a}={b}" for a, b in merge.items())}
    made = [run.provenance(stage) for stage in stages if run.provenance(stage).exists()]
    inputs = [*run.scene_files, run.masks / "labels.json", run.levels, run.photo_instances, *made]
    run_stage(job, "instances", settings, inputs, outputs, make)


def _remove(run: RunDir) -> None:
    run.provenance("instances").unlink(missing_ok=True)
    run.parents.unlink(missing_ok=True)
    shutil.rmtree(run.instances, ignore_errors=True)


def _find(job: Job, g: Gaussians, masks: Masks, ids: list[int]) -> Instances:
    """The 3D instances of the Gaussians, from the training views; warns of what did not become one."""
    views = job.scene.train_ids.tolist()

    def of_photo(view: View) -> np.ndarray | None:
        path = mask_path(job.run.photo_instances, view)
        return read_instances(path, (view.camera.height, view.camera.width)) if path.exists() else None

    sightings = gather(
        g, job.scene, masks, of_photo, views, ids,
        valid=job.valid, antialiased=job.antialiased,
        on_view=lambda done: job.emit(Progress("instances", done, len(views) + len(job.scene.views))),
    )  # fmt: skip
    found = label(g, sightings, masks.taxonomy)
    for category, count in found.alone.items():
        name = title_of(masks.taxonomy.name(category))
        what = (
            f"1 instance of {name} in a single photo is"
            if count == 1
            else (f"{count} instances of {name} in single photos are")
        )
        job.emit(Warned(f"{what} left to {name}: no other view agrees"))
    missing = sorted(set(ids) - set(found.parents.values()))
    if not found.parents:
        names = ", ".join(title_of(masks.taxonomy.name(i)) for i in ids)
        raise LabelError(
            f"{job.run.photo_instances}: no instance of {names} is seen in two training photos; name other "
            "categories, or leave out --labels.instances"
        )
    if missing:
        job.emit(Warned(f"no instances of {', '.join(title_of(masks.taxonomy.name(i)) for i in missing)}"))
    return found


def _draw(
    job: Job, g: Gaussians, masks: Masks, found: Instances, table: np.ndarray, taxonomy: Taxonomy
) -> None:
    """Draw the label images: a pixel keeps its category, and gets the instance that paints most of it.

    `table` is applied to the result, which has the categories of `taxonomy`.
    """
    run, views = job.run, job.scene.views
    painted = RenderedLabels(g, job.backend, job.antialiased)
    label_ids = g.label_ids.numpy()
    done = len(job.scene.train_ids)
    of = np.array([found.parents.get(i, i) for i in range(-1, max(found.taxonomy.names) + 1)], np.int16)
    split = sorted(set(found.parents.values()))
    only = RenderedLabels(
        g.select(torch.from_numpy(np.isin(of[label_ids + 1], split))), job.backend, job.antialiased
    )
    for row, (view, path) in enumerate(zip(views, prepare_folder(run.instances, views), strict=True)):
        shown = masks[view]
        after = np.where(of[painted[view] + 1] == shown, painted[view], shown)
        hidden = np.isin(after, split)  # the view's label image and the Gaussians differ here
        if hidden.any():
            behind = only.render(view.camera)
            after = np.where(hidden & (of[behind + 1] == shown), behind, after)
        write_mask(path, table[after], taxonomy)
        job.emit(Progress("instances", done + row + 1, done + len(views)))


def _within(label_ids: np.ndarray, before: np.ndarray, parents: Mapping[int, int]) -> np.ndarray:
    """Labels of points: an instance where it is of the point's category, else the category."""
    of = np.array([parents.get(int(i), int(i)) for i in label_ids], np.int16)
    return np.where(of == before, label_ids, before).astype(np.int16)


def _line(label_ids: np.ndarray, taxonomy: Taxonomy, parents: Mapping[int, int]) -> str:
    names = [f"{title_of(taxonomy.names[i])} ({(label_ids == i).sum():,})" for i in sorted(parents)]
    more = ", ..." if len(names) > _LISTED else ""
    return f"{len(names)} instances (Gaussians): {', '.join(names[:_LISTED])}{more}"
