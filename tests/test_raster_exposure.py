"""A photo's colours from those of a rendering: against plain torch, finite differences, and saturation."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from conftest import pinhole, random_gaussians

from sagesplat.raster import expose, rasterize

E = np.array([[1.2, 0.05, -0.02, 0.03], [-0.04, 0.9, 0.03, -0.02], [0.01, 0.02, 1.1, 0.01]], np.float32)


def images(height: int = 37, width: int = 45):
    generator = torch.Generator().manual_seed(0)
    rgb = torch.rand(height, width, 3, generator=generator) * 1.3
    photo = (rgb + 0.2 * torch.rand(height, width, 3, generator=generator) - 0.1).clamp(0, 1)
    return rgb, (photo * 255).round() / 255, torch.randn(height, width, 3, generator=generator)


@pytest.mark.parametrize("limited", [False, True])
def test_kernels_against_torch(limited):
    rgb, photo, grad = images()
    found = []
    for dtype in (torch.float32, torch.float64):  # of the latter torch's own operations are used
        x = rgb.to(dtype, copy=True).requires_grad_()
        matrix = torch.tensor(E, dtype=dtype, requires_grad=True)
        out = expose(x, matrix, photo.to(dtype) if limited else None)
        out.backward(grad.to(dtype))
        found.append([out.detach(), x.grad, matrix.grad])
    for ours, plain in zip(*found, strict=True):
        torch.testing.assert_close(ours.double(), plain.double(), rtol=1e-5, atol=2e-4)


def test_where_a_photo_is_saturated_the_scene_may_be_brighter():
    rgb = torch.tensor([[[1.5, 0.5, 0.7]]]).requires_grad_()
    photo = torch.tensor([[[1.0, 0.5, 1.0]]])
    out = expose(rgb, torch.eye(3, 4), photo)
    out.sum().backward()
    assert out.tolist() == [[[1.0, 0.5, pytest.approx(0.7)]]]  # what is too dark is still wrong
    assert rgb.grad is not None
    assert rgb.grad.tolist() == [[[0.0, 1.0, 1.0]]]


def test_bytes_are_taken_as_photos_on_a_gpu():
    rgb, photo, _ = images()
    eight = (photo * 255).round().to(torch.uint8)
    plain = expose(rgb.double(), torch.tensor(E), photo.double())
    torch.testing.assert_close(expose(rgb.double(), torch.tensor(E), eight), plain)


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_a_camera_exposes_its_picture(backend):
    g, camera = random_gaussians(40), pinhole()
    neutral = rasterize(g, camera, background=torch.tensor([0.2, 0.4, 0.6]), backend=backend)
    exposed = replace(camera, exposure=E)
    render = rasterize(g, exposed, background=torch.tensor([0.2, 0.4, 0.6]), backend=backend)
    expected = neutral.rgb.double() @ torch.tensor(E[:, :3]).double().T + torch.tensor(E[:, 3]).double()
    torch.testing.assert_close(render.rgb.double(), expected, atol=2e-6, rtol=0)
    torch.testing.assert_close(render.alpha, neutral.alpha)
    assert exposed.neutral.exposure is None
    assert exposed.resized(20, 10).exposure is E


def test_gradients_of_the_gaussians_go_through_the_exposure():
    g, camera = random_gaussians(30), replace(pinhole(48, 32), exposure=E)
    grads = []
    for backend in ("cpu", "reference"):
        leaves = {name: p.detach().clone().requires_grad_() for name, p in g.parameters().items()}
        render = rasterize(replace(g, **leaves), camera, backend=backend)
        (render.rgb.double() ** 2).sum().backward()
        grads.append({name: leaf.grad for name, leaf in leaves.items()})
    for name, ours in grads[0].items():
        scale = float(grads[1][name].abs().max())  # type: ignore
        torch.testing.assert_close(ours, grads[1][name], atol=2e-4 * scale, rtol=1e-3)
