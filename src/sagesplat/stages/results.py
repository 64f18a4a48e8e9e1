"""Results of a run, each checked against the levels, the categories and the views that the run has.

The readers of the files check a file by itself. A file that was edited, or comes from another run, can be
sound and still not belong to the others.
"""

from collections.abc import Iterable, Mapping
from pathlib import Path

from sagesplat.adapt.cell_models import FidelityModel, read_fidelity
from sagesplat.adapt.cells import Cells, reaching
from sagesplat.adapt.eq3 import SsimModel, read_models
from sagesplat.adapt.evaluate import UNIFORM, Evaluation, read_evaluation
from sagesplat.adapt.fidelity import SampledFidelity, read_sampled
from sagesplat.adapt.observe import TOTAL, Observations, read_observations
from sagesplat.adapt.plan import Plan
from sagesplat.adapt.plan_files import read_budget_plan, read_plans
from sagesplat.adapt.viewpoint import ViewModel, read_promises
from sagesplat.adapt.viewpoints import Viewpoints, read_viewpoints
from sagesplat.core.errors import DataError
from sagesplat.formats.increments import INDEX, Increment, read_index, totals
from sagesplat.run.job import Job
from sagesplat.run.records import settings_of, uses
from sagesplat.run.run_dir import RunDir

_WHOLE = -1  # level of the rows of the whole image in an evaluation


def observations_of(job: Job) -> Observations:
    """The run's observations; DataError where they are of other categories, levels or views."""
    path, table = job.run.observations, read_observations(job.run.observations)
    _check(path, "observe", "category", table.label_id.tolist(), {*job.names(), TOTAL})
    _check(path, "observe", "level", table.level.tolist(), set(job.ladder.levels))
    _check(path, "observe", "view", table.view.tolist(), range(len(job.scene.views)))
    return table


def evaluation_of(job: Job) -> Evaluation:
    """The run's evaluation; DataError like `observations_of`."""
    path, table = job.run.evaluation, read_evaluation(job.run.evaluation)
    _check(path, "evaluate", "category", table.label_id.tolist(), {*job.names(), TOTAL, UNIFORM})
    _check(path, "evaluate", "level", table.level.tolist(), {*job.ladder.levels, _WHOLE})
    _check(path, "evaluate", "view", table.view.tolist(), range(len(job.scene.views)))
    return table


def plans_of(job: Job) -> tuple[Plan, ...]:
    """The scene's plans, of levels that the run has."""
    plans, _ = read_plans(job.run.plan)
    _check_plans(job, plans)
    return plans


def budget_plan_of(job: Job) -> Plan | None:
    """The plan for a budget, if there is one, of levels that the run has."""
    plan = read_budget_plan(job.run.plan)
    _check_plans(job, [plan] if plan else [])
    return plan


def models_of(job: Job) -> dict[tuple[int, int], SsimModel]:
    """Eq. 3 by (label id, level), of categories and levels that the run has."""
    models = read_models(job.run.models)
    _check(job.run.models, "fit", "category", (label for label, _ in models), {*job.names(), TOTAL})
    _check(job.run.models, "fit", "level", (level for _, level in models), set(job.ladder.levels))
    return models


def promises_of(job: Job) -> dict[int, ViewModel]:
    """Models of SSIM against photos with their bounds, by label id, of levels that the run has.

    None without photos: of a splat that somebody else trained.
    """
    if not job.run.promises.exists() and not has_photos(job.run):
        return {}
    models = read_promises(job.run.promises)
    _check_models(job, job.run.promises, models)
    if any(model.quality != "ssim" for model in models.values()):
        raise _foreign(job.run.promises, "fit", "its quality")
    return models


def has_photos(run: RunDir) -> bool:
    """Whether the levels were measured against photos: else there is fidelity only."""
    if run.adopted.exists() and not settings_of(run, "adopt").get("photos"):
        return False
    return not run.provenance("fit").exists() or uses(run, "fit", run.observations)


