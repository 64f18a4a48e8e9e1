"""Masks of detections become a label image, probabilities and instances, exactly."""

import numpy as np
import pytest

from sagesplat.segment.detections import (
    Boxes,
    Found,
    confidence,
    painted_over,
    segmented,
    without_duplicates,
)
from sagesplat.segment.segmenters import Segmented

INSIDE, OUTSIDE = 20.0, -20.0
IDS = [201, 7, 202]


def mask(*columns: int, width: int = 8, logit: float = INSIDE) -> np.ndarray:
    """A mask [4, width] that is these columns."""
    logits = np.full((4, width), OUTSIDE, np.float32)
    logits[:, list(columns)] = logit
    return logits


def found(*each: tuple[int, float, np.ndarray], things: bool = True) -> Found:
    prompts = np.array([prompt for prompt, _, _ in each], np.int64)
    scores = np.array([score for _, score, _ in each], np.float32)
    masks = np.array([m for _, _, m in each], np.float32).reshape(-1, 4, 8)
    return Found(prompts, scores, masks, np.zeros(3, np.float32), things)


def test_a_score_at_the_threshold_is_one_half() -> None:
    scores = np.array([0.2, 0.6, 1.0, 0.1], np.float32)
    np.testing.assert_allclose(confidence(scores, 0.2), [0.5, 0.75, 1, 0.4375], atol=1e-6)
    np.testing.assert_allclose(confidence(scores, 0.0), [0.6, 0.8, 1, 0.55], atol=1e-6)


def test_pixels_go_to_the_surer_mask_and_the_rest_is_unlabelled() -> None:
    answer = segmented(
        found((0, 0.6, mask(0, 1, 2, 3)), (1, 0.8, mask(3, 4)), (0, 0.4, mask(6))), IDS, 0.2, (4, 8)
    )
    np.testing.assert_array_equal(answer.label_ids[0], [201, 201, 201, 7, 7, -1, 201, -1])
    assert answer.instances is not None
    np.testing.assert_array_equal(answer.instances[0], [1, 1, 1, 0, 0, -1, 2, -1])
    assert answer.label_ids.dtype == answer.instances.dtype == np.int16
    assert answer.ids.tolist() == [7, 201]
    assert answer.probabilities is not None
    p7, p201 = answer.probabilities[:, 0]
    total = 0.75 + 0.875  # both claim the fourth column: scaled to 1 in sum
    np.testing.assert_allclose(p201, [0.75, 0.75, 0.75, 0.75 / total, 0, 0, 0.625, 0], atol=1e-6)
    np.testing.assert_allclose(p7, [0, 0, 0, 0.875 / total, 0.875, 0, 0, 0], atol=1e-6)


def test_a_doubtful_pixel_of_a_sure_box_loses_to_a_sure_pixel() -> None:
    doubtful = mask(0, 1, logit=0.2)  # a probability of 0.55
    answer = segmented(found((0, 0.9, doubtful), (1, 0.4, mask(1))), IDS, 0.2, (4, 8))
    np.testing.assert_array_equal(answer.label_ids[0, :3], [201, 7, -1])


def test_a_mask_that_wins_nowhere_is_no_instance() -> None:
    answer = segmented(found((0, 0.9, mask(0, 1)), (0, 0.8, mask(1)), (2, 0.5, mask(5))), IDS, 0.2, (4, 8))
    assert answer.instances is not None
    np.testing.assert_array_equal(answer.instances[0], [0, 0, -1, -1, -1, 1, -1, -1])


def test_masks_are_resampled_to_the_photo() -> None:
    answer = segmented(found((0, 0.9, mask(0, 1, 2, 3))), IDS, 0.2, (40, 80))
    assert answer.label_ids.shape == (40, 80)
    np.testing.assert_array_equal(answer.label_ids[20] == 201, np.arange(80) < 40)
    assert answer.probabilities is not None
    assert answer.probabilities.shape == (1, 4, 8)


def test_nothing_found() -> None:
    answer = segmented(found(), IDS, 0.2, (4, 8))
    assert (answer.label_ids == -1).all()
    assert answer.instances is not None
    assert (answer.instances == -1).all()
    assert answer.probabilities is not None
    assert answer.probabilities.shape == (0, 4, 8)
    assert len(answer.ids) == 0


