"""The tables of a run: what the paper prints as Tables I to III, the plan, the models and their coverage."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Protocol

import numpy as np

from sagesplat.adapt.eq3 import Eq3, SsimModel
from sagesplat.adapt.evaluate import OTHERS, QUALITIES, Evaluation
from sagesplat.adapt.observe import TOTAL, Observations
from sagesplat.adapt.plan import Choice, Counts, Plan, quality_title
from sagesplat.core.gaussians import BYTES_PER_GAUSSIAN
from sagesplat.output.table import Table
from sagesplat.segment.masks import UNLABELLED, UNLABELLED_NAME

MB = 1e6  # bytes
_COLUMNS = 4  # of a ladder in a terminal


@dataclass(frozen=True)
class Kept:
    """Empirical coverage of a promise: rows in which the target was promised, and those that measured it."""

    promised: int
    kept: int

    @property
    def share(self) -> float:
        """Kept over promised, NaN if nothing was promised."""
        return self.kept / self.promised if self.promised else math.nan


def name_of(label_id: int, names: Mapping[int, str]) -> str:
    """A category as people call it."""
    special = {TOTAL: "whole image", UNLABELLED: UNLABELLED_NAME}
    return special.get(label_id) or names.get(label_id, f"category {label_id}")


def bytes_of(choice: Choice) -> int:
    """What a choice costs: bytes to send, or 248 a Gaussian."""
    return choice.nbytes if choice.transfer_bytes is None else choice.transfer_bytes


def by_size(counts: Counts) -> list[int]:
    """Label ids, the one with the most Gaussians at its last level first."""
    last = last_counts(counts)
    return sorted(last, key=lambda label_id: (-last[label_id], label_id))


def last_counts(counts: Counts) -> dict[int, int]:
    """Gaussians of each label in the full model, the last level: of recorded ones it is 3DGS itself."""
    last: dict[int, int] = {}
    for (label_id, _), count in sorted(counts.items(), key=lambda item: item[0][1]):
        last[label_id] = count
    return last


def view_mean(rows: Observations, label_id: int, level: int) -> float:
    """Mean SSIM of a label at a level over the views it is seen in, NaN if none."""
    return mean(rows.ssim[(rows.label_id == label_id) & (rows.level == level)])


def quality_table(
    observations: Observations, views: np.ndarray, labels: Sequence[int], names: Mapping[int, str], which: str
) -> Table:
    """Table I: mean SSIM over some views (rows of Scene.views), a line per level, a column per label."""
    rows = observations.select(np.isin(observations.view, views))
    columns = [TOTAL, *labels]
    body = [
        (level, *(view_mean(rows, label_id, level) for label_id in columns))
        for level in np.unique(rows.level).tolist()
    ]
    header = ("level", *(name_of(label_id, names) for label_id in columns))
    return Table(f"SSIM by level, {which} views", header, (",d", *[".3f"] * len(columns)), body)


def counts_table(counts: Counts, labels: Sequence[int], names: Mapping[int, str]) -> Table:
    """Table II: Gaussians by level and label."""
    levels = sorted({level for _, level in counts})
    body = []
    for level in levels:
        row = [counts.get((label_id, level), 0) for label_id in labels]
        body.append((level, sum(row), *row))
    header = ("level", "all", *(name_of(label_id, names) for label_id in labels))
    return Table("Gaussians by level", header, (",d",) * len(header), body)


def ladder_table(
    rows: Observations, counts: Counts, recovering: frozenset[int], names: Mapping[int, str]
) -> Table:
    """Tables I and II in one, for a terminal: mean SSIM and thousands of Gaussians at some levels.

    Those just after an opacity reset are left out where there are others.
    """
    levels = sorted({level for _, level in counts})
    not_recovering = [level for level in levels if level not in recovering] or levels
    spread = np.linspace(0, len(not_recovering) - 1, _COLUMNS).round().astype(int)
    picked = sorted({not_recovering[i] for i in spread})
    body = []
    for label_id in [*by_size(counts), TOTAL]:
        cells = []
        for level in picked:
            here = [n for (i, at), n in counts.items() if at == level and label_id in (TOTAL, i)]
            thousands = sum(here) / 1e3
            count = f"{thousands:.1f}k" if thousands < 9.95 else f"{thousands:.0f}k"
            cells.append(f"{view_mean(rows, label_id, level):.3f} {count:>5}")
        body.append((name_of(label_id, names), *cells))
    header = ("category", *(f"{level}" for level in picked))
    return Table("SSIM and Gaussians by level, training views", header, ("",) * len(header), body)


def outcome_table(plan: Plan, counts: Counts, evaluation: Evaluation, names: Mapping[int, str]) -> Table:
    """A plan in short: what each category takes, how many views reach the target, what test views show."""
    full = last_counts(counts)
    rows = evaluation.of(plan)
    fidelity = plan.quality == "fidelity"

    def measured(of: Evaluation) -> tuple[float, ...]:
        return (*((mean(of.fidelity),) if fidelity else ()), mean(of.ssim), mean(of.full_ssim))

    body = []
    for choice in sorted(plan.choices, key=lambda c: -full.get(c.label_id, 0)):
        here = measured(rows.select(rows.label_id == choice.label_id))
        share = choice.count / full[choice.label_id] if full.get(choice.label_id) else math.nan
        reached = choice.reached.share if choice.reached else math.nan
        cells = (choice.level, choice.count, share, reached)
        body.append((name_of(choice.label_id, names), *cells, *here, choice.verdict))
    share = plan.count / max(1, sum(full.values()))
    whole = measured(rows.select(rows.label_id == TOTAL))
    body.append((name_of(TOTAL, names), math.nan, plan.count, share, math.nan, *whole, plan.verdict))
    shown = ("fidelity", "SSIM", "full") if fidelity else ("test", "full")
    header = ("category", "level", "Gaussians", "share", "reach it", *shown, "status")
    formats = ("", "d", ",d", ".0%", ".0%", *[".3f"] * len(shown), "")
    beside = "and what test views measure beside the full model"
    return Table(f"Plan for {plan.asked}: share of views that reach it, {beside}", header, formats, body)


def plan_table(plan: Plan, counts: Counts, names: Mapping[int, str]) -> Table:
    """What one plan chose for each label, the largest first."""
    full = last_counts(counts)
    body = []
    for choice in sorted(plan.choices, key=lambda c: -full.get(c.label_id, 0)):
        share = choice.count / full[choice.label_id] if full.get(choice.label_id) else math.nan
        sent = math.nan if choice.transfer_bytes is None else choice.transfer_bytes / MB
        cells = (choice.level, choice.count, share, sent, choice.nbytes / MB)
        cells += (choice.distance,)
        of = choice.reached
        views = (of.share, of.low, of.high, of.num_views) if of else (math.nan,) * 4
        body.append((name_of(choice.label_id, names), *cells, *views, choice.verdict))
    header = ("category", "level", "Gaussians", "of full model", "MB to send", "MB as floats", "distance")
    header += ("reached in", "from", "to", "views", "status")
    formats = ("", ",d", ",d", ".1%", ".3f", ".2f", ".3f", ".0%", ".0%", ".0%", ",d", "")
    note = "reached in: share of the views that measure the target at this level or above, 95 % interval"
    return Table(f"Plan for {plan.asked}", header, formats, body, notes=(f"{note} from, to.",))


def targets_table(
    plans: Sequence[Plan],
    counts: Counts,
    labels: Sequence[int],
    names: Mapping[int, str],
    sizes: Mapping[tuple[int, int], int] | None = None,
) -> Table:
    """Table III: Gaussians, bytes and status of every label for the full model and for each target.

    `sizes`: bytes to send of each (label id, level); without, a Gaussian has 248 bytes, as in the paper.
    """
    full = last_counts(counts)
    most = last_counts(sizes) if sizes else {label: n * BYTES_PER_GAUSSIAN for label, n in full.items()}
    unit = "MB to send" if sizes else "MB"
    header = ["category", "full model Gaussians", f"full model {unit}"]
    for plan in plans:
        header += [f"{plan.asked} {column}" for column in ("level", "Gaussians", unit, "status")]
    chosen = [{choice.label_id: choice for choice in plan.choices} for plan in plans]

    def nbytes(choice: Choice) -> int:
        return bytes_of(choice) if sizes else choice.nbytes

    body = []
    for label_id in labels:
        row = [name_of(label_id, names), full.get(label_id, 0), most.get(label_id, 0) / MB]
        for choices in chosen:
            if choice := choices.get(label_id):
                row += [choice.level, choice.count, nbytes(choice) / MB, choice.verdict]
            else:
                row += [math.nan, 0, 0.0, ""]
        body.append(tuple(row))
    total = ["all", sum(full.values()), sum(most.values()) / MB]
    for plan in plans:
        total += [math.nan, plan.count, sum(map(nbytes, plan.choices)) / MB, plan.verdict]
    formats = ("", ",d", ".2f", *(",d", ",d", ".2f", "") * len(plans))
    return Table("Size by target", tuple(header), formats, [*body, tuple(total)])


class _Decisions(Protocol):
    """Columns of rows of (label, view, target): what was predicted of the chosen level, and measured."""

    @property
    def target(self) -> np.ndarray: ...  # SSIM, [R]

    @property
    def label_id(self) -> np.ndarray: ...  # [R]

    @property
    def predicted(self) -> np.ndarray: ...  # SSIM, [R]

    @property
    def ssim(self) -> np.ndarray: ...  # measured, [R]


def promise_kept(rows: _Decisions) -> Kept:
    """Of the (label, view, target) rows whose predicted SSIM reaches the target, those measured there too."""
    measured = np.isfinite(rows.ssim) & (rows.label_id != TOTAL)
    promised = measured & (rows.predicted >= rows.target)
    return Kept(int(promised.sum()), int((promised & (rows.ssim >= rows.target)).sum()))


def evaluation_table(evaluation: Evaluation, labels: Sequence[int], names: Mapping[int, str]) -> Table:
    """What every plan promised and what was measured, by label and for the whole image.

    A plan within a budget has no target and promises none: its rows come last.
    """
    body = []
    asked = [
        (i, t) for i in range(len(QUALITIES)) for t in np.unique(evaluation.target[evaluation.quality == i])
    ]
    for i, target in asked:
        within = np.isnan(evaluation.target) if np.isnan(target) else evaluation.target == target
        plan = evaluation.select(within & (evaluation.quality == i))
        for label_id in [*labels, TOTAL]:
            rows = plan.select(plan.label_id == label_id)
            own = rows.of_own_quality()
            rows, own = rows.select(np.isfinite(own.ssim)), own.select(np.isfinite(own.ssim))
            if not len(rows):
                continue
            kept = promise_kept(own)
            none = label_id == TOTAL or np.isnan(target)
            share = (math.nan,) * 3 if none else (kept.promised, kept.kept, kept.share)
            found = (mean(rows.fidelity), mean(rows.ssim))
            others = (mean(rows.full_ssim), mean(rows.psnr), mean(rows.full_psnr))
            others += (mean(rows.plain_psnr), mean(rows.cc_ssim), mean(rows.cc_psnr))
            others += (mean(rows.full_plain_psnr), mean(rows.full_cc_ssim), mean(rows.full_cc_psnr))
            others += tuple(mean(getattr(rows, f"{of}{name}")) for of in ("", "full_") for name in OTHERS)
            named = (quality_title(QUALITIES[i]), float(f"{target:g}"), name_of(label_id, names), len(rows))
            body.append((*named, *share, *found, *others))
    header = ("quality", "target", "category", "views", "promised", "kept", "share kept", "fidelity")
    header += ("SSIM", "full model SSIM", "PSNR", "full model PSNR")
    formats = ("", "g", "", ",d", ",d", ",d", ".0%", ".3f", ".3f", ".3f", ".2f", ".2f")
    for model in ("", "full model "):
        header += (f"{model}plain PSNR", f"{model}cc_ssim", f"{model}cc_psnr")
        formats += (".2f", ".3f", ".2f")
    for model in ("", "full model "):
        header += tuple(f"{model}{title}" for title in ("MS-SSIM", "FLIP", "LPIPS"))
        formats += (".3f",) * 3
    return Table("Promised and measured, unseen views", header, formats, body)


def models_table(models: Mapping[tuple[int, int], SsimModel], names: Mapping[int, str]) -> Table:
    """Eq. 3 for every label and level: parameters, fitted distances, error."""
    parameters = [one.name for one in fields(Eq3)] if models else []
    body = [
        (name_of(m.label_id, names), m.level, *m.params, *m.d_range, m.rmse, m.num_observations, m.status)
        for _, m in sorted(models.items())
    ]
    header = ("category", "level", *parameters, "d min", "d max", "rmse", "observations", "status")
    formats = ("", ",d", *[".4g"] * (len(parameters) + 2), ".4f", ",d", "")
    return Table("Models of SSIM over distance (Eq. 3)", header, formats, body)


def mean(values: np.ndarray) -> float:
    """Mean of the finite values, NaN if there are none."""
    finite = values[np.isfinite(values)]
    return float(finite.mean(dtype=np.float64)) if len(finite) else math.nan
