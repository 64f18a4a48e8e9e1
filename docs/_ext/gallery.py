"""Puts the pages that `make gallery` wrote into the site, each with the figures of its run."""

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

_BUILD = Path(__file__).parents[2] / "build"
_PAGE = "gallery"


def setup(app: Any) -> dict[str, bool]:
    """Called by Sphinx."""
    app.connect("source-read", _fill)
    app.connect("env-get-outdated", lambda *_: [_PAGE])
    app.connect("build-finished", _copy)
    return {"parallel_read_safe": True}


def _pages() -> Iterator[Path]:
    yield from sorted((_BUILD / "gallery").glob("*.html"))


def _fill(app: Any, page: str, source: list[str]) -> None:
    if page == _PAGE:
        shown = "\n\n".join(_scene(html.stem, html.stat().st_size) for html in _pages())
        missing = (
            "This copy of the site was built without scenes: `make gallery`, then `make docs`, adds them."
        )
        source[0] = source[0].replace("<!-- scenes -->", shown or missing)


def _scene(name: str, nbytes: int) -> str:
    """A live scene, and what its plans cost."""
    from sagesplat import open_run  # slow to import

    run = open_run(_BUILD / name)
    rows = [
        f"| fidelity {plan.target:g} | {plan.count:,} | {(plan.transfer_bytes or 0) / 1000:,.0f} kB |"
        for plan in run.plans
    ]
    full = run.costs.count[:, -1].sum(), run.costs.transfer_bytes[:, -1].sum() / 1000
    return f"""## {name.capitalize()}

<iframe class="bundle" src="gallery/{name}.html" title="{name}, a live splat scene"
  loading="lazy" allow="fullscreen; xr-spatial-tracking"></iframe>

[Full window](gallery/{name}.html){{.external}}, {nbytes / 1e6:.1f} MB with its viewer.

| plan | Gaussians | to send |
|---|---|---|
{chr(10).join(rows)}
| full model | {full[0]:,} | {full[1]:,.0f} kB |
"""


def _copy(app: Any, error: Exception | None) -> None:
    if error is None and app.builder.name == "html":
        for page in _pages():
            (Path(app.outdir) / _PAGE).mkdir(exist_ok=True)
            shutil.copy(page, Path(app.outdir) / _PAGE)
