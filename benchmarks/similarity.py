"""Definitions of similarity beside each other: how steady over screens, whether they order as LPIPS, cost.

Levels (all categories at one) are compared with the full model from the same viewpoints, on screens whose
focal length in pixels is s times the photos'.
"""

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from scipy.stats import rankdata

from benchmarks.common import ROOT, finish
from sagesplat import FinishedRun, open_run, rasterize
from sagesplat.adapt.viewpoints import Rule, capture_cameras, draw
from sagesplat.core.gaussians import Gaussians
from sagesplat.metrics.flip import PIXELS_PER_DEGREE, flip_map
from sagesplat.metrics.image import ssim_map
from sagesplat.metrics.lpips import load_lpips
from sagesplat.metrics.ms_ssim import ms_ssim
from sagesplat.output.tables import mean
from sagesplat.scene.scene import Camera

SCREENS = (0.5, 1.0, 2.0, 4.0)  # s
PHOTOS, TWICE, LAST = SCREENS.index(1), SCREENS.index(2), len(SCREENS) - 1  # places in SCREENS
LPIPS = "LPIPS alex"
Similarity = Callable[[np.ndarray, np.ndarray, float], float]  # of image, full model and s


def similarities(lpips: Path) -> dict[str, Similarity]:
    """The definitions, by name; FLIP and LPIPS are 0 for the same image, the others 1.

    FLIP at 67 pixels per degree on every screen, and at 67 s: the picture then fills the same angle on all of
    them. (At 268 pixels per degree it takes many seconds an image: above s = 2 the images are averaged.)
    """
    alex = load_lpips("alex", lpips)

    def ssim(most: float) -> Similarity:
        return lambda x, y, s: float(ssim_map(averaged(x, s, most), averaged(y, s, most)).mean())

    return {
        "SSIM": ssim(np.inf),
        "SSIM averaged to s <= 2": ssim(2),
        "SSIM averaged to s <= 1": ssim(1),
        "MS-SSIM": lambda x, y, s: ms_ssim(x, y),
        f"FLIP {PIXELS_PER_DEGREE:g}": lambda x, y, s: float(flip_map(x, y).mean()),
        f"FLIP {PIXELS_PER_DEGREE:g} s, s <= 2": lambda x, y, s: float(
            flip_map(averaged(x, s, 2), averaged(y, s, 2), min(s, 2) * PIXELS_PER_DEGREE).mean()
        ),
        LPIPS: lambda x, y, s: alex(x, y),
    }


def is_error(name: str) -> bool:
    """Whether a definition is 0 for the same image."""
    return name.startswith(("FLIP", "LPIPS"))


