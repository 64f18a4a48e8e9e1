"""Make the README's moving picture: the viewer changing levels, photographed in headless Chromium.

    sagesplat bundle runs/demo site
    python tools/moving_picture.py site docs/images/levels.webp

Each frame is the viewer, settled, at one target of fidelity. Needs the extras `dev` and `view`, and
Chromium on PATH.
"""

import argparse
import io
import sys
import threading
from pathlib import Path

from PIL import Image

sys.path.insert(0, str(Path(__file__).parents[1]))

from sagesplat.stages.view import show
from tests.browser import open_page

TARGETS = (0.3, 0.5, 0.7, 0.8, 0.85, 0.9, 0.93, 0.96, 0.98)
HOLD, LAST = 650, 1800  # ms that a frame stays, and the best one
NETWORK = 10.0, 50.0  # Mbit/s, ms: the panel shows what such a visitor loads
GREETED = "localStorage.setItem('sagesplat-welcome', 'seen')"
SETTLED = """() => {
  const { labels, pending } = window.sagesplat.state();
  return !pending && labels.every(({ wanted, shown }) => wanted === shown);
}"""


def frames(bundle: Path, size: tuple[int, int]) -> list[Image.Image]:
    """The viewer at each target, low to high."""
    pictures = []

    with show(bundle, print, port=0) as view:  # with ranges: no more is loaded than is shown
        server = threading.Thread(target=view.run, args=(False,))
        server.start()
        begin = f"{view.urls[0]}?target={TARGETS[0]}"
        with open_page(begin, size, script=GREETED, network=NETWORK) as opened:
            opened.wait_for("window.sagesplat.ready.then(() => true)")
            for target in TARGETS:
                opened.page.evaluate(
                    f"window.sagesplat.set({{ mode: 'target', quality: 'fidelity', target: {target} }})"
                )
                opened.page.wait_for_timeout(500)  # the plan, then the downloads
                opened.wait_for(f"({SETTLED})()", seconds=60)
                opened.page.wait_for_timeout(4000)  # the sort, the numbers, the marks of what changed
                opened.wait_for("document.body.innerText.includes('idle')", seconds=60)
                pictures.append(Image.open(io.BytesIO(opened.page.screenshot())).convert("RGB"))
            if opened.complaints:
                raise SystemExit(f"the page complains: {opened.complaints}")
        view.stop()
        server.join()
    return pictures


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("bundle", type=Path, help="of `sagesplat bundle`")
    parser.add_argument("out", type=Path, help="a .webp")
    parser.add_argument("--size", type=int, nargs=2, default=(960, 620), help="pixels")
    args = parser.parse_args()
    up = frames(args.bundle, tuple(args.size))
    loop = [*up[::-2], *up[1:-1]]  # the best first: many look at the first frame alone
    times = [LAST, *[HOLD] * (len(loop) - 1)]
    loop[0].save(
        args.out, save_all=True, append_images=loop[1:], duration=times, loop=0, quality=80, method=6
    )
    print(f"{args.out}: {len(loop)} frames, {args.out.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
