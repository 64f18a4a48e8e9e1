"""The main job and its stages."""

from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated

from msgspec import Meta
from tyro.conf import Positional, arg

from sagesplat.cli.base import (
    Compute,
    Flat,
    Ladder,
    Machine,
    Parallel,
    Redo,
    Run,
    Scene,
    Seed,
    command,
    open_job,
    prepare,
)
from sagesplat.cli.say import say
from sagesplat.core.config import (
    AdoptConfig,
    BlocksConfig,
    CleanConfig,
    FitConfig,
    LabelsConfig,
    MasksConfig,
    NestConfig,
    PaperConfig,
    PlanConfig,
    PosesConfig,
    RunConfig,
    SampleConfig,
    SceneConfig,
    TrainConfig,
)
from sagesplat.core.errors import RunError

_Courtyards = Annotated[int, Meta(ge=1, le=100)]
_SPLAT = (
    "splat: PLY, compressed PLY, SPZ, SOG, streamed SOG (lod-meta.json, .ssog), glTF, .splat, or a ZIP of one"
)
_INSTANCES = (
    'categories, such as "chair,car"; things: all that can be counted; *: all; "": fold instances back'
)
_FUSE = "Fuse the label images of all views through the trained Gaussians, before the levels are made."


@command
def info(scene: Scene, scene_config: Annotated[SceneConfig, Flat] = SceneConfig()) -> None:
    """Print what a capture holds."""
    from sagesplat.scene import describe, load_scene
    from sagesplat.segment.valid import describe_masks

    as_it_is = replace(scene_config, downscale=scene_config.downscale or 1)
    loaded = load_scene(scene, **asdict(as_it_is))
    rows = describe(loaded)
    if line := describe_masks(loaded):
        rows.append(("pixels that count", line))
    width = max(len(name) for name, _ in rows)
    for name, value in rows:
        say(f"{name:{width}}  {value}")


@command
def run(
    scene: Scene,
    run: Run,
    scene_config: Annotated[SceneConfig, Flat] = SceneConfig(),
    poses: PosesConfig = PosesConfig(),
    masks: Annotated[MasksConfig, Flat] = MasksConfig(),
    labels: LabelsConfig = LabelsConfig(),
    train: TrainConfig = TrainConfig(),
    clean: CleanConfig = CleanConfig(),
    blocks: BlocksConfig = BlocksConfig(),
    nest: NestConfig = NestConfig(),
    sample: SampleConfig = SampleConfig(),
    fit: FitConfig = FitConfig(),
    plan: Annotated[PlanConfig, Flat] = PlanConfig(),
    fuse: Annotated[bool, arg(help=_FUSE)] = False,
    ladder: Ladder = "nested",
    machine: Annotated[Machine, Flat] = Machine(),
    seed: Seed = 0,
) -> None:
    """Run the whole pipeline: photos in, levels, quality models, a plan and a report out.

    Camera poses are estimated if the photos have none, and label images are made if there are none. Finished
    stages are skipped, and a killed run resumes. Options that an earlier command on RUN was given are the
    defaults of the next one.
    """
    from sagesplat.stages import pipeline

    config = RunConfig(
        scene_config, poses, masks, labels, train, clean, blocks, nest, sample, fit, plan, fuse, ladder, seed
    )
    with open_job(run, machine, ladder, begins=True) as job:
        pipeline.run_all(job, scene, config)


@command
def adopt(
    splat: Positional[Annotated[Path, arg(metavar="SPLAT", help=_SPLAT)]],
    run: Run,
    adopt: Annotated[AdoptConfig, Flat] = AdoptConfig(),
    scene_config: Annotated[SceneConfig, Flat] = SceneConfig(),
    masks: Annotated[MasksConfig, Flat] = MasksConfig(),
    labels: LabelsConfig = LabelsConfig(),
    sample: SampleConfig = SampleConfig(),
    fit: FitConfig = FitConfig(),
    plan: Annotated[PlanConfig, Flat] = PlanConfig(),
    machine: Annotated[Machine, Flat] = Machine(),
) -> None:
    """Make a run of a splat that somebody else trained: levels, promises, a plan and a report.

    Its labels are those of the file; or label images or a network vote for them; else it is one category.
    """
    from sagesplat.stages import pipeline

    config = RunConfig(scene_config, masks=masks, labels=labels, sample=sample, fit=fit, plan=plan)
    with open_job(run, machine, begins=True) as job:
        pipeline.adopt(job, splat, adopt, config)


