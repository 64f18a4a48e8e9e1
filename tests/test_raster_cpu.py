"""The CPU backend, and where it can be had the CUDA one, against the float64 oracle: images, features, radii
and all gradients.
"""

from dataclasses import replace

import gsplat_standin
import pytest
import torch
from conftest import pinhole, random_gaussians, render_with_gradients

from sagesplat.core.gaussians import PARAMETERS, Gaussians
from sagesplat.raster import Backend, rasterize, set_threads
from sagesplat.scene.scene import Camera

# of images, and of gradients relative to a parameter's largest; a GPU computes with fast math
TOLERANCES = {"cpu": (3e-6, 1e-5), "cuda": (3e-6, 1e-5), "device": (1e-4, 1e-3)}


@pytest.fixture(params=["cpu", "stand-in", "device"])
def backend(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """The cpu backend; cuda over gsplat's torch code; cuda on a real device, where there is one."""
    if request.param == "stand-in":
        gsplat_standin.install(monkeypatch)
        return "cuda"
    if request.param == "device":
        gsplat_standin.use_device(monkeypatch)
    return request.param


def assert_agree(
    g: Gaussians, camera: Camera, backend: str = "cpu", *, image: float = 0, gradient: float = 0, **options
):
    image, gradient = (a or b for a, b in zip((image, gradient), TOLERANCES[backend], strict=True))
    named: Backend = "cpu" if backend == "cpu" else "cuda"
    expected, expected_grads = render_with_gradients(g, camera, "reference", **options)
    actual, actual_grads = render_with_gradients(g, camera, named, **options)
    assert actual.rgb.dtype == torch.float32
    assert (actual.rgb - expected.rgb).abs().max() < image
    assert (actual.alpha - expected.alpha).abs().max() < image
    assert (actual.features is None) == (expected.features is None)
    if actual.features is not None and expected.features is not None:
        assert actual.features.shape == expected.features.shape
        assert (actual.features - expected.features).abs().max() < image
    drawn = actual.radii > 0
    radii, wanted = actual.radii[drawn].double(), expected.radii[drawn]
    if named == "cuda":  # rounded up there
        assert ((radii - wanted > -1e-4) & (radii - wanted < 1 + 1e-4)).all()
    else:
        torch.testing.assert_close(radii, wanted, rtol=1e-5, atol=1e-5)
    means2d = actual.means2d[drawn].double().cpu()
    torch.testing.assert_close(means2d, expected.means2d[drawn], rtol=1e-5, atol=1e-4)
    assert actual_grads.keys() == expected_grads.keys()
    for name, wanted in expected_grads.items():
        largest = wanted.abs().max() if wanted.numel() else torch.ones(())
        error = (actual_grads[name].double().cpu() - wanted.double()).abs().max() if wanted.numel() else 0
        assert error <= gradient * largest, name
    return actual, actual_grads


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_agrees_with_the_oracle(degree, antialiased, backend):
    g = random_gaussians(80, seed=degree, degree=degree)
    background = torch.tensor([0.2, 0.3, 0.4])
    _, grads = assert_agree(
        g, pinhole(50, 38), backend, background=background, antialiased=antialiased, pose=True
    )
    for name in ("means", "quats", "log_scales", "logit_opacities", "sh0", "means2d", "pose"):
        assert grads[name].abs().max() > 1e-3, name  # something was compared


@pytest.mark.parametrize("channels", [1, 3, 4, 7, 40])
def test_features_blend_like_colours_over_zero(channels, backend):
    features = torch.randn(120, channels, generator=torch.Generator().manual_seed(channels))
    render, grads = assert_agree(
        random_gaussians(120, seed=5, degree=1),
        pinhole(45, 33),
        backend,
        features=features,
        background=torch.tensor([0.9, 0.1, 0.5]),
    )
    assert render.features is not None
    assert render.features.shape == (33, 45, channels)
    assert grads["features"].abs().max() > 1e-3


@pytest.mark.parametrize("size", [(16, 16), (33, 17), (5, 3), (1, 1), (1, 40)])
def test_any_image_size(size, backend):
    # translucent: where light runs out, gsplat stops one Gaussian earlier
    assert_agree(random_gaussians(60, seed=1, degree=1, logit=-3.0), pinhole(*size), backend)


def test_harmonics_above_the_asked_degree_are_ignored(backend):
    g = random_gaussians(80, seed=2)
    render, grads = assert_agree(g, pinhole(), backend, sh_degree=1)
    assert (grads["shN"][:, 3:] == 0).all()
    assert (grads["shN"][:, :3] != 0).any()
    full, _ = render_with_gradients(g, pinhole(), sh_degree=9)  # more than there are: all there are
    default, _ = render_with_gradients(g, pinhole())
    assert torch.equal(full.rgb, default.rgb)
    assert not torch.equal(full.rgb, render.rgb)


def test_a_jacobian_clamped_outside_the_image(backend):
    g = random_gaussians(80, seed=3, degree=1, log_scale=-1.0)
    g.means[:, 0] *= 6  # most centres lie outside
    g.means[:, 2] = g.means[:, 2].clamp_min(1.0)
    render, _ = assert_agree(g, pinhole(60, 40), backend, pose=True)
    clamped = ((render.means2d[:, 0].cpu() - 30).abs() > 1.3 * 30) & (render.radii > 0)
    assert clamped.sum() > 3


def test_an_opaque_pile_stops_early():
    g = random_gaussians(300, seed=4, degree=0, log_scale=0.3, logit=4.0)
    g.means[:, 2] = torch.linspace(2, 9, 300)
    render, grads = assert_agree(g, pinhole(40, 40), gradient=1e-4)
    assert render.alpha.min() > 1 - 1e-3
    assert (render.radii[200:] > 0).all()  # they would be seen
    assert (grads["sh0"][200:] == 0).all()  # and are hidden by those in front


@pytest.mark.threads
def test_same_bits_twice_and_with_any_number_of_threads():
    g, camera = random_gaussians(3000, seed=6, degree=1), pinhole(200, 120)
    features = torch.rand(3000, 4, generator=torch.Generator().manual_seed(1))
    results = []
    for threads in (1, 1, 2):
        assert set_threads(threads) == threads
        results.append(render_with_gradients(g, camera, features=features))
    first, first_grads = results[0]
    for render, grads in results[1:]:
        assert torch.equal(render.rgb, first.rgb)
        assert torch.equal(render.alpha, first.alpha)
        assert torch.equal(render.features, first.features)
        assert all(torch.equal(grads[name], first_grads[name]) for name in first_grads)


@pytest.mark.parametrize("count", [3, 8, 13])
def test_the_gradient_of_the_pose_of_few_gaussians(count, backend):
    _, grads = assert_agree(random_gaussians(count, seed=5, logit=2.0), pinhole(), backend, pose=True)
    assert (grads["pose"] != 0).all()


def test_the_pose_changes_no_other_gradient():
    g, trainable = random_gaussians(300, seed=8), torch.arange(300) % 4 > 0
    with_pose, without = (
        render_with_gradients(g, pinhole(), pose=pose, trainable=trainable)[1] for pose in (True, False)
    )
    moved = with_pose.pop("pose")
    for name, grad in without.items():
        assert torch.equal(with_pose[name], grad), name
    everything = render_with_gradients(g, pinhole(), pose=True)[1]["pose"]
    assert torch.equal(moved, everything)  # Gaussians that are not trainable show where the camera is, too


@pytest.mark.parametrize("names", [("means", "sh0"), ("means", "sh0", "shN")])
def test_gradients_of_no_gaussians(names):
    g = random_gaussians(9, degree=1).select(torch.zeros(0, dtype=torch.long))
    values = {name: getattr(g, name).clone().requires_grad_() for name in names}
    rgb = rasterize(replace(g, **values), pinhole(), backend="cpu").rgb
    grads = torch.autograd.grad(rgb.sum(), list(values.values()))
    assert [grad.shape for grad in grads] == [value.shape for value in values.values()]


def test_the_order_of_the_rows_does_not_matter():
    g, camera = random_gaussians(400, seed=7, degree=2), pinhole(90, 70)
    order = torch.randperm(400, generator=torch.Generator().manual_seed(2))
    render, grads = render_with_gradients(g, camera)
    shuffled, shuffled_grads = render_with_gradients(g.select(order), camera)
    assert (render.rgb - shuffled.rgb).abs().max() < 1e-6
    assert torch.equal(render.radii[order], shuffled.radii)
    for name, grad in grads.items():
        assert (grad[order] - shuffled_grads[name]).abs().max() <= 1e-6 * grad.abs().max(), name


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("name", ["logit_opacities", "sh0"])
def test_the_gradient_of_one_parameter_alone_is_that_beside_the_others(name, antialiased):
    g, camera = random_gaussians(60, logit=1.0), pinhole(50, 40)
    found = []
    for names in (PARAMETERS, (name,)):
        leaf = replace(g, **{n: getattr(g, n).clone().requires_grad_() for n in names})
        rgb = rasterize(leaf, camera, antialiased=antialiased, backend="cpu").rgb
        found += torch.autograd.grad(rgb.square().sum(), getattr(leaf, name))
    assert found[0].abs().max() > 0
    torch.testing.assert_close(found[1], found[0], rtol=1e-5, atol=1e-6)
