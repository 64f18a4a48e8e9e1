"""Coverage of fidelity bounds at fresh viewpoints, and plans beside equal levels of the same bytes."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from sagesplat.adapt.bound_plans import Costs
from sagesplat.adapt.calibrate_fidelity import plan_nominal
from sagesplat.adapt.cell_models import Expected, needed
from sagesplat.adapt.cell_plans import reach
from sagesplat.adapt.fidelity import SampledFidelity, shown_enough
from sagesplat.adapt.viewpoints import capture_cameras, draw
from sagesplat.run.job import Job
from sagesplat.scene.scene import Camera
from sagesplat.stages.fidelity import compositions_at
from sagesplat.stages.methods import NestedLevels
from sagesplat.stages.results import plans_of, viewpoints_of
from sagesplat.stages.sample import measured_levels

TARGETS = (0.8, 0.9, 0.95, 0.98)
MORE_TARGETS = (0.5, 0.6, 0.7, 0.75, 0.85, 0.97, 0.99)  # of the curve of plans over bytes


class Condition(NamedTuple):
    """What viewpoints have in common."""

    places: tuple[float, float, float]  # path, walk, back
    screen: float
    # width over height, and degrees of the shorter side; None: the photos'
    lens: tuple[float, float] | None = None


CONDITIONS = {
    "path": Condition((1, 0, 0), 1.0), "path, half the pixels": Condition((1, 0, 0), 0.5),
    "path, twice the pixels": Condition((1, 0, 0), 2.0), "walk": Condition((0, 1, 0), 1.0),
    "back": Condition((0, 0, 1), 1.0),
    "path, window of 60 degrees": Condition((1, 0, 0), 2.0, (16 / 9, 60.0)),
    "path, headset of 90 degrees": Condition((1, 0, 0), 1.0, (1.0, 90.0)),
    "path, half the pixels, headset": Condition((1, 0, 0), 0.5, (1.0, 90.0)),
    "walk, headset of 90 degrees": Condition((0, 1, 0), 1.0, (1.0, 90.0)),
}  # fmt: skip
_DRAWS = 1000  # bootstrap


def measure(
    job: Job, views: int = 300, seed: int = 90_000, progress: Callable[[int, int], None] | None = None
) -> dict[str, Any]:
    """Plan each target at fresh viewpoints, compose, measure; also scene plans, and equal levels.

    The viewpoints are drawn by the run's own rule with a seed that nothing was made with. Promises are scored
    on the cheapest levels that they allow; `curve` is of plans as they are made (`plan_for_cells`).
    """
    rule, targets = viewpoints_of(job).rule, np.array(sorted((*TARGETS, *MORE_TARGETS)))
    fresh = replace(rule, seed=rule.seed + seed)
    cameras = draw(job.scene, capture_cameras(job.scene), fresh, {"test": views}).cameras
    method, names, J, K = NestedLevels(job), job.names(), len(targets), len(job.ladder.levels)
    labels, costs = list(method.costs.labels), method.cell_costs
    expected = method.expect(cameras)
    planned = plan_nominal(method.fidelity, expected, costs.transfer_bytes, targets)
    whole_scene = [plan for plan in plans_of(job) if plan.quality == "fidelity"]
    by_cell = [plan.levels_of_cells(job.cells.label_of) for plan in whole_scene]
    scenes = np.array([[levels[cell] for cell in job.cells.ids.tolist()] for levels in by_cell])
    scenes = np.broadcast_to(scenes[None], (views, *scenes.shape))
    filled = method.planned_cells(expected, targets.tolist())
    asked = np.concatenate([planned, _equal(job, views), scenes, filled], 1)
    found, pixels = compositions_at(job, cameras, asked, "promises")
    if progress:
        progress(views, views)
    shown, promised = shown_enough(pixels, cameras), np.isfinite(needed(method.fidelity, expected, 0.9))
    equal, counted = found[:, J : J + K, :-1], [names[label] for label in labels]
    models = [label in method.fidelity for label in labels]
    after = J + K + len(whole_scene)
    sent = [_bytes(costs, levels) for levels in (filled, scenes)]
    level_bytes = method.costs.transfer_bytes.sum(0)
    return {
        "views": views,
        "categories": {names[label]: model.status for label, model in method.fidelity.items()},
        "targets": {
            f"{target:g}": _coverage(target, found[:, j, :-1], equal, shown & promised, counted)
            for j, target in enumerate(targets)
        },
        "scene_plans": {
            f"{plan.target:g}": _coverage(
                plan.target, found[:, J + K + j, :-1], equal, shown & models, counted
            )
            for j, plan in enumerate(whole_scene)
        },
        "curve": _curve(
            np.concatenate([found[:, after:], found[:, J : J + K]], 1), shown, sent[0], targets, level_bytes
        ),
        "scene_curve": _curve(
            np.concatenate([found[:, J + K : after], found[:, J : J + K]], 1), shown, sent[1],
            np.array([plan.target for plan in whole_scene]), level_bytes,
        ),
    }  # fmt: skip


def by_condition(
    job: Job, views: int = 200, seed: int = 91_000, conditions: Mapping[str, Condition] = CONDITIONS
) -> dict[str, Any]:
    """The targets by condition: kept, excess, share that has a promise, MB of plans and of a perfect planner.

    The perfect planner knows the fidelity of every cell at every level, all at one, and takes the levels of
    the fewest bytes by which each category reaches the target.
    """
    method, names = NestedLevels(job), job.names()
    labels, costs, targets, found = list(method.costs.labels), method.cell_costs, np.array(TARGETS), {}
    for name, condition in conditions.items():
        cameras = cameras_of(job, condition, views, seed)
        expected = method.expect(cameras)
        planned = plan_nominal(method.fidelity, expected, costs.transfer_bytes, targets)
        got, pixels = compositions_at(
            job, cameras, np.concatenate([planned, _equal(job, views)], 1), "promises"
        )
        filled = method.planned_cells(expected, targets.tolist())
        best = _perfect(measured_levels(job, cameras), expected, costs, targets)
        shown = shown_enough(pixels, cameras) & [label in method.fidelity for label in labels]
        promised = np.isfinite(needed(method.fidelity, expected, 0.9))
        rows = {}
        for j, target in enumerate(TARGETS):
            row = _coverage(
                target, got[:, j, :-1], got[:, len(targets) :, :-1], shown & promised,
                [names[label] for label in labels],
            )  # fmt: skip
            sent, least = (float(_bytes(costs, taken)[:, j].mean()) / 1e6 for taken in (filled, best))
            rows[f"{target:g}"] = row | {
                "promised": float(promised[shown].mean()), "mb": sent, "perfect_mb": least,
            }  # fmt: skip
        found[name] = rows
    return found


def cameras_of(job: Job, condition: Condition, views: int, seed: int = 91_000) -> list[Camera]:
    """Fresh viewpoints of a condition, by the run's rule but for it."""
    rule, (places, screen, lens) = viewpoints_of(job).rule, condition
    drawn = replace(rule, seed=rule.seed + seed, places=places, screens=(screen, screen), fov=1.0)
    cameras = draw(job.scene, capture_cameras(job.scene), drawn, {"test": views}).cameras
    return [through(camera, *lens) for camera in cameras] if lens else list(cameras)


