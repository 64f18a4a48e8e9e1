"""Redrawn splits: training views stay, figures are by target, and the result is JSON."""

import json

from viewpoint_fields import LEVELS, orbit, synthetic

from benchmarks.promises_photos import redrawn, summary

SCENE = orbit(96)
COSTS = {(5, level): level for level in LEVELS}


def test_redraws_of_a_known_field():
    draws = redrawn(synthetic(SCENE, 1), SCENE, COSTS, [0.5, 0.6, 0.99], 3)
    tests = [frozenset(draw.view.tolist()) for draw in draws]
    assert len(set(tests)) == 3
    assert all(len(views) == len(SCENE.test_ids) for views in tests)
    assert not set().union(*tests) & set(SCENE.train_ids.tolist())
    found = json.loads(json.dumps(summary(draws)))
    assert set(found["targets"]) <= {"0.5", "0.6"}  # what is never accepted is left out
    row = found["targets"]["0.5"]
    assert row["accepted"] == sum(
        (d.accepted & (d.target == 0.5) & (d.predictor == "bound")).sum() for d in draws
    )
    assert row["coverage_p5"] <= row["coverage"] <= 1
