"""The main job and its stages."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

from sagesplat.cli.base import Flat, LadderKind, Machine, Run, Scene, command, open_job
from sagesplat.core.config import (
    BlocksConfig,
    FitConfig,
    LabelsConfig,
    LiftConfig,
    MasksConfig,
    NestConfig,
    PaperConfig,
    PlanConfig,
    PosesConfig,
    RunConfig,
    SceneConfig,
    TrainConfig,
)


@command
def info(scene: Scene, scene_config: Annotated[SceneConfig, Flat] = SceneConfig()) -> None:
    """Print what a capture holds."""
    from sagesplat.scene import describe, load_scene

    rows = describe(load_scene(scene, **asdict(scene_config)))
    width = max(len(name) for name, _ in rows)
    for name, value in rows:
        print(f"{name:{width}}  {value}")


@command
def run(
    scene: Scene,
    run: Run,
    scene_config: Annotated[SceneConfig, Flat] = SceneConfig(),
    poses: PosesConfig = PosesConfig(),
    masks: Annotated[MasksConfig, Flat] = MasksConfig(),
    labels: LabelsConfig = LabelsConfig(),
    lift: LiftConfig = LiftConfig(),
    train: TrainConfig = TrainConfig(),
    blocks: BlocksConfig = BlocksConfig(),
    nest: NestConfig = NestConfig(),
    fit: FitConfig = FitConfig(),
    plan: Annotated[PlanConfig, Flat] = PlanConfig(),
    fuse: bool = False,
    ladder: LadderKind = "nested",
    machine: Annotated[Machine, Flat] = Machine(),
    seed: int = 0,
) -> None:
    """Everything: photos in, levels, models, a plan and a report out.

    Poses are found where the photos have none, and label images made where there are none.
    """
    from sagesplat.stages import pipeline

    config = RunConfig(
        scene_config, poses, masks, labels, lift, train, blocks, nest, fit, plan, fuse, ladder, seed
    )
    with open_job(run, machine, ladder) as job:
        pipeline.run_all(job, scene, config)


@command
def demo(
    run: Path = Path("runs/demo"),
    places: tuple[int, int] = (1, 1),
    machine: Annotated[Machine, Flat] = Machine(),
) -> None:
    """Make the built-in capture, run the main job on it and say where to look.

    Args:
        run: run folder.
        places: 2 2 makes a large capture, a grid of courtyards, and trains it in as many blocks.
        machine: where and how to compute.
    """
    from sagesplat.stages import pipeline

    with open_job(run, machine) as job:
        pipeline.run_demo(job, places)


@command
def masks(
    scene: Scene,
    run: Run,
    scene_config: Annotated[SceneConfig, Flat] = SceneConfig(),
    poses: PosesConfig = PosesConfig(),
    masks: Annotated[MasksConfig, Flat] = MasksConfig(),
    labels: LabelsConfig = LabelsConfig(),
    machine: Annotated[Machine, Flat] = Machine(),
) -> None:
    """Begin a run: read the capture (poses are found if there are none) and bring label images in."""
    from sagesplat.stages.label import make_masks
    from sagesplat.stages.scene import open_scene

    with open_job(run, machine) as job:
        open_scene(job, scene, scene_config, poses)
        make_masks(job, masks, labels)


@command
def lift(run: Run, lift: LiftConfig = LiftConfig(), machine: Annotated[Machine, Flat] = Machine()) -> None:
    """Vote the label images onto the points."""
    from sagesplat.stages.label import lift_labels

    with open_job(run, machine) as job:
        lift_labels(job, lift)


@command
def fuse(run: Run, machine: Annotated[Machine, Flat] = Machine()) -> None:
    """Let all views vote on the label images by way of the trained Gaussians; what follows uses them."""
    from sagesplat.stages.label import fuse_masks

    with open_job(run, machine) as job:
        fuse_masks(job)


@command
def train(
    run: Run,
    train: TrainConfig = TrainConfig(),
    blocks: BlocksConfig = BlocksConfig(),
    machine: Annotated[Machine, Flat] = Machine(),
    seed: int = 0,
) -> None:
    """Train 3DGS and record the levels; a killed training goes on."""
    from sagesplat.stages import pipeline

    with open_job(run, machine) as job:
        pipeline.train(job, train, blocks, seed)


@command
def parts(run: Run, machine: Annotated[Machine, Flat] = Machine()) -> None:
    """Draw the label images of a scene in blocks: each category in each block is one of its own."""
    from sagesplat.stages import blocks

    with open_job(run, machine) as job:
        blocks.label_block_categories(job)


@command
def nest(
    run: Run,
    nest: NestConfig = NestConfig(),
    blocks: BlocksConfig = BlocksConfig(),
    machine: Annotated[Machine, Flat] = Machine(),
    seed: int = 0,
) -> None:
    """Make the nested ladder: order the trained Gaussians, train their prefixes, write the chunks."""
    from sagesplat.stages import pipeline

    with open_job(run, machine) as job:
        pipeline.nest(job, nest, blocks, seed)


@command
def observe(
    run: Run,
    fit: FitConfig = FitConfig(),
    ladder: LadderKind = "nested",
    machine: Annotated[Machine, Flat] = Machine(),
) -> None:
    """Measure every category at every level in every view."""
    from sagesplat.stages.observe import observe_levels

    with open_job(run, machine, ladder) as job:
        observe_levels(job, fit)


@command
def fit(
    run: Run,
    fit: FitConfig = FitConfig(),
    ladder: LadderKind = "nested",
    machine: Annotated[Machine, Flat] = Machine(),
) -> None:
    """Fit SSIM over distance for every category and level."""
    from sagesplat.stages.fit import fit_ladder

    with open_job(run, machine, ladder) as job:
        fit_ladder(job, fit)


@command
def plan(
    run: Run,
    plan: Annotated[PlanConfig, Flat] = PlanConfig(),
    ladder: LadderKind = "nested",
    machine: Annotated[Machine, Flat] = Machine(),
) -> None:
    """Choose the cheapest levels that keep a target SSIM."""
    from sagesplat.stages.plan import make_plan

    with open_job(run, machine, ladder) as job:
        make_plan(job, plan)


@command
def compose(run: Run, ladder: LadderKind = "nested", machine: Annotated[Machine, Flat] = Machine()) -> None:
    """Write the planned scene as composed.ply."""
    from sagesplat.stages.compose import compose_plan

    with open_job(run, machine, ladder) as job:
        compose_plan(job)


@command
def evaluate(run: Run, ladder: LadderKind = "nested", machine: Annotated[Machine, Flat] = Machine()) -> None:
    """Measure the plans on the test views, beside what was promised."""
    from sagesplat.stages.evaluate import evaluate_plans

    with open_job(run, machine, ladder) as job:
        evaluate_plans(job)


@command
def report(
    run: Run,
    paper: bool = False,
    settings: Annotated[PaperConfig, Flat] = PaperConfig(),
    ladder: LadderKind = "nested",
    machine: Annotated[Machine, Flat] = Machine(),
) -> None:
    """Write the report; with --paper, every table and figure of the paper.

    Args:
        run: run folder.
        paper: cross-view, equal occupancy, and the paper's tables and figures, from its ladder of snapshots.
        settings: what they look at.
        ladder: the ladder to report on.
        machine: where and how to compute.
    """
    from sagesplat.stages.report import make_report

    with open_job(run, machine, "snapshots" if paper else ladder) as job:
        if paper:
            from sagesplat.studies.paper.run import paper_report

            paper_report(job, settings)
        else:
            make_report(job)