def averaged(image: np.ndarray, s: float, most: float) -> np.ndarray:
    """An image [H, W, 3] of a screen s, averaged to one of at most `most`, by a whole factor."""
    factor = int(max(1, s // most))
    height, width = image.shape[0] // factor, image.shape[1] // factor
    cut = image[: height * factor, : width * factor]
    return cut.reshape(height, factor, width, factor, 3).mean((1, 3), dtype=np.float32)


@torch.no_grad()
def picture(g: Gaussians, camera: Camera, antialiased: bool) -> np.ndarray:
    """An image in [0, 1], float32 [H, W, 3]."""
    return rasterize(g, camera, antialiased=antialiased).rgb.clamp(0, 1).cpu().numpy().copy()


def compare(
    run: FinishedRun, by_name: Mapping[str, Similarity], views: int, levels: int, seed: int
) -> tuple[np.ndarray, np.ndarray, list[int]]:
    """Values and milliseconds of CPU time [names, S, V, K] at fresh viewpoints, and the levels."""
    every = run.job.ladder.levels
    chosen = sorted({every[i] for i in np.linspace(0, len(every) - 2, levels).round().astype(int)})
    scenes = [run.compose(dict.fromkeys(run.names, level)) for level in (*chosen, every[-1])]
    rule = Rule(seed=seed, screens=(1.0, 1.0), places=(1.0, 0.0, 0.0))
    cameras = draw(run.scene, capture_cameras(run.scene), rule, {"test": views}).cameras
    found = np.empty((2, len(by_name), len(SCREENS), views, len(chosen)))
    for i, s in enumerate(SCREENS):
        for v, camera in enumerate(cameras):
            at = camera.resized(round(s * camera.width), round(s * camera.height))
            *images, full = (picture(g, at, run.antialiased) for g in scenes)
            for m, similarity in enumerate(by_name.values()):
                for k, image in enumerate(images):
                    begin = time.process_time()
                    found[0, m, i, v, k] = similarity(image, full, s)
                    found[1, m, i, v, k] = 1e3 * (time.process_time() - begin)
    return found[0], found[1], chosen


def rank_correlation(x: np.ndarray, y: np.ndarray) -> float:
    """Spearman's; NaN where all values are one."""
    a, b = rankdata(x), rankdata(y)
    return float(np.corrcoef(a, b)[0, 1]) if np.ptp(a) and np.ptp(b) else np.nan


def agreement(values: np.ndarray, lpips: np.ndarray) -> tuple[float, float]:
    """Rank correlation with LPIPS [S, V, K]: over levels in a viewpoint, over viewpoints at a level."""
    S, V, K = values.shape
    levels = [rank_correlation(values[i, v], lpips[i, v]) for i in range(S) for v in range(V)]
    views = [rank_correlation(values[i, :, k], lpips[i, :, k]) for i in range(S) for k in range(K)]
    return mean(np.array(levels)), mean(np.array(views))


def summary(name: str, values: np.ndarray, ms: np.ndarray, lpips: np.ndarray) -> dict[str, Any]:
    """A row of the table: of a definition's values and milliseconds of CPU time [S, V, K].

    `to_2`, `to_4`: mean distance of a viewpoint's value at s = 1/2 and at 2, or 4. `to_4_levels`: the latter
    over the distance of the coarsest and the finest of the levels at s = 1.
    """
    moved = [float(np.abs(values[i] - values[0]).mean()) for i in (TWICE, LAST)]
    by_level = values[PHOTOS].mean(0)
    by_levels, by_views = agreement(values if is_error(name) else 1 - values, lpips)
    return {
        "mean": values.mean((1, 2)).tolist(),
        "to_2": moved[0],
        "to_4": moved[1],
        "to_4_levels": moved[1] / float(np.ptp(by_level)),
        "rank_levels": by_levels,
        "rank_views": by_views,
        "ms": float(np.median(ms[PHOTOS])),
        "ms_at_4": float(np.median(ms[LAST])),
    }


def measure(
    runs: tuple[Path, ...], lpips: Path, views: int, levels: int, seed: int, say: Callable[[str], None]
) -> dict[str, Any]:
    """The table of each run, and `all`: its means over the runs."""
    by_name, results = similarities(lpips), {}
    for folder in runs:
        run = open_run(folder)
        values, ms, chosen = compare(run, by_name, views, levels, seed)
        reference = values[list(by_name).index(LPIPS)]
        table = {name: summary(name, values[m], ms[m], reference) for m, name in enumerate(by_name)}
        results[folder.name] = table
        say(f"{folder.name}: levels {', '.join(map(str, chosen))}, {views} viewpoints")
        for line in lines(table):
            say(line)
    every = {
        name: {key: np.mean([table[name][key] for table in results.values()], axis=0).tolist() for key in row}
        for name, row in table.items()
    }
    say(f"all {len(results)}:")
    for line in lines(every):
        say(line)
    return {"screens": SCREENS, "views": views, "seed": seed, "runs": results, "all": every}


def lines(table: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """A table for people."""
    head = f"  {'':22}" + "".join(f"{f's {s:g}':>7}" for s in SCREENS)
    out = [head + "   to 2   to 4  /levels  ranks: levels  views cpu ms  at s 4"]
    for name, row in table.items():
        means = "".join(f"{value:7.3f}" for value in row["mean"])
        out.append(
            f"  {name:22}{means}{row['to_2']:7.3f}{row['to_4']:7.3f}{row['to_4_levels']:9.2f}"
            f"{row['rank_levels']:15.3f}{row['rank_views']:7.3f}{row['ms']:7.1f}{row['ms_at_4']:11.1f}"
        )
    return out


def main(
    runs: tyro.conf.Positional[tuple[Path, ...]],
    lpips: Path = ROOT.parent / "shared" / "models",
    views: int = 8,
    levels: int = 5,
    seed: int = 90_000,
    write: bool = False,
) -> None:
    """Compare SSIM, SSIM of averaged images, MS-SSIM, FLIP and LPIPS on finished runs, on four screens.

    Args:
        runs: run folders, finished with nested levels.
        lpips: folder of lpips_alex.npz.
        views: viewpoints a run, of the rule's path.
        levels: levels a run, evenly spread below the full model.
        seed: of the viewpoints.
        write: keep the figures in benchmarks/results/cpu/similarity.json.
    """
    finish("similarity", measure(runs, lpips, views, levels, seed, print), write)


if __name__ == "__main__":
    tyro.cli(main, prog="python -m benchmarks.similarity")