def test_what_is_no_thing_has_no_instances() -> None:
    assert segmented(found((0, 1.0, mask(1)), things=False), IDS, 0.2, (4, 8)).instances is None


def test_boxes_for_the_same_thing_are_one() -> None:
    corners = [[0, 0, 10, 10], [0, 0, 10, 9], [0, 0, 10, 10], [5, 0, 15, 10], [0, 0, 40, 40]]
    boxes = Boxes(
        np.array([0, 0, 1, 0, 0]), np.array([0.5, 0.6, 0.4, 0.7, 0.3], np.float32),
        np.array(corners, np.float32), np.zeros(2, np.float32),
    )  # fmt: skip
    kept = without_duplicates(boxes)
    assert kept.scores.tolist() == pytest.approx([0.7, 0.6, 0.4, 0.3])  # 0.5 is the box of 0.6 again
    assert kept.prompts.tolist() == [0, 0, 1, 0]


def base(columns: dict[int, list[int]], instances: list[int] | None = None) -> Segmented:
    label_ids = np.full((4, 8), -1, np.int16)
    for label_id, of in columns.items():
        label_ids[:, of] = label_id
    ids = np.array(sorted(columns), np.int16)
    probabilities = np.array([np.where(label_ids == i, 0.9, 0.05) for i in ids], np.float32)
    numbers = None if instances is None else np.tile(np.array(instances, np.int16), (4, 1))
    return Segmented(label_ids, probabilities, ids, numbers)


def test_prompts_are_painted_over_another_segmenter() -> None:
    top = segmented(found((0, 0.6, mask(2, 3)), (1, 0.6, mask(6))), IDS, 0.2, (4, 8))
    both = painted_over(base({7: [0, 1], 184: [2, 3, 4]}, [0, 0, 3, 3, -1, -1, -1, -1]), top)
    np.testing.assert_array_equal(both.label_ids[0], [7, 7, 201, 201, 184, -1, 7, -1])
    assert both.instances is not None
    np.testing.assert_array_equal(both.instances[0], [2, 2, 0, 0, -1, -1, 1, -1])
    assert both.ids.tolist() == [7, 184, 201]
    assert both.probabilities is not None
    p7, p184, p201 = both.probabilities[:, 0]
    np.testing.assert_allclose(p201, [0, 0, 0.75, 0.75, 0, 0, 0, 0], atol=1e-6)
    np.testing.assert_allclose(p184[:5], [0.05, 0.05, 0.9 * 0.25, 0.9 * 0.25, 0.9], atol=1e-6)
    np.testing.assert_allclose(p7[[0, 3, 6]], [0.9, 0.05 * 0.25, 0.75 + 0.05 * 0.25], atol=1e-6)
    assert both.probabilities.sum(0).max() <= 1 + 1e-6


def test_probabilities_of_different_resolutions_are_joined() -> None:
    top = segmented(found((0, 0.6, mask(*range(4)))), IDS, 0.2, (4, 8))
    below = Segmented(
        np.full((4, 8), 3, np.int16), np.full((1, 2, 2), 0.8, np.float32), np.array([3], np.int16)
    )
    both = painted_over(below, top)
    assert both.probabilities is not None
    below_left, above_left = both.probabilities[:, 0]  # resampling blurs the border between them
    np.testing.assert_allclose(below_left, 0.8 * (1 - above_left), atol=1e-6)
    assert above_left[0] > 0.6 > 0.2 > above_left[1] > 0
    assert both.instances is not None
    assert both.instances.max() == 0


def test_without_probabilities_below_there_are_none() -> None:
    top = segmented(found((0, 0.6, mask(2))), IDS, 0.2, (4, 8))
    below = Segmented(np.full((4, 8), 3, np.int16), None, np.zeros(0, np.int16))
    both = painted_over(below, top)
    assert both.probabilities is None
    np.testing.assert_array_equal(both.label_ids[0], [3, 3, 201, 3, 3, 3, 3, 3])
