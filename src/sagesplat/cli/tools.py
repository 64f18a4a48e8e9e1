"""Commands around a run: what goes in, what comes out, what the machine can do."""

import sys
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Literal

from msgspec import Meta
from tyro.conf import Positional, arg

from sagesplat.cli.base import Compute, Device, Flat, Ladder, Run, command, open_job
from sagesplat.cli.say import say
from sagesplat.core.config import BundleConfig
from sagesplat.core.errors import BackendUnavailable, RunError
from sagesplat.core.limits import AtLeast1, SomeShare, StepNumber


@command
def export(
    run: Run,
    out: Positional[Annotated[Path, arg(metavar="OUT")]],
    level: StepNumber | None = None,
    only: str = "",
    without: str = "",
    target_fidelity: SomeShare | None = None,
    target_ssim: SomeShare | None = None,
    chunks: Literal["spz", "ply"] | None = None,
    levels: tuple[StepNumber, ...] = (),
    rasterize_mode: Literal["classic", "antialiased", "playcanvas"] | None = None,
    labels_inside: bool = False,
    doubles: bool = False,
    ladder: Ladder = "nested",
    machine: Annotated[Compute, Flat] = Compute(),
) -> None:
    """Write Gaussians for other viewers: the planned scene, one level, all levels, or their increments.

    The name of OUT chooses the format: .ply, .compressed.ply, .spz, .sog, .glb, .splat, .rad;
    FOLDER/lod-meta.json and .ssog hold all levels. Categories are kept: in a file beside (OUT.labels.json),
    or inside an .spz, an .ssog and a .glb.

    Args:
        run: run folder
        out: file to write, or with --chunks a folder
        level: number of a level (of a recorded one: its training step) to write instead of the planned scene
        only: categories or instances to write, such as "chair 2,vase" (default: all); a category means all
            its instances
        without: categories or instances to leave out, such as "person,chair 1"; says how large the holes are
        target_fidelity: write the scene planned for this fidelity (default: for the budget, else the main
            target)
        target_ssim: write the scene planned for this SSIM against photos
        levels: numbers of the levels that lod-meta.json or .ssog gets (default: all)
        rasterize_mode: how viewers of the file draw (default: as PlayCanvas's engine does for lod-meta.json
            and .ssog, else as the run was trained for .spz and .sog, which say it, else classic, as most do)
        labels_inside: write the categories into the .ply, as a property and comments; viewers that rely on
            the published layout then fail
        doubles: write x y z of a .ply as doubles in the capture's own coordinates, such as UTM; viewers that
            rely on the published layout then fail
        chunks: write the increment of each level of each category as a file of this format
    """
    from sagesplat.segment.edit import parse_names
    from sagesplat.stages.export import export_increments, export_scene

    of_scenes = {
        "--only": only, "--without": without, "--level": level, "--levels": levels,
        "--target-fidelity": target_fidelity, "--target-ssim": target_ssim,
        "--rasterize-mode": rasterize_mode, "--labels-inside": labels_inside, "--doubles": doubles,
    }  # fmt: skip
    if chunks and (given := [name for name, value in of_scenes.items() if value]):
        raise RunError(f"{out}: {given[0]} does not go with --chunks; leave it out")
    if target_fidelity is not None and target_ssim is not None:
        raise RunError(f"{out}: a scene has one target; leave out --target-ssim or --target-fidelity")
    with open_job(run, machine, ladder) as job:
        if chunks:
            count = export_increments(job, out, chunks)
        else:
            target = None if target_ssim is None else ("ssim", target_ssim)
            target = target if target_fidelity is None else ("fidelity", target_fidelity)
            count = export_scene(
                job, out, level=level, labels=parse_names(only, "only"), target=target, levels=levels,
                rasterize_mode=rasterize_mode, without=parse_names(without, "without"),
                labels_inside=labels_inside, doubles=doubles,
            )  # fmt: skip
    say(f"{out}: {count:,} {'chunks' if chunks else 'Gaussians'}")


@command
def download(
    what: Positional[Annotated[str, arg(metavar="WHAT")]] = "",
    folder: Positional[Annotated[Path | None, arg(metavar="FOLDER")]] = None,
    scale: AtLeast1 | None = None,
    show: Annotated[bool, arg(name="list")] = False,
) -> None:
    """Download a benchmark scene, or network weights that are not part of the package.

    Of a scene only its own photos and model are transferred out of the official archive. Files that are
    there already are kept, so an interrupted download resumes when the command is given again.

    Args:
        what: a scene, such as mipnerf360/garden; or lpips, the weights of the perceptual metric (761 MB are
            fetched, 69 MB kept)
        folder: where to put it (default: the current folder; weights: ~/.cache/sagesplat)
        scale: downscaling factor of the photos, as the archive has them (default: the one papers evaluate on)
        show: list the scenes
    """
    from sagesplat.cli.console import Console
    from sagesplat.core.events import Progress, StageStarted
    from sagesplat.download.scenes import download_scene, find_scene, read_registry
    from sagesplat.download.weights import download_lpips

    if show:
        for scene in read_registry().values():
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
            say(find_scene(what).licence, file=sys.stderr)
            found = [download_scene(what, folder or Path(), scale=scale, on_progress=progress)]
    say(*found)
    if what != "lpips" and (factor := scale or find_scene(what).scale) > 1:
        print(f"train with --downscale {factor}", file=sys.stderr)


