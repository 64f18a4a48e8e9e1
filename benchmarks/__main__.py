"""`python -m benchmarks NAME`: each prints a table and ends with one line of JSON (docs/performance.md)."""

import json
import shutil
import subprocess
import tempfile
import time
from dataclasses import replace
from datetime import date
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
import torch
import tyro

from benchmarks import audit as table_iii
from benchmarks import deeplab as segmenting
from benchmarks import formats as formatting
from benchmarks import freeze as freezing
from benchmarks import fuzz as fuzzing
from benchmarks import labels as labelling
from benchmarks import measure, plain, size_tables, workloads
from benchmarks import plans as planning
from benchmarks import promises as promising
from benchmarks import quality as qualities
from benchmarks import segment as overlays
from benchmarks import size as sizing
from benchmarks import whole as whole_runs
from benchmarks import wild as disturbed
from benchmarks.gpu import base, script
from sagesplat.core.config import TrainConfig
from sagesplat.core.gaussians import PARAMETERS, Gaussians
from sagesplat.demo.capture import cached_capture
from sagesplat.raster import Backend, Workspace, add_weights, rasterize, set_threads
from sagesplat.run.job import Job
from sagesplat.run.run_dir import RunDir
from sagesplat.scene import load_scene
from sagesplat.scene.images import Photos
from sagesplat.scene.scene import Camera, Scene
from sagesplat.segment import coco
from sagesplat.segment.mask_files import import_masks
from sagesplat.segment.masks import Masks, Taxonomy
from sagesplat.train.events import Step
from sagesplat.train.trainer import train

RESULTS = Path(__file__).parent / "results" / "cpu"

app = tyro.extras.SubcommandApp()


def _finish(name: str, result: dict, write: bool, folder: Path = RESULTS) -> None:  # type: ignore[type-arg]
    """Print the last line; with --write, keep it."""

    def short(value):  # type: ignore[no-untyped-def]
        if isinstance(value, dict):
            return {k: short(v) for k, v in value.items()}
        if isinstance(value, list):
            return [short(v) for v in value]
        return float(f"{value:.4g}") if isinstance(value, float) else value

    line = json.dumps(short(result))
    if write:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / f"{name}.json").write_text(line + "\n")
    print(line)


def _photo(scene: Scene, row: int) -> torch.Tensor:
    return torch.from_numpy(Photos(scene.views)[row]).float() / 255


@app.command
def deeplab(steps: int = 160, views: int = 30, write: bool = False) -> None:
    """A small DeepLabV2 trained on the built-in garden: mIoU on views it has not seen."""
    _finish("deeplab", segmenting.measure(steps, views), write)


@app.command
def wild(
    out: Path,
    /,
    *,
    rows: tuple[str, ...] = (),
    steps: int = 2000,
    seed: int = 0,
    threads: int = 0,
    write: bool = False,
) -> None:
    """Disturbed captures with and without their remedies: test views, and the truth off the path.

    Args:
        out: folder for captures and runs; what is done is not done again.
        rows: some of the rows, by name (default: all).
        steps: of each training.
        seed: of captures and trainings.
        threads: 0: one per core.
        write: keep the results in benchmarks/results/wild.json.
    """
    set_threads(threads)
    unknown = [row for row in rows if row not in disturbed.ROWS]
    if unknown:
        raise SystemExit(f"wild: no row {unknown[0]!r}; choose from {', '.join(disturbed.ROWS)}")
    found = disturbed.measure(out, rows or tuple(disturbed.ROWS), steps, seed, print)
    _finish("wild", {"steps": steps, "seed": seed, "rows": found}, write, RESULTS.parent)


@app.command
def labels(
    out: Path | None = None, /, *, steps: int = 1000, seed: int = 0, threads: int = 2, write: bool = False
) -> None:
    """3D instances of the built-in garden against the modelled objects, and the speed of lifting labels.

    Args:
        out: folder for the run; a training in it is used again (default: a temporary one).
        steps: of its training.
        seed: of the corruption of masks.
        threads: 0: one per core.
        write: keep the results in benchmarks/results/labels.json, with the command, commit and date.
    """
    set_threads(threads)
    with tempfile.TemporaryDirectory() as folder:
        found = labelling.measure(out or Path(folder) / "run", steps, seed)
    for name, value in found.items():
        print(f"{name:24} {value:.4g}")
    command = f"python -m benchmarks labels --steps {steps} --seed {seed} --threads {threads}"
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True).stdout
    made = {"command": command, "commit": commit.strip(), "date": date.today().isoformat()}
    _finish("labels", {**made, **found}, write, RESULTS.parent)


