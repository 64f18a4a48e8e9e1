"""Evaluation: the columns of both qualities, equal levels beside the plans, memory."""

import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from conftest import random_gaussians, write_capture

from sagesplat.adapt import evaluate as module
from sagesplat.adapt.evaluate import (
    QUALITIES,
    UNIFORM,
    Evaluation,
    evaluate,
    fidelity_by_label,
    read_evaluation,
)
from sagesplat.adapt.observe import TOTAL, RenderedLabels
from sagesplat.adapt.plan import Choice, Plan
from sagesplat.core.gaussians import Gaussians
from sagesplat.scene.scene import Scene


@dataclass(frozen=True)
class Levels:
    """Level k has k thirds of each category."""

    whole: Gaussians

    levels = (1, 2, 3)
    recovering = frozenset()

    def part(self, levels: dict[int, int]) -> Gaussians:
        ids = self.whole.label_ids.tolist()
        keep = [i for i, label in enumerate(ids) if i % 9 // 3 < levels[label]]
        parts = {name: values[keep] for name, values in self.whole.parameters().items()}
        return Gaussians(**parts, label_ids=self.whole.label_ids[keep])

    def load(self, level: int) -> Gaussians:
        return self.part(dict.fromkeys((-1, 3, 184), level))

    compose = part


def plan(target: float, level: int, quality) -> Plan:
    choices = tuple(Choice(label, level, 0.5, np.nan, 1, "ok") for label in (-1, 3, 184))
    return Plan(target, None, choices, 0.95, quality=quality)


@pytest.fixture(scope="module")
def capture(tmp_path_factory) -> tuple[Scene, Levels, dict[int, np.ndarray]]:
    truth = random_gaussians(120, degree=1, logit=2.0)
    scene = write_capture(tmp_path_factory.mktemp("capture") / "c", truth)
    photos = dict.fromkeys(range(len(scene.views)), np.full((32, 48, 3), 128, np.uint8))
    return replace(scene, test_every=4), Levels(truth), photos


PLANS = [plan(0.9, 3, "fidelity"), plan(0.7, 1, "fidelity"), plan(0.7, 2, "ssim")]


def measured(capture, **options) -> Evaluation:
    scene, ladder, photos = capture
    masks = RenderedLabels(ladder.whole, "cpu")
    return evaluate(
        scene, photos, masks, ladder, PLANS, lambda plan, *_: float(QUALITIES.index(plan.quality)),
        backend="cpu", uniform=[1, 3], **options,
    )  # fmt: skip


def test_both_qualities_are_measured(capture, tmp_path: Path):
    table = measured(capture)
    full, low, photo = (table.of(one) for one in PLANS)
    assert full.fidelity == pytest.approx(1, abs=1e-6)  # the full model against itself
    assert (low.fidelity[low.label_id == TOTAL] < 0.99).all()
    assert full.ssim[full.label_id == TOTAL] == pytest.approx(full.full_ssim[full.label_id == TOTAL])
    whole = full.label_id == TOTAL
    assert full.ms_ssim[whole] == pytest.approx(full.full_ms_ssim[whole])
    assert np.isnan(full.ms_ssim[~whole]).all()
    assert np.isnan(full.flip).all()  # nobody asked
    assert set(low.predicted[low.label_id != TOTAL]) == {0}
    assert set(photo.predicted[photo.label_id != TOTAL]) == {1}  # the same target, of the other quality
    np.testing.assert_array_equal(low.of_own_quality().ssim, low.fidelity)
    np.testing.assert_array_equal(photo.of_own_quality().ssim, photo.ssim)
    uniform = table.uniform("fidelity")
    assert uniform[3] == pytest.approx(1, abs=1e-6)
    assert uniform[1] == pytest.approx(low.fidelity[low.label_id == TOTAL].mean())
    assert UNIFORM not in np.concatenate([one.label_id for one in (full, low, photo)])
    table.write_csv(tmp_path / "e.csv")
    np.testing.assert_array_equal(read_evaluation(tmp_path / "e.csv").fidelity, table.fidelity)


def test_further_similarities_are_of_whole_images_of_plans(capture):
    table = measured(capture, others={"flip": lambda image, photo: float(np.abs(image - photo).mean())})
    low = table.of(PLANS[1])
    whole = low.label_id == TOTAL
    assert (low.flip[whole] > 0).all()
    assert np.isfinite(low.full_flip[whole]).all()
    assert np.isnan(low.flip[~whole]).all()
    assert np.isnan(low.ms_ssim).all()


def test_images_of_the_full_model_take_bounded_memory(capture, monkeypatch):
    """What does not fit is rendered again, and measures the same."""
    before = measured(capture)
    monkeypatch.setattr(sys.modules[module.__name__], "KEPT", 1)
    np.testing.assert_array_equal(measured(capture).fidelity, before.fidelity)


def test_too_little_of_a_category_is_not_measured(capture, monkeypatch):
    assert np.isfinite(measured(capture).fidelity).all()
    monkeypatch.setattr(sys.modules[module.__name__], "PROMISED_SHARE", 0.9)
    table = measured(capture)
    parts = table.select((table.label_id != TOTAL) & (table.label_id != UNIFORM))
    assert np.isnan(parts.fidelity).all()
    assert np.isfinite(table.select(table.label_id == TOTAL).fidelity).all()
    assert np.isfinite(parts.ssim).all()


def test_fidelity_by_label():
    image, other = np.zeros((2, 40, 40, 3), np.float32)
    other[:, 20:] = 0.5
    labels = np.repeat(np.array([[3] * 10 + [7] * 30], np.int16), 40, 0)
    found = fidelity_by_label(image, other, labels, 500)
    assert set(found) == {7, TOTAL}
    assert found[7] < found[TOTAL] < 1