@command
def doctor(build: bool = False, json: bool = False) -> None:
    """Check this machine: what works, what is missing and how to get it.

    Args:
        build: compile gsplat's CUDA kernels now (about a minute) rather than at their first use
        json: print the findings as JSON
    """
    from sagesplat.cli.doctor import as_json, examine, is_well, print_findings, unbuilt

    findings = examine(build=build)
    if json:
        print(as_json(findings))
    else:
        print_findings(findings)
    if not is_well(findings):
        raise SystemExit(1)
    if build and (why := unbuilt(findings)):
        raise BackendUnavailable(f"--build: nothing was built: {why}")


@command
def bundle(
    run: Run,
    out: Positional[Annotated[Path, arg(metavar="OUT")]],
    config: Annotated[BundleConfig, Flat] = BundleConfig(),
    machine: Annotated[Device, Flat] = Device(),
) -> None:
    """Write a finished run as a folder for any static web server, or as one page: scene, models and viewer.

    Args:
        run: run folder, finished with the nested levels
        out: folder to write (new, empty, or an earlier bundle, which is replaced); with --single-file a page
    """
    from sagesplat.segment.display_names import categories
    from sagesplat.stages.bundle import bundle as write

    with open_job(run, machine) as job:
        made = write(job, out, **asdict(config))
    megabytes = f"{made.sizes.chunks / 1e6:.1f} MB of {made.sizes.total / 1e6:.1f} MB"
    say(f"{out}: {categories(made.labels)}, {made.chunks} chunks, {made.count:,} Gaussians, {megabytes}")


@command
def completion(shell: Positional[Literal["bash", "zsh", "fish"]]) -> None:
    """Print the script that completes commands and flags in a shell.

    bash: `source <(sagesplat completion bash)` in ~/.bashrc. zsh: the same with zsh in ~/.zshrc. fish:
    `sagesplat completion fish > ~/.config/fish/completions/sagesplat.fish`.

    Args:
        shell: bash, zsh or fish
    """
    from sagesplat.cli.completion import script

    print(script(shell))


@command
def labels(
    action: Positional[Annotated[Literal["apply"], arg(metavar="apply")]],
    run: Run,
    edits: Positional[Annotated[Path | None, arg(metavar="EDITS")]] = None,
    out: Positional[Annotated[Path | None, arg(metavar="OUT")]] = None,
    machine: Annotated[Device, Flat] = Device(),
) -> None:
    """Apply label edits made in the viewer to a finished run: a new run with its bundle, without training.

    The run stays as it is. Names, merged categories and settings are exact; the parts of a split category are
    measured. Promises are calibrated again.

    Args:
        action: apply
        run: run folder, finished with the nested levels
        edits: the file that the viewer saved (default: labels.edit.json in the run folder)
        out: new run folder, or an earlier edited one, which is replaced (default: RUN-edited)
    """
    from sagesplat.segment.display_names import categories
    from sagesplat.stages.label_edits import apply_labels

    with open_job(run, machine) as job:
        made = apply_labels(job, edits, out)
    say(f"{made.path}: {categories(len(made.categories))}; `sagesplat view {made.path}` shows them")


@command
def view(
    path: Positional[Annotated[Path, arg(metavar="RUN|BUNDLE")]],
    port: Annotated[int, Meta(ge=0, le=2**16 - 1)] | None = None,
    host: str | None = None,
    lan: bool = False,
    ssl_certfile: Path | None = None,
    ssl_keyfile: Path | None = None,
    browser: bool = True,
    follow: bool = False,
    edit: bool = False,
) -> None:
    """Show a run or a bundle in the browser; with --follow a training in progress.

    Args:
        path: run folder (its bundle is made if it is missing or out of date), or a bundle
        port: port to listen on (default: the first free one from 8000)
        host: address to listen on; 0.0.0.0 serves the whole network (default: this machine only)
        lan: serve the whole network, and show the address as a QR code for phones
        ssl_certfile: certificate (PEM) for https, which headsets require
        ssl_keyfile: key of the certificate, if it is a separate file
        browser: open the browser
        follow: show the newest level of a training in progress
        edit: edit labels in the viewer and save them in the run folder, for `sagesplat labels apply`; on this
            machine only
    """
    from sagesplat.cli.console import Console
    from sagesplat.core.qr import qr_text
    from sagesplat.stages.view import show

    if lan and host:
        raise RunError(f"--lan and --host {host}: give one of them; --lan is --host 0.0.0.0")
    host = "0.0.0.0" if lan else host
    certificate = {"ssl_certfile": ssl_certfile, "ssl_keyfile": ssl_keyfile}
    with (
        Console() as console,
        show(path, console, port=port, host=host, follow=follow, edit=edit, **certificate) as shown,
    ):
        if lan and len(shown.urls) > 1 and "utf" in (sys.stdout.encoding or "").lower():
            say(*qr_text(shown.urls[-1]).splitlines())
        say(*shown.urls, shown.hint, "Ctrl-C ends it")
        shown.run(browser)
