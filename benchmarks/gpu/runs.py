"""Whole trainings on a GPU: ours and gsplat's."""

import os
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from benchmarks.gpu import gsplat_trainer
from benchmarks.gpu.base import Bench, Clock, Outcome, one_line, wait
from benchmarks.gpu.split import grown, stages
from sagesplat.adapt.observe import render_rgb
from sagesplat.core.config import TrainConfig
from sagesplat.core.errors import SageError
from sagesplat.core.gaussians import Gaussians
from sagesplat.metrics.image import psnr, ssim_map
from sagesplat.metrics.lpips import Net, load_lpips
from sagesplat.raster import rasterize
from sagesplat.train import densify, trainer
from sagesplat.train.events import LevelSaved, Step, Trained
from sagesplat.train.parallel import train_together
from sagesplat.train.strategy import schedule_of

AS_GSPLAT: dict[str, Any] = {"antialiased": False}  # as its example; the rest is our default
KEPT_BACK = 0.1  # of the time, for what comes after the long runs
LARGE = 4_000_000  # Gaussians of `large`: ours with about as many as gsplat makes of garden
WEIGHTS = {"ours": 1.0, "gsplat": 1.3, "mcmc": 0.9, "ours-mcmc": 0.9, "large": 1.3}  # time of a run, guessed


Moment = tuple[int, Gaussians]  # a step, and the model in training; the clock is stopped


@dataclass(eq=False)
class Run:
    """A training, watched."""

    name: str
    steps: int  # taken
    seconds: float
    curve: list[dict[str, float]]  # at each level: step, seconds, ssim, psnr, gaussians, ...
    gaussians: Gaussians  # on the CPU
    peak_mib: float
    stopped: str | None  # why it did not end by itself

    def figures(self) -> dict[str, Any]:
        """All but the Gaussians."""
        return {name: value for name, value in vars(self).items() if name != "gaussians"}

    def reaches(self, ssim: float) -> float | None:
        """Seconds of training after which the test views are this similar."""
        return time_to([(p["seconds"], p["ssim"]) for p in self.curve], ssim)


def full(bench: Bench) -> Outcome:
    """The whole training, by our schedule."""
    run = run_of(bench, "ours")
    last, views = run.curve[-1], len(bench.scene.train_ids)
    figures = run.figures() | {"views": views, "steps_per_s": run.steps / run.seconds}
    names = bench.masks.taxonomy.name if bench.masks else str
    figures["counts"] = {names(label): count for label, count in run.gaussians.counts().items()}
    for net in ("alex", "vgg"):
        try:
            figures[f"lpips_{net}"] = lpips(bench, run.gaussians, net)
        except SageError as error:
            figures[f"lpips_{net}"] = str(error)
    perceived = (f"{net} {figures[f'lpips_{net}']:.4f}" for net in ("alex", "vgg")
                 if isinstance(figures[f"lpips_{net}"], float))  # fmt: skip
    line = (
        f"{run.steps:,} steps on {views} views in {run.seconds:.1f} s ({figures['steps_per_s']:.0f}/s), "
        f"{run.peak_mib:,.0f} MiB, SSIM {last['ssim']:.4f}, PSNR {last['psnr']:.2f}, "
        f"LPIPS {', '.join(perceived) or 'no weights'}, {len(run.gaussians):,} Gaussians"
    )
    return Outcome("ok", f"{line}; {run.stopped}" if run.stopped else line, figures)


def race(bench: Bench) -> Outcome:
    """gsplat's recipes and ours: time to the same SSIM on test views."""
    runs: dict[str, Run] = {}
    missed: dict[str, str] = {}
    hopeless = dict.fromkeys(("gsplat", "mcmc", "large"), "it needs a GPU") if bench.small else {}
    for name in bench.asked.runs or WEIGHTS:
        if name in hopeless:
            missed[name] = hopeless[name]
            continue
        try:
            runs[name] = run_of(bench, name)
        except Exception as error:
            missed[name] = one_line(error)
    if not runs:
        raise RuntimeError("; ".join(missed.values()))
    finals = {name: run.curve[-1]["ssim"] for name, run in runs.items()}
    # when each was as good on the test views as each is at its end
    times = {end: {name: run.reaches(ssim) for name, run in runs.items()} for end, ssim in finals.items()}
    figures: dict[str, Any] = {"final_ssim": finals, "seconds_to_the_end_of": times, "missed": missed}
    figures["runs"] = {name: run.figures() for name, run in runs.items()}
    parts = []
    for name, run in runs.items():
        others = ((n, t) for n, t in times[name].items() if n != name and n in ("gsplat", "ours"))
        same = ", ".join(f"{n} {'never' if t is None else f'{t:.1f} s'}" for n, t in others)
        also = f"; {run.stopped}" if run.stopped else ""
        parts.append(f"{name} {run.seconds:.1f} s to {finals[name]:.4f} ({same or 'alone'}{also})")
    parts += [f"{name}: {why}" for name, why in missed.items()]
    failed = any(name not in hopeless for name in missed)
    return Outcome("FAILED" if failed else "ok", "; ".join(parts), figures)


