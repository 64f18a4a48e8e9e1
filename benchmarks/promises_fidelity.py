"""Coverage of fidelity bounds at fresh viewpoints, and plans beside equal levels of the same bytes."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from sagesplat.adapt.bound_plans import Costs, Quality, plan_for_view, quality_at
from sagesplat.adapt.fidelity import distances_at, measure_compositions, shown_enough
from sagesplat.adapt.fidelity_models import plan_nominal
from sagesplat.adapt.viewpoint import where
from sagesplat.adapt.viewpoints import capture_cameras, draw
from sagesplat.run.job import Job
from sagesplat.stages.methods import NestedLevels
from sagesplat.stages.results import fidelity_of, plans_of, viewpoints_of

TARGETS = (0.8, 0.9, 0.95, 0.98)
MORE_TARGETS = (0.5, 0.6, 0.7, 0.75, 0.85, 0.97, 0.99)  # of the curve of plans over bytes
# places (path, walk, back) and screens of the viewpoints
CONDITIONS: dict[str, tuple[tuple[float, float, float], float]] = {
    "path": ((1, 0, 0), 1.0), "path, half the pixels": ((1, 0, 0), 0.5),
    "path, twice the pixels": ((1, 0, 0), 2.0), "walk": ((0, 1, 0), 1.0), "back": ((0, 0, 1), 1.0),
}  # fmt: skip
_DRAWS = 1000  # bootstrap


def measure(
    job: Job, views: int = 300, seed: int = 90_000, progress: Callable[[int, int], None] | None = None
) -> dict[str, Any]:
    """Plan each target at fresh viewpoints, compose, measure; also scene plans, and equal levels.

    The viewpoints are drawn by the run's own rule with a seed that nothing was made with. Promises are scored
    on the cheapest levels that they allow; `curve` is of plans as they are made (`plan_for_view`).
    """
    models, rule = fidelity_of(job), viewpoints_of(job).rule
    fresh = replace(rule, seed=rule.seed + seed)
    cameras = draw(job.scene, capture_cameras(job.scene), fresh, {"test": views}).cameras
    costs = NestedLevels(job).costs
    labels, K, names = list(costs.labels), len(job.ladder.levels), job.names()
    distance = distances_at(job.scene, job.point_labels, cameras, labels, job.fit_config.distance)
    targets = np.array(sorted((*TARGETS, *MORE_TARGETS)))
    J = len(targets)
    planned = plan_nominal(models, labels, K, distance, cameras, targets)
    equal = np.broadcast_to(np.arange(1, K + 1)[None, :, None], (views, K, len(labels)))
    whole_scene = [plan for plan in plans_of(job) if plan.quality == "fidelity"]
    scenes = np.array([[plan.levels[label] for label in labels] for plan in whole_scene])
    scenes = np.broadcast_to(scenes.reshape(1, -1, len(labels)), (views, len(whole_scene), len(labels)))

    def measured(levels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return measure_compositions(
            job.ladder, cameras, levels, backend=job.backend, antialiased=job.antialiased, progress=progress
        )

    found, pixels = measured(np.concatenate([planned, equal, scenes], 1))
    shown = shown_enough(pixels, cameras)
    far = dict(zip(labels, distance.T.astype(np.float64), strict=True))
    quality = quality_at(costs, models, far, cameras, "fidelity")
    filled = np.array(
        [[made(quality, costs, t, v, pixels[v], labels) for t in targets] for v in range(views)]
    )
    by_plan, _ = measured(filled)
    promised = _promised(models, labels, distance, cameras)
    counted = [names[label] for label in labels]
    return {
        "views": views,
        "categories": {names[label]: models[label].status for label in labels if label in models},
        "targets": {
            f"{target:g}": _coverage(
                target, planned[:, j] - 1, found[:, j, :-1], found[:, J : J + K, :-1],
                shown & promised, counted,
            )
            for j, target in enumerate(targets)
        },
        "scene_plans": {
            f"{plan.target:g}": _coverage(
                plan.target, scenes[:, j] - 1, found[:, J + K + j, :-1], found[:, J : J + K, :-1],
                shown & [label in models for label in labels], counted,
            )
            for j, plan in enumerate(whole_scene)
        },
        "curve": _curve(
            np.concatenate([by_plan, found[:, J : J + K]], 1), shown,
            costs.transfer_bytes[np.arange(len(labels)), filled - 1].sum(2), targets,
            costs.transfer_bytes.sum(0),
        ),
        "scene_curve": _curve(
            np.concatenate([found[:, J + K :], found[:, J : J + K]], 1), shown,
            costs.transfer_bytes[np.arange(len(labels)), scenes - 1].sum(2),
            np.array([plan.target for plan in whole_scene]), costs.transfer_bytes.sum(0),
        ),
    }  # fmt: skip


def by_condition(job: Job, views: int = 200, seed: int = 91_000) -> dict[str, Any]:
    """The targets by condition: kept, excess, share that has a promise, MB of plans and of a perfect planner.

    The perfect planner takes the cheapest level that measures the target, all categories at one level.
    """
    models, rule = fidelity_of(job), viewpoints_of(job).rule
    costs, names = NestedLevels(job).costs, job.names()
    labels, K = list(costs.labels), len(job.ladder.levels)
    targets, found = np.array(TARGETS), {}
    for name, (places, screen) in CONDITIONS.items():
        drawn = replace(rule, seed=rule.seed + seed, places=places, screens=(screen, screen))
        cameras = draw(job.scene, capture_cameras(job.scene), drawn, {"test": views}).cameras
        distance = distances_at(job.scene, job.point_labels, cameras, labels, job.fit_config.distance)
        far = dict(zip(labels, distance.T.astype(np.float64), strict=True))
        planned = plan_nominal(models, labels, K, distance, cameras, targets)
        equal = np.broadcast_to(np.arange(1, K + 1)[None, :, None], (views, K, len(labels)))
        got, pixels = measure_compositions(
            job.ladder, cameras, np.concatenate([planned, equal], 1), backend=job.backend,
            antialiased=job.antialiased,
        )  # fmt: skip
        quality = quality_at(costs, models, far, cameras, "fidelity")
        shown = shown_enough(pixels, cameras) & [label in models for label in labels]
        promised = _promised(models, labels, distance, cameras)
        rows = {}
        for j, target in enumerate(TARGETS):
            row = _coverage(
                target, planned[:, j] - 1, got[:, j, :-1], got[:, len(targets) :, :-1], shown & promised,
                [names[label] for label in labels],
            )  # fmt: skip
            levels = np.array([made(quality, costs, target, v, pixels[v], labels) for v in range(views)])
            best = np.where(shown, (got[:, len(targets) :, :-1] >= target).argmax(1), 0)
            sent, least = (
                float(costs.transfer_bytes[np.arange(len(labels)), taken].sum(1).mean()) / 1e6
                for taken in (levels - 1, best)
            )
            row |= {"promised": float(promised[shown].mean()), "mb": sent, "perfect_mb": least}
            rows[f"{target:g}"] = row
        found[name] = rows
    return found


def made(
    quality: Quality, costs: Costs, target: float, view: int, pixels: np.ndarray, labels: Sequence[int]
) -> list[int]:
    """The levels of the plan of a viewpoint."""
    plan = plan_for_view(quality, costs, target, view, pixels.astype(np.float64))
    return [plan.levels[label] for label in labels]


def _promised(models, labels, distance, cameras):  # type: ignore[no-untyped-def]
    """Whether a bound is given, bool [V, L]: inside the support, of a category with a model."""
    given = np.zeros((len(cameras), len(labels)), bool)
    for column, label in enumerate(labels):
        if label in models:
            predicted = models[label].predict(
                distance[:, column].astype(np.float64), *where(cameras, models[label].focal)
            )
            given[:, column] = np.isfinite(predicted.bound).any(1)
    return given


def _coverage(
    target: float, taken: np.ndarray, got: np.ndarray, uniform: np.ndarray, counts: np.ndarray,
    names: Sequence[str],
) -> dict[str, Any]:  # fmt: skip
    """Coverage of one target, and the excess beside that of a perfect planner.

    `taken` [V, L]: levels; `got` [V, L]; `uniform` [V, K, L]: with all categories at one level; `counts`
    [V, L]: decisions that are scored. `beyond`: how far the level below the one taken is above the target.
    """
    kept = (got >= target) & counts
    best = (uniform >= target).argmax(1)
    perfect = np.take_along_axis(uniform, best[:, None], 1)[:, 0]
    below = np.take_along_axis(uniform, np.maximum(taken - 1, 0)[:, None], 1)[:, 0]
    beyond = np.where(taken > 0, np.maximum(below - target, 0), 0)
    by_view = kept.sum(1), counts.sum(1)
    rng = np.random.default_rng(0)
    draws = rng.integers(len(got), size=(_DRAWS, len(got)))
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
        "excess": float((got - target)[counts].mean()),
        "perfect": float((perfect - target)[counts].mean()),
        "beyond_step": float(beyond[counts].mean()),
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
                f"excess {row['excess']:.4f} (perfect {row['perfect']:.4f}, beyond the step "
                f"{row['beyond_step']:.4f}); worst {worst[0]} {worst[1][0]} of {worst[1][1]}"
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
