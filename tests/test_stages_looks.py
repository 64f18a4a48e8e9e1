"""What plans look like, in one part of a view."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from conftest import job_of
from PIL import Image

from sagesplat.core.config import PlanConfig
from sagesplat.io.files import read_json, write_text
from sagesplat.output.tables import bytes_of
from sagesplat.stages.bundle import bundle
from sagesplat.stages.looks import _furthest, looks
from sagesplat.stages.plan import make_plan
from sagesplat.stages.results import plans_of


def test_the_part_is_where_the_difference_is() -> None:
    difference = np.zeros((30, 60))
    difference[20:30, 40:60] = 0.5
    mean, part = _furthest(difference)
    assert mean == 0.5
    assert part == (slice(20, 30), slice(40, 60))


def test_the_same_part_at_every_plan_and_of_the_full_model(run: Path, tmp_path: Path) -> None:
    make_plan(replace(job_of(run), force=True), PlanConfig(target_fidelity=0.8, other_targets=(0.5,)))
    job = job_of(run)
    plans = sorted((p for p in plans_of(job) if p.quality == "fidelity"), key=lambda plan: plan.target)
    *planned, full = looks(job, 2.0)
    assert [look.asked for look in planned] == [plan.target for plan in plans]
    assert [look.nbytes for look in planned] == [sum(map(bytes_of, plan.choices)) for plan in plans]
    assert (full.asked, full.fidelity) == (1, 1)
    assert {look.image.shape for look in planned} == {full.image.shape}
    camera = job.scene.views[0].camera
    assert full.image.shape == (2 * camera.height // 3, 2 * camera.width // 3, 3)
    for look in planned:
        assert look.fidelity <= 1
        assert look.fidelity_of_part <= 1
    assert planned[0].fidelity_of_part <= planned[0].fidelity  # where it is furthest away
    write_text(tmp_path / "viewer" / "index.html", "<body><!-- poster --></body>")
    bundle(job, tmp_path / "out", viewer=tmp_path / "viewer")
    named = read_json(tmp_path / "out" / "manifest.json")["looks"]
    assert named["targets"] == [plan.target for plan in plans] + [1]
    height, width, _ = full.image.shape
    with Image.open(tmp_path / "out" / named["uri"]) as picture:
        assert picture.size == (len(named["targets"]) * width, height)
