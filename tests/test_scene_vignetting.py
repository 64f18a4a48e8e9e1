"""The light that a lens loses is found from tracks, and taken out of the photos."""

import json
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from conftest import orbit
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from sagesplat.core.config import SceneConfig, TrainConfig
from sagesplat.core.errors import RunError
from sagesplat.core.events import StageDone
from sagesplat.demo.capture import make_capture
from sagesplat.demo.wild import Wild
from sagesplat.io.typed import convert_as
from sagesplat.run.capture import fingerprint
from sagesplat.run.job import Job
from sagesplat.run.run_dir import RunDir
from sagesplat.scene import describe, load_scene
from sagesplat.scene.images import Photos, load_photo
from sagesplat.scene.scene import Camera, Points, Scene, View, Vignetting
from sagesplat.scene.stored import read_scene, write_scene
from sagesplat.scene.vignetting import corrected, light
from sagesplat.scene.vignetting_fit import estimate_vignetting, with_vignetting
from sagesplat.stages.noticed import noticed
from sagesplat.stages.scene import open_scene
from sagesplat.train.trainer import view_updates

LENS = Vignetting((-0.4, -0.1), 0.5)
SIDE, VIEWS = 48, 12


def camera(width=SIDE, height=SIDE, focal=0.9 * SIDE, centre=None) -> Camera:
    cx, cy = centre or (width / 2, height / 2)
    K = np.array([[focal, 0, cx], [0, focal, cy], [0, 0, 1]], np.float32)
    return Camera(np.eye(4, dtype=np.float32), K, width, height)


def stored(light: np.ndarray) -> np.ndarray:
    """sRGB in [0, 1] of linear light."""
    curve = 1.055 * np.maximum(light, 1e-9) ** (1 / 2.4) - 0.055
    return np.where(light < 0.0031308, 12.92 * light, curve).clip(0, 1)


def as_bytes(light: np.ndarray) -> np.ndarray:
    return (255 * stored(light) + 0.5).astype(np.uint8)


