"""Nested levels beside sets of Gaussians made for one size: bytes at equal SSIM, and what nesting costs.

All is encoded by the encoder of the run's increments, and measured on test views as decoded. Baselines:
snapshots of the training, the trained model pruned and tuned, 3DGS-MCMC at fixed caps, and the trained model
tuned as one for the time that nesting took. They lie in RUN/compare, where `sagesplat compare` has its own.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from benchmarks.common import finish
from benchmarks.promises import CASES
from benchmarks.size_tables import AS_ONE, TRAINED, Measured, summary, table
from sagesplat.core.config import (
    CleanConfig,
    CompareConfig,
    FitConfig,
    LabelsConfig,
    MasksConfig,
    NestConfig,
    RunConfig,
    SampleConfig,
)
from sagesplat.core.errors import RunError, SageError
from sagesplat.core.events import Event, StageDone, StageSkipped, Warned
from sagesplat.core.gaussians import Gaussians
from sagesplat.formats.levels import read_header, read_level
from sagesplat.formats.quantisation import rounded
from sagesplat.formats.spz import SH_BITS
from sagesplat.raster import device_of, resolve_backend, set_threads
from sagesplat.run.job import Job
from sagesplat.run.records import seconds_of, settings_of
from sagesplat.run.run_dir import RunDir
from sagesplat.stages.block_levels import nest_scene
from sagesplat.stages.blocks import train_scene
from sagesplat.stages.clean import clean_levels
from sagesplat.stages.label import lift_labels, make_masks
from sagesplat.stages.methods import NestedLevels
from sagesplat.stages.results import increments_of
from sagesplat.stages.sample import sample_levels
from sagesplat.stages.scene import open_scene
from sagesplat.stages.shared import existing, inlier_inputs, train_config
from sagesplat.studies.compare.report import Point
from sagesplat.studies.compare.run import (
    Baseline,
    Contender,
    encode_set,
    mcmc_sets,
    measure_sets,
    planned_within,
    prefixes,
    pruned_sets,
    snapshot_points,
    trained_sets,
)
from sagesplat.studies.lpips import NETS, load_metrics
from sagesplat.train import nested
from sagesplat.train.early_stopping import ActiveTiles, trainable_rows
from sagesplat.train.importance import importance
from sagesplat.train.photo_loader import PhotoLoader
from sagesplat.train.state import initial_state
from sagesplat.train.stepper import Stepper

Say = Callable[[str], None]
SCENES = {"garden": "garden", "dinosaur": "dinosaur", "built-in": "built-in-11"}  # name: of `promises.CASES`
_TOGETHER = 8  # sets in memory at a time
_TIMED = 100  # steps of nesting, and on the full model, whose CPU time decides how many take as long


@dataclass(frozen=True)
class Asked:
    """What is trained and measured."""

    steps: int = 2000
    """Steps of the training, and of 3DGS-MCMC."""
    nest_steps: int = 3000
    """Steps of nesting."""
    base_steps: int = 3000
    """Steps of its base model."""
    as_one_steps: int = 0
    """Steps of the model that is tuned as one (0: as many as take the CPU time of nesting, measured)."""
    tune_steps: int = 500
    """Steps after pruning."""
    snapshots: int = 10
    """Snapshots of the training, at most."""
    shares: tuple[float, ...] = (0.05, 0.1, 0.2, 0.35, 0.5, 0.7)
    """Sizes that the trained model is pruned to."""
    caps: tuple[float, ...] = (0.05, 0.1, 0.2, 0.35, 0.5, 1.0)
    """Sizes of 3DGS-MCMC."""
    plan_views: int = 80
    """Viewpoints at which levels are measured for plans within budgets."""
    lpips: Path | None = None
    """Folder with the LPIPS weights."""
    vgg: bool = False
    """LPIPS of VGG too, which takes longest of all that is measured."""
    device: str = "auto"
    """cpu, cuda, or auto."""
    seed: int = 0
    """Seed of the trainings."""

    @property
    def compare(self) -> CompareConfig:
        """The same for `studies.compare`."""
        return CompareConfig(
            snapshots=self.snapshots, shares=self.shares, caps=self.caps, tune_steps=self.tune_steps,
            lpips=self.lpips,
        )  # fmt: skip


def open_job(folder: Path, scene: str, asked: Asked, say: Say) -> Job:
    """The run of a capture, trained and nested where it is not yet.

    `scene` is one of SCENES, whose run is FOLDER/NAME, a capture, or a run folder with a training.
    """
    given = Path(scene)
    run = given if (given / "scene.json").exists() else folder / given.name
    backend = resolve_backend("auto", asked.device)
    job = Job(RunDir(run, "nested"), _told(run.name, say), backend, device=asked.device)
    if run != given and not any(job.run.levels.glob("*.npz")):  # a killed training resumes
        _train(job, folder, scene, asked)
    if not job.run.prefixes.exists():
        config = replace(_config(scene, asked).nest, steps=asked.nest_steps, base_steps=asked.base_steps)
        clean_levels(job, CleanConfig())
        nest_scene(job, config, asked.seed)
    return job


def _config(scene: str, asked: Asked) -> RunConfig:
    found = CASES[SCENES[scene]].config if scene in SCENES else RunConfig()
    return replace(found, train=replace(found.train, max_steps=asked.steps, level_every=0), nest=NestConfig())


def _train(job: Job, folder: Path, scene: str, asked: Asked) -> None:
    """From the capture to the trained model."""
    config = _config(scene, asked)
    capture = CASES[SCENES[scene]].capture(folder / "captures" / scene) if scene in SCENES else Path(scene)
    open_scene(job, capture, config.scene)
    make_masks(job, MasksConfig(), LabelsConfig())
    lift_labels(job)
    train_scene(job, config.train, config.blocks, asked.seed)


def _told(name: str, say: Say) -> Callable[[Event], None]:
    def tell(event: Event) -> None:
        match event:
            case StageDone(stage, seconds, lines):
                say(f"{name}: {stage} {seconds:.0f} s; {lines[0] if lines else ''}")
            case StageSkipped(stage):
                say(f"{name}: {stage} is there already")
            case Warned(text):
                say(f"{name}: {text}")
            case _:
                pass

    return tell


def measure(folder: Path, scene: str, asked: Asked, say: Say) -> Measured:
    """Train what is missing of a capture's baselines, and measure all sets."""
    job = open_job(folder, scene, asked, say)
    if not len(job.scene.test_ids):
        raise RunError(f"{job.run.path}: no test views to measure on; begin a run with --test-every 8")
    place, config = job.run.path / "compare", asked.compare
    as_one = _as_one(job, place, asked)
    baselines = [*pruned_sets(job, config, place), *mcmc_sets(job, config, place), as_one]
    contenders = [*snapshot_points(job, config), *trained_sets(job, baselines).values(), _trained(job)]
    metrics = load_metrics(job.emit, asked.lpips, NETS if asked.vgg else NETS[:1])
    points = measure_sets(job, prefixes(NestedLevels(job)), metrics)
    points += measure_sets(job, _planned(job, asked), metrics)
    for begin in range(0, len(contenders), _TOGETHER):
        some = [_as_decoded(job, one) for one in contenders[begin : begin + _TOGETHER]]
        points += measure_sets(job, some, metrics)
    raw = Contender(AS_ONE, "as in training", as_one.step, lambda: _as_trained(job, as_one.path), {})
    unencoded = measure_sets(job, [raw], {})[0]
    return Measured(job.run.path.name, points, _figures(job, points, unencoded, as_one, asked))