def fidelity_of(job: Job) -> dict[int, FidelityModel]:
    """Models of fidelity with their bounds, by label id, of the cells and levels that the run has."""
    path, models = job.run.fidelity, read_fidelity(job.run.fidelity)
    _check_models(job, path, models)
    label_of = job.cells.label_of
    for label, model in models.items():
        _check(path, "fit", "cell", (cell.cell for cell in model.cells), _cells_of(label_of, label))
    return models


def _cells_of(label_of: Mapping[int, int], label: int) -> list[int]:
    return [cell for cell, of in label_of.items() if of == label]


def _check_models(job: Job, path: Path, models: Mapping[int, ViewModel | FidelityModel]) -> None:
    _check(path, "fit", "category", models, job.names())
    levels = (level for model in models.values() for level in model.levels)
    _check(path, "fit", "level", levels, set(job.ladder.levels))


def viewpoints_of(job: Job) -> Viewpoints:
    """The drawn viewpoints."""
    return read_viewpoints(job.run.viewpoints)


def sampled_of(job: Job) -> SampledFidelity:
    """Fidelity at the viewpoints of the set "fit", of cells and levels that the run has."""
    path, sampled = job.run.sampled, read_sampled(job.run.sampled)
    if sampled.labels != tuple(job.cells.ids.tolist()):
        raise _foreign(path, "sample", "its cells")
    V, _, K = sampled.fidelity.shape
    if len(job.ladder.levels) != K:
        raise _foreign(path, "sample", f"{K} levels")
    if len(viewpoints_of(job).rows("fit")) != V:
        raise _foreign(path, "sample", f"{V} viewpoints")
    return sampled


def cells_of(job: Job) -> Cells:
    """The cells, in sight from wherever the sampled viewpoints show them."""
    drawn, sampled = viewpoints_of(job), sampled_of(job)
    fit = [drawn.cameras[row] for row in drawn.rows("fit")]
    return reaching(job.cells, fit, sampled.shares())


def increments_of(job: Job) -> list[Increment]:
    """The increments of the nested levels, of categories and levels that the run has."""
    path, listed = job.run.increments / INDEX, read_index(job.run.increments)
    _check(path, "nest", "cell", (one.cell for one in listed), job.by_cell.sizes)
    _check(path, "nest", "level", (one.level for one in listed), set(job.ladder.levels))
    counts, label_of = job.by_cell.counts, job.cells.label_of
    if any(label_of.get(one.cell) != one.label_id for one in listed):
        raise _foreign(path, "nest", "its cells")
    cells = sorted(job.by_cell.sizes)
    table = totals(listed, cells, len(job.ladder.levels), "count").tolist()
    for cell, row in zip(cells, table, strict=True):
        for level, count in reversed(list(enumerate(row, 1))):
            if count != counts[cell, level]:
                raise _foreign(path, "nest", f"{count:,} Gaussians of cell {cell}")
    return listed


def _check_plans(job: Job, plans: Iterable[Plan]) -> None:
    for plan in plans:
        for choice in plan.choices:
            if (choice.label_id, choice.level) not in job.ladder.counts:
                what = f"level {choice.level} of category {choice.label_id}"
                raise _foreign(job.run.plan, "plan", what)
        if left := {label for label, _ in job.ladder.counts} - plan.levels.keys():
            raise _foreign(job.run.plan, "plan", f"a plan without category {min(left)}")


def _check(path: Path, stage: str, what: str, values: Iterable[int], known: Iterable[int]) -> None:
    """DataError for the first of `values` that is not known."""
    if unknown := sorted(set(values) - set(known)):
        raise _foreign(path, stage, f"{what} {unknown[0]}")


def _foreign(path: Path, stage: str, what: str) -> DataError:
    which = "that folder" if path.name == INDEX else "it"
    return DataError(f"{path}: {what} is not this run's; delete {which} and run `sagesplat {stage}` again")
