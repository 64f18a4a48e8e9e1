"""Nested levels (prefix LOD): a category is one ordered set of Gaussians, its prefixes are its levels."""

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType

import numpy as np
import torch
from jaxtyping import Bool, Float32, Int, Int8
from torch import Tensor

from sagesplat.core import geometry
from sagesplat.core.config import NestConfig, TrainConfig
from sagesplat.core.gaussians import Gaussians, concat
from sagesplat.core.second_opacity import weight_at
from sagesplat.formats.spz import SH_BITS
from sagesplat.io.typed import check_limits
from sagesplat.kernels.jit import njit
from sagesplat.raster import Backend, device_of
from sagesplat.scene.images import Photos
from sagesplat.scene.scene import Points, Scene
from sagesplat.segment.masks import Masks
from sagesplat.segment.valid import ALL_VALID, ValidPixels
from sagesplat.train.cells import split_cells
from sagesplat.train.checkpoint import Pace, latest_checkpoint
from sagesplat.train.early_stopping import ActiveTiles, trainable_rows
from sagesplat.train.events import Event, Resumed
from sagesplat.train.importance import importance
from sagesplat.train.lr_schedule import LrSchedule
from sagesplat.train.photo_loader import PhotoLoader
from sagesplat.train.sky import Shell, Sky
from sagesplat.train.state import TrainState, initial_state
from sagesplat.train.stepper import Stepper
from sagesplat.train.trainer import LOOK_EVERY, finite, named_failures, train
from sagesplat.train.votes import label_weights, winners

# docs/developers/nested.md compares these
_LR_MULTIPLIER, _SHRINK_TO = 4.0, 0.1  # of 3DGS's late learning rates: at first, and what is left of it
_REFERENCE_STEPS, _MOST_MULTIPLIER = 2400, 6.0  # the first goes with the root of these over the steps
_DRAWN_FROM = 0.03  # smallest prefix that a step draws; less favours categories that are easy to represent
_FULL_SHARE, _FULL_SHARE_END = 0.1, 0.75  # of the first and of the last steps draw the full model
_SHORT, _FULL_SHARE_SHORT = 1000, 0.3  # of fewer steps the first share is this: else the full model suffers
_BY_CELL = 0.5  # of the steps draw a prefix for each cell, not for each category
_SAVE_EVERY = 500
_AVERAGE_EVERY = 5
_NEARLY_FULL, _NEARLY_FROM = 0.2, 0.4  # share of the full steps that draw less, and the least prefix of these
SORT_AT = 1 / 12, 1 / 6, 1 / 3, 1 / 2, 2 / 3  # of the steps
_SORT_BY, _FEWEST = 3, 20  # each time another third of the views says how to sort, or as many as these


@dataclass(frozen=True, eq=False)
class Nested:
    """Gaussians in the order in which they are sent: by cell, or category, the most important first."""

    gaussians: Gaussians
    of_base: Bool[np.ndarray, " N"]  # of the base model, which comes first in each category
    second_opacities: Tensor | None = None  # [N] logits; see `core.second_opacity`


@dataclass(frozen=True, eq=False)
class Spans:
    """Several sets of Gaussians that replace each other, in each category by itself.

    At a level, numbered from 0, those Gaussians of a category are shown whose span holds it.
    """

    order: Float32[np.ndarray, " N"]  # ascending in a category of a set
    first: Int8[np.ndarray, " N"]
    last: Int8[np.ndarray, " N"]  # the same in a set
    levels: int  # that a step draws from, for each category


@dataclass(frozen=True)
class NestStep:
    """One step on a composition was taken."""

    step: int
    loss: float


def level_sizes(count: int, config: NestConfig) -> tuple[int, ...]:
    """Gaussians at each level of a category of `count`: ascending, geometric, at least one.

    In a small category several levels have the same size.
    """
    shares = config.smallest ** np.linspace(0, 1, config.levels)[::-1]
    return tuple(int(n) for n in np.ceil(shares * count - 1e-9))


