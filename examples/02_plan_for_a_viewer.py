"""Plan the levels for one camera of a finished run and write the scene that it should get.

The camera is a view of the capture, moved back along its viewing direction by --back world units.
python examples/02_plan_for_a_viewer.py RUN VIEW_NAME OUT.ply --target-ssim 0.7 --back 1.5
"""

import argparse
from dataclasses import replace
from pathlib import Path

from sagesplat.adapt.model import read_models
from sagesplat.adapt.observe import PERCENTILE, distances_in_views
from sagesplat.adapt.plan import plan_view
from sagesplat.files import read_json
from sagesplat.job import Job
from sagesplat.output.ply import write_ply
from sagesplat.run_dir import RunDir


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
    models, ladder = read_models(job.run.models), job.ladder
    views = {view.name: view for view in job.scene.views}
    if args.view not in views:
        parser.error(f"no view {args.view!r}; there are {', '.join(list(views)[:5])}, ...")

    view = views[args.view]
    w2c = view.camera.w2c.copy()
    w2c[2, 3] += args.back  # the world moves away along the camera's z
    viewer = replace(view, camera=replace(view.camera, w2c=w2c))

    # The distances must be measured as those that the models were fitted to.
    measured = read_json(job.run.provenance("observe"))["settings"]["distance"]
    percentile = PERCENTILE if measured == "percentile" else 0.0
    table = distances_in_views(replace(job.scene, views=(viewer,)), job.point_labels, percentile)
    distances = {label: float(by_view[0]) for label, by_view in table.items()}

    plan = plan_view(models, ladder.counts, distances, args.target_ssim, None, recovering=ladder.recovering)
    for c in plan.choices:
        name, promise = job.names()[c.label_id], f"distance {c.distance:6.2f}, SSIM {c.predicted_ssim:.3f}"
        print(f"{name:24} level {c.level:6}  {c.count:9,} Gaussians  {promise}, {c.status}")
    write_ply(args.ply, ladder.compose(plan.levels), job.names())
    print(f"{args.ply}: {plan.count:,} Gaussians, {plan.nbytes / 1e6:.1f} MB at 248 bytes each")


if __name__ == "__main__":
    main()
