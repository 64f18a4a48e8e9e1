"""The CUDA backend: masks, frozen rows, weights, and what it says where it cannot run."""

import gc
import weakref
from dataclasses import replace
from pathlib import Path
from typing import Any

import gsplat_standin
import numpy as np
import pytest
import torch
from conftest import pinhole, random_gaussians, render_with_gradients
from test_raster_cpu import assert_agree, backend  # noqa: F401

from sagesplat.core.errors import BackendUnavailable, DataError, OutOfMemory
from sagesplat.core.extras import install
from sagesplat.raster import TILE, add_weights, blend, cuda, rasterize, resolve_backend

BACKGROUND = torch.tensor([0.2, 0.3, 0.4])
FEATURES = torch.randn(80, 5, generator=torch.Generator().manual_seed(0))
TRAINABLE = torch.arange(80) % 3 > 0
TILE_MASK = torch.tensor([[1, 0, 1, 0], [0, 1, 1, 0], [1, 1, 0, 1]], dtype=torch.bool)


@pytest.fixture
def standin(monkeypatch: pytest.MonkeyPatch) -> None:
    gsplat_standin.install(monkeypatch)


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize(
    "options",
    [
        {"features": FEATURES, "antialiased": True},
        {"tile_mask": TILE_MASK, "features": FEATURES},
        {"tile_mask": TILE_MASK.numpy()},
        {"trainable": TRAINABLE, "features": FEATURES, "tile_mask": TILE_MASK, "antialiased": True},
        {"trainable": torch.zeros(80, dtype=torch.bool)},
        {"pose": True, "trainable": TRAINABLE, "tile_mask": TILE_MASK, "features": FEATURES},
        {"pose": True, "antialiased": True},
    ],
    ids=lambda options: "-".join(options),
)
def test_options_agree_with_the_oracle(options, packed, backend, monkeypatch):  # noqa: F811
    if packed and backend == "cpu":
        pytest.skip("packed is gsplat's")
    monkeypatch.setattr(cuda, "PACKED", packed)
    g, camera = random_gaussians(80, seed=1), pinhole(57, 40)
    _, grads = assert_agree(g, camera, backend, background=BACKGROUND, **options)
    if "trainable" in options:
        grads.pop("pose", None)
        assert all((grad[~options["trainable"]] == 0).all() for grad in grads.values())
    else:
        assert all((grad != 0).any() for grad in grads.values())


def test_tiles_that_are_not_drawn_show_the_background(backend):  # noqa: F811
    options: dict[str, Any] = {
        "tile_mask": torch.zeros(3, 4, dtype=torch.bool),
        "background": BACKGROUND,
        "features": FEATURES,
    }
    named = "cpu" if backend == "cpu" else "cuda"
    render, grads = render_with_gradients(random_gaussians(80), pinhole(57, 40), named, **options)
    assert (render.rgb == BACKGROUND).all()
    assert (render.alpha == 0).all()
    assert render.features is not None
    assert (render.features == 0).all()
    assert all((grad == 0).all() for grad in grads.values())


@pytest.mark.parametrize("packed", [False, True])
def test_nothing_to_draw(packed, backend, monkeypatch):  # noqa: F811
    monkeypatch.setattr(cuda, "PACKED", packed)
    g = random_gaussians(20)
    behind = replace(g, means=g.means * torch.tensor([1.0, 1.0, -1.0]))
    faint = replace(g, logit_opacities=torch.full((20,), -40.0))
    named = "cpu" if backend == "cpu" else "cuda"
    for nothing in (g.select(torch.zeros(20, dtype=torch.bool)), behind, faint):
        for antialiased in (False, True):
            render, grads = render_with_gradients(
                nothing, pinhole(20, 10), named, background=BACKGROUND, antialiased=antialiased
            )
            assert (render.rgb == BACKGROUND).all()
            assert (render.alpha == 0).all()
            assert (render.radii == 0).all()
            assert (render.means2d == 0).all()
            assert all((grad == 0).all() for grad in grads.values())
        oracle = rasterize(nothing, pinhole(20, 10), background=BACKGROUND, backend="reference")
        assert (oracle.rgb == BACKGROUND).all()


def test_what_is_not_drawn_leaves_no_garbage(standin):
    g = random_gaussians(80, seed=2)
    g.means[::2, 2] *= -1
    render, grads = render_with_gradients(g, pinhole(), "cuda", antialiased=True)
    assert (render.radii[::2] == 0).all()
    assert (render.means2d[::2] == 0).all()
    assert all(torch.isfinite(grad).all() for grad in grads.values())