def through(camera: Camera, ratio: float, fov: float) -> Camera:
    """The camera with a picture of a ratio of width to height, and degrees of its shorter side."""
    shorter = 2 * math.tan(math.radians(fov) / 2) * camera.focal
    width, height = round(shorter * max(ratio, 1)), round(shorter * max(1 / ratio, 1))
    K = np.array([[camera.focal, 0, width / 2], [0, camera.focal, height / 2], [0, 0, 1]], np.float32)
    return replace(camera, K=K, width=width, height=height)


def _equal(job: Job, views: int) -> np.ndarray:
    """Compositions with all cells at one level, [V, K, C]."""
    K, C = len(job.ladder.levels), len(job.cells.ids)
    return np.broadcast_to(np.arange(1, K + 1)[None, :, None], (views, K, C))


def _bytes(costs: Costs, levels: np.ndarray) -> np.ndarray:
    """Bytes to send of compositions [V, J, C], as [V, J]."""
    return costs.transfer_bytes[np.arange(levels.shape[2]), levels - 1].sum(2)


def _perfect(known: SampledFidelity, expected: Expected, costs: Costs, targets: np.ndarray) -> np.ndarray:
    """Levels [V, J, C] of a planner that knows the cells' pixels and what they measure."""
    V, C = known.pixels.shape
    found = np.ones((V, len(targets), C), int)
    for row in range(V):
        share = known.pixels[row] / known.image[row]
        mean = np.maximum.accumulate(np.nan_to_num(known.fidelity[row].astype(np.float64)), 1)
        for j, target in enumerate(targets):
            asked = np.full(len(expected.labels), target)
            found[row, j] += reach(costs.transfer_bytes, mean, share, expected.column, asked).levels
    return found


def _coverage(
    target: float, got: np.ndarray, uniform: np.ndarray, counts: np.ndarray, names: Sequence[str]
) -> dict[str, Any]:  # fmt: skip
    """Coverage of one target, and the excess beside that of equal levels, each category at its best one.

    `got` [V, L]; `uniform` [V, K, L]: with all categories at one level; `counts` [V, L]: decisions that are
    scored.
    """
    kept = (got >= target) & counts
    best = (uniform >= target).argmax(1)
    perfect = np.take_along_axis(uniform, best[:, None], 1)[:, 0]
    return shares_kept(kept, counts, names) | {
        "excess": float((got - target)[counts].mean()),
        "perfect": float((perfect - target)[counts].mean()),
    }