def multi(bench: Bench) -> Outcome:
    """Two GPUs that train one model."""
    if bench.small or torch.cuda.device_count() < 2:
        return Outcome("skipped", "no GPU" if bench.small else "one GPU")
    steps = min(bench.asked.steps, 1000)
    config, args = (TrainConfig(max_steps=steps, **AS_GSPLAT), (bench.scene, bench.photos, bench.labels))
    seconds = {}
    for name, events in {
        "one": trainer.train(*args, config, backend="cuda"),
        "two": train_together(2, os.cpu_count() or 2, *args, config, backend="cuda"),
    }.items():
        begin, first = time.perf_counter(), True
        for event in events:
            if first and isinstance(event, Step):  # processes start, kernels compile
                begin, first = time.perf_counter(), False
        wait(bench.device)
        seconds[name] = time.perf_counter() - begin
    ratio = 2 * seconds["one"] / seconds["two"]
    times = f"{seconds['one']:.1f} s alone, {seconds['two']:.1f} s by two"
    line = f"{steps} steps: {times}, {ratio:.2f} times the photos a second"
    return Outcome("ok", line, {"steps": steps, "seconds": seconds, "photos_ratio": ratio})


def run_of(bench: Bench, name: str) -> Run:
    """A training that several checks look at, done once."""
    if name not in bench.runs:
        try:
            bench.runs[name] = _train(bench, name)
        except Exception as error:
            bench.runs[name] = error
    found = bench.runs[name]
    if isinstance(found, Exception):
        raise found
    return found


def _train(bench: Bench, name: str) -> Run:
    if bench.left() < KEPT_BACK * 60 * bench.asked.minutes:
        raise RuntimeError("no time left")
    most = LARGE if name == "large" else 0
    strategy = "mcmc" if name == "ours-mcmc" else "default"
    config = TrainConfig(max_steps=steps_of(bench), max_gaussians=most, strategy=strategy, **AS_GSPLAT)
    if name in ("gsplat", "mcmc"):
        moments = gsplats(bench, config, mcmc=name == "mcmc")
    else:
        moments = ours(bench, config)
    run = watch(bench, name, config, moments)
    if name == "ours":
        bench.trained = run.gaussians
    last = run.curve[-1]
    print(f"  {name}: {run.steps:,} steps, {run.seconds:.1f} s, SSIM {last['ssim']:.4f}", flush=True)
    return run


def steps_of(bench: Bench) -> int:
    """Steps of each long run: as asked, or as many as there is time for when first asked."""
    if bench.steps == 0:
        names = ["ours"]
        if bench.chosen("race") and not bench.small:
            names = [name for name in WEIGHTS if name in (bench.asked.runs or WEIGHTS)]
        took = stages(bench, grown(bench), repeats=3 if bench.small else 60)["step"]
        room = bench.left() - KEPT_BACK * 60 * bench.asked.minutes
        room -= 0 if bench.small else 8 * len(names)  # looking at the models takes time too
        bench.steps = affordable(bench.asked.steps, room, took, sum(WEIGHTS[name] for name in names))
        if bench.steps < bench.asked.steps:
            asked = bench.asked.steps
            print(f"  {bench.steps:,} of {asked:,} steps: {took:.1f} ms each, {room:.0f} s left", flush=True)
    return bench.steps


def ours(bench: Bench, config: TrainConfig) -> Iterator[Moment]:
    """Our trainer, at its levels and at its end."""
    training = trainer.begin(bench.scene, bench.photos, bench.labels, config, backend=bench.backend)
    for event in training.run():
        if isinstance(event, LevelSaved | Trained):
            yield training.state.step, training.state.gaussians


