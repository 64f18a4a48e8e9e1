"""Compositions that calibrate fidelity: each is measured once, whatever rounds ask for."""

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from sagesplat.stages import fidelity


def test_no_composition_is_measured_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    measured: Counter[tuple[int, ...]] = Counter()

    def compositions_at(
        job: Any, cameras: Sequence[Any], planned: np.ndarray, stage: str, only: Any = None
    ) -> tuple[np.ndarray, np.ndarray]:
        for camera, of_view in zip(cameras, planned, strict=True):
            measured.update({(camera, *levels) for levels in of_view.tolist()})
        of_camera = np.array(cameras)[:, None, None]
        values = of_camera + 0.01 * np.concatenate([planned, planned.sum(2, keepdims=True)], 2)
        return values.astype(np.float32), np.array(cameras)[:, None] + np.arange(planned.shape[2])

    monkeypatch.setattr(fidelity, "compositions_at", compositions_at)
    cameras: Any = [10, 20, 30]
    compositions = fidelity.Compositions(None, cameras)  # pyright: ignore[reportArgumentType]
    rng = np.random.default_rng(0)
    rounds = [rng.integers(1, 4, (3, 13, 2)) for _ in range(4)]
    for planned in [*rounds, rounds[0]]:
        once = dict(measured)
        values, pixels = compositions.measure(planned)
        new = {key: n for key, n in measured.items() if n != once.get(key)}
        wanted, shown = compositions_at(None, cameras, planned, "")
        measured.clear()
        measured.update(once | new)
        np.testing.assert_array_equal(values, wanted)
        np.testing.assert_array_equal(pixels, shown)
    assert set(measured.values()) == {1}
    assert len(measured) == 3 * 9  # all pairs of three levels


def test_no_viewpoints_are_no_measurements() -> None:
    compositions = fidelity.Compositions(None, [])  # pyright: ignore[reportArgumentType]
    values, pixels = compositions.measure(np.zeros((0, 13, 2), np.int64))
    assert values.shape[:2] == (0, 13)
    assert len(pixels) == 0