def shares_kept(kept: np.ndarray, counts: np.ndarray, names: Sequence[str]) -> dict[str, Any]:
    """Share of decisions [V, L] that are kept, with its interval by a bootstrap of viewpoints."""
    by_view = kept.sum(1), counts.sum(1)
    rng = np.random.default_rng(0)
    draws = rng.integers(len(kept), size=(_DRAWS, len(kept)))
    spread = by_view[0][draws].sum(1) / np.maximum(by_view[1][draws].sum(1), 1)
    by_category = {
        name: [int(kept[:, i].sum()), int(counts[:, i].sum())]
        for i, name in enumerate(names)
        if counts[:, i].any()
    }
    return {
        "decisions": int(counts.sum()),
        "kept": float(kept.sum() / counts.sum()),
        "interval": np.quantile(spread, [0.025, 0.975]).tolist(),
        "by_category": by_category,
    }


def _curve(
    found: np.ndarray, shown: np.ndarray, bytes_of: np.ndarray, targets: np.ndarray, level_bytes: np.ndarray
) -> dict[str, Any]:
    """Mean bytes, whole image and lowest category of plans, and of equal levels at the same bytes."""
    J = len(targets)
    whole = found[..., -1].mean(0)
    by_category = np.where(shown[:, None], found[..., :-1], np.nan)
    lowest = np.nanmin(np.nanmean(by_category, 0), 1)
    size = bytes_of.mean(0)
    return {
        "targets": targets.tolist(),
        "bytes": size.tolist(),
        "whole": whole[:J].tolist(),
        "equal_levels_whole": np.interp(size, level_bytes, whole[J:]).tolist(),
        "lowest": lowest[:J].tolist(),
        "equal_levels_lowest": np.interp(size, level_bytes, lowest[J:]).tolist(),
    }


def condition_lines(conditions: dict[str, Any], categories: dict[str, str]) -> list[str]:
    """The results by condition for people."""
    out = []
    for name, rows in conditions.items():
        for target, row in rows.items():
            low, high = row["interval"]
            worst = _worst(row, categories)
            out.append(
                f"  {name:22} {target:>5}: promised {row['promised']:.3f} of {row['decisions']}, kept "
                f"{row['kept']:.3f} [{low:.3f}, {high:.3f}], excess {row['excess']:.4f} (perfect "
                f"{row['perfect']:.4f}), {row['mb']:.3f} MB (perfect {row['perfect_mb']:.3f}); worst "
                f"{worst[0]} {worst[1][0]} of {worst[1][1]}"
            )
    return out


def lines(name: str, result: dict[str, Any]) -> list[str]:
    """The result for people."""
    out = [f"{name}: fidelity at {result['views']} fresh viewpoints"]
    few = [name for name, status in result["categories"].items() if status != "calibrated"]
    if few:
        out.append(f"  uncalibrated: {', '.join(few)}")
    for target, row in result["targets"].items():
        if float(target) in TARGETS:
            low, high = row["interval"]
            worst = _worst(row, result["categories"])
            out.append(
                f"  {target:>5}: kept {row['kept']:.3f} [{low:.3f}, {high:.3f}] of {row['decisions']}, "
                f"excess {row['excess']:.4f} (perfect {row['perfect']:.4f}); "
                f"worst {worst[0]} {worst[1][0]} of {worst[1][1]}"
            )
    for target, row in result["scene_plans"].items():
        worst = _worst(row, result["categories"])
        out.append(
            f"  scene plan {target}: kept {row['kept']:.3f}; worst {worst[0]} {worst[1][0]} of {worst[1][1]}"
        )
    for what, curve in (("viewpoints", result["curve"]), ("scene", result["scene_curve"])):
        for i, target in enumerate(curve["targets"]):
            whole, equal, low, equal_low = (
                curve[name][i] for name in ("whole", "equal_levels_whole", "lowest", "equal_levels_lowest")
            )
            out.append(
                f"  {what}, {target}: {curve['bytes'][i] / 1e6:.3f} MB, whole image {whole:.3f} "
                f"(equal levels {equal:.3f}), lowest category {low:.3f} ({equal_low:.3f})"
            )
    return out


def _worst(row: dict[str, Any], status: dict[str, str]) -> tuple[str, list[int]]:
    """The calibrated category with the lowest share kept: its name, decisions kept and made."""
    of = {name: n for name, n in row["by_category"].items() if status.get(name) == "calibrated"}
    return min((of or row["by_category"]).items(), key=lambda item: item[1][0] / item[1][1])
