"""Results of a scene in blocks, merged by category, for people to read."""

from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from typing import TypeVar

import numpy as np

from sagesplat.adapt.evaluate import Evaluation
from sagesplat.adapt.observe import Observations
from sagesplat.adapt.plan import Choice, Counts, Plan

Rows = TypeVar("Rows", Observations, Evaluation)
Categories = Mapping[int, int]  # label of a category in a block -> label of its category; others stay


def relabelled(rows: Rows, categories: Categories) -> Rows:
    """The same rows, with categories instead of per-block categories."""
    label_ids = [categories.get(label, label) for label in rows.label_id.tolist()]
    return replace(rows, label_id=np.array(label_ids, rows.label_id.dtype))


def merged(rows: Rows, categories: Categories, keys: Sequence[str]) -> Rows:
    """One row for all blocks of a category with the same `keys`; means are over pixels.

    Distances are the closest, levels the highest, PSNR is of the mean squared error.
    """
    rows = relabelled(rows, categories)
    names = [f.name for f in fields(rows)]
    # numbered by value, as rows without a target (NaN) belong together too
    key = np.stack(
        [np.unique(getattr(rows, name), return_inverse=True)[1] for name in ("label_id", *keys)], 1
    )
    _, first, group = np.unique(key, axis=0, return_index=True, return_inverse=True)
    group, pixels = group.ravel(), rows.num_pixels.astype(np.float64)

    def mean(values: np.ndarray) -> np.ndarray:
        known = np.isfinite(values) * pixels
        total = np.bincount(group, known, len(first))
        summed = np.bincount(group, np.where(known > 0, values, 0) * known, len(first))
        return np.where(total > 0, summed / np.maximum(total, 1), np.nan)

    columns = {}
    for name in names:
        values = getattr(rows, name)
        if name in ("label_id", *keys):
            found = values[first]
        elif name == "num_pixels":
            found = np.bincount(group, pixels, len(first))
        elif name == "level":
            found = np.zeros(len(first))
            np.maximum.at(found, group, values)
        elif name == "distance":
            found = np.full(len(first), np.nan)
            np.fmin.at(found, group, values)
        elif name.endswith("psnr"):
            found = -10 * np.log10(mean(10 ** (-values.astype(np.float64) / 10)))
        else:
            found = mean(values.astype(np.float64))
        columns[name] = found.astype(values.dtype)
    return type(rows)(**columns)


def merged_counts(counts: Counts, categories: Categories) -> dict[tuple[int, int], int]:
    """Gaussians of each (category, level)."""
    found: dict[tuple[int, int], int] = {}
    for (label, level), count in counts.items():
        key = categories.get(label, label), level
        found[key] = found.get(key, 0) + count
    return found


def merged_plan(plan: Plan, categories: Categories) -> Plan:
    """The plan with one choice a category: sums, the highest level, the lowest promise, the worst status."""
    groups: dict[int, list[Choice]] = {}
    for choice in plan.choices:
        groups.setdefault(categories.get(choice.label_id, choice.label_id), []).append(choice)
    return replace(plan, choices=tuple(_together(label, groups[label]) for label in sorted(groups)))


def _together(label: int, choices: Sequence[Choice]) -> Choice:
    if len(choices) == 1:
        return replace(choices[0], label_id=label)
    states = {choice.status for choice in choices}
    transfer_bytes = [choice.transfer_bytes for choice in choices if choice.transfer_bytes is not None]
    known = [choice.calibrated for choice in choices if choice.calibrated is not None]
    reached = [choice.reached for choice in choices if choice.reached]
    return Choice(
        label,
        max(choice.level for choice in choices),
        _least([choice.predicted for choice in choices]),
        _least([choice.distance for choice in choices]),
        sum(choice.count for choice in choices),
        next(status for status in ("infeasible", "no promise", "ok", "no model") if status in states),
        sum(transfer_bytes) if len(transfer_bytes) == len(choices) else None,
        all(known) if known else None,
        min(reached, key=lambda one: one.low) if reached else None,
    )


def _least(values: Sequence[float]) -> float:
    return float(np.fmin.reduce(np.array(values, np.float64)))
