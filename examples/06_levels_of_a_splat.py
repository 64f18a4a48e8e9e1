"""Make levels of a splat that is trained already, measure them, and write the planned scene.

    python examples/06_levels_of_a_splat.py scene.ply RUN small.spz
    python examples/06_levels_of_a_splat.py results/ckpts/ckpt_29999_rank0.pt RUN small.sog  # of gsplat
    python examples/06_levels_of_a_splat.py nerfstudio_models/step-000029999.ckpt RUN small.glb

After a training in the same script, three lines do: `Gaussians.from_gsplat(splats)`, `adopt_splat`, and
`run.bundle` or, in a notebook, `run.show()`.
"""

import argparse
from pathlib import Path

import torch

from sagesplat import (
    AdoptConfig,
    Event,
    Gaussians,
    MeasureConfig,
    PlanConfig,
    RunConfig,
    SageError,
    StageDone,
    Warned,
    adopt_splat,
    measure_levels,
    write_splat,
)


def show(event: Event) -> None:
    """The engine prints nothing: it calls this with each event."""
    match event:
        case StageDone(name, seconds, lines):
            print(f"{name}: {seconds:.1f} s. {' '.join(lines)}")
        case Warned(text):
            print(f"warning: {text}")


def splat_of(path: Path) -> Path | Gaussians:
    """The Gaussians of a checkpoint of gsplat or nerfstudio; any other file is read by sagesplat."""
    if path.suffix not in (".pt", ".ckpt"):
        return path
    checkpoint = torch.load(path, map_location="cpu", weights_only=True)
    return Gaussians.from_gsplat(checkpoint.get("splats") or checkpoint["pipeline"])


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "splat", type=Path, help="splat file, or a checkpoint: .pt of gsplat, .ckpt of nerfstudio"
    )
    parser.add_argument("run", type=Path, help="run folder, made if it is not there")
    parser.add_argument("out", type=Path, help="where the planned scene goes; the suffix says the format")
    parser.add_argument("--cameras", type=Path, help="capture or cameras in the frame of the splat")
    parser.add_argument("--target-fidelity", type=float, default=0.9, help="SSIM against the full splat")
    parser.add_argument("--views", type=int, default=96, help="viewpoints to draw without --cameras")
    parser.add_argument("--width", type=int, default=512, help="of these viewpoints, pixels")
    args = parser.parse_args()

    run = adopt_splat(
        splat_of(args.splat),
        args.run,
        AdoptConfig(fit="none", views=args.views, size=(args.width, args.width * 3 // 4)),
        RunConfig(plan=PlanConfig(args.target_fidelity)),
        cameras=args.cameras,
        on_event=show,
    )
    print(f"\n{run}")
    measured = measure_levels(run.path, out=run.path / "measured", config=MeasureConfig(size=args.width))
    print(f"\n{measured}")
    plan = min(run.plans, key=lambda plan: abs(plan.target - args.target_fidelity))
    write_splat(args.out, run.compose(plan), run.names, antialiased=run.antialiased)
    print(f"\n{args.out}: {plan.count:,} Gaussians")


if __name__ == "__main__":
    try:
        main()
    except (SageError, OSError) as error:  # one line: what is wrong, and what to do
        raise SystemExit(f"{Path(__file__).name}: {error}") from None
