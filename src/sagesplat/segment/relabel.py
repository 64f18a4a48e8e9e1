"""What edits of labels make of a run's categories: the new category of every Gaussian, names and settings."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Int16, Int32

from sagesplat.core.errors import LabelError
from sagesplat.formats import label_edits
from sagesplat.segment.edit import alternatives, free_id
from sagesplat.segment.masks import UNLABELLED, UNLABELLED_NAME


@dataclass(frozen=True, eq=False)
class Relabelled:
    """The categories after edits."""

    names: dict[int, str]  # by new id, unlabelled included where it has Gaussians
    new_ids: Mapping[int, Int16[np.ndarray, " _"]]  # by old id, of its Gaussians in their order
    weights: dict[str, float]  # of plans within a budget, where it is not 1
    hidden: tuple[str, ...]
    always: tuple[str, ...]  # in full whatever the plan says

    def moved(self, old: int) -> int | None:
        """The one new category that an old one is part of; None where it was split."""
        first = int(self.new_ids[old][0])
        return first if (self.new_ids[old] == first).all() else None

    @property
    def sources(self) -> dict[int, list[int]]:
        """The old categories of each new one, by id."""
        found: dict[int, list[int]] = {}
        for old, ids in self.new_ids.items():
            for new in np.unique(ids).tolist():
                found.setdefault(new, []).append(old)
        return found

    def parents(self, before: Mapping[str, str], names: Mapping[int, str]) -> dict[str, str]:
        """The category that each instance is of, by their names now.

        `before`: the same before the edits; `names`: the categories then, by id. What was merged of several
        is an instance of the one that all of them were of.
        """
        moved = {names[old]: self.names[new] for old in self.new_ids if (new := self.moved(old)) is not None}
        found = {}
        for new, sources in self.sources.items():
            of = {before.get(names[old]) for old in sources}
            if len(of) == 1 and (parent := of.pop()) is not None and new in self.names:
                found[self.names[new]] = moved.get(parent, parent)
        return {name: parent for name, parent in found.items() if parent not in found and parent != name}

    @property
    def changed(self) -> list[int]:
        """The new categories whose Gaussians are not exactly those of the old category of their id."""
        return [new for new, old in self.sources.items() if old != [new] or self.moved(new) is None]


@dataclass
class _Category:
    name: str
    label_id: int | None  # None: it gets a free one
    weight: float = 1.0
    hidden: bool = False
    always: bool = False


@dataclass
class _State:
    """Categories while edits are applied: `owner` says which one each Gaussian is of."""

    categories: list[_Category]
    owner: dict[int, Int32[np.ndarray, " _"]]  # by old id: number of the category, by rank
    old_ids: dict[str, int]  # by the run's own names
    number_of: dict[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.number_of = {one.name: number for number, one in enumerate(self.categories)}


def relabelled(
    names: Mapping[int, str],
    counts: Mapping[int, int],
    operations: Sequence[label_edits.Operation],
    *,
    weights: Mapping[str, float] | None = None,
    hidden: Sequence[str] = (),
    always: Sequence[str] = (),
) -> Relabelled:
    """Apply edits to the categories of a run.

    Args:
        names: Categories by id, of those that the ladder has.
        counts: Gaussians of each, by id.
        operations: In their order; each uses the names that those before it left.
        weights: Settings that the run has already, by category.
        hidden: The same.
        always: The same.

    Returns:
        The categories afterwards.

    Raises:
        LabelError: For a category that there is not, a name that is taken, ranks that the category does not
            have, a split that takes all, and edits that leave no category.

    Example:
        >>> from sagesplat.formats.label_edits import Rename
        >>> from sagesplat.segment.relabel import relabelled
        >>> relabelled({3: "car"}, {3: 10}, [Rename("car", "my car")]).names
        {3: 'my car'}
    """
    weights = weights or {}
    categories = [
        _Category(name, label, weights.get(name, 1.0), name in hidden, name in always)
        for label, name in names.items()
    ]
    owner = {label: np.full(counts[label], number, np.int32) for number, label in enumerate(names)}
    if UNLABELLED not in names:  # what is merged into it loses its category
        categories.append(_Category(UNLABELLED_NAME, UNLABELLED))
    state = _State(categories, owner, {name: label for label, name in names.items()})
    for number, operation in enumerate(operations, 1):
        try:
            _apply(state, operation)
        except LabelError as error:
            raise LabelError(f"operation {number}: {error}") from None
    return _result(state)


def _apply(state: _State, operation: label_edits.Operation) -> None:
    number = _find(state, operation.category)
    category = state.categories[number]
    match operation:
        case label_edits.Rename(to=to):
            _rename(state, number, to)
        case label_edits.Merge(into=into):
            _merge(state, number, into)
        case label_edits.Split(to=to, gaussians=gaussians):
            _split(state, number, to, gaussians)
        case label_edits.Hide(hidden=hidden):
            category.hidden = hidden
        case label_edits.Weigh(weight=weight):
            category.weight = weight
        case label_edits.Full(always=always):
            category.always = always


def _find(state: _State, name: str) -> int:
    if name in state.number_of:
        return state.number_of[name]
    raise LabelError(f"no category {name!r}; {alternatives(name, sorted(state.number_of))}")


def _check_free(state: _State, name: str) -> None:
    if name in state.number_of:
        raise LabelError(f"the name {name!r} is taken; choose another, or merge the two")
    if name == UNLABELLED_NAME:
        raise LabelError(f"the name {name!r} is that of what has no category; choose another")


def _rename(state: _State, number: int, to: str) -> None:
    category = state.categories[number]
    if to == category.name:
        return
    _check_free(state, to)
    del state.number_of[category.name]
    category.name, state.number_of[to] = to, number
    if category.label_id == UNLABELLED:
        category.label_id = None


def _merge(state: _State, number: int, into: str) -> None:
    target = _find(state, into)
    if target == number:
        raise LabelError(f"{into!r} cannot be merged with itself")
    del state.number_of[state.categories[number].name]
    for owner in state.owner.values():
        owner[owner == number] = target


def _split(state: _State, number: int, to: str, gaussians: Mapping[str, label_edits.Runs]) -> None:
    _check_free(state, to)
    new = len(state.categories)
    for label, runs in gaussians.items():
        if label not in state.old_ids:
            raise LabelError(f"no category {label!r} in the run that the ranks are of")
        owner = state.owner[state.old_ids[label]]
        if (end := sum(runs[-1])) > len(owner):
            raise LabelError(f"rank {end - 1} of {label!r}, which has {len(owner):,} Gaussians")
        ranks = label_edits.ranks_of(runs)
        if (owner[ranks] != number).any():
            raise LabelError(f"Gaussians that are not of {state.categories[number].name!r}")
        owner[ranks] = new
    if not any((owner == number).any() for owner in state.owner.values()):
        raise LabelError(f"nothing would be left of {state.categories[number].name!r}; rename it instead")
    state.categories.append(_Category(to, None))
    state.number_of[to] = new


def _result(state: _State) -> Relabelled:
    used = set(np.unique(np.concatenate(list(state.owner.values()))).tolist())
    kept = [one for number, one in enumerate(state.categories) if number in used]
    if not any(one.label_id != UNLABELLED for one in kept):
        raise LabelError("the edits leave no category; keep at least one beside what has none")
    taken = {one.label_id for one in kept if one.label_id is not None} | {UNLABELLED}
    for one in kept:
        if one.label_id is None:
            one.label_id = free_id(one.name, taken)
            taken.add(one.label_id)
    ids = np.array([0 if one.label_id is None else one.label_id for one in state.categories], np.int16)
    return Relabelled(
        {int(one.label_id or 0): one.name for one in sorted(kept, key=lambda one: one.label_id or 0)},
        {label: ids[owner] for label, owner in state.owner.items()},
        {one.name: one.weight for one in kept if one.weight != 1},
        tuple(one.name for one in kept if one.hidden),
        tuple(one.name for one in kept if one.always),
    )
