"""Label photos with a network and save each with its categories drawn over it.

    python examples/04_label_photos.py OUT a.jpg b.jpg  # EoMT, from huggingface.co
    python examples/04_label_photos.py OUT *.jpg --model net.onnx --classes net.json

`Segmented.probabilities` holds what the network thinks of each category, where it says so.
"""

import argparse
from pathlib import Path

import numpy as np
from PIL import Image, ImageOps

from sagesplat import HfSegmenter, OnnxSegmenter, SageError, label_image

EOMT = "tue-mps/coco_panoptic_eomt_small_640_2x"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("out", type=Path, help="folder for the overlays")
    parser.add_argument("photos", type=Path, nargs="+", help="photos")
    parser.add_argument("--model", default=EOMT, help="a name on huggingface.co, a folder, or NETWORK.onnx")
    parser.add_argument("--classes", type=Path, help="what the outputs of an ONNX network mean")
    args = parser.parse_args()

    segmenter = OnnxSegmenter(Path(args.model), args.classes) if args.classes else HfSegmenter(args.model)
    args.out.mkdir(parents=True, exist_ok=True)
    for path in args.photos:
        photo = np.asarray(ImageOps.exif_transpose(Image.open(path)).convert("RGB"))
        found = segmenter([photo])[0]
        ids, counts = np.unique(found.label_ids, return_counts=True)
        shares = {
            segmenter.taxonomy.name(i): n / photo[..., 0].size
            for i, n in zip(ids.tolist(), counts, strict=True)
        }
        colours = {i: segmenter.taxonomy.color(i) for i in ids.tolist()}
        overlay = 0.5 * photo + 0.5 * label_image(found.label_ids, colours)
        Image.fromarray(overlay.astype(np.uint8)).save(args.out / f"{path.stem}.png")
        print(path.name, ", ".join(f"{name} {share:.0%}" for name, share in shares.items() if share > 0.01))


if __name__ == "__main__":
    try:
        main()
    except (SageError, OSError) as error:  # one line: what is wrong, and what to do
        raise SystemExit(f"{Path(__file__).name}: {error}") from None
