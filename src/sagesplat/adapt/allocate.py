"""Which level each label gets: the cheapest that keeps a target.

Rules that a second implementation must share, so that both give the same levels (tests/data/plans.json):
- Of equal levels the cheaper comes first, then the one of higher quality, then the lower index.
- Costs are whole numbers.
- A level whose cost is infinite cannot be had. A level without a promise (NaN) is passed over where its label
  has others with one. A label without any takes its highest level.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from sagesplat.core.errors import RunError

SLACK = 0.01  # least gain of SSIM for a change of level


@dataclass(frozen=True, eq=False)
class Allocation:
    """A level per label."""

    levels: Int[np.ndarray, "L"]
    status: str  # "ok"; "infeasible": a label misses the target
    missed: Bool[np.ndarray, "L"]  # labels with promises of which none reaches the target


def cheapest(
    quality: Float[np.ndarray, "L K"],
    cost: Float[np.ndarray, "L K"] | Int[np.ndarray, "L K"],
    target: float | Float[np.ndarray, "L"],
    *,
    previous: Int[np.ndarray, "L"] | None = None,
    slack: float = SLACK,
) -> Allocation:
    """Choose per label the cheapest level whose promised SSIM reaches a target.

    With `previous` levels there is hysteresis. A label goes up at once where its level no longer reaches the
    target. It comes down only to a level that reaches it by `slack` more, or by half of what is left to 1 if
    that is less. Where nothing reaches the target it stays if that is within `slack` of the best. So promises
    that vary by less than the slack never alternate between two levels, if they rise along the levels.

    Args:
        quality: [L, K], promised SSIM of each label and level; NaN: no promise.
        cost: [L, K], whole numbers; inf: a level that cannot be had.
        target: SSIM, for all labels or [L].
        previous: [L], the levels before, -1: none.
        slack: SSIM.

    Returns:
        A level per label (column of `quality`); where none reaches the target the best one, "infeasible".

    Raises:
        RunError: For impossible arguments.

    Example:
        >>> import numpy as np
        >>> from sagesplat.adapt.allocate import cheapest
        >>> quality, cost = np.array([[0.6, 0.8, 0.9], [0.3, 0.4, 0.5]]), np.array([[1, 4, 9], [2, 3, 4]])
        >>> found = cheapest(quality, cost, target=0.7)
        >>> found.levels.tolist(), found.status, found.missed.tolist()
        ([1, 2], 'infeasible', [False, True])
    """
    quality, cost, previous = _arguments(quality, cost, previous, slack)
    q, c, promised = _known(quality, cost)
    target = _targets(target, len(q))
    wanted, met, lower = _reaching(q, c, promised, target, slack)
    levels = _hold(previous, wanted, lower, q, c, promised, met, target, slack)
    missed = promised & ~met
    return Allocation(levels, "infeasible" if missed.any() else "ok", missed)


def along(
    quality: Float[np.ndarray, "P L K"],
    cost: Float[np.ndarray, "L K"] | Int[np.ndarray, "L K"],
    target: float | Float[np.ndarray, "L"],
    *,
    slack: float = SLACK,
) -> Int[np.ndarray, "P L"]:
    """Levels at each position of a path: `cheapest` after the levels of the position before.

    RunError for impossible arguments.
    """
    quality, cost, levels = _arguments(quality, cost, None, slack, path=True)
    q, c, promised = _known(quality, cost)
    plan = np.empty(q.shape[:2], np.int64)
    target = _targets(target, q.shape[1])
    wanted, met, lower = _reaching(q, c, promised, target, slack)
    for p in range(len(q)):
        at = (wanted[p], lower[p], q[p], c[p], promised[p], met[p])
        levels = plan[p] = _hold(levels, *at, target, slack)
    return plan


def choose(
    quality: Float[np.ndarray, "... K"],
    cost: Float[np.ndarray, "... K"] | Int[np.ndarray, "... K"],
    target: float | Float[np.ndarray, "... 1"],
    otherwise: Sequence[Float[np.ndarray, "... K"] | Int[np.ndarray, "... K"]] = (),
) -> tuple[Int[np.ndarray, "..."], Bool[np.ndarray, "..."]]:
    """The cheapest level whose SSIM reaches `target`, else the best one; and whether one reaches it.

    Every plan for a target chooses by this rule, whatever predicts the SSIM and whatever a level costs. Of
    equal levels the module's rules take the one of lower index. `otherwise`: what makes a level the best
    where none reaches the target, the first key first (default: its SSIM). A level of unknown SSIM (NaN) or
    of infinite cost is never chosen while there is another.
    """
    usable = np.isfinite(cost) & ~np.isnan(quality)
    good = usable & (quality >= target)
    met = np.asarray(good.any(-1))
    best = [-key for key in otherwise or (quality,)]
    return np.where(met, _first(good, cost, -quality), _first(usable, *best, cost)), met


def _known(quality, cost):
    """Quality without NaN, cost with inf for what is passed over, both [..., L, K]; which labels promise."""
    finite = np.isfinite(cost)
    known = finite & ~np.isnan(quality)
    promised = known.any(-1)
    usable = np.where(promised[..., None], known, finite)
    return np.where(known, quality, 0.0), np.where(usable, cost, np.inf), promised


def _first(allowed, *keys):
    """Along the last axis the allowed index with the smallest keys, the first key first; 0 if none is."""
    for key in keys:
        key = np.where(allowed, key, np.inf)
        allowed = allowed & (key == key.min(-1, keepdims=True))
    return allowed.argmax(-1)


def _reaching(q, c, promised, target, slack):
    """Level of each label without hysteresis, whether one reaches the target, level to come down to or -1."""
    usable = np.isfinite(c)
    wanted, met = choose(q, c, target[:, None])
    highest = q.shape[-1] - 1 - usable[..., ::-1].argmax(-1)
    safe = usable & (q >= (target + np.minimum(slack, (1 - target) / 2))[:, None])
    lower = np.where(safe.any(-1), _first(safe, c, -q), -1)
    return np.where(promised, wanted, highest), met, lower


def _hold(previous, wanted, lower, q, c, promised, met, target, slack):
    """Levels [L] at one position after those before it, from what `_reaching` says of it."""
    rows = np.arange(len(q))
    before, at = q[rows, previous], c[rows, previous]
    down = met & (lower >= 0) & (c[rows, lower] < at)
    stays = np.where(met, before >= target, before >= q[rows, wanted] - slack)
    stays &= (previous >= 0) & np.isfinite(at) & promised
    return np.where(stays, np.where(down, lower, previous), wanted)


def _arguments(quality, cost, previous, slack, path=False):
    """Arguments as arrays of float64 and int64; RunError for what cannot be planned with."""
    quality, cost = np.ascontiguousarray(quality, np.float64), np.ascontiguousarray(cost, np.float64)
    if quality.ndim != 2 + path or not quality.size or cost.shape != quality.shape[-2:]:
        shapes = f"[{'positions, ' * path}labels, levels] and [labels, levels]"
        _refuse(f"quality {quality.shape} and cost {cost.shape} do not fit", f"give {shapes}")
    levels = np.full(len(cost), -1) if previous is None else np.asarray(previous)
    last = cost.shape[1] - 1
    whole = levels.shape == cost.shape[:1] and levels.dtype.kind in "iu"
    if not whole or levels.min() < -1 or levels.max() > last:
        _refuse("previous levels do not fit", f"give whole numbers, -1 to {last}, for {len(cost)} labels")
    if (np.abs(quality) > 1).any():
        _refuse("a quality lies outside -1 to 1", "give SSIM, NaN where no promise is known")
    finite = np.isfinite(cost)
    amounts = np.where(finite, cost, 0)
    if not (cost >= 0).all() or (amounts != np.floor(amounts)).any():
        _refuse("a cost is not a whole number from 0 on", "give bytes or Gaussians, inf to leave a level out")
    if amounts.max(-1).sum() >= 2**53:
        _refuse("costs add up to 2**53 or more", "give them in a larger unit")
    if not finite.any(-1).all():
        _refuse(f"label {finite.any(-1).argmin()} has no level", "give one a finite cost or drop the label")
    if not 0 <= slack <= 1:
        _refuse(f"slack {slack} is impossible", "choose a difference of SSIM from 0 to 1, such as 0.01")
    return quality, cost, np.array(levels, np.int64, order="C")


def _targets(target, labels):
    target = np.asarray(target, np.float64)
    if target.shape not in ((), (labels,)) or not ((target > 0) & (target <= 1)).all():
        _refuse(f"target SSIM {target} is impossible", "choose one or one per label, above 0 and at most 1")
    return np.broadcast_to(target, (labels,))


def _refuse(problem, cure):
    raise RunError(f"{problem}; {cure}")
