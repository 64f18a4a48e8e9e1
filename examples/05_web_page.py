"""Put a finished run on a web page, with a slider for the quality that is kept and what the planner promises.

python examples/05_web_page.py RUN SITE --target-fidelity 0.9

SITE/index.html is a page of yours around the viewer; any static web server shows it, for example
python -m http.server --directory SITE
"""

import argparse
from html import escape
from pathlib import Path

from sagesplat import SageError, open_run

PAGE = """<!doctype html>
<html lang="en">
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{name}</title>
<style>
  body {{ max-width: 60rem; margin: 2rem auto; padding: 0 1rem; font: 16px/1.5 system-ui, sans-serif }}
  iframe {{ width: 100%; aspect-ratio: 16/10; border: 0 }}
  td {{ padding-right: 2rem }}
</style>
<h1>{name}</h1>
<iframe src="scene/?ui=0&target={target}" title="{name} in 3D" allow="fullscreen; xr-spatial-tracking">
</iframe>
<p><label>Quality <input type="range" min="0.3" max="0.99" step="0.01" value="{target}"></label>
<output></output>
<p>From the first photo's place, {size:.2f} MB keep at least {target:g} of the full scene's {full:.2f} MB:
<table>{rows}</table>
<script>
  const frame = document.querySelector("iframe");
  const slider = document.querySelector("input");
  frame.addEventListener("load", async () => {{
    const viewer = frame.contentWindow.sagesplat;
    await viewer.ready;
    slider.addEventListener("input", () => viewer.set({{ target: slider.valueAsNumber }}));
    setInterval(() => {{
      document.querySelector("output").textContent = `${{(viewer.state().bytesShown / 1e6).toFixed(2)}} MB`;
    }}, 500);
  }});
</script>
"""


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path)
    parser.add_argument("site", type=Path, help="folder for the page; the bundle goes into scene/ there")
    parser.add_argument("--target-fidelity", type=float, default=0.9, help="SSIM against the full model")
    args = parser.parse_args()

    run = open_run(args.run)
    plan = run.plan_camera(run.scene.views[0].camera, target_fidelity=args.target_fidelity)
    rows = "".join(
        f"<tr><td>{escape(run.titles[choice.label_id])}<td>level {choice.level}<td>{choice.promised}"
        for choice in plan.choices
    )
    args.site.mkdir(parents=True, exist_ok=True)
    made = run.bundle(args.site / "scene")
    page = PAGE.format(
        name=escape(args.run.resolve().name),
        target=args.target_fidelity,
        size=(plan.transfer_bytes or 0) / 1e6,
        full=made.sizes.chunks / 1e6,
        rows=rows,
    )
    (args.site / "index.html").write_text(page, encoding="utf-8")
    size = f"{made.sizes.total / 1e6:.1f} MB with its viewer"
    print(f"{args.site / 'index.html'}: {made.labels} categories, {size}")


if __name__ == "__main__":
    try:
        main()
    except (SageError, OSError) as error:  # one line: what is wrong, and what to do
        raise SystemExit(f"{Path(__file__).name}: {error}") from None
