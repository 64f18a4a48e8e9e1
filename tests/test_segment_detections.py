"""Masks of detections become a label image and instances, exactly."""

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
    numbers = None if instances is None else np.tile(np.array(instances, np.int16), (4, 1))
    return Segmented(label_ids, numbers)


def test_prompts_are_painted_over_another_segmenter() -> None:
    top = segmented(found((0, 0.6, mask(2, 3)), (1, 0.6, mask(6))), IDS, 0.2, (4, 8))
    both = painted_over(base({7: [0, 1], 184: [2, 3, 4]}, [0, 0, 3, 3, -1, -1, -1, -1]), top)
    np.testing.assert_array_equal(both.label_ids[0], [7, 7, 201, 201, 184, -1, 7, -1])
    assert both.instances is not None
    np.testing.assert_array_equal(both.instances[0], [2, 2, 0, 0, -1, -1, 1, -1])
