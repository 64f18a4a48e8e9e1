"""Makes bundles for the web viewer from the newest level of a running training."""

import shutil
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch

from sagesplat.adapt.cells import describe_cells
from sagesplat.core.errors import RunError
from sagesplat.formats.increments import write_increments
from sagesplat.formats.levels import read_level
from sagesplat.io.files import write_json, write_text
from sagesplat.io.lock import alone
from sagesplat.io.typed import known_json
from sagesplat.run.job import Job
from sagesplat.run.recorded import recorded_settings
from sagesplat.stages.bundle_contents import bundle_contents
from sagesplat.viewer.built import PAGE, check_viewer, has_viewer, package_viewer
from sagesplat.viewer.bundle import MANIFEST, check_target, write_documents

_OTHERS = 10.0  # seconds to wait for another process that writes the same live bundle
_LIVE = ".live.json"  # the level that a live bundle was made from, and its files


def live_bundle(job: Job, folder: Path, viewer: Path | None = None) -> bool:
    """Write the newest level of a training, which may still run, to `folder`; False if it is there already.

    In the bundle a category is one cell with one level; there are no bounds. Files are written atomically.
    Those that a page may still be loading are kept until two newer levels are written. RunError if there is
    no level yet, or where another process writes there for seconds.
    """
    job = replace(job, run=replace(job.run, ladder="snapshots"))  # what training writes knows no instances
    with alone(folder, _OTHERS):
        return _live_bundle(job, folder, viewer or package_viewer())


def _live_bundle(job: Job, folder: Path, viewer: Path) -> bool:
    steps = sorted(job.run.levels.glob("[!.]*.npz"))
    if not steps:
        raise RunError(f"{job.run.levels}: no level yet; wait, or run `sagesplat train`")
    newest = {"level": steps[-1].name, "written": steps[-1].stat().st_mtime_ns}
    previous = read_live(folder / _LIVE)
    if previous and previous.of == newest and (folder / MANIFEST).exists():
        return False
    check_viewer(viewer)
    if not previous:
        check_target(folder)
        write_json(folder / _LIVE, {})  # where this one is killed, the next one knows the folder as its own
    if not has_viewer(folder, viewer):  # none yet, or that of another version; its page comes last
        shutil.copytree(viewer, folder, ignore=shutil.ignore_patterns(PAGE), dirs_exist_ok=True)
        write_text(folder / PAGE, (viewer / PAGE).read_text(encoding="utf-8"))
    g = read_level(steps[-1])
    g = g.select(torch.argsort(g.label_ids, stable=True))
    labels, cell_ids = torch.unique(g.label_ids, return_inverse=True)
    label_of = dict(enumerate(labels.tolist()))  # every category is one cell
    g = replace(g, label_ids=cell_ids.to(g.label_ids.dtype))
    antialiased = trains_antialiased(job)
    work, target = folder / ".chunks", folder / "chunks"
    sizes = {cell: (n,) for cell, n in g.counts().items()}
    chunks = write_increments(work, g, sizes, job.names(), label_of=label_of, antialiased=antialiased)
    target.mkdir(exist_ok=True)
    for chunk in chunks:
        (work / chunk.uri).replace(target / chunk.uri)
    shutil.rmtree(work)
    contents = bundle_contents(job, g, describe_cells(g, label_of), antialiased)
    write_documents(folder, replace(contents, chunks=chunks, live=True))
    uris = [chunk.uri for chunk in chunks]
    kept = [uris, *(version for version in (previous.kept if previous else ()) if version != uris)][:3]
    write_json(folder / _LIVE, {"of": newest, "kept": kept})
    for path in target.iterdir():
        if path.name not in {uri for version in kept for uri in version}:
            path.unlink()
    return True


@dataclass(frozen=True)
class Live:
    """What the last call of `live_bundle` wrote down."""

    of: Any = None  # the newest level then
    kept: list[list[str]] = field(default_factory=list)  # files of the last versions


def read_live(path: Path) -> Live | None:
    """What the last call of `live_bundle` wrote down; None where there is nothing of use."""
    return known_json(path, Live)


def trains_antialiased(job: Job) -> bool:
    """Whether the run trains with antialiasing, as far as it says so by now."""
    train = recorded_settings(job.run).get("train")
    return train is not None and train.antialiased