def order(
    g: Gaussians,
    scene: Scene,
    masks: Masks,
    *,
    base: Gaussians | None = None,
    valid: ValidPixels = ALL_VALID,
    antialiased: bool = False,
    shell: Shell | None = None,
) -> Nested:
    """Label Gaussians by the pixels that they contribute to, and order each category by importance.

    `base`, a small model of the same scene, replaces as many of the least important Gaussians and is ordered
    before the others: a model trained small makes better low levels than the most important part of a large
    one. Gaussians on the `shell`, and no others, are of the sky.
    """
    views = scene.train_ids.tolist()
    importances = importance(g, scene, views, "sensitivity", valid=valid, antialiased=antialiased)
    of_base = np.zeros(len(g), bool)
    if base is not None and len(base):
        kept = np.sort(np.argsort(-importances, kind="stable")[: max(len(g) - len(base), 0)])
        own = importance(base, scene, views, "sensitivity", valid=valid, antialiased=antialiased)
        g = concat([base, g.select(torch.from_numpy(kept))])
        importances = np.concatenate([own, importances[kept]])
        of_base = np.arange(len(g)) < len(base)
    ids, weights = label_weights(g, scene, masks, views, antialiased=antialiased)
    g = replace(g, label_ids=_labels(g, ids, weights, shell))
    rows = np.lexsort((-importances, ~of_base, g.label_ids.numpy()))  # the last key decides first
    return Nested(g.select(torch.from_numpy(rows)), of_base[rows])


def in_cells(
    nested: Nested, count: int, inside: Bool[np.ndarray, " N"] | None = None
) -> tuple[Nested, dict[int, int]]:
    """An ordered model split into about `count` cells, and the label id of each; the order within them stays.

    The label ids of its Gaussians are then those of cells. 0: a category is a cell, of the same id. `inside`
    as in `split_cells`.
    """
    g = nested.gaussians
    if not count:
        return nested, {label: label for label in g.counts()}
    cells, label_of = split_cells(g.means.numpy(), g.label_ids.numpy(), count, inside)
    rows = np.argsort(cells, kind="stable")
    order = torch.from_numpy(rows)
    g = replace(g.select(order), label_ids=torch.from_numpy(cells[rows]))
    return Nested(g, nested.of_base[rows]), label_of


def _labels(
    g: Gaussians, ids: np.ndarray, weights: Float32[np.ndarray, "N L"], shell: Shell | None
) -> Tensor:
    """The category (int16 [N]) that each Gaussian paints most of: sky on the shell, another elsewhere."""
    if not shell:
        return winners(g, ids, weights)
    sky = np.isin(ids, shell.label_ids)
    far, near = (winners(g, ids[some], weights[:, some]) for some in (sky, ~sky))
    return torch.where(shell.holds(g.means), far, near)


def with_at_most(scene: Scene, labels: np.ndarray, count: int, seed: int) -> tuple[Scene, np.ndarray]:
    """The scene with at most `count` of its points, chosen at random, and their labels (int16 [P])."""
    points = scene.points
    if len(points.xyz) <= count:
        return scene, labels
    rows = np.sort(np.random.default_rng(seed).choice(len(points.xyz), count, replace=False))
    place = np.full(len(points.xyz), -1)
    place[rows] = np.arange(count)
    kept = place[points.track_points] >= 0
    tracks = place[points.track_points[kept]], points.track_views[kept], points.track_uv[kept]
    return replace(scene, points=Points(points.xyz[rows], points.rgb[rows], *tracks)), labels[rows]


def capped_config(config: TrainConfig, cap: int, steps: int) -> TrainConfig:
    """3DGS-MCMC with at most `cap` Gaussians, otherwise as `config`; only the last level is recorded."""
    mcmc = replace(config, strategy="mcmc", max_gaussians=cap, max_steps=steps, level_every=steps)
    return replace(mcmc, freeze_at=None, poses=False, exposure="off", outliers=False)


