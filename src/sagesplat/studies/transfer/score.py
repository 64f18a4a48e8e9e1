"""Cross-scene: how well the quality models (Eq. 3) of one run predict another, against its own (method A)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from sagesplat.adapt.eq1 import choose_latest
from sagesplat.adapt.eq3 import SsimModel
from sagesplat.adapt.observe import Observations
from sagesplat.adapt.plan import Counts, Models
from sagesplat.core.errors import RunError
from sagesplat.core.geometry import mean_neighbour_distance
from sagesplat.io.columns import ColumnTable
from sagesplat.output.tables import mean
from sagesplat.segment.masks import UNLABELLED_NAME

NORMALISATIONS = ("raw", "extent", "footprint")
# B's own models; A's, with B's distances in A's units three ways; A's medians, whatever the distance
PREDICTORS = ("own", *NORMALISATIONS, "median")


@dataclass(frozen=True, eq=False)
class FittedRun:
    """What transfer needs of one run."""

    name: str  # path of the run folder
    names: Mapping[int, str]  # label id -> category
    observations: Observations  # rows of views that show enough of the category
    models: Models
    counts: Counts  # every level of the ladder
    recovering: frozenset[int]  # levels taken shortly after an opacity reset
    train_views: Int[np.ndarray, " T"]  # rows of Scene.views, those that `models` were fitted to
    test_views: Int[np.ndarray, " U"]
    extent: float  # world units; NaN if all cameras stand in one place
    focals: Float[np.ndarray, " V"]  # pixels, geometric mean of fx and fy
    spacings: Mapping[int, float]  # by label id, see point_spacings


@dataclass(frozen=True)
class Shared:
    """A category of both runs, matched by name."""

    name: str
    label_a: int
    label_b: int
    levels: tuple[int, ...]  # settled levels of B
    matched: tuple[int, ...]  # for each the settled level of A with the nearest share of its run


@dataclass(frozen=True, eq=False)
class Transfer(ColumnTable):
    """One row per (split of B, target, category, predictor); NaN where no view can tell."""

    split: np.ndarray  # [R] "train" or "test" views of B
    target: Float[np.ndarray, " R"]  # SSIM
    category: np.ndarray  # [R] name
    predictor: np.ndarray  # [R] one of PREDICTORS
    views: Int[np.ndarray, " R"]  # that show the category
    ssim_error: Float[np.ndarray, " R"]  # mean |predicted - measured| over views and settled levels
    bias: Float[np.ndarray, " R"]  # mean of predicted - measured
    outside: Float[np.ndarray, " R"]  # share of those rows at a distance beyond the fitted ones, or unknown
    reachable: Int[np.ndarray, " R"]  # views in which some level measures the target
    iteration_error: Float[np.ndarray, " R"]  # mean |chosen - cheapest such level| there, training steps
    hit: Float[np.ndarray, " R"]  # share of them in which the chosen level measures the target
    missed: Int[np.ndarray, " R"]  # those in which it does not: chosen too cheap
    regret: Float[np.ndarray, " R"]  # mean Gaussians above the cheapest such level where it does
    regret_share: Float[np.ndarray, " R"]  # the same over the category's Gaussians at its last level


def point_spacings(xyz: Float[np.ndarray, "P 3"], point_labels: Int[np.ndarray, " P"]) -> dict[int, float]:
    """Median distance from a point to the nearest other of its label, world units; absent if it has one."""
    labels, sizes = np.unique(point_labels, return_counts=True)
    return {
        label: float(np.median(mean_neighbour_distance(xyz[point_labels == label], k=1)))
        for label in labels[sizes > 1].tolist()
    }


def shared_categories(a: FittedRun, b: FittedRun) -> list[Shared]:
    """The categories that both runs have models for, in order of B's ids; RunError if there is none."""
    last_a, last_b = (max(level for _, level in run.counts) for run in (a, b))
    ids_a, ids_b = ({n: i for i, n in run.names.items() if n != UNLABELLED_NAME} for run in (a, b))
    found = []
    for name in sorted(ids_a.keys() & ids_b, key=ids_b.__getitem__):
        label_a, label_b = ids_a[name], ids_b[name]
        levels_a, levels_b = settled_levels(a, label_a), settled_levels(b, label_b)
        if levels_a and levels_b:
            matched = [min(levels_a, key=lambda i, j=j: abs(i / last_a - j / last_b)) for j in levels_b]
            found.append(Shared(name, label_a, label_b, tuple(levels_b), tuple(matched)))
    if not found:
        raise RunError(
            f"{b.name}: shares no category ({', '.join(ids_b)}) with {a.name} ({', '.join(ids_a)}); choose "
            "runs that have one in common"
        )
    return found


def settled_levels(run: FittedRun, label_id: int) -> list[int]:
    """Levels that a plan chooses from, ascending: recovering ones only where there is no other."""
    levels = sorted(level for label, level in run.models.keys() & run.counts if label == label_id)
    return [level for level in levels if level not in run.recovering] or levels


