"""Plan the levels for one camera of a finished run and write the scene that it should get.

The camera is a view of the capture, moved back along its viewing direction by --back world units.
python examples/02_plan_for_a_viewer.py RUN VIEW_NAME OUT.ply --target-ssim 0.7 --back 1.5
"""

import argparse
from dataclasses import replace
from pathlib import Path

from sagesplat.adapt.bound_plans import plan_for_view, quality_at
from sagesplat.adapt.observe import PERCENTILE, distances_in_views
from sagesplat.adapt.viewpoint import read_promises
from sagesplat.formats.ply import write_ply
from sagesplat.run.job import Job
from sagesplat.run.run_dir import RunDir
from sagesplat.stages.methods import NestedLevels


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path)
    parser.add_argument("view", help="name of a photo of the capture")
    parser.add_argument("ply", type=Path)
    parser.add_argument("--target-ssim", type=float, default=0.7)
    parser.add_argument("--back", type=float, default=0.0, help="world units")
    args = parser.parse_args()

    job = Job(RunDir(args.run), emit=lambda event: None)  # scene, labels and ladder, read when asked for
    costs, promises = NestedLevels(job).costs, read_promises(job.run.promises)
    views = {view.name: view for view in job.scene.views}
    if args.view not in views:
        parser.error(f"no view {args.view!r}; there are {', '.join(list(views)[:5])}, ...")

    view = views[args.view]
    w2c = view.camera.w2c.copy()
    w2c[2, 3] += args.back  # the world moves away along the camera's z
    viewer = replace(view, camera=replace(view.camera, w2c=w2c))

    # The distances must be measured as those that the promises were fitted to.
    percentile = PERCENTILE if job.fit_config.distance == "percentile" else 0.0
    far = distances_in_views(replace(job.scene, views=(viewer,)), job.point_labels, percentile)

    plan = plan_for_view(quality_at(costs, promises, far, [viewer.camera]), costs, args.target_ssim, 0)
    for c in plan.choices:
        name, kept = job.names()[c.label_id], f"SSIM at least {c.predicted_ssim:.3f}, {c.status}"
        print(f"{name:24} level {c.level:3}  {c.count:9,} Gaussians  distance {c.distance:6.2f}  {kept}")
    write_ply(args.ply, job.ladder.compose(plan.levels), job.names())
    print(f"{args.ply}: {plan.count:,} Gaussians, {plan.transfer_bytes or 0:,} bytes to send")


if __name__ == "__main__":
    main()
