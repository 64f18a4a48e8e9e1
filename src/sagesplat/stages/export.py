"""Makes PLY or SPZ files, from levels, compositions and increments of a run."""

from collections.abc import Sequence
from pathlib import Path

from sagesplat.adapt.ladder import read_prefixes
from sagesplat.adapt.viewpoint import QualityKind
from sagesplat.core.errors import RunError
from sagesplat.formats.increments import INDEX, Format, write_increments
from sagesplat.formats.ply import write_ply
from sagesplat.run.job import Job
from sagesplat.run.records import settings_of
from sagesplat.stages.compose import compose
from sagesplat.stages.plan import main_plan, scene_plan
from sagesplat.stages.shared import label_named


def export_increments(job: Job, folder: Path, kind: Format) -> int:
    """Write what each level of each category adds as files of their own; returns how many."""
    if job.run.ladder != "nested":
        raise RunError(f"{job.run.path}: snapshots have no chunks; use --ladder nested")
    if folder.exists() and not (job.force and (folder / INDEX).exists()):
        raise RunError(f"{folder}: exists; choose a new folder (--force replaces one of chunks)")
    ladder, made = read_prefixes(job.run.prefixes), settings_of(job.run, "nest")
    chunks = write_increments(
        folder, ladder.gaussians, ladder.sizes, job.names(), replaces=ladder.replaces, kind=kind,
        sh_bits=tuple(made["sh_bits"]), antialiased=job.antialiased,
    )  # fmt: skip
    return len(chunks)


def export_ply(
    job: Job,
    path: Path,
    *,
    level: int | None,
    labels: Sequence[str],
    target: tuple[QualityKind, float] | None,
) -> int:
    """Write a level or a composition, whole or some categories, as a PLY; returns the number of Gaussians."""
    if path.exists() and not job.force:
        raise RunError(f"{path}: exists; add --force to replace it")
    wanted = [label_named(job, name) for name in labels] or list(job.names())
    if level is not None:
        g = job.ladder.load(level, wanted)
    else:
        plan = main_plan(job) if target is None else scene_plan(job, *target)
        g = compose(job, plan).of_labels(wanted)
    write_ply(path, g, job.names())
    return len(g)
