"""Makes the quality models, from the observations: Eq. 3, and what else the run's method fits."""

from collections.abc import Sequence

from sagesplat.adapt.eq3 import Samples, SsimModel, fit_model, samples, write_models
from sagesplat.adapt.observe import Observations
from sagesplat.core.config import FitConfig
from sagesplat.core.errors import RunError
from sagesplat.run.executor import split
from sagesplat.run.job import Job
from sagesplat.run.records import settings_of
from sagesplat.run.remote import work_all
from sagesplat.run.run_dir import RunDir
from sagesplat.run.stage import run_stage
from sagesplat.stages.methods import method_of
from sagesplat.stages.shared import label_image_inputs, observed


def fit_curves(job: Job, table: Observations) -> dict[tuple[int, int], SsimModel]:
    """Eq. 3 of every category at every level, from the training views."""
    parts = split(samples(table, job.scene.train_ids), job.pieces)
    found = [model for part in work_all(job, "fit", _fit_some, parts) for model in part]
    return {(model.label_id, model.level): model for model in found}


def _fit_some(job: Job, part: Sequence[Samples]) -> list[SsimModel]:
    return [fit_model(*found) for found in part]


def fit_ladder(job: Job, config: FitConfig) -> None:
    """Fit the quality models of every category at every level to the observations."""
    run, method = job.run, method_of(job)

    def make() -> list[str]:
        table = observed(job)
        models = fit_curves(job, table)
        write_models(run.models, models)
        statuses = [m.status for m in models.values()]
        lines = [", ".join(f"{statuses.count(s)} {s}" for s in sorted(set(statuses)))]
        return lines + method.fit(table, config, models)

    settings = {name: getattr(config, name) for name in method.fit_settings}
    _check_observed(run, config)
    inputs = [*run.scene_files, run.provenance("observe"), run.observations, *method.level_files]
    inputs += [run.labels, run.provenance("train"), *label_image_inputs(run)]
    inputs += method.sample_files
    run_stage(job, "fit", settings, inputs, method.model_files, make)


def _check_observed(run: RunDir, config: FitConfig) -> None:
    """RunError where the levels were observed with other distances than `config` names."""
    made, wanted = settings_of(run, "observe")["distance"], config.distance
    if made != wanted:
        raise RunError(
            f"{run.observations}: observed with distance {made}; add --fit.distance {made}, or "
            f"observe again: `sagesplat observe {run.path} --fit.distance {wanted} --force`"
        )