@pytest.mark.parametrize("packed", [False, True])
def test_what_1_6_changes(packed, standin, monkeypatch):
    """isect_tiles takes the shapes for exact tiles, and packed projections also say where cameras begin."""
    g, camera, gsplat = random_gaussians(80, seed=1), pinhole(), cuda.kernels()
    monkeypatch.setattr(cuda, "PACKED", packed)
    expected = rasterize(g, camera, backend="cuda").rgb
    project, intersect = gsplat.fully_fused_projection, gsplat.isect_tiles
    given = []

    def project_1_6(*arguments, **options):
        found = project(*arguments, **options)
        return (*found[:3], torch.tensor([0, len(found[2])]), *found[3:]) if packed else found

    def intersect_1_6(means2d, radii, depths, *sizes, conics, opacities):
        given.append((conics.shape, opacities.shape, means2d.shape))
        return intersect(means2d, radii, depths, *sizes)

    monkeypatch.setattr(gsplat, "fully_fused_projection", project_1_6)
    monkeypatch.setattr(gsplat, "isect_tiles", intersect_1_6)
    assert torch.equal(rasterize(g, camera, backend="cuda").rgb, expected)
    ((conics, opacities, means2d),) = given
    assert conics[:2] == opacities == means2d[:2]


def test_a_render_without_gradients(standin):
    with torch.no_grad():
        render = rasterize(random_gaussians(20), pinhole(), backend="cuda")
    assert not render.rgb.requires_grad
    assert not render.means2d.requires_grad
    assert rasterize(random_gaussians(20), pinhole(), backend="cuda").means2d.requires_grad is False


@pytest.mark.parametrize("trainable", [None, TRAINABLE])
def test_a_graph_that_nobody_walks_back_is_freed(trainable, standin):
    g = random_gaussians(80)
    g.means.requires_grad_()
    render = rasterize(g, pinhole(), backend="cuda", trainable=trainable)
    watched = weakref.ref(render.means2d)
    gc.disable()  # a cycle through C++ would not be found anyway
    try:
        del render
        assert watched() is None
    finally:
        gc.enable()


def test_gradients_of_two_backward_passes_add_up(standin):
    g = random_gaussians(40)
    g.means.requires_grad_()
    render = rasterize(g, pinhole(), backend="cuda")
    render.rgb.sum().backward(retain_graph=True)
    assert render.means2d.grad is not None
    once = render.means2d.grad.clone()
    render.rgb.sum().backward()
    torch.testing.assert_close(render.means2d.grad, 2 * once)


def test_a_masks_rows_are_found_once(monkeypatch):
    mask = torch.tensor([True, False, True])
    moving, still = cuda._rows(mask)
    assert (moving.tolist(), still.tolist()) == ([0, 2], [1])
    assert cuda._rows(mask)[0] is moving
    mask[0] = False
    assert cuda._rows(mask)[0].tolist() == [2]
    assert cuda._rows(torch.tensor([True, False, True]))[0] is not moving


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("columns", [3, 40])
def test_weights_are_those_of_the_cpu(columns, packed, standin, monkeypatch):
    monkeypatch.setattr(cuda, "PACKED", packed)
    g, camera = random_gaussians(60, seed=4, degree=0), pinhole(40, 30)
    columns_of = np.random.default_rng(0).integers(-1, columns, (30, 40))
    expected = np.full((60, columns), 0.5, np.float32)  # it adds
    actual, tensor = expected.copy(), torch.from_numpy(expected.copy())
    add_weights(g, camera, columns_of, expected, antialiased=True)
    cuda.add_weights(g, camera, columns_of, actual, antialiased=True)
    cuda.add_weights(g, camera, torch.from_numpy(columns_of), tensor, antialiased=True)
    np.testing.assert_allclose(actual, expected, atol=2e-5)
    np.testing.assert_array_equal(actual, tensor.numpy())
    assert (expected > 0.6).any()
    as_tensors = torch.full((60, columns), 0.5)
    add_weights(g, camera, torch.from_numpy(columns_of), as_tensors, antialiased=True)
    np.testing.assert_array_equal(as_tensors.numpy(), expected)


@pytest.mark.skipif(cuda.missing() is not None, reason=str(cuda.missing()))
def test_weights_on_the_device():
    g, camera = random_gaussians(60, seed=4, degree=0), pinhole(40, 30)
    there = replace(g, **{name: p.cuda() for name, p in g.parameters().items()})
    columns_of = np.random.default_rng(0).integers(-1, 3, (30, 40))
    expected, actual = np.zeros((60, 3), np.float32), np.zeros((60, 3), np.float32)
    add_weights(g, camera, columns_of, expected)
    add_weights(there, camera, columns_of, actual)
    np.testing.assert_allclose(actual, expected, rtol=1e-3, atol=1e-3)


# --- what it says where it cannot run -------------------------------------------------------------------


def test_tensors_on_two_devices_are_named():
    g, camera = random_gaussians(4), pinhole()
    far = torch.zeros(4, 2, device="meta")
    with pytest.raises(DataError, match=r"^features is on meta, means is on cpu; move them to one device$"):
        rasterize(g, camera, features=far)
    with pytest.raises(DataError, match=r"^means is on cpu, but backend cuda draws what is on cuda; move"):
        rasterize(g, camera, backend="cuda")
    there = replace(g, means=torch.zeros(4, 3, device="meta"))
    with pytest.raises(DataError, match=r"^means is on meta, but backend cpu draws what is on cpu"):
        rasterize(there, camera, backend="cpu")


