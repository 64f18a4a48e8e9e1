"""LPIPS: its authors' values, a plain counterpart in float64, and weights that cannot be used."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.lib.stride_tricks import sliding_window_view
from PIL import Image

from sagesplat.core.errors import BackendUnavailable, DataError
from sagesplat.metrics.lpips import load_lpips, shapes

MODELS = Path(__file__).resolve().parents[2] / "shared" / "models"
NETS = {  # before each convolution: M = max pooling; after it: T = tap
    "alex": "c T M c T M c T c T c T",
    "vgg": "c c T M c c T M c c c T M c c c T M c c c T",
}


def random_weights(net, seed=0):
    """Weights that keep the features' size from layer to layer."""
    rng = np.random.default_rng(seed)
    weights = {}
    for name, shape in shapes(net).items():
        if name.startswith("lin"):
            weights[name] = rng.random(shape, np.float32)
        else:
            size = np.sqrt(2 / max(np.prod(shape[1:]), 200))
            weights[name] = (size * rng.standard_normal(shape, np.float32)).astype(np.float16)
    return weights


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("lpips")
    for net in NETS:
        np.savez(folder / f"lpips_{net}.npz", allow_pickle=False, **random_weights(net))
    return folder


def images(*shape, count=2, seed=0):
    return np.random.default_rng(seed).random((count, *shape, 3), np.float32)


def plain_features(image, net, weights, unit_range):
    """The taps in float64, a window at a time."""
    x = image.astype(float) if unit_range else image.astype(float) * 2 - 1
    x = (x - [-0.030, -0.088, -0.188]) / [0.458, 0.448, 0.450]
    k, taps = 0, []
    for step in NETS[net].split():
        if step == "c":
            weight, bias = (weights[f"conv{k}.{part}"].astype(float) for part in ("weight", "bias"))
            side = weight.shape[2]
            stride, padding = (4, 2) if side == 11 else (1, side // 2)
            x = np.pad(x, ((padding, padding), (padding, padding), (0, 0)))
            windows = sliding_window_view(x, (side, side), (0, 1))[::stride, ::stride]
            x = np.maximum(np.tensordot(windows, weight, ([2, 3, 4], [1, 2, 3])) + bias, 0)
            k += 1
        elif step == "M":
            side = 3 if net == "alex" else 2
            x = sliding_window_view(x, (side, side), (0, 1))[::2, ::2].max((-1, -2))
        else:
            taps.append(x / (np.sqrt((x * x).sum(-1, keepdims=True)) + 1e-10))
    return taps


@pytest.mark.parametrize(
    ("net", "size", "as_3dgs"),
    [("alex", (31, 60), False), ("alex", (70, 45), True), ("vgg", (19, 34), False)],
)
def test_the_plain_counterpart_agrees(folder, net, size, as_3dgs):
    x, y = images(*size)
    lpips, weights = load_lpips(net, folder, as_3dgs=as_3dgs), random_weights(net)
    taps = [plain_features(image, net, weights, as_3dgs) for image in (x, y)]
    plain = sum(
        (((a - b) ** 2) @ weights[f"lin{i}"]).mean() for i, (a, b) in enumerate(zip(*taps, strict=True))
    )
    assert lpips(x, y) == pytest.approx(plain, rel=1e-4)
    assert lpips(x, y) == lpips.distance(lpips.features(x), lpips.features(y))
    assert lpips(x, y) == pytest.approx(lpips(y, x), rel=1e-6)
    assert lpips(x, x.copy()) == 0
    assert abs(replace(lpips, as_3dgs=not as_3dgs)(x, y) / plain - 1) > 1e-3


@pytest.mark.parametrize(("net", "values"), [("alex", (0.7219, 0.1376)), ("vgg", (0.5686, 0.4217))])
def test_the_authors_values(net, values):
    if not (MODELS / f"lpips_{net}.npz").exists():
        pytest.skip("needs the weights beside the checkout")
    lpips = load_lpips(net, MODELS)
    names = ("ex_ref", "ex_p0", "ex_p1")
    photos = [np.asarray(Image.open(MODELS / "lpips_example" / f"{n}.png").convert("RGB")) for n in names]
    reference, *others = [lpips.features(photo.astype(np.float32) / 255) for photo in photos]
    assert [lpips.distance(reference, other) for other in others] == pytest.approx(values, abs=5e-4)


@pytest.mark.parametrize(("net", "smallest"), [("alex", 31), ("vgg", 16)])
def test_images_too_small_are_nan(folder, net, smallest):
    lpips = load_lpips(net, folder / f"lpips_{net}.npz")
    assert np.isfinite(lpips(*images(smallest, smallest)))
    for size in (smallest - 1, 50), (50, smallest - 1), (0, 0):
        assert np.isnan(lpips(*images(*size)))


@pytest.mark.usefixtures("unchecked_shapes")
def test_images_that_do_not_fit(folder):
    lpips = load_lpips("alex", folder)
    x, y = images(64, 64)[0], images(65, 64)[0]  # their features have the same shape
    with pytest.raises(ValueError, match=r"\(64, 64, 3\) and \(65, 64, 3\)"):
        lpips(x, y)
    with pytest.raises(ValueError, match=r"\(64, 64, 3\) and \(65, 64, 3\)"):
        lpips.distance(lpips.features(x), lpips.features(y))
    with pytest.raises(ValueError, match=r"\[H, W, 3\]"):
        lpips(x[..., 0], x[..., 0])


def test_weights_come_from_the_cache(folder, tmp_path, monkeypatch):
    monkeypatch.setenv("SAGESPLAT_CACHE", str(tmp_path))
    with pytest.raises(BackendUnavailable) as caught:
        load_lpips("alex")
    assert str(caught.value) == (
        f"{tmp_path}/lpips/lpips_alex.npz: no such file, but LPIPS needs it; "
        "run `sagesplat download lpips` or give --lpips FOLDER"
    )
    (tmp_path / "lpips").symlink_to(folder)
    assert load_lpips("alex").net == "alex"


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("conv1.bias", np.zeros(5, np.float16)),
        ("lin4", np.array([None] * 256, object)),
        ("lin2", np.full(384, np.nan, np.float32)),
    ],
)
def test_wrong_weights_are_one_line(tmp_path, name, value):
    weights = random_weights("alex") | {name: value}
    np.savez(tmp_path / "lpips_alex.npz", allow_pickle=value.dtype == object, **weights)
    assert_refused("alex", tmp_path)


def test_damaged_files_are_one_line(folder, tmp_path):
    path = tmp_path / "lpips_alex.npz"
    content = (folder / path.name).read_bytes()
    header = content.replace(b"'fortran_order': False", b"'fortran_order': (((((")  # numpy's parser gives up
    for bad in b"", content[: len(content) // 2], header:
        path.write_bytes(bad)
        assert_refused("alex", path)
    path.unlink()
    path.mkdir()
    assert_refused("alex", path)
    assert_refused("vgg", folder / "lpips_alex.npz")


def assert_refused(net, folder):
    with pytest.raises(DataError) as caught:
        load_lpips(net, folder)
    line = str(caught.value)
    assert "\n" not in line
    assert line.startswith(f"{folder}")
    assert f"not the weights of LPIPS {net}" in line
    assert "sagesplat download lpips" in line