@app.command
def segment(
    out: Path,
    scene: Path | None = None,
    models: tuple[Path, ...] = (),
    classes: Path | None = None,
    views: int = 5,
    small: bool = False,
    blend: float = 0.6,
    given: bool = True,
    run: Path | None = None,
    measured: int = 0,
) -> None:
    """Segmenters on a few views beside the photo and the capture's own label images: a sheet, IoU.

    Args:
        out: PNG to write.
        scene: capture with label images (default: the built-in one).
        models: ONNX networks.
        classes: what their outputs mean.
        views: rows of the sheet, evenly spaced.
        small: also a small DeepLabV2 that learns from all other views.
        blend: share of the colours; 1 shows no photo.
        given: whether the sheet shows the given label images too.
        run: a trained run of the capture, which is drawn instead of photos that may not be passed on.
        measured: views that the IoU is of, evenly spaced; 0: the rows of the sheet.
    """
    capture = load_scene(scene or cached_capture())
    rows = np.linspace(0, len(capture.views) - 1, views).astype(int).tolist()
    with tempfile.TemporaryDirectory() as folder:
        import_masks(capture, capture.path / "masks", Path(folder))
        masks = Masks(Path(folder), Taxonomy.read(Path(folder) / "labels.json"))
        segmenters = overlays.networks(models, classes or Path("classes.json"))
        if small:
            segmenters |= overlays.small_deeplab(masks, capture, Photos(capture.views), rows)
        on = np.unique(np.linspace(0, len(capture.views) - 1, measured).astype(int)).tolist()
        table, columns = overlays.compare(capture, masks, segmenters, rows, on)
        if given:
            columns = {"given": [masks[capture.views[row]] for row in rows]} | columns
        shown = [Photos(capture.views)[row] for row in rows]
        first = ("rendered", overlays.rendered(run, rows)) if run else ("photo", shown)
        names = Taxonomy(dict(coco.NAMES) | dict(masks.taxonomy.names))
        overlays.sheet(shown, columns, names, blend, first).save(out)
    for name, found in table.items():
        print(name, " ".join(f"{category} {iou:.2f}" for category, iou in found.items()))
    _finish("segment", table, False)


@app.command
def fusion(run: Path, out: Path, views: int = 5, blend: float = 0.6) -> None:
    """Label images of a fused run before and after, on a few views: a sheet of overlays."""
    job = Job(RunDir(run), lambda event: None)
    rows = np.linspace(0, len(job.scene.views) - 1, views).astype(int).tolist()
    overlays.fusion_sheet(job, rows, blend).save(out)