def test_masks_of_another_size_are_refused():
    assert TILE == blend.TILE
    g, camera = random_gaussians(4), pinhole(40, 30)
    with pytest.raises(
        DataError, match=r"^tile_mask has shape \(3, 2\), not \(2, 3\); make it for this view$"
    ):
        rasterize(g, camera, tile_mask=np.ones((3, 2), bool))
    with pytest.raises(DataError, match=r"^trainable has shape \(5,\), not \(4,\)"):
        rasterize(g, camera, trainable=torch.ones(5, dtype=torch.bool))


def test_out_of_memory_is_one_line(standin, monkeypatch):
    def full(*arguments: object, **options: object) -> None:
        raise torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 9 GiB.\nMore lines")

    monkeypatch.setattr(cuda.kernels(), "rasterize_to_pixels", full)
    with pytest.raises(OutOfMemory, match=r"^the GPU is out of memory .*--downscale.*$"):
        rasterize(random_gaussians(4), pinhole(), backend="cuda")


@pytest.fixture
def able(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A machine that has all that the backend needs."""
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(cuda, "gsplat_version", lambda: "1.5.3+pt28cu128")
    monkeypatch.setattr(cuda, "compiled", lambda: None)
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin" / "nvcc").write_text("#!/bin/sh\n")
    (tmp_path / "bin" / "nvcc").chmod(0o755)
    monkeypatch.setenv("CUDA_HOME", str(tmp_path))
    return tmp_path


def test_a_machine_that_has_all(able, monkeypatch):
    assert cuda.nvcc() == able / "bin" / "nvcc"
    assert resolve_backend("auto", "cuda") == resolve_backend("cuda") == "cuda"
    assert resolve_backend("auto") == resolve_backend("auto", "cpu") == "cpu"  # tensors lie on the CPU
    for version in ("1.5.3", "1.6.0.dev3", "1.6.1"):
        monkeypatch.setattr(cuda, "gsplat_version", lambda version=version: version)
        assert cuda.missing() is None, version
    monkeypatch.setattr(cuda, "nvcc", lambda: None)
    monkeypatch.setattr(cuda, "compiled", lambda: able / "csrc.so")
    assert cuda.missing() is None  # no compiler is needed then


@pytest.mark.parametrize(
    ("owner", "name", "value", "says"),
    [
        (cuda, "nvcc", lambda: None, "no nvcc to do it; install the CUDA toolkit 13.0 and set CUDA_HOME"),
        (cuda, "gsplat_version", lambda: "1.5.2", "gsplat 1.5.2 is not supported; "),
        (cuda, "gsplat_version", lambda: "1.7.0", f"not supported; {install('gsplat>=1.5.3,<1.7')}"),
        (cuda, "gsplat_version", lambda: None, f"needs gsplat; {install('sagesplat[cuda]')}"),
        (torch.cuda, "is_available", lambda: False, "or driver; check nvidia-smi or use --device cpu"),
        (torch.version, "cuda", None, "is built without CUDA; install a build with it"),
    ],
)
def test_every_gap_is_one_line_with_its_cure(able, monkeypatch, owner, name, value, says):
    monkeypatch.setattr(owner, name, value)
    with pytest.raises(BackendUnavailable) as caught:
        resolve_backend("auto", "cuda")
    assert says in str(caught.value)
    cuda.kernels.cache_clear()  # where there is a GPU, an earlier test has loaded them
    with pytest.raises(BackendUnavailable):
        cuda.kernels()


def test_backends_and_devices_that_do_not_go_together():
    assert resolve_backend("reference") == "reference"
    with pytest.raises(BackendUnavailable, match=r"^backend 'gpu' is not known; use cpu, cuda or"):
        resolve_backend("gpu")  # type: ignore[arg-type]
    with pytest.raises(BackendUnavailable, match=r"^device 'tpu' is not known; use --device cpu or cuda$"):
        resolve_backend("auto", "tpu")
    for name, device in (("cpu", "cuda"), ("reference", "cuda"), ("cuda", "cpu")):
        with pytest.raises(
            BackendUnavailable, match=rf"^backend {name} does not run on {device}; leave one of"
        ):
            resolve_backend(name, device)  # type: ignore[arg-type]


@pytest.mark.filterwarnings("ignore:The distutils package")  # setuptools, where nothing imported it before
def test_the_installed_gsplat_is_found(monkeypatch, tmp_path):
    assert cuda.gsplat_version() == "1.5.3"
    monkeypatch.setenv("TORCH_EXTENSIONS_DIR", str(tmp_path))
    assert cuda.compiled() is None
    (tmp_path / "gsplat_cuda").mkdir(exist_ok=True)
    (tmp_path / "gsplat_cuda" / "gsplat_cuda.so").touch()
    assert cuda.compiled() == tmp_path / "gsplat_cuda" / "gsplat_cuda.so"