def predictors(
    a: FittedRun, b: FittedRun, shared: Shared, focals: Float[np.ndarray, " V"]
) -> dict[str, tuple[list[SsimModel], Float[np.ndarray, " V"]]]:
    """By predictor: a model per level of B, and the factor from B's distances at these `focals` to its own.

    The factor keeps, from B to A: raw: the distance; extent: distance over the scene's extent; footprint: the
    world size of a pixel at that distance (d / focal) over the category's point spacing, at A's median focal.
    NaN where that is not known: the models then say their medians.
    """
    of_a = [a.models[shared.label_a, level] for level in shared.matched]
    of_b = [b.models[shared.label_b, level] for level in shared.levels]
    same = np.ones(len(focals))
    spacing_a, spacing_b = a.spacings.get(shared.label_a, np.nan), b.spacings.get(shared.label_b, np.nan)
    focal_a = np.median(a.focals[a.train_views])
    return {
        "own": (of_b, same),
        "raw": (of_a, same),
        "extent": (of_a, same * (a.extent / b.extent)),
        "footprint": (of_a, spacing_a * focal_a / (spacing_b * focals)),
        "median": (of_a, same * np.nan),
    }


def transfer(a: FittedRun, b: FittedRun, targets: Sequence[float]) -> Transfer:
    """Predict B with A's models and with its own, over B's settled levels, and choose levels by either."""
    rows = []
    for shared in shared_categories(a, b):
        levels = np.array(shared.levels)
        mine = b.observations.select(b.observations.label_id == shared.label_b)
        mine = mine.select(np.isin(mine.level, levels))
        views, column = np.unique(mine.view, return_inverse=True)
        measured = np.full((len(levels), len(views)), np.nan, np.float32)
        measured[np.searchsorted(levels, mine.level), column] = mine.ssim
        distance = np.empty(len(views))
        distance[column] = mine.distance  # one per view, whatever the level
        counts = np.array([b.counts[shared.label_b, level] for level in shared.levels])
        full = b.counts[max(key for key in b.counts if key[0] == shared.label_b)]  # at the last level
        for predictor, (models, scale) in predictors(a, b, shared, b.focals[views]).items():
            d = distance * scale
            predicted = np.stack([model(d) for model in models])
            low, high = np.array([model.d_range for model in models]).T[..., None]
            outside = ~((d >= low) & (d <= high))
            for split, ids in (("train", b.train_views), ("test", b.test_views)):
                here = np.isin(views, ids)
                error = (predicted - measured)[:, here]
                quality = {"ssim_error": mean(np.abs(error)), "bias": mean(error)}
                quality |= {"views": int(here.sum()), "outside": mean(outside[:, here])}
                for target in targets:
                    key = {"split": split, "target": target, "category": shared.name, "predictor": predictor}
                    chosen = score(predicted[:, here], measured[:, here], levels, counts, target)
                    share = chosen["regret"] / full if full else np.nan
                    rows.append(key | quality | chosen | {"regret_share": share})
    return Transfer(**{f.name: np.array([row[f.name] for row in rows]) for f in fields(Transfer)})


def transferred_levels(
    a: FittedRun, b: FittedRun, view: int, distances: Mapping[int, float], target: float, predictor: str
) -> dict[int, int]:
    """Level of each shared category, by B's label id, that A's models choose for a view of B.

    `distances`: by label id of B, world units; NaN or absent where nothing is in sight.
    """
    levels = {}
    for shared in shared_categories(a, b):
        models, scale = predictors(a, b, shared, b.focals[[view]])[predictor]
        d = np.array([distances.get(shared.label_b, np.nan)]) * scale
        counts = np.array([b.counts[shared.label_b, level] for level in shared.levels])
        ssim = np.stack([model(d) for model in models])
        levels[shared.label_b] = shared.levels[int(choose_latest(ssim.T, counts, target)[0][0])]
    return levels


def score(
    predicted: Float[np.ndarray, "L V"],
    measured: Float[np.ndarray, "L V"],
    levels: Int[np.ndarray, " L"],
    counts: Int[np.ndarray, " L"],
    target: float,
) -> dict[str, Any]:
    """Levels chosen by prediction against those chosen knowing the measurement: some columns of Transfer."""
    chosen, best = (choose_latest(ssim.T, counts, target)[0] for ssim in (predicted, measured))
    reached = measured >= target
    hit, reachable = reached[chosen, np.arange(len(chosen))], reached.any(0)
    return {
        "reachable": int(reachable.sum()),
        "iteration_error": mean(np.abs(levels[chosen] - levels[best])[reachable]),
        "hit": mean(hit[reachable]),
        "missed": int((reachable & ~hit).sum()),
        "regret": mean((counts[chosen] - counts[best])[hit]),
    }
