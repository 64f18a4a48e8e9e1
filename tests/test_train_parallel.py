"""Processes that train together: the result of one process with as many photos a step."""

import signal
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from test_train_early_stopping import CONFIG, capture  # noqa: F401 - a fixture

from sagesplat.core.config import TrainConfig
from sagesplat.core.errors import RunError
from sagesplat.core.gaussians import PARAMETERS
from sagesplat.train import parallel
from sagesplat.train.events import LabelFrozen, LevelSaved, Resumed, Step, Trained
from sagesplat.train.parallel import train_together
from sagesplat.train.trainer import train

SHORT = replace(CONFIG, max_steps=40, level_every=10, refine_every=6)


def run(events):
    events = list(events)
    assert isinstance(events[-1], Trained)
    return events, events[-1]


@pytest.mark.parametrize(
    "config",
    [
        replace(SHORT, poses=True, freeze_at=0.45),
        pytest.param(replace(SHORT, strategy="mcmc", batch=4), marks=pytest.mark.slow),
    ],
)
def test_two_processes_do_what_one_does_with_twice_the_batch(capture, tmp_path, config):  # noqa: F811
    scene, photos, masks, labels = capture
    alone = replace(config, batch=max(2, config.batch))
    events, one = run(train(scene, photos, labels, alone, masks=masks))
    together, two = run(
        train_together(2, 2, scene, photos, labels, config, masks=masks, folder=tmp_path, settings="s")
    )
    assert len(one.gaussians) == len(two.gaussians)
    assert one.frozen == two.frozen
    assert bool(one.frozen) == (config.freeze_at is not None)
    drawn = config.strategy == "mcmc"  # by lot: rounding may send a Gaussian elsewhere
    for name in PARAMETERS if not drawn else ():
        a, b = getattr(one.gaussians, name), getattr(two.gaussians, name)
        # sums in another order: rounding, which Adam magnifies where gradients are tiny
        assert float((a - b).abs().mean()) < 1e-3 * float(a.std()), name
    if config.poses:
        a, b = (end.per_view["pose"] for end in (one, two))
        assert a.counts.tolist() == b.counts.tolist()
        assert float((a.values - b.values).abs().max()) < 1e-2 * float(a.values.abs().max())
        assert float(a.values.abs().max()) > 0
    losses = [[e.loss for e in run if isinstance(e, Step)] for run in (events, together)]
    np.testing.assert_allclose(*losses, rtol=1e-2 if drawn else 2e-3)
    assert len([e for e in together if isinstance(e, LevelSaved) and e.path]) == 40 // 10
    assert [e.label_id for e in events if isinstance(e, LabelFrozen)] == [
        e.label_id for e in together if isinstance(e, LabelFrozen)
    ]


@pytest.mark.slow
def test_a_killed_pair_goes_on(capture, tmp_path):  # noqa: F811
    scene, photos, masks, labels = capture
    options = {"masks": masks, "settings": "s"}
    _, whole = run(train_together(2, 2, scene, photos, labels, SHORT, **options, folder=tmp_path / "a"))
    for event in train_together(2, 2, scene, photos, labels, SHORT, **options, folder=tmp_path / "b"):
        if isinstance(event, Step) and event.step == 25:
            break
    events, end = run(train_together(2, 2, scene, photos, labels, SHORT, **options, folder=tmp_path / "b"))
    assert events[0] == Resumed(20)
    assert len(end.gaussians) == len(whole.gaussians)
    for name in PARAMETERS:
        a, b = getattr(whole.gaussians, name), getattr(end.gaussians, name)
        assert float((a - b).abs().mean()) < 1e-3 * float(a.std()), name


@pytest.mark.slow
def test_a_process_that_cannot_go_on_says_why(capture, capfd):  # noqa: F811
    scene, _, masks, labels = capture
    config = TrainConfig(max_steps=20)
    with pytest.raises(RunError, match="process 1 of 2 ended with code 1; look at its message above"):
        list(train_together(2, 2, scene, Hungry(scene), labels, config, masks=masks))
    assert (
        "process 1: training did not begin: out of memory; lower --train.max-gaussians"
        in capfd.readouterr().err
    )


class Hungry:
    """Photos for which all processes but the first have no memory."""

    def __init__(self, scene, first=True):
        from sagesplat.scene.images import Photos

        self.photos, self.first = Photos(scene.views), first

    def __getitem__(self, row):
        if not self.first:
            raise MemoryError
        return self.photos[row]

    def __setstate__(self, state):
        self.__dict__ |= state | {"first": False}


def test_more_processes_than_gpus(capture, monkeypatch):  # noqa: F811
    monkeypatch.setattr(parallel.torch.cuda, "device_count", lambda: 1)
    with pytest.raises(RunError, match="--processes 2: this machine has 1 GPUs; lower it"):
        next(train_together(2, 2, *capture, backend="cuda"))


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no signal masks")
def test_the_others_do_not_hear_ctrl_c() -> None:
    """A terminal sends it to all: the first ends the others, which would only print tracebacks."""
    code = "import signal; print(signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, []))"
    with parallel._without_ctrl_c():
        assert subprocess.check_output([sys.executable, "-c", code]) == b"True\n"
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, [])


@pytest.mark.slow
def test_a_process_that_dies_is_named(capture):  # noqa: F811
    scene, _, masks, labels = capture
    with pytest.raises(RunError, match="process 1 of 2 ended with code"):
        list(train_together(2, 2, scene, Broken(scene), labels, TrainConfig(max_steps=20), masks=masks))


class Broken:
    """Photos that only the first process can read."""

    def __init__(self, scene):
        from sagesplat.scene.images import Photos

        self.photos = Photos(scene.views)

    def __getitem__(self, row):
        return self.photos[row]

    def __setstate__(self, state):
        raise SystemExit(7)