def _planned(job: Job, asked: Asked) -> list[Contender]:
    """Plans within the bytes of each level of the same share: most expected fidelity."""
    sampling = SampleConfig(views=asked.plan_views, calibration_views=1)
    sample_levels(job, sampling, FitConfig())
    levels = NestedLevels(job)
    budgets = levels.costs.transfer_bytes.sum(0).tolist()
    return planned_within(levels, [(f"as level {k}", float(n)) for k, n in enumerate(budgets, 1)])


def _trained(job: Job) -> Contender:
    """The trained model as it was when nesting began."""
    return Contender(TRAINED, "trained", job.last_level.step, partial(read_level, job.trained))


def _as_decoded(job: Job, contender: Contender) -> Contender:
    nbytes, arrived = encode_set(job, contender.load())
    return replace(contender, load=lambda: arrived, encoded=nbytes)


def _as_trained(job: Job, path: Path) -> Gaussians:
    """A set that was trained with rounding, as training drew it."""
    return rounded(read_level(path), SH_BITS)


def _as_one(job: Job, place: Path, asked: Asked) -> Baseline:
    nest = settings_of(job.run, "nest")
    config = NestConfig(steps=nest["steps"])
    there = sorted(place.glob("pruned-none-*.npz"))
    before = int(there[0].stem.rpartition("-")[2]) if there else 0
    config = replace(config, steps=asked.as_one_steps or before or _steps_as_long(job, config))
    run = job.run
    return Baseline(
        AS_ONE, f"{config.steps} steps more", place / f"pruned-none-{config.steps}.npz",
        job.last_level.step + config.steps, {**asdict(config), "seed": asked.seed},
        [*run.scene_files, job.trained, *inlier_inputs(run), *existing(run.sky)], train_as_one,
        lambda: (config, asked.seed),
    )  # fmt: skip