def patches(
    lens: Vignetting | None, gains: np.ndarray, noise: float = 0.02
) -> tuple[Scene, list[np.ndarray]]:
    """Photos [V] of 4 px patches that lie elsewhere in each, of points whose colour is known."""
    rng, cells = np.random.default_rng(0), SIDE // 4
    colours = rng.uniform(0.05, 0.6, (cells * cells, 3))
    share = np.ones((SIDE, SIDE)) if lens is None else light(lens, camera())
    uv, photos = [], []
    for gain in gains:
        place = rng.permutation(cells * cells)
        grid = np.empty((cells * cells, 3))
        grid[place] = colours * gain * np.exp(rng.normal(0, noise, colours.shape))
        photo = grid.reshape(cells, cells, 3).repeat(4, 0).repeat(4, 1)
        photos.append(as_bytes(photo * share[..., None]))
        uv.append(4 * np.stack([place % cells, place // cells], 1) + 2.0)
    n = len(colours)
    points = Points(
        np.zeros((n, 3), np.float32), np.zeros((n, 3), np.uint8), np.tile(np.arange(n), len(gains)),
        np.repeat(np.arange(len(gains), dtype=np.int32), n), np.concatenate(uv).astype(np.float32),
    )  # fmt: skip
    views = tuple(
        View(f"{i}", replace(camera(), w2c=at.w2c), Path(f"{i}.jpg"))
        for i, at in enumerate(orbit(len(gains), SIDE, SIDE))
    )
    return Scene("patches", Path(), views, points, test_every=0), photos


def test_light_falls_from_the_axis_to_the_reach_and_stays_there():
    share = light(LENS, camera(64, 48, 40, centre=(20, 30)))
    assert share[30, 20] == pytest.approx(1, abs=1e-3)
    t = (((63.5 - 20) / 40) ** 2 + ((30.5 - 30) / 40) ** 2) / LENS.reach
    assert t > 1
    assert share[30, 63] == pytest.approx(np.exp(-0.5)) == pytest.approx(1 - LENS.lost)
    t = (((10.5 - 20) / 40) ** 2 + ((5.5 - 30) / 40) ** 2) / LENS.reach
    assert share[5, 10] == pytest.approx(np.exp(-0.4 * t - 0.1 * t * t), rel=1e-5)


@given(st.integers(0, 2**32 - 1), st.floats(-0.9, 0), st.floats(-0.2, 0.1))
def test_correction_undoes_the_lens(seed, a, b):
    lens, at = Vignetting((a, b), 0.5), camera(16, 12, 14)
    scene = np.random.default_rng(seed).uniform(0.02, 0.9, (12, 16, 3))
    found = corrected(as_bytes(scene * light(lens, at)[..., None]), lens, at)
    assert np.abs(found.astype(int) - as_bytes(scene)).max() <= 3  # of bytes that were rounded when darker


def test_the_lens_is_found_among_exposures():
    gains = 2 ** np.random.default_rng(1).uniform(-0.7, 0.7, (VIEWS, 1))
    scene, photos = patches(LENS, gains)
    found = estimate_vignetting(scene, photos)
    assert found is not None
    np.testing.assert_allclose(light(found, camera()), light(LENS, camera()), atol=0.03)


@pytest.mark.parametrize("lens", [None, Vignetting((-0.03, 0.0), 0.5)])
def test_no_lens_is_found_where_there_is_none(lens):
    scene, photos = patches(lens, 2 ** np.random.default_rng(2).uniform(-0.5, 0.5, (VIEWS, 3)))
    assert estimate_vignetting(scene, photos) is None


def test_no_lens_is_found_in_few_or_no_tracks():
    scene, photos = patches(LENS, np.ones((VIEWS, 1)))
    few_points = np.flatnonzero(scene.points.track_points < 99)
    for some in (np.zeros(0, np.int64), np.arange(0, len(scene.points.track_views), 12), few_points):
        names = ("track_points", "track_views", "track_uv")
        tracks = {name: getattr(scene.points, name)[some] for name in names}
        assert estimate_vignetting(replace(scene, points=replace(scene.points, **tracks)), photos) is None


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    folder = tmp_path_factory.mktemp("lens")
    make_capture(folder / "capture", views=16, width=96, height=72, wild=Wild(vignetting=0.4))
    return folder / "capture"


def test_a_capture_is_read_without_its_vignetting(capture):
    scene = load_scene(capture, vignetting=True)
    found = scene.views[0].vignetting
    assert found is not None
    assert found.lost == pytest.approx(0.35, abs=0.08)  # of 0.4, before the camera's tone curve
    plain, flat = (load_photo(replace(scene.views[0], vignetting=v)).astype(float) for v in (None, found))
    truth = np.array(Image.open(capture / "truth" / "images" / scene.views[0].name), float)
    corner = np.s_[:12, :12]
    assert abs((flat - truth)[corner].mean()) < 0.4 * abs((plain - truth)[corner].mean())
    assert ("vignetting", f"{found.lost:.0%} of the light is lost in the corners, corrected") in describe(
        scene
    )
    assert fingerprint(scene) != fingerprint(with_vignetting(scene, None))


def test_the_scene_of_a_run_keeps_what_was_found(capture, tmp_path, monkeypatch):
    lines: list[str] = []
    job = Job(RunDir(tmp_path / "run"), lambda e: lines.extend(e.lines) if isinstance(e, StageDone) else None)
    open_scene(job, capture, SceneConfig(vignetting=True))
    assert any(line.endswith("of the light in the corners: the photos are corrected") for line in lines)
    monkeypatch.setattr("sagesplat.scene.estimate_vignetting", None)  # not estimated again
    open_scene(Job(job.run, lambda _: None), capture, SceneConfig(vignetting=True))
    scene = Job(job.run, lambda _: None).given_scene
    found = scene.views[-1].vignetting
    assert found is not None
    assert job.given_scene.views[0].vignetting == found
    np.testing.assert_array_equal(job.photos[0], corrected(
        load_photo(replace(scene.views[0], vignetting=None)), found, scene.views[0].camera
    ))  # fmt: skip
    assert noticed(job) == (f"vignetting of {100 * found.lost:.0f} % taken out of the photos",)
    write_scene(tmp_path / "part.npz", scene)
    assert {view.vignetting for view in read_scene(tmp_path / "part.npz").views} == {found}


def test_training_tells_of_a_lens_that_nobody_corrected(capture):
    scene = load_scene(capture)
    config = TrainConfig(max_steps=10)
    (line,) = view_updates(scene, Photos(scene.views), config)[1]
    assert "--vignetting" in line
    assert view_updates(scene, Photos(scene.views), replace(config, exposure="off"))[1] == []
    known = with_vignetting(scene, estimate_vignetting(scene, Photos(scene.views)))
    assert view_updates(known, Photos(known.views), config)[1] == []


@pytest.mark.parametrize(
    "made",
    [{}, {"coefficients": [1, "2"], "reach": 1}, {"coefficients": [1, 2], "reach": 0},
     {"coefficients": [1, 99], "reach": 1}, {"coefficients": [float("nan"), 2], "reach": 1}],
)  # fmt: skip
def test_a_damaged_record_is_refused(capture, tmp_path, made):
    with pytest.raises(ValueError, match=r"xpected|missing|out of range"):
        convert_as(made, Vignetting)
    assert convert_as(json.loads(json.dumps(asdict(LENS))), Vignetting) == LENS
    job = Job(RunDir(tmp_path / "run"), lambda _: None)
    open_scene(job, capture, SceneConfig())
    kept = json.loads(job.run.scene.read_text())
    job.run.scene.write_text(json.dumps(kept | {"vignetting": made}))
    with pytest.raises(RunError, match="not the scene of a run"):
        _ = Job(job.run, lambda _: None).given_scene


def test_light_does_not_depend_on_the_size_of_the_photo():
    large = camera(96, 96, 80)
    np.testing.assert_allclose(
        light(LENS, large).reshape(48, 2, 48, 2).mean((1, 3)), light(LENS, large.resized(48, 48)), atol=3e-3
    )


def test_black_and_saturated_pixels_stay():
    photo = np.zeros((12, 16, 3), np.uint8)
    photo[:, 8:] = 255
    np.testing.assert_array_equal(corrected(photo, LENS, camera(16, 12, 14)), photo)
