"""Results of a scene in blocks, merged by category."""

import numpy as np

from sagesplat.adapt.evaluate import Evaluation
from sagesplat.adapt.observe import TOTAL
from sagesplat.output import tables
from sagesplat.output.by_category import merged

NAMES = {3: "vase", TOTAL: "whole image"}


def evaluation(rows: list[tuple[float, int, float, int]]) -> Evaluation:
    """Rows of (target, label id, measured SSIM, pixels) in view 0."""
    target, label, ssim, pixels = (np.array(column) for column in zip(*rows, strict=True))
    f, i = np.float32, np.int32
    zero, measured = np.zeros(len(rows), i), ssim.astype(f)
    return Evaluation(
        zero + 1, target.astype(f), zero, label.astype(i), zero, measured, measured, measured, 30 * measured,
        measured, 30 * measured, pixels.astype(i), *[measured] * 12,
    )  # fmt: skip


def test_rows_of_a_budget_plan_are_merged_like_those_of_a_target() -> None:
    """A plan within a budget has no target: NaN, which differs from itself."""
    parts = [(target, label, ssim, 10) for target in (0.5, np.nan) for label, ssim in ((3, 0.4), (4, 0.8))]
    found = merged(evaluation(parts), {4: 3}, ("quality", "target", "view"))
    assert found.label_id.tolist() == [3, 3]
    np.testing.assert_array_equal(found.target, np.array([0.5, np.nan], np.float32))
    np.testing.assert_allclose(found.ssim, 0.6, rtol=1e-6)
    assert found.num_pixels.tolist() == [20, 20]


def test_the_budget_plan_is_in_the_table_of_the_evaluation() -> None:
    rows = evaluation([(0.5, 3, 0.6, 9), (np.nan, 3, 0.7, 9), (np.nan, TOTAL, 0.8, 9)])
    table = tables.evaluation_table(rows, [3], NAMES)
    assert [row[1:3] for row in table.cells()] == [["0.5", "vase"], ["–", "vase"], ["–", "whole image"]]