def train_capped(
    scene: Scene,
    photos: Photos,
    point_labels: np.ndarray,  # int16 [P]
    config: TrainConfig,
    cap: int,
    steps: int,
    *,
    valid: ValidPixels = ALL_VALID,
    seed: int = 0,
    backend: Backend = "auto",
    sky: Sky | None = None,
    start: Gaussians | None = None,
) -> Iterator[Event]:
    """The events of a training of `capped_config`, from `cap` of the points where there are more.

    With `start` it begins with these Gaussians.
    """
    if sky:
        scene, point_labels = sky.begin(scene, point_labels)
    some, labels = with_at_most(scene, point_labels, cap, seed)
    yield from train(
        some, photos, labels, capped_config(config, cap, steps),
        valid=valid, seed=seed, backend=backend, shell=sky.shell if sky else None, start=start,
    )  # fmt: skip


def nest(
    nested: Nested,
    scene: Scene,
    photos: Photos,
    train_config: TrainConfig,
    config: NestConfig,
    *,
    valid: ValidPixels = ALL_VALID,
    seed: int = 0,
    backend: Backend = "auto",
    checkpoint: Path | None = None,
    settings: str = "",
    movable: np.ndarray | None = None,  # bool [N]
    spans: Spans | None = None,
    shell: Shell | None = None,
    label_of: Mapping[int, int] = MappingProxyType({}),
) -> Iterator[NestStep | Resumed | Nested]:
    """Train a nested ladder: afterwards every composition of prefixes renders well.

    Each step draws a prefix of every category, log-uniform between 3 % and all of it, or the full model (with
    a probability that rises from 0.1, in short trainings 0.3, to 0.75; a fifth of these steps draw prefixes
    between 40 and 100 %). In half of the steps each cell has a prefix of its own instead. The composition is
    compared with a photo. Values are rounded as the increments will hold them. The result is the
    mean of the last steps' values (at most 500 steps, or a fifth): prefixes pull in different directions to
    the end. Gaussians outside the composition, and their Adam moments, stay as they
    are. Prefixes are drawn with the opacities that they have, between the first and the second ones. At five
    steps all Gaussians are sorted again by importance: in each category the base model stays first.

    Args:
        nested: The ordered model to start from (`order`).
        scene: The capture; `scene.train_ids` are used.
        photos: Its photos.
        train_config: Settings of the training that made the model.
        config: Steps, levels and the loss of this one.
        valid: The pixels that count; nothing is learnt from the others.
        seed: Of all random numbers.
        backend: Rasteriser; decides the device.
        checkpoint: Where to save, at most every 500 steps; one of the same `settings` is resumed.
        settings: What a checkpoint has to have been written with.
        movable: bool [N]; the others keep their values, and all keep their order. None: all are trained.
        spans: Levels that replace each other; all Gaussians keep their order. None: prefixes.
        shell: Gaussians that lie on it stay on it (see `train.sky`).
        label_of: Label id by cell id, where the label ids of Gaussians are those of cells.

    Yields:
        `NestStep` at every step, `Resumed` after a damaged checkpoint, and the trained `Nested` last.

    Raises:
        RunError: For impossible settings, a loss that is not finite, or memory that runs out.
    """
    check_limits(config, "nest.")
    device = device_of(backend)
    near = geometry.morton_order(nested.gaussians.means.numpy())  # neighbours in space are rendered together
    labels, of_base = nested.gaussians.label_ids.numpy()[near], nested.of_base[near]
    state = initial_state(nested.gaussians.select(torch.from_numpy(near)), seed)
    state.order_share = torch.from_numpy(spans.order[near]) if spans else order_shares(labels, of_base, -near)
    if spans is None:
        given = nested.second_opacities
        state.add_second_opacities(None if given is None else given[torch.from_numpy(near)])
    if checkpoint and checkpoint.exists():
        state, damage = latest_checkpoint(checkpoint, settings)
        if damage:
            yield Resumed(state.step, damage)
    state = state.to(device)
    categories, column = np.unique(labels, return_inverse=True)
    column = torch.from_numpy(column).to(device)
    of_cells = np.unique([label_of.get(cell, cell) for cell in categories.tolist()], return_inverse=True)[1]
    views = scene.train_ids.tolist()
    stays = movable is not None or spans is not None
    sort_at = [] if stays else [round(part * config.steps) for part in SORT_AT]
    edges = None
    if spans is not None:
        edges = torch.from_numpy(np.stack([spans.first, spans.last])[:, near]).to(device)
    stepper = Stepper(
        PhotoLoader(scene, photos, device, valid), replace(train_config, batch=1), ActiveTiles(scene, None),
        backend, sh_bits=SH_BITS, rate_weight=config.rate_weight, shell=shell,
        sky=shell.holds(state.gaussians.means) if shell else None,
    )  # fmt: skip
    rates = learning_rates(train_config, config, scene)
    trainable = trainable_rows(state.gaussians, {})
    if movable is not None:
        trainable &= torch.from_numpy(movable[near]).to(device)
    value, tail, pace = 0.0, TailAverage(config.steps), Pace()
    with named_failures(lambda: f"training on compositions stopped at step {state.step}"):
        while state.step < config.steps:
            if state.step in sort_at:
                importances = importance(
                    state.gaussians, scene, _sorting(views, sort_at.index(state.step)),
                    "sensitivity", valid=valid, antialiased=train_config.antialiased,
                )  # fmt: skip
                state.order_share = order_shares(labels, of_base, importances).to(device)
            if edges is None:
                rows, weights = _draw_prefixes(state, column, of_cells, config)
            else:
                assert spans is not None
                rows, weights = _draw_levels(state, column, len(categories), edges, spans.levels), None
            loss = stepper(
                state, nested.gaussians.sh_degree, rates(state.step + 1), trainable,
                drawn_rows=rows, second_weights=weights,
            )  # fmt: skip
            tail.add(state)
            saves = state.step % _SAVE_EVERY == 0
            if device.type == "cpu" or saves or state.step % LOOK_EVERY == 0:  # looking waits for a GPU
                value = finite(loss, state.step)
            if checkpoint and saves and pace.due():
                pace.write(checkpoint, state, settings)
            yield NestStep(state.step, value)
    assert state.order_share is not None
    sets = np.zeros(len(labels)) if spans is None else spans.last[near]
    rows = np.lexsort((state.order_share.cpu().numpy(), sets, labels))
    state = state.to(torch.device("cpu"))
    g, second = state.gaussians.select(torch.from_numpy(rows)), state.second_opacities
    second = None if second is None else second[torch.from_numpy(rows)]
    yield Nested(g, of_base[rows], second)


