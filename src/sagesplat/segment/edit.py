"""Operations on labels: merge categories, keep some of them, fold the rare ones into unlabelled."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from jaxtyping import Bool, Int16, Int64

from sagesplat.core.errors import LabelError, short
from sagesplat.core.names import RULE, checked
from sagesplat.scene.scene import View
from sagesplat.segment import coco
from sagesplat.segment.masks import (
    MAX_LABEL_ID,
    UNLABELLED,
    UNLABELLED_NAME,
    VOID_8,
    Masks,
    Taxonomy,
    mask_path,
    prepare_folder,
    write_labels,
    write_mask,
)
from sagesplat.segment.valid import ALL_VALID, ValidPixels

Table = Int16[np.ndarray, " M"]  # new id of each old one; the last entry, which -1 names, stays -1
NO_MERGE: Mapping[str, str] = MappingProxyType({})


@dataclass(frozen=True, eq=False)
class Edited:
    """What became of the categories of a folder of masks."""

    taxonomy: Taxonomy  # those that are left
    table: Table
    shares: dict[str, float]  # of all pixels, by category that is left
    dropped: dict[str, float]  # share of all pixels that `keep` made unlabelled, by category
    folded: dict[str, float]  # the same for `min_share`
    asked: dict[str, Any] = field(default_factory=dict)  # merge, keep and min_share as they were applied

    @property
    def record(self) -> dict[str, Any]:
        """All of it as plain values, for provenance."""
        return {**self.asked, "shares": self.shares, "dropped": self.dropped, "folded": self.folded}


def parse_names(text: str, option: str) -> tuple[str, ...]:
    """The categories in "chair 1,vase", which `option` was given; LabelError for what is no name."""
    names = tuple(name.strip() for name in text.split(",")) if text.strip() else ()
    if "" in names:
        raise LabelError(f"{option} {short(repr(text))}: a name is empty; write NAME,NAME")
    return tuple(dict.fromkeys(named(name, option) for name in names))


def parse_merge(text: str) -> dict[str, str]:
    """The pairs in "plant=tree-merged,vase=plant", chains resolved: each category and what it ends in.

    LabelError for what is not of this form, for a category that goes to two others and for a circle.
    """
    merge: dict[str, str] = {}
    for pair in text.split(",") if text.strip() else ():
        old, _, new = (part.strip() for part in pair.partition("="))
        if not old or not new or "=" in new:
            raise LabelError(
                f"merge {short(repr(pair.strip()))}: not of the form FROM=INTO; write FROM=INTO,FROM=INTO"
            )
        if merge.setdefault(old, new) != new:
            raise LabelError(f"merge: {old} goes into {merge[old]} and into {new}; leave one of them")
    return resolve(merge)


def named(name: str, option: str) -> str:
    """A name that was typed, as it may be; LabelError where it may not."""
    try:
        return checked(name)
    except ValueError as error:
        raise LabelError(f"{option} {short(repr(name))}: {error}; {RULE}") from None


def resolve(merge: Mapping[str, str]) -> dict[str, str]:
    """The same with chains followed to their end; LabelError for a circle, and for what is no name."""
    merge = {named(old, "merge"): named(new, "merge") for old, new in merge.items()}
    ends = {}
    for old in merge:
        chain = [old]
        while (new := merge.get(chain[-1])) is not None:
            chain.append(new)
            if new in chain[:-1]:
                raise LabelError(f"merge: {' = '.join(chain)} is a circle; leave one of them out")
        ends[old] = chain[-1]
    return ends


def edit_table(
    taxonomy: Taxonomy,
    *,
    keep: Sequence[str] = (),
    merge: Mapping[str, str] = NO_MERGE,
    ignore: Sequence[str] = (),
) -> tuple[Taxonomy, Table]:
    """The categories that are left and their ids: `merge`, `ignore`, `keep` (empty: all).

    `merge` maps a category to the one it goes into: one of the taxonomy, `unlabelled`, or a new one, which
    gets COCO panoptic's id where that is its name and the id is free, else the first free id from 201 on.
    LabelError for categories that there are not.
    """
    merge = resolve(merge)
    _check_known(taxonomy, merge, "merge")
    ids = {name: label_id for label_id, name in taxonomy.names.items()} | {UNLABELLED_NAME: UNLABELLED}
    for new in merge.values():
        if new not in ids:
            ids[new] = free_id(new, set(ids.values()))
    names = {i: n for n, i in ids.items() if n not in merge and i != UNLABELLED}
    kept = {i: n for i, n in sorted(names.items()) if n not in ignore}
    if keep:
        _check_unmerged(keep, merge, "keep")
        _check_known(Taxonomy(kept), keep, "keep")
        kept = {i: n for i, n in kept.items() if n in keep}
    table = np.full(max(taxonomy.names, default=0) + 2, UNLABELLED, np.int16)
    for label_id, name in taxonomy.names.items():
        new_id = ids[merge.get(name, name)]
        table[label_id] = new_id if new_id in kept else UNLABELLED
    return Taxonomy(kept), table


def ignored_ids(
    taxonomy: Taxonomy, ignore: Sequence[str], merge: Mapping[str, str] = NO_MERGE
) -> tuple[list[int], list[str]]:
    """Ids that are ignored, as they were before `merge`, and the names of which there are no pixels.

    LabelError for a name that is neither a category of the taxonomy, after `merge`, nor one of COCO's.
    """
    merge = resolve(merge)
    _check_unmerged(ignore, merge, "ignore")
    after = {label_id: merge.get(name, name) for label_id, name in taxonomy.names.items()}
    unseen = [name for name in ignore if name not in after.values()]
    _check_known(Taxonomy(after), [name for name in unseen if name not in coco.NAMES.values()], "ignore")
    return [label_id for label_id, name in after.items() if name in ignore], unseen


def count_pixels(label_ids: Int16[np.ndarray, "*S"], taxonomy: Taxonomy) -> Int64[np.ndarray, " M"]:
    """Pixels by id, those of -1 last: as long as the tables of this taxonomy, to be summed over images."""
    size = max(taxonomy.names, default=0) + 2
    return np.bincount(label_ids.ravel().astype(np.int64) % size, minlength=size)  # -1 % size is the last


def fold_table(
    taxonomy: Taxonomy, num_pixels: Int64[np.ndarray, " M"], min_share: float
) -> tuple[Taxonomy, Table]:
    """Without the categories that have less than `min_share` of all pixels (see `count_pixels`).

    Unlabelled pixels are among "all". LabelError if nothing is left, or for a share outside [0, 1].
    """
    if not 0 <= min_share <= 1:
        raise LabelError(f"min_share {min_share} is no share of the pixels; give one from 0 to 1")
    shares = num_pixels / max(num_pixels.sum(), 1)
    left = {i: name for i, name in taxonomy.names.items() if num_pixels[i] and shares[i] >= min_share}
    if not left:
        before = ", ".join(sorted(set(taxonomy.names.values()))) or "none"
        raise LabelError(
            f"no category with pixels and at least {min_share:g} of them is left of {before}; "
            "keep more of them or lower min_share"
        )
    table = np.full(len(num_pixels), UNLABELLED, np.int16)
    table[list(left)] = list(left)
    return Taxonomy(left), table


def edit_labels(
    folder: Path,
    views: Sequence[View],
    target: Path | None = None,
    *,
    keep: Sequence[str] = (),
    merge: Mapping[str, str] = NO_MERGE,
    ignore: Sequence[str] = (),
    min_share: float = 0.0,
    valid: ValidPixels = ALL_VALID,
    on_view: Callable[[int, int], None] | None = None,
) -> Edited:
    """Edit a folder of masks: first `merge`, then `ignore` and `keep`, then fold what is below `min_share`.

    `ignore`: categories that become unlabelled, and so do all pixels that are not `valid`. `keep`: the
    categories that stay, all others become unlabelled; none named: all stay. `merge`: see `edit_table`.
    `min_share`: of the pixels of all views, unlabelled ones included. `target`: where the result goes, the
    folder itself by default; a killed edit is finished by calling it again. `on_view(done, total)` is called
    after each image, read or written. LabelError for names that there are not, when nothing would be left, or
    for masks that cannot be read: then nothing is written.
    """
    target = target or folder
    before = Taxonomy.read(folder / "labels.json")
    masks = Masks(folder, before)
    after, table = edit_table(before, keep=keep, merge=merge, ignore=ignore)
    counts, total = np.zeros(len(table), np.int64), 2 * len(views)
    for row, view in enumerate(views):
        counts += count_pixels(_valid_only(masks[view], valid[view]), before)
        if on_view:
            on_view(row + 1, total)
    new_counts = np.zeros(max(after.names, default=0) + 2, np.int64)
    np.add.at(new_counts, table, counts)
    left, fold = fold_table(after, new_counts, min_share)
    table = fold[table]
    _prepare(folder, target, views, before, left)
    for row, view in enumerate(views):
        write_mask(mask_path(target, view), table[_valid_only(masks[view], valid[view])], left)
        if on_view:
            on_view(len(views) + row + 1, total)
    write_labels(target, left, set(left.names))
    merge = resolve(merge)
    pixels = max(int(counts.sum()), 1)
    gone = {i: n for i, n in before.names.items() if merge.get(n, n) not in after.names.values()}
    return Edited(
        left,
        table,
        shares={name: new_counts[i] / pixels for i, name in left.names.items()},
        dropped={name: counts[i] / pixels for i, name in gone.items()},
        folded={n: new_counts[i] / pixels for i, n in after.names.items() if i not in left.names},
        asked={"merge": merge, "ignore": list(ignore), "keep": list(keep), "min_share": min_share},
    )


def _valid_only(
    label_ids: Int16[np.ndarray, "H W"], valid: Bool[np.ndarray, "H W"] | None
) -> Int16[np.ndarray, "H W"]:
    return label_ids if valid is None else np.where(valid, label_ids, np.int16(UNLABELLED))


def _prepare(folder: Path, target: Path, views: Sequence[View], before: Taxonomy, after: Taxonomy) -> None:
    """Make a folder ready to be filled; one that is edited in place stays readable all the while."""
    if target.resolve() == folder.resolve():
        (before | after).write(target / "labels.json")
    else:
        prepare_folder(target, views)


def _check_unmerged(names: Sequence[str], merge: Mapping[str, str], option: str) -> None:
    for name in names:
        if name in merge:
            raise LabelError(f"{option}: {name} is merged into {merge[name]}; {option} that")


def _check_known(taxonomy: Taxonomy, names: Mapping[str, str] | Sequence[str], option: str) -> None:
    known = taxonomy.names.values()
    for name in names:
        if name not in known:
            raise LabelError(f"{option}: no category {name!r}; {alternatives(name, sorted(set(known)))}")


def alternatives(name: str, known: Collection[str]) -> str:
    """What an error says of the names that there are, with the one that may have been meant."""
    close = get_close_matches(name, known, n=1)
    hint = f"did you mean {close[0]}? " if close else ""
    return f"{hint}there are {', '.join(known) or 'none'}"


def free_id(name: str, taken: set[int]) -> int:
    """COCO's id of this name, else one that neither COCO nor 8-bit files (255) have a meaning for."""
    own = next((i for i, n in coco.NAMES.items() if n == name), None)
    if own is not None and own not in taken:
        return own
    free = range(max(coco.NAMES) + 1, MAX_LABEL_ID + 1)
    return next(i for i in free if i not in taken and i != VOID_8)