@command
def demo(
    run: Positional[Annotated[Path, arg(metavar="RUN")]] = Path("runs/demo"),
    places: tuple[_Courtyards, _Courtyards] = (1, 1),
    wild: bool = False,
    machine: Annotated[Machine, Flat] = Machine(),
) -> None:
    """Run the whole pipeline on the built-in capture, and say where to look.

    Args:
        run: run folder
        places: rows and columns of courtyards; more than one makes a large scene, trained in that many blocks
        wild: disturb the capture as photos of people are: exposure, vignetting, people who walk by, poses
            that are a little off; and use --labels.ignore person --train.poses
    """
    from sagesplat.stages import pipeline

    with open_job(run, machine, begins=True) as job:
        pipeline.run_demo(job, places, wild)


@command
def masks(
    scene: Scene,
    run: Run,
    scene_config: Annotated[SceneConfig, Flat] = SceneConfig(),
    poses: PosesConfig = PosesConfig(),
    masks: Annotated[MasksConfig, Flat] = MasksConfig(),
    labels: LabelsConfig = LabelsConfig(),
    machine: Annotated[Parallel, Flat] = Parallel(),
) -> None:
    """Begin a run: read the capture, estimate its camera poses if need be, make or import label images."""
    from sagesplat.stages.label import make_masks
    from sagesplat.stages.scene import check_not_adopted, open_scene

    with open_job(run, machine, begins=True) as job:
        check_not_adopted(job.run)
        open_scene(job, scene, scene_config, poses, masks, labels)
        make_masks(job, masks, labels)


@command
def lift(run: Run, machine: Annotated[Redo, Flat] = Redo()) -> None:
    """Transfer the labels of the images to the 3D points of the capture."""
    from sagesplat.stages.label import lift_labels

    with open_job(run, machine) as job:
        lift_labels(job)


@command
def fuse(run: Run, machine: Annotated[Compute, Flat] = Compute()) -> None:
    """Fuse the label images of all views through the trained Gaussians; later stages use the fused ones."""
    from sagesplat.stages.label import fuse_masks

    with open_job(run, machine) as job:
        fuse_masks(job)


@command
def instances(
    run: Run,
    categories: Positional[Annotated[str, arg(metavar="CATEGORIES", help=_INSTANCES)]] = "things",
    machine: Annotated[Compute, Flat] = Compute(),
) -> None:
    """Tell the instances of categories apart: each becomes a category of its own, "chair 1", "chair 2"."""
    from sagesplat.run.recorded import recorded_settings
    from sagesplat.stages.instances import make_instances

    with open_job(run, machine) as job:
        known = recorded_settings(job.run)
        labels = replace(known.get("labels", LabelsConfig()), instances=categories)
        make_instances(job, known.get("masks", MasksConfig()), labels)


@command
def train(
    run: Run,
    train: TrainConfig = TrainConfig(),
    blocks: BlocksConfig = BlocksConfig(),
    machine: Annotated[Machine, Flat] = Machine(),
    seed: Seed = 0,
) -> None:
    """Train 3DGS and record levels; a killed training resumes."""
    from sagesplat.stages.blocks import train_scene

    with open_job(run, machine) as job:
        train_scene(job, train, blocks, seed)


@command
def clean(
    run: Positional[Annotated[Path, arg(metavar="RUN|SPLAT")]],
    out: Positional[Annotated[Path | None, arg(metavar="OUT")]] = None,
    cameras: Path | None = None,
    picture: Path | None = None,
    clean: CleanConfig = CleanConfig(),
    machine: Annotated[Compute, Flat] = Compute(),
) -> None:
    """Remove floaters: from the trained scene of a run, or from a splat file of any tool.

    Args:
        run: run folder; or a splat, of which OUT gets what stays
        out: .ply, .compressed.ply, .spz, .sog, .glb, .splat or .rad to write; only with a splat
        cameras: of a splat: where its photos were taken from, as a capture (best with its photos), a
            cameras.json of 3DGS, a transforms.json or a viewpoints.json (default: viewpoints drawn from the
            splat, which tell less)
        picture: of a splat: PNG of views before and after, and of what goes (of a run: RUN/floaters.png)
    """
    if (run / "scene.json").is_file() or (run / "provenance").is_dir():
        if out or cameras or picture:
            raise RunError(f"{run}: a run folder; leave out OUT, --cameras and --picture")
        from sagesplat.stages.clean import clean_levels

        with open_job(run, machine) as job:
            clean_levels(job, clean)
        return
    if out is None:
        raise RunError(f"{run}: not a run folder; of a splat, name the file to write after it")
    from sagesplat.cli.console import Console
    from sagesplat.stages.clean_splat import clean_splat

    backend, _ = prepare(Machine(**vars(machine)))
    with Console() as console:
        clean_splat(run, out, clean, console, cameras=cameras, picture=picture, backend=backend)
    say(*[out] if picture is None else [out, picture])