def _steps_as_long(job: Job, config: NestConfig) -> int:
    """Steps on the full model that take the CPU time of nesting, by timing a few of both, in turns."""
    g, train = read_level(job.trained), train_config(job)
    views = job.scene.train_ids.tolist()
    begin = time.process_time()
    importance(g, job.scene, views, "sensitivity", valid=job.inliers, antialiased=job.antialiased)
    sorting = len(nested.SORT_AT) * (time.process_time() - begin)
    unordered = nested.Nested(g, np.zeros(len(g), bool))
    few = replace(config, steps=_TIMED)
    events = nested.nest(
        unordered, job.scene, job.photos, train, few, valid=job.inliers, backend=job.backend,
        movable=np.ones(len(g), bool), shell=job.sky.shell if job.sky else None,
    )  # fmt: skip
    steps, took = _full_steps(job, few, 0), {"nested": list[float](), "full": list[float]()}
    for _ in range(_TIMED):
        for name, one in (("nested", events), ("full", steps)):
            begin = time.process_time()
            next(one)
            took[name].append(time.process_time() - begin)
    # the first steps load photos and compile; the share of full draws rises over the steps
    each = {name: float(np.mean(times[_TIMED // 10 :])) for name, times in took.items()}
    return max(1, round((config.steps * each["nested"] + sorting) / each["full"]))


def train_as_one(job: Job, config: NestConfig, seed: int) -> Gaussians:
    """The trained model, trained on in full: nesting's rounding, rates and tail average, no levels."""
    g = read_level(job.trained)
    for after in _full_steps(job, config, seed):
        g = after
    return g.to("cpu")


def _full_steps(job: Job, config: NestConfig, seed: int) -> Iterator[Gaussians]:
    device = device_of(job.backend)
    state = initial_state(read_level(job.trained).to(device), seed)
    state.sort()
    settings = replace(train_config(job), batch=1)
    stepper = Stepper(
        PhotoLoader(job.scene, job.photos, device, job.inliers), settings, ActiveTiles(job.scene, None),
        job.backend, sh_bits=SH_BITS, shell=job.sky.shell if job.sky else None,
    )  # fmt: skip
    rates, trainable = nested.learning_rates(settings, config, job.scene), trainable_rows(state.gaussians, {})
    tail = nested.TailAverage(config.steps)
    for step in range(1, config.steps + 1):
        stepper(state, settings.sh_degree, rates(step), trainable)
        tail.add(state)
        yield state.gaussians


def _figures(
    job: Job, points: Sequence[Point], unencoded: Point, as_one: Baseline, asked: Asked
) -> dict[str, Any]:
    """What is not a point of a curve."""
    full = job.ladder.load(job.ladder.levels[-1])
    begin = time.perf_counter()
    encode_set(job, full)
    took = time.perf_counter() - begin
    encoder = {one.uri.rsplit(".", 1)[-1] for one in increments_of(job)}
    encoded = next(p for p in points if p.method == AS_ONE)
    return {
        "test_views": len(job.scene.test_ids),
        "steps": {
            "train": settings_of(job.run, "train")["max_steps"],
            "nest": settings_of(job.run, "nest")["steps"],
            "as_one": as_one.step - job.last_level.step,
        },
        "antialiased": job.antialiased,
        "trained_gaussians": sum(read_header(job.trained).counts.values()),
        "encoder": "+".join(sorted(encoder)),
        "seconds": {
            "train": seconds_of(job.run, "train"),
            "base": seconds_of(job.run, "base") if job.run.base_model.exists() else 0.0,
            "nest": seconds_of(job.run, "nest"),
            "as_one": seconds_of(job.run, as_one.path.stem),
        },
        "encoding_s_per_100k": took * 1e5 / len(full),  # and reading it back
        "ssim_lost_by_encoding": unencoded.ssim - encoded.ssim,
        "psnr_lost_by_encoding": unencoded.psnr - encoded.psnr,
    }


def main(
    folder: Path = Path("runs/size"),
    scenes: tuple[str, ...] = tuple(SCENES),
    asked: tyro.conf.OmitArgPrefixes[Asked] = Asked(),
    threads: int = 0,
    write: bool = False,
) -> None:
    """Bytes at equal SSIM beside sets made for one size, and what nesting costs.

    Args:
        folder: where runs are made; what is done already is skipped.
        scenes: garden, dinosaur, built-in, folders of captures, or run folders with a training.
        threads: 0: one per core.
        write: keep the figures in benchmarks/results/size.json.
    """
    set_threads(threads)
    results = {}
    for scene in scenes:
        begin = time.perf_counter()
        try:
            found = measure(folder, scene, asked, lambda line: print(line, flush=True))
        except SageError as error:
            raise SystemExit(str(error)) from None
        shown = table(found)
        print(f"\n{shown.title}\n\n{shown.markdown()}")
        results[found.scene] = summary(found) | {"measured_in_s": time.perf_counter() - begin}
    finish("size", {"scenes": results}, write, "")


if __name__ == "__main__":
    tyro.cli(main, prog="python -m benchmarks.size")