def gsplats(bench: Bench, config: TrainConfig, mcmc: bool = False) -> Iterator[Moment]:
    """gsplat's recipe, or its MCMC with as many Gaussians as ours; photos are on the device at the start."""
    rows = bench.scene.train_ids.tolist()
    photos = [torch.from_numpy(bench.photos[row]).to(bench.device).float() / 255 for row in rows]
    cameras = [bench.scene.views[row].camera for row in rows]
    camera, points = cameras[0], len(bench.scene.points.xyz)
    most = densify.cap(config, camera.width * camera.height, points) if mcmc else 0
    return gsplat_trainer.train(bench.initial(), cameras, photos, bench.scene.extent, config, cap=most)


def watch(bench: Bench, name: str, config: TrainConfig, moments: Iterator[Moment]) -> Run:
    """Train and, with the clock stopped, look at the model from time to time."""
    plan, limit = schedule_of(config), bench.end - KEPT_BACK * 60 * bench.asked.minutes
    clock, curve, stopped, last = Clock(bench.device), [], None, None
    if bench.device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(bench.device)
    clock.start()
    for step, g in moments:
        clock.stop()
        last = step, g
        degree = min(config.sh_degree, step // plan.raise_sh_every)
        before = curve[-1] if curve else {"step": 0, "seconds": 0.0}
        if step > before["step"]:
            point = {"step": step, "seconds": clock.seconds, "gaussians": len(g)}
            point["step_ms"] = 1e3 * (clock.seconds - before["seconds"]) / (step - before["step"])
            curve.append(point | view_quality(bench, g, degree))
        if time.perf_counter() > limit:
            stopped = f"out of time at step {step:,}"
            break
        clock.start()
    else:
        clock.stop()
    assert last is not None
    peak = torch.cuda.max_memory_allocated(bench.device) / 2**20 if bench.device.type == "cuda" else 0.0
    return Run(name, last[0], clock.seconds, curve, last[1].to("cpu"), peak, stopped)


@torch.no_grad()
def view_quality(bench: Bench, g: Gaussians, degree: int) -> dict[str, float]:
    """Mean SSIM and PSNR over the test views, whoever trained."""
    ssims, errors, g = [], [], g.to(bench.device)
    for row in bench.scene.test_ids.tolist():
        photo = torch.from_numpy(bench.photos[row])
        rgb = rasterize(g, bench.scene.views[row].camera, sh_degree=degree, backend=bench.backend).rgb
        rgb = rgb.clamp(0, 1)
        if bench.device.type == "cuda":
            from sagesplat.metrics import ssim_triton

            photo = photo.to(bench.device)
            ssims.append(ssim_triton.ssim_map(rgb, photo).mean())
        else:
            ssims.append(torch.tensor(ssim_map(rgb.numpy(), (photo.float() / 255).numpy()).mean()))
        errors.append((rgb - photo.float() / 255).square().mean())
    psnrs = psnr(torch.stack(errors).double().cpu().numpy())
    return {"ssim": float(torch.stack(ssims).mean()), "psnr": float(np.mean(psnrs))}


def lpips(bench: Bench, g: Gaussians, net: Net) -> float:
    """Mean over the test views; vgg as 3DGS computes it."""
    metric, there, values = load_lpips(net, bench.asked.lpips, as_3dgs=net == "vgg"), g.to(bench.device), []
    for row in bench.scene.test_ids.tolist():
        image = render_rgb(there, bench.scene.views[row].camera, backend=bench.backend, antialiased=False)
        values.append(metric(image, bench.photos[row].astype(np.float32) / 255))
    return float(np.mean(values))


def time_to(curve: Sequence[tuple[float, float]], ssim: float) -> float | None:
    """Seconds at which a curve of (seconds, SSIM) first reaches a value, on straight lines; None: never."""
    before = None
    for seconds, value in curve:
        if value >= ssim:
            if before is None or value == before[1]:
                return seconds
            return before[0] + (seconds - before[0]) * (ssim - before[1]) / (value - before[1])
        before = seconds, value
    return None


def affordable(asked: int, seconds: float, step_ms: float, runs: float) -> int:
    """Steps of each of so many runs that fit into some seconds: whole hundreds, at most as asked."""
    fitting = int(1e3 * max(0.0, seconds) / (step_ms * max(runs, 1e-9)))
    return min(asked, max(300, fitting // 100 * 100))