@app.command
def garden(
    scene: Path = workloads.GARDEN,
    downscale: int = 1,
    threads: int = 0,
    steps: int = 0,
    repeats: int = 20,
    write: bool = False,
) -> None:
    """A training step on a capture, from its points or after some steps of training: its parts and rates."""
    used = set_threads(threads)
    capture = load_scene(scene, downscale=downscale)
    g = workloads.trained(capture, steps) if steps else workloads.initial(capture)
    camera, photo = capture.views[1].camera, _photo(capture, 1)
    result = {"scene": capture.name, "size": [camera.width, camera.height], "gaussians": len(g)}
    degree = min(3, steps // 1000)
    result |= {"steps": steps, "threads": used, **measure.parts(g, camera, photo, degree, repeats)}
    if not steps:  # the trainer's own step, photo, statistics and all
        labels = np.full(len(g), -1, np.int16)
        config = TrainConfig(max_steps=30_000, level_every=30_000, lr_schedule="published")
        for name, start in (("step_ms", g),):
            events = train(capture, Photos(capture.views), labels, config, start=start)
            step = partial(next, (event for event in events if isinstance(event, Step)))
            result[name] = measure.milliseconds(step, 40)
    result |= measure.blending(g, camera, repeats) | {"peak_mib": measure.peak_mib()}
    for name, value in result.items():
        print(f"{name:32} {value:,.4g}" if isinstance(value, float) else f"{name:32} {value}")
    _finish(f"{capture.name}_{camera.width}_{steps}", result, write)


@app.command
def whole(
    scene: Path,
    out: Path | None = None,
    downscale: int = 1,
    steps: int = 3000,
    threads: int = 0,
    sources: tuple[Path, ...] = (whole_runs.HERE,),
    repeats: int = 1,
    write: bool = False,
) -> None:
    """Seconds of `sagesplat run` by stage.

    Args:
        scene: capture.
        out: folder for the runs; what is done is not done again (default: one that is removed afterwards).
        downscale: of the photos.
        steps: of training.
        threads: 0: one per core.
        sources: checkouts of the package, which take turns (`git worktree add`).
        repeats: of each.
        write: keep the results.
    """
    options = ["--downscale", str(downscale), "--train.max-steps", str(steps), "--threads", str(threads)]
    with tempfile.TemporaryDirectory() as folder:
        found = whole_runs.measure(scene.resolve(), out or Path(folder), sources, repeats, options)
    print(*whole_runs.table(found), sep="\n")
    result = {"scene": scene.name, "downscale": downscale, "steps": steps, "threads": threads, "runs": found}
    _finish(f"whole_{scene.name}", result, write)


@app.command
def quality(
    scene: Path = workloads.GARDEN,
    downscale: int = 2,
    sources: tuple[Path, ...] = (whole_runs.HERE,),
    steps: tuple[int, ...] = (1000,),
    repeats: int = 1,
    write: bool = False,
) -> None:
    """Time to quality: seconds of training, and PSNR and SSIM on test views.

    Args:
        scene: capture.
        downscale: of its photos.
        sources: checkouts of the package, which take turns (`git worktree add`).
        steps: of training, one number for each checkout.
        repeats: of each.
        write: keep the results.
    """
    found = qualities.measure(scene.resolve(), downscale, sources, steps, repeats)
    for name, run in found.items():
        print(f"{name}: {run['seconds']:.1f} s, {run['psnr']:.2f} dB, {run['ssim']:.4f}")
    _finish(f"quality_{scene.name}", {"scene": scene.name, "downscale": downscale, "runs": found}, write)


@app.command
def refine(
    scene: Path = workloads.GARDEN, downscale: int = 1, threads: int = 1, steps: int = 60, write: bool = False
) -> None:
    """What refining the cameras adds to a training step: settings take turns, one step each."""
    used = set_threads(threads)
    capture = load_scene(scene, downscale=downscale)
    plain = TrainConfig(max_steps=2 * steps, level_every=2 * steps, lr_schedule="published", exposure="off")
    settings = {"poses": replace(plain, poses=True), "exposure": replace(plain, exposure="affine")}
    times = measure.steps_side_by_side(capture, {"plain": plain, **settings}, steps)
    camera = capture.views[0].camera
    result = {"scene": capture.name, "size": [camera.width, camera.height], "threads": used}
    result |= {"gaussians": len(capture.points.xyz), **{f"{name}_ms": ms for name, ms in times.items()}}
    result |= {f"{name}_ratio": ms / times["plain"] for name, ms in times.items() if name != "plain"}
    for name, value in result.items():
        print(f"{name:32} {value}")
    _finish(f"refine_{capture.name}_{camera.width}", result, write)


@app.command
def formats(
    splats: tuple[str, ...] = (), splat_transform: Path | None = None, count: int = 5000, write: bool = False
) -> None:
    """Round trips of splat files with PlayCanvas's splat-transform: errors in steps of each format.

    Args:
        splats: files of splats to use besides random ones; of a streamed SOG level K as PATH@K.
        splat_transform: the program (default: npx; it needs Node 22).
        count: random Gaussians.
    """
    with tempfile.TemporaryDirectory() as folder:
        transform = formatting.found(splat_transform)
        result = formatting.run([Path(path) for path in splats], transform, Path(folder), count)
    for scene, pairs in result.items():
        for pair, errors in pairs.items():
            shown = " ".join(f"{name} {error:.2g}" for name, error in errors.items() if name != "rows")
            print(f"{scene:20} {pair:26} {errors['rows']:>8,.0f}  {shown}")
    if write:
        path = RESULTS.parent / "formats.json"
        path.write_text(json.dumps({"worst": formatting.verdict(result), "scenes": result}, indent=1) + "\n")
    _finish("formats", {"worst_in_steps": formatting.verdict(result)}, False)


@app.command
def audit() -> None:
    """The paper's Table III: its sums, and what Eq. 1 chooses from its numbers."""
    for table in (table_iii.choices_table(), table_iii.sums_table()):
        print(f"{table.title}\n\n{table.markdown()}")


@app.command
def clouds(largest: int = 1_000_000, repeats: int = 5, write: bool = False) -> None:
    """Steps on clouds of 10 k to 1 M Gaussians at 800 x 533, sparse and dense, with one thread and all."""
    view, rows = workloads.camera(), []
    photo = torch.rand(view.height, view.width, 3)
    for overlap in workloads.OVERLAPS:
        for count in (n for n in (10_000, 100_000, 1_000_000) if n <= largest):
            g = workloads.cloud(count, overlap, view)
            for threads in (1, 0):
                used = set_threads(threads)
                row = {"overlap": overlap, "gaussians": count, "threads": used}
                times = repeats if count < 1_000_000 else 1
                row |= measure.parts(g, view, photo, 3, times) | measure.blending(g, view, times)
                rows.append(row)
                names = ("step_ms", "forward_ms", "backward_ms", "ssim_ms", "adam_ms")
                rates = f"{row['pairs_per_s_forward']:.2e} {row['pairs_per_s_backward']:.2e} pairs/s"
                shown = " ".join(f"{name[:-3]} {row[name]:.1f}" for name in names)
                print(f"{overlap} {count:>9,} threads {used}: {shown} ms; {rates}", flush=True)
    _finish("clouds", {"rows": rows}, write)


@app.command
def blending(count: int = 20_000, size: int = 512, repeats: int = 20, write: bool = False) -> None:
    """Blending alone, of large faint Gaussians that overlap: pairs a second, share of the peak, threads."""
    view = workloads.camera(size, size)
    g = workloads.cloud(count, "dense", view)
    result = {}
    for threads in (1, 0):
        used = set_threads(threads)
        result[f"threads_{used}"] = measure.blending(g, view, repeats)
        for name, value in result[f"threads_{used}"].items():
            print(f"{used} threads {name:24} {value:.4g}")
    one, most = result["threads_1"], result[f"threads_{used}"]
    for part in ("forward", "backward"):
        result[f"scaling_{part}"] = most[f"pairs_per_s_{part}"] / one[f"pairs_per_s_{part}"]
    result["scaling_peak"] = most["peak_gflops"] / one["peak_gflops"]
    _finish("blending", result, write)


@app.command
def growth(repeats: int = 5, write: bool = False) -> None:
    """How a step grows with the number of Gaussians, of pixels, and with overlap: a plot of each."""
    from matplotlib.figure import Figure

    set_threads(0)
    curves: dict[str, list[tuple[float, dict[str, float]]]] = {
        "Gaussians": [],
        "pixels": [],
        "sigma [px]": [],
    }
    for count in (10_000, 20_000, 50_000, 100_000, 200_000, 400_000):
        view = workloads.camera(512, 512)
        curves["Gaussians"].append(
            (count, _step_parts(workloads.cloud(count, "sparse", view), view, repeats))
        )
    g = workloads.cloud(50_000, "sparse", workloads.camera(512, 512))
    for size in (128, 256, 512, 1024, 1536):
        curves["pixels"].append((size * size, _step_parts(g, workloads.camera(size, size), repeats)))
    for sigma in (1, 2, 4, 8, 16, 32):
        view = workloads.camera(512, 512)
        wide = replace(g, log_scales=g.log_scales + float(np.log(sigma / 2)))
        curves["sigma [px]"].append((sigma, _step_parts(wide, view, repeats)))
    figure = Figure(figsize=(12, 3.6), layout="constrained")
    for axes, (name, points) in zip(figure.subplots(1, 3), curves.items(), strict=True):
        for part in ("step_ms", "forward_ms", "backward_ms", "ssim_ms", "adam_ms"):
            axes.loglog([x for x, _ in points], [row[part] for _, row in points], "o-", label=part[:-3])
        axes.set_xlabel(name)
        axes.set_ylabel("ms")
        axes.grid(True, alpha=0.3)
        axes.legend(fontsize=7)
    if write:
        RESULTS.mkdir(parents=True, exist_ok=True)
        figure.savefig(RESULTS / "growth.png", dpi=110)
    _finish("growth", {n: [{"x": x, **row} for x, row in points] for n, points in curves.items()}, write)


def _step_parts(g: Gaussians, view: Camera, repeats: int) -> dict[str, float]:
    return measure.parts(g, view, torch.rand(view.height, view.width, 3), 3, repeats)


@app.command
def against_torch(scene: Path = workloads.GARDEN, downscale: int = 2, write: bool = False) -> None:
    """The same image and gradients by plain torch operations: time of both, in one run."""
    set_threads(0)
    capture = load_scene(scene, downscale=downscale)
    g, camera = workloads.initial(capture), capture.views[1].camera
    leaves = {name: p.requires_grad_() for name, p in g.parameters().items()}
    g = replace(g, **leaves)

    def ours() -> torch.Tensor:
        return rasterize(g, camera, sh_degree=0).rgb

    def torchs() -> torch.Tensor:
        return plain.render(g, camera)

    result = {
        "size": [camera.width, camera.height],
        "gaussians": len(g),
        "largest_difference": float((ours() - torchs()).abs().max().detach()),
        "torch_forward_ms": measure.milliseconds(lambda: torchs().detach(), 1),
        "torch_both_ms": measure.milliseconds(lambda: torchs().sum().backward(), 1),
        "forward_ms": measure.milliseconds(lambda: ours().detach(), 10),
        "both_ms": measure.milliseconds(lambda: ours().sum().backward(), 10),
    }
    result["times_faster"] = result["torch_both_ms"] / result["both_ms"]
    _finish("against_torch", result, write)


@app.command
def votes(
    scene: Path = workloads.GARDEN, count: int = 200_000, labels: int = 11, write: bool = False
) -> None:
    """Blending weights of every Gaussian and label over all views of a capture."""
    used = set_threads(0)
    capture = load_scene(scene)
    g = workloads.initial(capture)
    rng = np.random.default_rng(0)
    rows = torch.from_numpy(rng.integers(0, len(g), count))
    g = g.select(rows)
    g = replace(g, means=g.means + 0.01 * torch.from_numpy(rng.normal(size=(count, 3)).astype(np.float32)))
    camera, space, out = capture.views[0].camera, Workspace(), np.zeros((count, labels), np.float32)
    blocks = rng.integers(
        0, labels, (-(-camera.height // 64), -(-camera.width // 64))
    )  # regions, as labels are
    columns = np.kron(blocks, np.ones((64, 64), np.int64))[: camera.height, : camera.width]
    columns = np.ascontiguousarray(columns)
    add_weights(g, camera, columns, out, workspace=space)
    begin = time.perf_counter()
    for view in capture.views:
        add_weights(g, view.camera, columns, out, workspace=space)
    seconds = time.perf_counter() - begin
    result = {"views": len(capture.views), "size": [camera.width, camera.height], "gaussians": count}
    _finish("votes", result | {"labels": labels, "threads": used, "seconds": seconds}, write)


@app.command
def memory(count: int = 1_000_000, steps: int = 3, write: bool = False) -> None:
    """Most memory that training so many Gaussians at 800 x 533 takes."""
    set_threads(0)
    view = workloads.camera()
    before = measure.peak_mib()
    g = workloads.cloud(count, "sparse", view)
    parts = measure.parts(g, view, torch.rand(view.height, view.width, 3), 3, steps)
    peak = measure.peak_mib()
    per_gaussian = (peak - before) * 2**20 / count
    result = {"gaussians": count, "peak_mib": peak, "bytes_per_gaussian": per_gaussian, **parts}
    _finish("memory", result, write)


# What the gate holds: rates over the machine's own multiply-add peak, measured in the same run
GATE = {"share_of_peak_forward": 0.6, "share_of_peak_backward": 0.6, "steps_per_gflop": 0.6}


@app.command
def gate(write: bool = False) -> None:
    """Fails where the kernels use much less of the machine than when `results/cpu/gate.json` was written."""
    set_threads(0)
    view = workloads.camera(512, 512)
    rates = measure.blending(workloads.cloud(20_000, "dense", view), view, 10)
    sparse = workloads.cloud(50_000, "sparse", view)
    photo = torch.rand(view.height, view.width, 3)
    step = measure.parts(sparse, view, photo, 3, 10)["step_ms"]
    result = {name: rates[name] for name in list(GATE)[:2]}
    result["steps_per_gflop"] = 1e3 / step / rates["peak_gflops"]
    path = RESULTS / "gate.json"
    if not write:
        known = json.loads(path.read_text())
        for name, least in GATE.items():
            ratio = result[name] / known[name]
            print(f"{name:28} {result[name]:.4g}, {ratio:.2f} of {known[name]:.4g} (at least {least})")
            if ratio < least:
                raise SystemExit(f"{name} fell to {ratio:.2f} of what it was; see docs/performance.md")
    _finish("gate", result, write)


@app.command
def agreement(count: int = 400, width: int = 120, height: int = 90, seeds: int = 5) -> None:
    """Largest differences of the cpu backend to the float64 reference; gradients relative to the largest."""
    worst: dict[str, float] = {}
    for seed in range(seeds):
        images, grads = zip(
            *(_gradients(b, count, width, height, seed) for b in ("reference", "cpu")), strict=True
        )
        errors = {"image": float((images[0] - images[1]).abs().max())}
        for name in grads[0]:
            exact, fast = grads[0][name].double(), grads[1][name].double()
            errors[name] = float((exact - fast).abs().max() / exact.abs().max())
        worst = {name: max(worst.get(name, 0.0), error) for name, error in errors.items()}
    for name, error in worst.items():
        print(f"{name:16} {error:.2e}")
    print(json.dumps(worst))


@app.command
def gpu(
    scene: Path = workloads.GARDEN,
    downscale: int = 1,
    steps: int = 30_000,
    minutes: float = 9.0,
    device: Literal["cuda", "cpu"] = "cuda",
    only: tuple[str, ...] = (),
    masks: Path | None = None,
    lpips: Path | None = None,
    out: Path | None = None,
    write: bool = False,
) -> None:
    """All checks that a machine with a GPU owes, in so many minutes; `--device cpu` tries the script."""
    asked = base.Asked(scene, downscale, steps, minutes, device, only, masks, lpips, out, write)
    raise SystemExit(script.main(asked))


@app.command
def viewer(bundle: Path, write: bool = False) -> None:
    """A bundle in Chromium at 2, 10, 50 Mbit/s: bytes and seconds to the first picture and to targets."""
    from benchmarks import viewer as loading

    result = loading.measure(bundle)
    print(loading.table(result))
    _finish("viewer", result, write)


@app.command
def label_edits(run: Path, views: int = 60, split: bool = False, write: bool = False) -> None:
    """Ten edits of labels applied to a finished run: seconds, promises before and after, clicks."""
    from benchmarks import label_edits as editing

    set_threads(0)
    _finish("label-edits", editing.measure(run, views, split), write)


@app.command
def server(idle: int = 1000, slow: int = 1000, honest: int = 200, write: bool = False) -> None:
    """`sagesplat view` with idle, slow and honest clients at once, plain and over TLS."""
    from benchmarks import server as serving

    rows = [serving.measure(idle, slow, honest, tls) for tls in (False, True)]
    for row in rows:
        print(
            f"{'TLS' if row['tls'] else 'plain':5} {row['finished']} of {honest} honest ones finished"
            f" in {row['seconds']:.0f} s (a file {row['file_median_s']:.1f} s, at most"
            f" {row['file_longest_s']:.1f});"
            f" server {row['server_rss_mb']:.0f} MB, terminal {row['terminal_lines']} lines"
        )
    result = {"date": date.today().isoformat(), "commit": serving.commit(), "command": "benchmarks server"}
    _finish("server", {**result, "rows": rows}, write)


@app.command
def fuzz(
    readers: tyro.conf.Positional[tuple[str, ...]] = (),
    *,
    seconds: float = 720,
    out: Path = Path("fuzz-findings"),
    seed: int = 0,
    jobs: int = 2,
    write: bool = False,
) -> None:
    """Damaged files for every reader, guided by coverage where atheris is installed; fails on findings.

    Args:
        readers: names (none: all; benchmarks/readers lists them).
        seconds: of all readers together, in `jobs` processes.
        out: folder for the files that a reader fails on.
        seed: of the random numbers.
        jobs: processes.
        write: keep the figures in benchmarks/results/fuzz.json.
    """
    rows = []
    for row in fuzzing.run(seconds, readers, out, seed, jobs):
        branches = "" if row["branches"] is None else f", {row['branches']} branches"
        print(f"{row['reader']:20} {row['executions']:>10,} in {row['seconds']:>6} s{branches}", flush=True)
        for text in row["findings"].values():
            print(f"    {text}")
        rows.append(row)
    found = sum(len(row["findings"]) for row in rows)
    executions = sum(row["executions"] for row in rows)
    result = {"executions": executions, "findings": found, "readers": len(rows)}
    result |= {"guided": any(row["guided"] for row in rows), "seconds": seconds, "jobs": jobs}
    if write:
        fuzzing.write(RESULTS.parent / "fuzz.json", result, rows)
    _finish("fuzz", result, False)
    if found:
        raise SystemExit(f"{found} findings; the files are in {out}")


@app.command
def viewer_figure(curves: Path, out: Path) -> None:
    """Draws the curve.csv that web/test/network.report.mjs simulated."""
    from benchmarks import viewer as loading

    loading.figure(curves, out)


@app.command
def pictures(run: Path, out: Path, name: str = "", photo: str = "", press: str = "", column: int = 0) -> None:
    """Pictures of README and docs/images from a finished run: the viewer's screenshots, and its result.

    Args:
        run: finished run folder.
        out: folder for viewer.png, viewer-phone.png and demo.png.
        name: file name, without suffix, of a single screenshot instead.
        photo: name of the photo at whose viewpoint the phone, or the single screenshot, stands (default:
            where the viewer begins).
        press: selector of something to click first, such as ".labels .blocks".
        column: number of the test view in demo.png, of those in the report.
    """
    from benchmarks import pictures as made

    for path in made.screenshots(run, out, name=name, photo=photo, press=press):
        print(path)
    if not name:
        made.result(run, out / "demo.png", column)


@app.command
def scaling(
    bundles: tyro.conf.Positional[tuple[Path, ...]] = (),
    *,
    out: Path,
    viewers: tuple[int, ...] = (1_000, 10_000, 100_000, 1_000_000, 10_000_000),
    seed: int = 0,
    write: bool = False,
) -> None:
    """Internet scale by simulation (docs/scaling.md): visits, caches of a CDN, new trainings, money.

    Args:
        bundles: folders whose visits are recorded (none: the committed recordings).
        out: folder for JSON, CSV and figures.
        viewers: visits a day.
        seed: of the simulated days.
        write: also copy them to benchmarks/results and docs/images.
    """
    from benchmarks.scaling import report
    from sagesplat.core.errors import SageError

    try:
        result = report.run(bundles, out, viewers, seed, lambda line: print(line, flush=True))
    except SageError as error:
        raise SystemExit(str(error)) from None
    if write:
        report.commit(out)
    kept = ("viewers", "mb_per_visit", "pop_hits_bytes", "origin_gb", "peak_origin_requests_per_s")
    _finish("scaling", {"days": [{name: row[name] for name in kept} for row in result["days"]]}, False)


@app.command
def blocks(
    scene: Path, out: Path, count: int = 4, steps: int = 3000, nest_steps: int = 1000,
    boundary_steps: int = 300, threads: int = 1, margin: float = 0.2, write: bool = False,
) -> None:  # fmt: skip
    """A large scene in blocks of `steps` each, and as one with as many steps as all blocks together."""
    from benchmarks.blocks import compare
    from sagesplat.core.config import BlocksConfig, NestConfig, RunConfig, TrainConfig

    def config(times: int) -> RunConfig:
        return RunConfig(
            train=TrainConfig(max_steps=times * steps),
            blocks=BlocksConfig(count=count, boundary_steps=boundary_steps),
            nest=NestConfig(steps=times * nest_steps, base_steps=times * nest_steps, levels=12),
        )

    tables, result = compare(scene, out, config(1), config(count), threads)
    for table in tables:
        print(f"\n{table.title}\n\n{table.markdown()}")
    _finish("blocks", result, write)


@app.command
def faults(
    scene: tyro.conf.Positional[str], *, out: Path,
    only: tuple[Literal["a", "b", "c", "d", "e", "f", "g", "h", "i", "j"], ...] = (),
    downscale: int = 1, steps: int = 300, nest_steps: int = 100, levels: int = 4, kills: int = 20,
    seed: int = 0, write: bool = False,
) -> None:  # fmt: skip
    """Nodes, drivers and runs killed at random, a full disk: the same result, and what it costs.

    Args:
        scene: a capture, or demo for the built-in one.
        out: folder for the runs, what they print, faults.json and faults.md.
        only: cases: undisturbed (a), on three nodes (b), nodes killed (c), driver killed (d), disk full (e),
            run killed again and again (f), SIGTERM and five quick Ctrl-C (g), no memory left (h), capture
            moved and changed (i), three bundlers at once (j).
        downscale: times smaller photos.
        steps: of the training of each block.
        nest_steps: of its nested ladder, and of the small model that this begins with.
        levels: of the ladder.
        kills: of case f; case g has half as many.
        seed: of the random moments.
        write: also put the result into benchmarks/results.
    """
    from benchmarks import faults as disturbing
    from benchmarks.faults_run import Asked, settings
    from sagesplat.core.errors import SageError

    capture = cached_capture() if scene == "demo" else Path(scene).absolute()
    words = settings(downscale, steps, nest_steps, levels)
    own = out.absolute() / "capture"  # one case moves it
    if not own.exists():
        shutil.copytree(capture, own)
    asked = Asked(own, out.absolute(), words, kills, seed)
    try:
        cases = disturbing.measure(asked, only, lambda line: print(line, flush=True))
    except SageError as error:
        raise SystemExit(str(error)) from None
    name = scene if scene == "demo" else capture.name
    print(disturbing.report(name, asked, cases, write))


@app.command
def freeze(
    scene: Path = workloads.GARDEN,
    downscale: int = 2,
    steps: int = 3000,
    targets: tuple[float, ...] = (0.8, 0.87),
    threads: int = 0,
    write: bool = False,
) -> None:
    """Whole trainings with and without `--train.freeze-at`, in one run: time, tiles drawn, quality."""
    set_threads(threads)
    config = TrainConfig(max_steps=steps)
    with tempfile.TemporaryDirectory() as folder:
        capture = freezing.open_capture(scene, Path(folder), downscale)
        freezing.timed(capture, replace(config, max_steps=20, freeze_at=0.01))  # kernels are compiled now
        result = freezing.compare(capture, config, list(targets))
    for name, run in result.items():
        if name != "pixel_shares":
            times = " ".join(f"{ms:.0f}" for ms in run["ms_per_step"])
            tiles = " ".join(f"{100 * share:.0f}" for share in run["tiles_drawn"])
            test, share = run["test"], run.get("share_of_time", 1)
            print(
                f"{name:15} {run['seconds']:6.1f} s ({share:.2f}), {run['steps']} steps;"
                f" test {test['psnr']:.2f} dB, {test['ssim']:.4f}; ms {times}; % of tiles {tiles}"
            )
    _finish("freeze", result, write)


@app.command
def adopt(
    folder: Path = Path("runs/adopt"),
    scenes: tuple[str, ...] = ("playbot", "garden", "built-in-11"),
    splat_transform: Path | None = None,
    views: int = 40,
    steps: int = 3000,
    write: bool = False,
) -> None:
    """Levels of adopted splats beside those of splat-transform, at equal counts.

    Args:
        folder: where runs are made; what is done already is skipped.
        scenes: a streamed SOG in the folder of splats, and scenes of `promises`.
        splat_transform: its command (default: by npx).
        views: viewpoints to draw for a splat without a capture.
        steps: of the training of the lower levels.
        write: keep the figures in benchmarks/results/cpu/adopt.json.
    """
    from benchmarks import adopt as adopting
    from benchmarks.formats import found

    results = {}
    for name in scenes:
        streamed = adopting.SPLATS / name / "lod-meta.json"
        case = (
            adopting.published(streamed)
            if streamed.exists()
            else adopting.trained(name, folder, found(splat_transform))
        )
        results[name] = adopting.measure(case, folder / "adopted" / name, views, steps, print)
    _finish("adopt", results, write)


@app.command
def start(scene: Path | None = None, downscale: int = 1, repeats: int = 5, write: bool = False) -> None:
    """Seconds until help is printed and until the first training step of a run whose kernels are cached.

    Args:
        scene: capture (default: the built-in one).
        downscale: of its photos.
        repeats: times that each is measured; the best counts.
        write: keep the figures in benchmarks/results/cpu.
    """
    from benchmarks import start as starting

    result = starting.measure(scene or cached_capture(), ["--downscale", str(downscale)], repeats)
    for name, value in result.items():
        print(f"{name:20} {value}")
    _finish("start", result, write)


@app.command
def interrupts(
    run: Path,
    /,
    *,
    commands: tuple[str, ...] = (),
    moments: int = 4,
    seed: int = 0,
    write: bool = False,
) -> None:
    """Ctrl-C at several moments of every command that makes part of a run: seconds until it answers and ends.

    Args:
        run: finished run folder, such as one of `sagesplat demo`; copies of it are worked on.
        commands: some of them (default: all).
        moments: interrupts of each.
        seed: of the moments.
        write: keep the figures in benchmarks/results/cpu.
    """
    from benchmarks import interrupts as interrupting

    unknown = [name for name in commands if name not in interrupting.CASES]
    if unknown:
        raise SystemExit(f"no command {unknown[0]!r}; choose from {', '.join(interrupting.CASES)}")
    names = commands or tuple(interrupting.CASES)
    result = interrupting.measure(run, names, moments, seed, lambda line: print(line, flush=True))
    _finish("interrupts", result, write)


@app.command
def structure(src: tuple[Path, ...] = (Path("src/sagesplat"),), write: bool = False) -> None:
    """How the package is built: entries, imports between them, cycles, lengths; of several checkouts in turn.

    Args:
        src: folders of packages, such as src/sagesplat; the name of each becomes a column.
        write: also put the figures into benchmarks/results.
    """
    from benchmarks import structure as building

    if missing := [str(path) for path in src if not (path / "__init__.py").exists()]:
        raise SystemExit(f"{missing[0]}: not a Python package; name its folder, such as src/sagesplat")
    results = {str(path): building.measure(path.resolve()) for path in src}
    print(building.table(results))
    _finish("structure", results, write)


@app.command
def tables() -> None:
    """Measured tables of the documents, the oldest first, with the commits to the code since."""
    from benchmarks import doc_tables

    print(doc_tables.ages(Path("docs"), date.today()))


@app.command
def promises(
    folder: Path = Path("runs/promises"),
    scenes: tuple[str, ...] = tuple(promising.CASES),
    views: int = 300,
    redraws: int = 20,
    write: bool = False,
) -> None:
    """Coverage of promises: fidelity at fresh viewpoints, SSIM against photos over redraws.

    Args:
        folder: where the scenes are run; what is done there already is not run again.
        scenes: which of them.
        views: fresh viewpoints a scene.
        redraws: of calibration and test photos.
        write: keep the figures in benchmarks/results/cpu/promises.json.
    """
    _finish("promises", promising.measure(folder, scenes, views, redraws, print), write)


@app.command
def size(
    folder: Path = Path("runs/size"),
    scenes: tuple[str, ...] = tuple(sizing.SCENES),
    asked: tyro.conf.OmitArgPrefixes[sizing.Asked] = sizing.Asked(),  # noqa: B008 - frozen
    threads: int = 0,
    survey: bool = False,
    write: bool = False,
) -> None:
    """Bytes at equal SSIM beside sets made for one size, what nesting costs, and levels from far away.

    Args:
        folder: where runs are made; what is done already is skipped.
        scenes: garden, dinosaur, built-in, folders of captures, or run folders with a training.
        threads: 0: one per core.
        survey: also write FOLDER/survey, rows as the public compression survey has them.
        write: keep the figures in benchmarks/results/size.json.
    """
    from sagesplat.core.errors import SageError

    set_threads(threads)
    asked, results = replace(asked, vgg=asked.vgg or survey), {}
    for scene in scenes:
        begin = time.perf_counter()
        try:
            found = sizing.measure(folder, scene, asked, lambda line: print(line, flush=True))
        except SageError as error:
            raise SystemExit(str(error)) from None
        shown = size_tables.table(found)
        print(f"\n{shown.title}\n\n{shown.markdown()}")
        if survey:
            for path in size_tables.write_survey(folder / "survey", found):
                print(f"{path}\n{path.read_text()}")
        results[found.scene] = size_tables.summary(found) | {"measured_in_s": time.perf_counter() - begin}
    _finish("size", {"scenes": results}, write, RESULTS.parent)


@app.command
def plans(positions: int = 1000, write: bool = False) -> None:
    """Levels for a target and within a budget: time of one plan and of a path, by labels and levels."""
    rows = [planning.measure(positions, *size) for size in planning.SIZES]
    for row in rows:
        print(
            f"{row['labels']:4} x {row['levels']}: target {row['target_ms']:.2f} ms, budget"
            f" {row['budget_ms']:.2f} ms (at most {row['budget_ms_most']:.2f}), {row['proven']:.0%} proven,"
            f" gap {row['gap']:.1e}; path {row['path_target_s']:.2f} s and {row['path_budget_s']:.2f} s,"
            f" changes {row['changes_target']:.2%} and {row['changes_budget']:.2%}"
        )
    _finish("plans", {"positions": positions, "rows": rows}, write)


def _gradients(backend: Backend, count: int, width: int, height: int, seed: int):  # type: ignore[no-untyped-def]
    """Image, and gradients of a random weighting of image, alpha and four features."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    g = Gaussians(
        means=normal(count, 3) * torch.tensor([1.2, 0.9, 0.9]) + torch.tensor([0.0, 0.0, 4.0]),
        quats=normal(count, 4),
        log_scales=normal(count, 3) * 0.5 - 2.3,
        logit_opacities=normal(count) * 1.5,
        sh0=normal(count, 1, 3) * 0.5,
        shN=normal(count, 15, 3) * 0.1,
        label_ids=torch.zeros(count, dtype=torch.int16),
    )
    K = np.array([[0.9 * width, 0, 0.45 * width], [0, 0.9 * width, 0.55 * height], [0, 0, 1]], np.float32)
    camera = Camera(np.eye(4, dtype=np.float32), K, width, height)
    features = torch.rand(count, 4, generator=generator).requires_grad_()
    leaves = {name: p.requires_grad_() for name, p in g.parameters().items()}
    render = rasterize(replace(g, **leaves), camera, features=features, backend=backend)
    assert render.features is not None
    loss = torch.zeros(())
    for output in (render.rgb, render.alpha, render.features):
        loss = loss + (output * normal(*output.shape)).sum()
    loss.backward()
    grads = {name: getattr(g, name).grad for name in PARAMETERS} | {"features": features.grad}
    return render.rgb.detach(), grads | {"means2d": render.means2d.grad}


if __name__ == "__main__":
    app.cli(prog="python -m benchmarks")
