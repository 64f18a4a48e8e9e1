"""Pictures of README and docs/images from a finished run: python -m tools.pictures RUN OUT

Screenshots of the viewer, and a test view: photo, full model, composed scene, categories.
"""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from PIL import Image

from sagesplat.adapt.plan import Plan
from sagesplat.formats.ply import read_ply
from sagesplat.output.figures import STYLE, Colours, Panel, label_image
from sagesplat.output.tables import MB, last_counts
from sagesplat.run.job import Job
from sagesplat.run.run_dir import RunDir
from sagesplat.segment.display_names import titles
from sagesplat.stages.methods import method_of
from sagesplat.stages.plan import main_target, scene_plan
from sagesplat.stages.report_data import picture_panels
from sagesplat.stages.shared import label_colors
from sagesplat.stages.view import show
from tests.browser import Opened, launch, open_page

WINDOWS: dict[str, tuple[int, int, Literal["light", "dark"]]] = {  # width, height, colours
    "viewer": (840, 540, "light"),
    "viewer-phone": (360, 640, "dark"),
}
_WIDTH = 1080  # px of a result's picture
_GREETED = "localStorage.setItem('sagesplat-welcome', 'seen')"
_QUIET = 3000  # ms after which the panel moves no more


def screenshots(run: Path, out: Path, *, name: str = "", photo: str = "", press: str = "") -> list[Path]:
    """The viewer on a run, as PNG in all colours: in a window, and on a phone unless `name` is another's.

    `photo`: whose viewpoint the phone, or `name`, stands at (default: where the viewer begins). `press`: a
    selector of what is clicked first.
    """
    windows = {name: WINDOWS["viewer"]} if name else WINDOWS
    made = []
    with _served(run) as url, launch() as browser:
        for called, (width, height, scheme) in windows.items():
            asked = f"{url}?view={photo}" if photo and (name or width < 640) else url
            with open_page(
                asked, (width, height), browser=browser, scheme=scheme, touch=width < 640, script=_GREETED
            ) as opened:
                _wait(opened)
                if press:
                    opened.page.locator(press).first.click()
                    opened.page.wait_for_timeout(_QUIET)
                if opened.complaints:
                    raise RuntimeError(f"{called}: {opened.complaints}")
                path = out / f"{called}.png"
                opened.page.screenshot(path=path)
            _packed(path)
            made.append(path)
    return made


def result(run: Path, path: Path, column: int = 0) -> None:
    """A test view of a run: photo, full model, composed scene, categories with their names. PNG."""
    job = Job(RunDir(run), lambda event: None)
    plan = scene_plan(job, *main_target(job.run))
    composed = plan.compose(job.ladder) if job.antialiased else read_ply(job.run.composed)
    panel = picture_panels(job, composed)[column]
    sizes = method_of(job).bytes_to_send or {}
    full = sum(last_counts(sizes).values()) / MB
    figure = _result(panel, plan, full, label_colors(job), titles(job.names()))
    figure.savefig(path, dpi=100, pil_kwargs={"optimize": True})


def _result(panel: Panel, plan: Plan, full_mb: float, colours: Colours, names: dict[int, str]) -> Figure:
    share = panel.photo.shape[0] / panel.photo.shape[1]
    sent = (plan.transfer_bytes or 0) / MB
    pictures = [
        ("photo, not trained on", panel.photo),
        (f"full model, {full_mb:.2f} MB", panel.full),
        (f"planned for {plan.asked}, {sent:.2f} MB", panel.composed),
        ("categories", label_image(panel.label_ids, colours)),
    ]
    width = _WIDTH / 100
    height = width / len(pictures) * share + 0.75
    with rc_context(STYLE):
        figure = Figure(figsize=(width, height))
        for column, (title, pixels) in enumerate(pictures):
            axes = figure.add_axes((column / len(pictures) + 0.001, 0.42 / height, 0.246, 1 - 0.75 / height))
            axes.imshow(pixels, aspect="auto", interpolation="lanczos")
            axes.set_title(title, loc="left", fontsize=11, pad=5)
            axes.set_axis_off()
        shown = [label for label in np.unique(panel.label_ids).tolist() if label in colours]
        handles = [
            Patch(color=(r / 255, g / 255, b / 255), label=names[label])
            for label, (r, g, b) in ((label, colours[label]) for label in shown)
        ]
        figure.legend(handles=handles, loc="lower right", ncols=len(handles), fontsize=11, handlelength=1)
    return figure


@contextmanager
def _served(run: Path) -> Iterator[str]:
    with show(run, print, port=0) as view:
        thread = threading.Thread(target=view.run, args=(False,))
        thread.start()
        try:
            yield view.urls[0]
        finally:
            view.stop()
            thread.join()


def _wait(opened: Opened) -> None:
    """Until everything that the plan wants is drawn, and nothing moves."""
    opened.wait_for(
        "window.sagesplat?.state && (({ pending, labels }) => !pending && labels.length > 0 &&"
        " labels.every((l) => l.shown >= l.wanted))(sagesplat.state())",
        120.0,
    )
    opened.page.evaluate(
        "new Promise((done) => { const stop = sagesplat.onSample(({ settled }) => {"
        " if (settled) { stop(); done() } }) })"
    )
    opened.page.wait_for_timeout(_QUIET)


def _packed(path: Path) -> None:
    """The same picture, without transparency and as small as PNG makes it."""
    image: Any = Image.open(path).convert("RGB")
    image.save(path, optimize=True)


def main(
    run: tyro.conf.Positional[Path],
    out: tyro.conf.Positional[Path],
    *,
    name: str = "",
    photo: str = "",
    press: str = "",
    column: int = 0,
) -> None:
    """Pictures of README and docs/images from a finished run: the viewer's screenshots, and its result.

    Args:
        run: finished run folder.
        out: folder for viewer.png, viewer-phone.png and demo.png.
        name: file name, without suffix, of a single screenshot instead.
        photo: name of the photo at whose viewpoint the phone, or the single screenshot, stands (default:
            where the viewer begins).
        press: selector of something to click first, such as ".labels .blocks".
        column: number of the test view in demo.png, of those in the report.
    """
    for path in screenshots(run, out, name=name, photo=photo, press=press):
        print(path)
    if not name:
        result(run, out / "demo.png", column)


if __name__ == "__main__":
    tyro.cli(main, prog="python -m tools.pictures")
