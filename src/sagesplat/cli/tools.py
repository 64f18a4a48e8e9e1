"""Commands around a run: what goes in, what comes out, what the machine can do."""

import sys
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from sagesplat.cli.base import Flat, LadderKind, Machine, Run, command, open_job
from sagesplat.core.config import BundleConfig
from sagesplat.core.errors import RunError


@command
def export(
    run: Run,
    out: Positional[Annotated[Path, arg(metavar="OUT")]],
    level: int | None = None,
    labels: tuple[str, ...] = (),
    target_ssim: float | None = None,
    chunks: Literal["spz", "ply"] | None = None,
    ladder: LadderKind = "nested",
    machine: Annotated[Machine, Flat] = Machine(),
) -> None:
    """Write Gaussians as a PLY: the plan's composition, or one level; or all chunks of the nested ladder.

    Args:
        run: run folder.
        out: PLY to write, or a folder for chunks.
        level: a level by its number (of snapshots: training step), instead of the composition.
        labels: names of the categories to take.
        target_ssim: the composition for this planned target (default: the budget's or the main one).
        chunks: a file for what each level of each category adds, in this format.
        ladder: the ladder to take them from.
        machine: where and how to compute.
    """
    from sagesplat.stages.export import export_increments, export_ply

    with open_job(run, machine, ladder) as job:
        if chunks:
            count = export_increments(job, out, chunks)
        else:
            count = export_ply(job, out, level=level, labels=labels, target=target_ssim)
    print(f"{out}: {count:,} {'chunks' if chunks else 'Gaussians'}")


@command
def download(
    what: Positional[Annotated[str, arg(metavar="WHAT")]] = "",
    folder: Positional[Annotated[Path | None, arg(metavar="FOLDER")]] = None,
    scale: int | None = None,
    show: Annotated[bool, arg(name="list")] = False,
) -> None:
    """Fetch a scene of the field, or weights that are not part of the package.

    Of a scene only its own photos and model are transferred out of the official archive. What is there
    already is kept, so a download that was cut goes on when the command is given again.

    Args:
        what: a scene, such as mipnerf360/garden; or lpips, the weights of the perceptual metric (761 MB are
            fetched, 69 MB kept).
        folder: where to put it (default: the folder you are in; of weights the cache, ~/.cache/sagesplat).
        scale: photos so many times smaller, as the archive has them (default: what papers evaluate on).
        show: list the scenes.
    """
    from sagesplat.cli.console import Console
    from sagesplat.core.events import Progress, StageStarted
    from sagesplat.download.scenes import download_scene, find_scene, list_scenes
    from sagesplat.download.weights import download_lpips

    if show:
        for scene in list_scenes():
            size = f"of a {scene.archive_gb:g} GB archive" if scene.archive_gb else ""
            print(f"{scene.name:24} {scene.photos:4} photos {size:24} {scene.page}")
        return
    if not what:
        raise RunError("nothing to download; name a scene (see `sagesplat download --list`) or lpips")

    with Console() as console:
        console(StageStarted("download"))

        def progress(name: str, done: int, total: int) -> None:
            console(Progress("download", done, max(total, done, 1), name))

        if what == "lpips":
            found = download_lpips(folder, on_progress=progress)
        else:
            print(find_scene(what).licence, file=sys.stderr)
            found = [download_scene(what, folder or Path(), scale=scale, on_progress=progress)]
    print("\n".join(map(str, found)))
    if what != "lpips" and (factor := scale or find_scene(what).scale) > 1:
        print(f"train with --downscale {factor}", file=sys.stderr)


@command
def doctor(build: bool = False, json: bool = False) -> None:
    """Say what this machine can do, and what more needs.

    Args:
        build: compile gsplat's CUDA kernels now (about a minute), rather than at their first use.
        json: print it for machines.
    """
    from sagesplat.cli.doctor import as_json, examine, is_well, print_findings

    findings = examine(build=build)
    if json:
        print(as_json(findings))
    else:
        print_findings(findings)
    if not is_well(findings):
        raise SystemExit(1)


@command
def bundle(
    run: Run,
    out: Positional[Annotated[Path, arg(metavar="OUT")]],
    config: Annotated[BundleConfig, Flat] = BundleConfig(),
    machine: Annotated[Machine, Flat] = Machine(),
) -> None:
    """Write a finished run as a folder for any static web server: scene, promises and viewer.

    Args:
        run: run folder, finished with the nested ladder.
        out: folder to write: a new or empty one, or an earlier bundle, which is replaced.
        config: what it says of the scene.
        machine: where and how to compute.
    """
    from sagesplat.stages.bundle import bundle as write

    with open_job(run, machine) as job:
        made = write(job, out, **asdict(config))
    megabytes = f"{made.sizes.chunks / 1e6:.1f} MB of {made.sizes.total / 1e6:.1f} MB"
    print(f"{out}: {made.labels} categories, {made.chunks} chunks, {made.count:,} Gaussians, {megabytes}")


@command
def view(
    path: Positional[Annotated[Path, arg(metavar="RUN|BUNDLE")]],
    port: int | None = None,
    host: str | None = None,
    ssl_certfile: Path | None = None,
    ssl_keyfile: Path | None = None,
    browser: bool = True,
    follow: bool = False,
) -> None:
    """Show a bundle, or a run's, in the browser; with --follow its training as it goes on.

    Args:
        path: run folder (its bundle is made if it is missing or out of date), or a bundle.
        port: port to listen on (default: the first free one from 8000 on).
        host: address to listen on; 0.0.0.0 lets everybody in the network in (default: this machine only).
        ssl_certfile: certificate (PEM) for https, which headsets ask for.
        ssl_keyfile: its key, if it is in a file of its own.
        browser: open the browser.
        follow: show the newest snapshot of a training that goes on.
    """
    from sagesplat.cli.console import Console
    from sagesplat.stages.view import show

    certificate = {"ssl_certfile": ssl_certfile, "ssl_keyfile": ssl_keyfile}
    with (
        Console() as console,
        show(path, console, port=port, host=host, follow=follow, **certificate) as shown,
    ):
        print(*shown.urls, shown.hint, "Ctrl-C ends it", sep="\n", flush=True)
        shown.run(browser)
