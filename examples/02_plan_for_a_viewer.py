"""Plan the levels for one camera of a finished run and write the scene that it should get.

The camera is a view of the capture, moved back along its viewing direction by --back world units.
python examples/02_plan_for_a_viewer.py RUN VIEW_NAME OUT.ply --target-fidelity 0.9 --back 1.5
"""

import argparse
from dataclasses import replace
from pathlib import Path

from sagesplat import SageError, open_run, write_ply


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path)
    parser.add_argument("view", help="name of a photo of the capture")
    parser.add_argument("ply", type=Path)
    parser.add_argument("--target-fidelity", type=float, help="SSIM against the full model (default: 0.95)")
    parser.add_argument("--target-ssim", type=float, help="SSIM against photos, instead")
    parser.add_argument("--back", type=float, default=0.0, help="world units")
    args = parser.parse_args()

    run = open_run(args.run)
    views = {view.name: view for view in run.scene.views}
    if args.view not in views:
        parser.error(f"no view {args.view!r}; there are {', '.join(list(views)[:5])}, ...")
    w2c = views[args.view].camera.w2c.copy()
    w2c[2, 3] += args.back  # the world moves away along the camera's z
    viewer = replace(views[args.view].camera, w2c=w2c)

    plan = run.plan_camera(viewer, target_fidelity=args.target_fidelity, target_ssim=args.target_ssim)
    print(plan)  # a row for each category; "predicted" is what it measures at least
    write_ply(args.ply, run.compose(plan), run.names, antialiased=run.antialiased)
    print(f"{args.ply}: {plan.count:,} Gaussians, {plan.transfer_bytes or 0:,} bytes to send")


if __name__ == "__main__":
    try:
        main()
    except (SageError, OSError) as error:  # one line: what is wrong, and what to do
        raise SystemExit(f"{Path(__file__).name}: {error}") from None