@command
def nest(
    run: Run,
    nest: NestConfig = NestConfig(),
    machine: Annotated[Parallel, Flat] = Parallel(),
    seed: Seed = 0,
) -> None:
    """Make the nested levels: order the trained Gaussians, train prefixes, write the increments."""
    from sagesplat.stages.block_levels import nest_scene

    with open_job(run, machine) as job:
        nest_scene(job, nest, seed)


@command
def observe(
    run: Run,
    fit: FitConfig = FitConfig(),
    ladder: Ladder = "nested",
    machine: Annotated[Parallel, Flat] = Parallel(),
) -> None:
    """Measure SSIM and PSNR of every category at every level in every view."""
    from sagesplat.stages.observe import observe_levels

    with open_job(run, machine, ladder) as job:
        observe_levels(job, fit)


@command
def sample(
    run: Run,
    sample: SampleConfig = SampleConfig(),
    fit: FitConfig = FitConfig(),
    machine: Annotated[Parallel, Flat] = Parallel(),
) -> None:
    """Draw viewpoints and measure every level there against the full model (fidelity)."""
    from sagesplat.stages.sample import sample_levels

    with open_job(run, machine, "nested") as job:
        sample_levels(job, sample, fit)


@command
def fit(
    run: Run,
    fit: FitConfig = FitConfig(),
    ladder: Ladder = "nested",
    machine: Annotated[Parallel, Flat] = Parallel(),
) -> None:
    """Fit the quality models: fidelity and SSIM of every category and level, over the viewpoint."""
    from sagesplat.stages.fit import fit_ladder

    with open_job(run, machine, ladder) as job:
        fit_ladder(job, fit)


@command
def plan(
    run: Run,
    plan: Annotated[PlanConfig, Flat] = PlanConfig(),
    ladder: Ladder = "nested",
    machine: Annotated[Redo, Flat] = Redo(),
) -> None:
    """Choose the cheapest level of each category that reaches a target, or the best within a budget.

    A target is of fidelity (SSIM against the full model from the same viewpoint) or of SSIM against photos.
    """
    from sagesplat.stages.plan import make_plan, show_plan

    with open_job(run, machine, ladder) as job:
        make_plan(job, plan)
        show_plan(job)


@command
def compose(run: Run, ladder: Ladder = "nested", machine: Annotated[Compute, Flat] = Compute()) -> None:
    """Write the scene that the plan chose as composed.ply."""
    from sagesplat.stages.compose import compose_plan

    with open_job(run, machine, ladder) as job:
        compose_plan(job)


@command
def evaluate(run: Run, ladder: Ladder = "nested", machine: Annotated[Compute, Flat] = Compute()) -> None:
    """Render the planned scenes in the test views: measured SSIM beside the predicted one."""
    from sagesplat.stages.evaluate import evaluate_plans

    with open_job(run, machine, ladder) as job:
        evaluate_plans(job)


@command
def report(
    run: Run,
    paper: bool = False,
    url: str = "",
    settings: Annotated[PaperConfig, Flat] = PaperConfig(),
    ladder: Ladder = "nested",
    machine: Annotated[Parallel, Flat] = Parallel(),
) -> None:
    """Write the report; with --paper, the tables and figures of the paper.

    Args:
        run: run folder
        paper: evaluate as in the paper (cross-view, equal model size), with the training snapshots as levels;
            their stages are run first where they are missing
        url: address at which the bundle was published: the report links to it, and shows it as a QR code
            for phones
    """
    from sagesplat.stages.report import make_report

    with open_job(run, machine, "snapshots" if paper else ladder) as job:
        if paper:
            from sagesplat.studies.lpips import load_metrics
            from sagesplat.studies.paper.run import paper_report
            from sagesplat.studies.paper.snapshots import adapt_snapshots

            load_metrics(job.emit, settings.lpips)  # what is missing is said before the work
            adapt_snapshots(job)
            paper_report(job, settings)
        else:
            make_report(job, url)
