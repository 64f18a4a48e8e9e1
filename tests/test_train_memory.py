"""The prediction of a training's memory, and the cap that follows from a limit."""

from dataclasses import replace
from pathlib import Path

import pytest
from conftest import random_gaussians, write_capture

from sagesplat.core.config import TrainConfig
from sagesplat.core.errors import RunError
from sagesplat.io.files import write_text
from sagesplat.scene.scene import Scene
from sagesplat.train import memory


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return write_capture(tmp_path_factory.mktemp("capture") / "c", random_gaussians(150, degree=0))


def test_the_prediction_grows_with_what_is_asked_for(scene: Scene) -> None:
    def needed(config: TrainConfig, **options: int) -> int:
        return memory.fit(scene, config, 64 * memory.GIB, **options).needed

    many = TrainConfig(strategy="mcmc", max_gaussians=10**6)
    assert 1.9e9 < needed(many) < 2.6e9
    assert needed(replace(many, sh_degree=0)) < 0.5 * needed(many)
    assert needed(many, processes=3) == pytest.approx(3 * needed(many), abs=3)
    assert needed(TrainConfig(max_gaussians=10**6)) > needed(TrainConfig())  # the photos set that cap
    fitted = memory.fit(scene, many, 64 * memory.GIB)
    assert fitted.config == many
    assert str(fitted) == "needs about 2.2 GiB at the densification cap of 1,000,000 Gaussians, of 64.0"


def test_the_cap_lowers_itself(scene: Scene) -> None:
    many = TrainConfig(strategy="mcmc", max_gaussians=10**6)
    fitted = memory.fit(scene, many, memory.GIB)
    assert 250_000 < fitted.lowered < 400_000
    assert fitted.config == replace(many, max_gaussians=fitted.lowered)
    assert memory.fit(scene, fitted.config, memory.GIB).lowered == fitted.lowered
    assert memory.fit(scene, fitted.config, memory.GIB).needed <= memory.GIB
    line = f"the cap is lowered to {fitted.lowered:,}, to fit into 1.0"
    assert line in str(fitted)
    on = memory.fit(scene, many, 64 * memory.GIB, began=fitted.lowered)  # elsewhere, after a crash
    assert on.config == fitted.config
    assert "as training began" in str(on)


def test_what_cannot_fit_is_one_line_before_the_run(scene: Scene) -> None:
    with pytest.raises(RunError, match=r"150 Gaussians need about 0\.4 GiB, the limit is 0\.1; raise --mem"):
        memory.fit(scene, TrainConfig(), memory.GIB // 8)
    with pytest.raises(RunError, match=r"5,000,000 Gaussians need about 9\.\d GiB, the limit is 4\.0"):
        memory.fit(scene, TrainConfig(), 4 * memory.GIB, began=5 * 10**6)


def test_photos_leave_room(scene: Scene) -> None:
    assert memory.photo_cache(64 * memory.GIB) == memory.GIB
    assert memory.photo_cache(memory.GIB) == memory.GIB // 4
    assert 0 < memory.photo_cache() <= memory.GIB


@pytest.mark.parametrize(
    ("groups", "files", "limits"),
    [
        (
            "0::/a/b\n",
            {"memory.max": "9000\n", "a/memory.max": "4000\n", "a/b/memory.max": "max\n"},
            [4000, 9000],
        ),
        (
            "4:cpu:/x\n3:memory,hugetlb:/docker/7\n",
            {"memory/docker/7/memory.limit_in_bytes": "7000\n", "memory/memory.limit_in_bytes": "8000"},
            [7000, 8000],
        ),
        (None, {}, []),
    ],
    ids=["v2", "v1", "nothing"],
)
def test_limits_of_containers(tmp_path: Path, groups, files, limits) -> None:
    if groups is not None:
        write_text(tmp_path / "proc/self/cgroup", groups)
    for name, text in files.items():
        write_text(tmp_path / "sys/fs/cgroup" / name, text)
    assert sorted(memory._cgroup_limits(tmp_path))[:-1] == limits
    assert 10**8 < memory.default_limit() < 10**15
