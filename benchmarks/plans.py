"""How long it takes to plan: one position and a path, towards a target and within a budget."""

import time
from collections.abc import Callable

import numpy as np

from sagesplat.adapt.allocate import along, best_within, cheapest
from sagesplat.adapt.fill import fill

SIZES = ((5, 5), (12, 16), (30, 16), (128, 16))  # labels, levels
TARGET = 0.8
_SHARES = np.linspace(0.05, 0.8, 40)  # of the way from the smallest composition to the largest


def walk(positions: int, labels: int, levels: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Quality [P, L, K] with returns that shrink and distances that change, bytes [L, K], weights [L]."""
    rng = np.random.default_rng(labels)
    share = np.linspace(0.1, 1, levels) ** rng.uniform(1, 2, (labels, 1))
    cost = np.ceil(np.exp(rng.normal(10, 1.2, (labels, 1))) * share) * 232
    phase = rng.uniform(0, 2 * np.pi, labels) + np.linspace(0, 6, positions)[:, None]
    rise = (5 + 3 * np.sin(phase))[..., None]
    quality = rng.uniform(0.75, 0.98, (labels, 1)) * (1 - np.exp(-rise * (share + 0.05)))
    return quality, cost, rng.exponential(1e4, labels)


def measure(positions: int, labels: int, levels: int) -> dict[str, float]:
    """Milliseconds a plan, share proven, largest gap [SSIM], seconds a path, share of levels that change."""
    quality, cost, weight = walk(positions, labels, levels)
    budgets = cost.min(1).sum() + _SHARES * (cost.max(1).sum() - cost.min(1).sum())
    plans = [best_within(quality[0], cost, weight, budget) for budget in budgets]  # compiles, too
    times = [_ms(lambda b=b: best_within(quality[0], cost, weight, b)) for b in budgets]
    begin = time.perf_counter()
    by_target = along(quality, cost, target=TARGET)
    middle = time.perf_counter()
    by_budget = along(quality, cost, budget=float(budgets[len(budgets) // 2]), weight=weight)
    end = time.perf_counter()
    rising = np.maximum.accumulate(quality[0], 1)
    cheap = cheapest(rising, cost, TARGET).levels
    fill(cheap, rising, cost, weight)
    return {
        "labels": labels,
        "levels": levels,
        "target_ms": _ms(lambda: cheapest(quality[0], cost, TARGET)),
        "fill_ms": _ms(lambda: fill(cheap, rising, cost, weight)),
        "budget_ms": float(np.median(times)),
        "budget_ms_most": max(times),
        "proven": float(np.mean([plan.optimal for plan in plans])),
        "gap": max((plan.bound - plan.value) / weight.sum() for plan in plans),
        "path_target_s": middle - begin,
        "path_budget_s": end - middle,
        "changes_target": float(np.mean(np.diff(by_target, axis=0) != 0)),
        "changes_budget": float(np.mean(np.diff(by_budget, axis=0) != 0)),
    }


def _ms(call: Callable[[], object], repeats: int = 7) -> float:
    """The median time of a call."""
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        call()
        times.append(time.perf_counter() - begin)
    return 1e3 * float(np.median(times))
