"""Run every stage on a capture, without the command line, and read what was planned.

python examples/01_run_from_python.py CAPTURE RUN --target-fidelity 0.95
"""

import argparse
from pathlib import Path

from sagesplat import (
    Event,
    NestConfig,
    PlanConfig,
    RunConfig,
    SageError,
    SceneConfig,
    StageDone,
    StageSkipped,
    TrainConfig,
    Warned,
    run_scene,
)


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
    parser.add_argument("--target-fidelity", type=float, help="SSIM against the full model (default: 0.95)")
    parser.add_argument("--target-ssim", type=float, help="SSIM against photos")
    parser.add_argument("--max-steps", type=int, default=7000)
    parser.add_argument("--nest-steps", type=int, default=3000, help="of the nested levels")
    parser.add_argument("--downscale", type=int, default=1)
    args = parser.parse_args()

    config = RunConfig(
        scene=SceneConfig(downscale=args.downscale),
        train=TrainConfig(max_steps=args.max_steps),
        nest=NestConfig(steps=args.nest_steps, base_steps=args.nest_steps),
        plan=PlanConfig(args.target_fidelity, args.target_ssim),
    )
    run = run_scene(args.capture, args.run, config, on_event=show)
    for plan in run.plans:
        print(f"\n{plan.asked}: {plan.count:,} Gaussians, {plan.nbytes / 1e6:.1f} MB, {plan.verdict}")
        for choice in plan.choices:
            name = run.titles[choice.label_id]
            print(f"  {name:24} level {choice.level:6}  {choice.count:9,}  {choice.verdict}")


if __name__ == "__main__":
    try:
        main()
    except (SageError, OSError) as error:  # one line: what is wrong, and what to do
        raise SystemExit(f"{Path(__file__).name}: {error}") from None
