"""Plans of recorded levels, by Eq. 1 of the paper: of each category the smallest that reaches the target."""

import math
from collections.abc import Collection, Mapping, Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

from sagesplat.adapt.allocate import choose
from sagesplat.adapt.plan import Choice, Counts, Models, Plan, check_share, check_target


def plan_view(
    models: Models,
    counts: Counts,
    distances: Mapping[int, float],
    target: float,
    view: int | None,
    *,
    recovering: Collection[int] = (),
) -> Plan:
    """Choose the cheapest level of each category that is predicted to reach a target in one view (Eq. 1).

        level = argmin count(level) subject to SSIM(level, distance) >= target, for each category by itself

    Where no level reaches the target, the one with the best prediction is taken, with status "infeasible".

    Args:
        models: Eq. 3 by (label id, level).
        counts: Gaussians by (label id, level).
        distances: d_min by label id, world units. A category that is missing, or NaN, is predicted by its
            median.
        target: SSIM, above 0 and at most 1.
        view: Row in `Scene.views`, for the record; None: no view of the scene.
        recovering: Levels recorded just after an opacity reset: taken only where there is no other.

    Returns:
        One choice per category of `counts`.

    Raises:
        RunError: For an impossible target.

    Example:
        >>> from sagesplat.adapt.eq3 import Eq3, SsimModel
        >>> from sagesplat.adapt.eq1 import plan_view
        >>> def model(level, k):  # SSIM k at distance 0, falling by exp(-0.1 d)
        ...     curve = Eq3(k, 0.1, 0.0, 1.0, k, 0.1, 0.0, 1.0, 0.0)
        ...     return SsimModel(3, level, curve, (0.0, 10.0), k, 0.0, 9, "one regime")
        >>> models, counts = {(3, 1): model(1, 0.7), (3, 2): model(2, 0.95)}, {(3, 1): 100, (3, 2): 900}
        >>> plan_view(models, counts, {3: 1.0}, 0.6, None).levels
        {3: 1}
        >>> plan_view(models, counts, {3: 1.0}, 0.8, None).levels
        {3: 2}
    """
    check_target(target)
    choices = []
    for label_id, levels in _eligible(models, counts, recovering).items():
        distance = float(distances.get(label_id, math.nan))
        choices.append(_choose(models, label_id, levels, np.array([distance]), target, 1.0, distance))
    return Plan(float(target), view, tuple(choices))


def plan_scene(
    models: Models,
    counts: Counts,
    distances: Mapping[int, np.ndarray],
    target: float,
    share: float = 0.95,
    *,
    recovering: Collection[int] = (),
) -> Plan:
    """Choose the cheapest level of each category that reaches a target in a share of the views (Eq. 1).

    Where no level does, the one that reaches it in most views is taken, then the best on average, with status
    "infeasible". Other arguments and errors are those of `plan_view`.

    Args:
        models: Eq. 3 by (label id, level).
        counts: Gaussians by (label id, level).
        distances: By label id, d_min in each view that shows the category, [V] in world units.
        target: SSIM, above 0 and at most 1.
        share: Of the views, above 0 and at most 1.
        recovering: See `plan_view`.

    Returns:
        One choice per category of `counts`.
    """
    check_target(target)
    check_share(share)
    choices = []
    for label_id, levels in _eligible(models, counts, recovering).items():
        known = np.asarray(distances.get(label_id, ()), np.float64)
        views = known if len(known) else np.array([math.nan])
        choices.append(_choose(models, label_id, levels, views, target, share, math.nan))
    return Plan(float(target), None, tuple(choices), float(share))


def _eligible(models: Models, counts: Counts, recovering: Collection[int]) -> dict[int, dict[int, int]]:
    """Per label id, ascending, the counts of the levels to choose from."""
    eligible: dict[int, dict[int, int]] = {}
    for label_id in sorted({label_id for label_id, _ in counts}):
        levels = {level: count for (label, level), count in counts.items() if label == label_id}
        modelled = {level: count for level, count in levels.items() if (label_id, level) in models} or levels
        not_recovering = {level: count for level, count in modelled.items() if level not in recovering}
        eligible[label_id] = not_recovering or modelled
    return eligible


def _choose(
    models: Models,
    label_id: int,
    levels: dict[int, int],
    distances: np.ndarray,  # [V], NaN = unknown
    target: float,
    share: float,
    distance: float,  # for the record
) -> Choice:
    """The level of one category; `levels` maps each candidate to its count."""
    last = max(levels)
    if (label_id, last) not in models:  # never seen: nothing is predicted, nothing is left out
        return Choice(label_id, last, math.nan, distance, levels[last], "no model")
    steps = sorted(levels)
    counts = np.array([levels[step] for step in steps])
    ssim = np.stack([models[label_id, step](distances) for step in steps])
    needed = max(1, math.ceil(share * len(distances) - 1e-9))
    predicted = np.sort(ssim, 1)[:, -needed]  # what the best `needed` views reach
    most_views = (ssim >= target).sum(1), ssim.mean(1)
    found, met = choose_latest(predicted, counts, target, most_views)
    at = int(found)
    status = "ok" if met else "infeasible"
    return Choice(label_id, steps[at], float(predicted[at]), distance, int(counts[at]), status)


def choose_latest(
    ssim: Float[np.ndarray, "... K"],
    counts: Int[np.ndarray, " K"],
    target: float,
    otherwise: Sequence[Float[np.ndarray, "... K"] | Int[np.ndarray, "... K"]] = (),
) -> tuple[Int[np.ndarray, "..."], Bool[np.ndarray, "..."]]:
    """`allocate.choose` for K recorded levels in order of their steps: of equal ones the latest."""
    found, met = choose(ssim[..., ::-1], counts[::-1], target, [key[..., ::-1] for key in otherwise])
    return np.asarray(len(counts) - 1 - found), met  # [] too: numpy makes a number of that