def _sorting(views: list[int], number: int) -> list[int]:
    """The views by which Gaussians are sorted again for this time, evenly spread."""
    parts = min(max(len(views) // _FEWEST, 1), _SORT_BY)
    return views[number % parts :: parts]


def tail_start(steps: int) -> int:
    """The step after which values are averaged: there is no checkpoint between it and the last step."""
    return max((steps - 1) // _SAVE_EVERY * _SAVE_EVERY, steps * 4 // 5)


class TailAverage:
    """The mean of a training's values over its last steps, at every fifth of them and the last one.

    Polyak and Juditsky, "Acceleration of stochastic approximation by averaging", 1992.
    """

    def __init__(self, steps: int) -> None:
        self._start, self._end, self._count = tail_start(steps), steps, 0
        self._means: list[Tensor] = []

    def add(self, state: TrainState) -> None:
        """Take the values of a step; at the last one they become the mean."""
        if state.step <= self._start or ((self._end - state.step) % _AVERAGE_EVERY):
            return
        values = [*state.gaussians.parameters().values()]
        if state.second_opacities is not None:
            values.append(state.second_opacities)
        self._count += 1
        if not self._means:
            self._means = [value.detach().clone() for value in values]
        for mean, value in zip(self._means, values, strict=True):
            mean.lerp_(value.detach(), 1 / self._count)
            if state.step == self._end:
                value.detach().copy_(mean)


def _draw_prefixes(
    state: TrainState, column: Tensor, of_cells: Int[np.ndarray, " C"], config: NestConfig
) -> tuple[Tensor | None, Tensor | None]:
    """Indices of the Gaussians that a step draws (None: all), and weights [N] of second opacities, if any.

    `column` [N]: of each Gaussian's cell; `of_cells`: of each cell's category.
    """
    prefix = draw_shares(state.rng, of_cells, config, state.step / config.steps)
    rows = weights = None
    if (prefix < 1).any():
        assert state.order_share is not None
        rows = _rows_before(state.order_share, column, prefix)
    if state.second_opacities is not None:
        weights = torch.from_numpy(weight_at(prefix)).to(column.device)[column]
    return rows, weights


def _rows_before(order_share: Tensor, column: Tensor, prefix: Float32[np.ndarray, " L"]) -> Tensor:
    """Indices, ascending, of the Gaussians in the prefixes of their categories."""
    if order_share.is_cuda:
        return torch.nonzero(order_share < torch.from_numpy(prefix).to(column.device)[column])[:, 0]
    return torch.from_numpy(_below(order_share.numpy(), column.numpy(), prefix))


@njit(cache=True)
def _below(order_share, column, prefix):
    rows, count = np.empty(len(column), np.int64), 0
    for row in range(len(column)):
        rows[count] = row
        count += order_share[row] < prefix[column[row]]
    return rows[:count]


def _draw_levels(state: TrainState, column: Tensor, num_labels: int, edges: Tensor, levels: int) -> Tensor:
    """Indices of the Gaussians of a level of each category; `edges` [2, N]: its first and last level."""
    drawn = torch.from_numpy(state.rng.integers(levels, size=num_labels))
    level = drawn.to(column.device)[column]
    return torch.nonzero((edges[0] <= level) & (level <= edges[1]))[:, 0]


def order_shares(labels: np.ndarray, first: np.ndarray, importances: np.ndarray) -> Tensor:
    """Share of its category ordered before each Gaussian (float32 [N]): those `first`, then by importance."""
    rows = np.lexsort((-importances, ~first, labels))
    _, begins, counts = np.unique(labels[rows], return_index=True, return_counts=True)
    found = np.empty(len(rows), np.float32)
    found[rows] = (np.arange(len(rows)) - np.repeat(begins, counts)) / np.repeat(counts, counts)
    return torch.from_numpy(found)


def draw_shares(
    rng: np.random.Generator, of_cells: Int[np.ndarray, " C"], config: NestConfig, done: float
) -> Float32[np.ndarray, " C"]:
    """Prefix of each cell that a step renders, as a share of it; `done`: share of the steps taken.

    `of_cells`: the category of each, 0 to L - 1.
    """
    first = _FULL_SHARE_SHORT if config.steps < _SHORT else _FULL_SHARE
    full = first + (_FULL_SHARE_END - first) * done
    num_labels = int(of_cells.max()) + 1
    if num_labels < len(of_cells) and rng.random() < _BY_CELL:
        num_labels, of_cells = len(of_cells), np.arange(len(of_cells))
    if rng.random() < full:
        if rng.random() < _NEARLY_FULL:  # else levels of more than a half are hardly trained in the end
            return rng.uniform(_NEARLY_FROM, 1, num_labels).astype(np.float32)[of_cells]
        return np.ones(len(of_cells), np.float32)
    return np.exp(rng.uniform(np.log(_DRAWN_FROM), 0, num_labels)).astype(np.float32)[of_cells]


def learning_rates(
    train_config: TrainConfig, config: NestConfig, scene: Scene
) -> Callable[[int], Mapping[str, float]]:
    """Learning rates by parameter name, for each step."""
    third = LrSchedule(
        replace(train_config, max_steps=3, lr_schedule="published"), scene.extent
    ).learning_rates(2)
    first = min(_LR_MULTIPLIER * math.sqrt(_REFERENCE_STEPS / max(config.steps, 1)), _MOST_MULTIPLIER)

    def rates(step: int) -> Mapping[str, float]:
        multiplier = first * _SHRINK_TO ** (step / config.steps)
        return {name: multiplier * rate for name, rate in third.items()}

    return rates
