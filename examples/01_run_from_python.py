"""Run every stage on a capture, without the command line, and read what was planned.

python examples/01_run_from_python.py CAPTURE RUN --target-ssim 0.8
"""

import argparse
from pathlib import Path

from sagesplat.adapt.plan import read_plans
from sagesplat.core.config import PlanConfig, RunConfig, SceneConfig, TrainConfig
from sagesplat.core.events import Event, StageDone, StageSkipped, Warned
from sagesplat.raster import set_threads
from sagesplat.run.job import Job
from sagesplat.run.run_dir import RunDir
from sagesplat.stages.pipeline import run_all


def show(event: Event) -> None:
    """The engine prints nothing: it calls this with each event."""
    match event:
        case StageDone(name, seconds, lines):
            print(f"{name}: {seconds:.1f} s. {' '.join(lines)}")
        case StageSkipped(name):
            print(f"{name}: up to date")
        case Warned(text):
            print(f"warning: {text}")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("capture", type=Path, help="COLMAP workspace with images/, sparse/ and masks/")
    parser.add_argument("run", type=Path, help="run folder, made if it is not there")
    parser.add_argument("--target-ssim", type=float, default=0.8)
    parser.add_argument("--max-steps", type=int, default=7000)
    parser.add_argument("--downscale", type=int, default=1)
    args = parser.parse_args()

    config = RunConfig(
        scene=SceneConfig(downscale=args.downscale),
        train=TrainConfig(max_steps=args.max_steps),
        plan=PlanConfig(target_ssim=args.target_ssim),
    )
    job = Job(RunDir(args.run), show, threads=set_threads())
    run_all(job, args.capture, config)

    scene_plans, _ = read_plans(job.run.plan)
    for plan in scene_plans:
        print(f"\nSSIM {plan.target:g}: {plan.count:,} Gaussians, {plan.nbytes / 1e6:.1f} MB, {plan.status}")
        for choice in plan.choices:
            name = job.names()[choice.label_id]
            print(f"  {name:24} level {choice.level:6}  {choice.count:9,}  {choice.status}")


if __name__ == "__main__":
    main()
