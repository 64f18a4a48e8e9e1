"""Render a splat PLY from a camera of a capture and save a PNG.

python examples/03_render.py SCENE.ply CAPTURE VIEW_NAME OUT.png
"""

import argparse
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from sagesplat import SageError, load_scene, rasterize, read_ply, set_threads


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("ply", type=Path, help="any 3DGS .ply, with or without labels")
    parser.add_argument("capture", type=Path, help="COLMAP workspace that the splats were trained on")
    parser.add_argument("view", help="name of a photo of the capture")
    parser.add_argument("png", type=Path)
    parser.add_argument("--width", type=int, default=0, help="pixels (default: the photo's)")
    parser.add_argument(
        "--antialiased",
        action="store_true",
        help="for splats trained with it: a comment `SplatRenderMode: mip` in the file",
    )
    args = parser.parse_args()

    gaussians = read_ply(args.ply)
    views = {view.name: view for view in load_scene(args.capture).views}
    if args.view not in views:
        parser.error(f"no view {args.view!r}; there are {', '.join(list(views)[:5])}, ...")
    camera = views[args.view].camera
    if args.width:
        camera = camera.resized(args.width, round(args.width * camera.height / camera.width))

    set_threads()  # one per core
    with torch.no_grad():
        rgb = rasterize(gaussians, camera, antialiased=args.antialiased).rgb
    Image.fromarray((rgb.clamp(0, 1).numpy() * 255).round().astype(np.uint8)).save(args.png)
    print(f"{args.png}: {camera.width}x{camera.height}, {len(gaussians):,} Gaussians")


if __name__ == "__main__":
    try:
        main()
    except (SageError, OSError) as error:  # one line: what is wrong, and what to do
        raise SystemExit(f"{Path(__file__).name}: {error}") from None
