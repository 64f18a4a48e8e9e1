"""Small labelled Gaussians, cameras and a capture on disk that several tests share."""

import gc
import os
import pickle
import shutil
import time
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jaxtyping
import numpy as np
import pytest
import shapes  # noqa: F401 - before sagesplat
import torch
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from PIL import Image
from scipy.spatial.transform import Rotation
from torch import Tensor

from sagesplat.adapt.observe import RenderedLabels
from sagesplat.core.config import NestConfig, PlanConfig, RunConfig, SampleConfig, SceneConfig, TrainConfig
from sagesplat.core.events import Event
from sagesplat.core.gaussians import PARAMETERS, Gaussians
from sagesplat.core.sh import num_bases, sh0_to_rgb
from sagesplat.demo.capture import make_capture as make_demo_capture
from sagesplat.io.columns import text_cell
from sagesplat.io.files import write_json, write_text
from sagesplat.io.lock import locked
from sagesplat.raster import Backend, Render, rasterize, set_threads
from sagesplat.run.job import Job
from sagesplat.run.run_dir import RunDir
from sagesplat.scene import load_scene
from sagesplat.scene.colmap_write import ModelCamera, ModelImage, write_model
from sagesplat.scene.scene import Camera, Scene
from sagesplat.stages.api import run_scene
from sagesplat.stages.pipeline import run_all

# a busy machine is no failure
settings.register_profile(
    "sagesplat",
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
)
settings.load_profile("sagesplat")

LABELS = (-1, 3, 184)
DOT = Image.new("RGB", (1, 1))
SMALL_RUN = RunConfig(  # of `finished_run`
    scene=SceneConfig(test_every=4, calibrate_every=3),
    train=TrainConfig(max_steps=6, level_every=2, sh_degree=1),
    nest=NestConfig(steps=2, levels=4, smallest=0.1, base_share=0),
    plan=PlanConfig(target_ssim=0.4, other_targets=()),
)


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """What is imported stays: looking for garbage in it, now and at every test, finds nothing."""
    gc.disable()
    found = yield
    gc.enable()
    gc.freeze()
    return found


# the files that take longest: begun last, one of two processes would wait for the other
_LONG = ("test_run_stage", "test_viewer_browser", "test_stages_nest", "test_stages_blocks", "test_run_ray")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    items.sort(key=lambda item: item.path.stem not in _LONG)


# the files whose tests look at the figures of reports, or make them of what is hard to draw
_FIGURES = (
    "test_output_report", "test_studies_paper", "test_pipeline",
    "test_studies_sparse_categories", "test_stages_clean", "test_stages_clean_splat",
)  # fmt: skip


# the files that make so many small runs that their reports are a word
_PLAIN_REPORTS = ("test_run_stage", "test_run_executor", "test_stages_blocks", "test_studies_sweep")


def draw_nothing(patch: pytest.MonkeyPatch) -> None:
    """Reports without figures, which take most of the time of a small run, and have their own tests."""
    patch.setattr("sagesplat.output.figures.save_figure", lambda figure, path, svg=True: b"<svg/>")
    patch.setattr("sagesplat.output.report.report_figures", lambda *_: iter(()))
    for name in ("before_after.before_after", "contact_sheet.contact_sheet"):
        patch.setattr(
            f"sagesplat.output.{name}", lambda path, *_, **options: Image.new("RGB", (1, 1)).save(path)
        )


@pytest.fixture(scope="module", autouse=True)
def no_figures(request: pytest.FixtureRequest) -> Iterator[None]:
    """Most tests draw nothing; some write no report at all."""
    with pytest.MonkeyPatch.context() as patch:
        if request.path.stem not in _FIGURES:
            draw_nothing(patch)
        if request.path.stem in _PLAIN_REPORTS:
            patch.setattr(
                "sagesplat.output.report.write_report",
                lambda folder, _: write_text(folder / "index.html", "report"),
            )
        yield


@pytest.fixture
def unchecked_shapes(monkeypatch: pytest.MonkeyPatch) -> None:
    """For tests that pass wrong shapes on purpose."""
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)


@pytest.fixture(scope="session", autouse=True)
def unsynced() -> Iterator[None]:
    """Nobody pulls the plug on a test: thousands of small files need not reach the disk."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("os.fsync", lambda handle: None)
        yield


@pytest.fixture(scope="session", autouse=True)
def few_samples() -> Iterator[None]:
    """Small clouds need fewer points to find room in them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sagesplat.adapt.free_space._SAMPLES", 150_000)
        yield


@pytest.fixture(autouse=True)
def one_thread():
    """Scenes are tiny: threads that wait for each other cost more than they bring."""
    set_threads(1)


def random_gaussians(
    count: int, *, seed: int = 0, degree: int = 3, log_scale: float = -2.2, logit: float = 0.0
) -> Gaussians:
    """A labelled cloud around (0, 0, 4) of mixed sizes, shapes, opacities and colours."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    return Gaussians(
        means=normal(count, 3) * torch.tensor([1.0, 0.8, 0.8]) + torch.tensor([0.0, 0.0, 4.0]),
        quats=normal(count, 4),
        log_scales=normal(count, 3) * 0.5 + log_scale,
        logit_opacities=normal(count) * 1.5 + logit,
        sh0=normal(count, 1, 3) * 0.5,
        shN=normal(count, num_bases(degree) - 1, 3) * 0.1,
        label_ids=torch.tensor(LABELS, dtype=torch.int16)[torch.arange(count) % len(LABELS)],
    )


def pinhole(width: int = 70, height: int = 50, angle: float = 0.2) -> Camera:
    """A camera near the origin that sees the cloud, its principal point off the centre."""
    w2c = np.eye(4, dtype=np.float32)
    w2c[:3, :3] = Rotation.from_euler("y", angle).as_matrix()
    w2c[:3, 3] = [0.1, -0.2, 0.3]
    K = np.array([[0.85 * width, 0, 0.47 * width], [0, 0.8 * width, 0.54 * height], [0, 0, 1]], np.float32)
    return Camera(w2c, K, width, height)


def render_with_gradients(
    g: Gaussians,
    camera: Camera,
    backend: Backend = "cpu",
    *,
    features: Tensor | None = None,
    pixels: Tensor | None = None,
    pose: bool = False,
    **options: Any,
) -> tuple[Render, dict[str, Tensor]]:
    """A render and the gradients of a fixed random weighting of its outputs (of `pixels` [H, W] only)."""
    leaves = {name: p.clone().requires_grad_() for name, p in g.parameters().items()}
    if features is not None:
        features = features.clone().requires_grad_()
        leaves["features"] = features
    if pose:
        leaves["pose"] = options["pose"] = torch.zeros(6, device=g.means.device, requires_grad=True)
    moving = replace(g, **{name: leaves[name] for name in PARAMETERS})
    render = rasterize(moving, camera, features=features, backend=backend, **options)
    generator = torch.Generator().manual_seed(9)
    loss = torch.zeros(())
    for output in (render.rgb, render.alpha[..., None], render.features):
        if output is not None:
            weights = torch.randn(output.shape, generator=generator)
            loss = loss + (output * (weights if pixels is None else weights * pixels[..., None])).sum()
    loss.backward()
    leaves["means2d"] = render.means2d
    return render, {name: leaf.grad for name, leaf in leaves.items() if leaf.grad is not None}


def orbit(views: int, width: int = 48, height: int = 32) -> list[Camera]:
    """Cameras on an arc around (0, 0, 4), all looking at it."""
    cameras = []
    for angle in np.linspace(-0.5, 0.5, views):
        w2c = np.eye(4)
        w2c[:3, :3] = Rotation.from_euler("xyz", [0.05, angle, 0.0]).as_matrix()
        w2c[:3, 3] = np.array([0.0, 0.0, 4.0]) - w2c[:3, :3] @ [0.0, 0.0, 4.0]
        K = np.array([[40, 0, width / 2 + 1], [0, 40, height / 2 - 2], [0, 0, 1]])
        cameras.append(Camera(w2c.astype(np.float32), K.astype(np.float32), width, height))
    return cameras


def write_capture(folder: Path, truth: Gaussians, *, views: int = 8, noise: float = 0.05) -> Scene:
    """A COLMAP workspace of photos of `truth`; its points are the means of `truth`, up to `noise`."""
    rng = np.random.default_rng(0)
    cameras = orbit(views)
    xyz = truth.means.numpy() + rng.normal(0, noise, (len(truth), 3))
    rgb = (sh0_to_rgb(truth.sh0[:, 0]).clamp(0, 1) * 255).to(torch.uint8).numpy()
    width, height = cameras[0].width, cameras[0].height
    K = cameras[0].K.astype(float)
    model = ModelCamera(1, "PINHOLE", width, height, (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))
    images = []
    (folder / "images").mkdir(parents=True)
    for i, camera in enumerate(cameras):
        pixels = rasterize(truth, camera).rgb.clamp(0, 1) * 255
        Image.fromarray(pixels.round().to(torch.uint8).numpy()).save(folder / "images" / f"{i:02d}.png")
        local = xyz @ camera.w2c[:3, :3].T + camera.w2c[:3, 3]
        uv = local[:, :2] / local[:, 2:] * [K[0, 0], K[1, 1]] + K[:2, 2]
        images.append(ModelImage(i + 1, f"{i:02d}.png", 1, camera.w2c.astype(float), uv, np.arange(len(xyz))))
    write_model(folder / "sparse" / "0", [model], images, xyz, rgb, np.full(len(xyz), 0.5))
    return load_scene(folder)


def shared(folders: pytest.TempPathFactory, name: str, make: Callable[[Path], object]) -> Path:
    """A folder that `make` fills once for all processes of the tests, without figures; change only copies."""
    base = folders.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / name
    folder.mkdir(exist_ok=True)
    with locked(folder, wait=3600.0):
        if not (folder / "made").exists():
            with pytest.MonkeyPatch.context() as patch:
                draw_nothing(patch)
                make(folder)
            write_text(folder / "made", "")
    return folder


@pytest.fixture(scope="session")
def finished_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run on nested levels, in two seconds; its capture is beside it. Copy it before a change."""

    def make(folder: Path) -> None:
        set_threads(1)
        truth = random_gaussians(120, degree=1, logit=2.0)
        images = RenderedLabels(truth, "cpu")
        scene, masks = write_capture(folder / "capture", truth, noise=0.02), folder / "capture" / "masks"
        masks.mkdir()
        for view in scene.views:
            ids = np.where(images[view] < 0, 255, images[view]).astype(np.uint8)
            Image.fromarray(ids).save(masks / view.name)
        write_json(masks / "labels.json", {"labels": {"3": "car", "184": "tree-merged"}})
        run_all(Job(RunDir(folder / "run"), lambda event: None, "cpu"), folder / "capture", SMALL_RUN)

    made = shared(tmp_path_factory, "finished", make)
    folder = tmp_path_factory.mktemp("finished")
    shutil.copytree(made / "run", folder / "run")  # each process may lock its own
    (folder / "capture").symlink_to(made / "capture")
    return folder / "run"


@pytest.fixture
def run(finished_run: Path, tmp_path: Path) -> Path:
    """A copy of the finished run, to change, with a link to its capture beside it."""
    (tmp_path / "capture").symlink_to(finished_run.parent / "capture")
    return Path(shutil.copytree(finished_run, tmp_path / "run"))


def job_of(run: Path, emit: Callable[[Event], None] = lambda event: None, **options: Any) -> Job:
    return Job(RunDir(run), emit, "cpu", **options)


@pytest.fixture
def viewer(tmp_path: Path) -> Path:
    """A folder with a page in place of the built viewer."""
    (tmp_path / "viewer").mkdir()
    (tmp_path / "viewer" / "index.html").write_text("<body><!-- pack --><!-- poster --></body>")
    return tmp_path / "viewer"


@pytest.fixture(scope="session")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The modelled garden: 12 photos of 64 x 48 pixels, to read only."""

    def make(folder: Path) -> None:
        make_demo_capture(folder / "capture", views=12, width=64, height=48)

    return shared(tmp_path_factory, "garden", make) / "capture"


Call = Callable[..., tuple[int, str]]


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Call:
    """A command as typed: its exit code, and what it prints."""

    def typed(*words: str | Path) -> tuple[int, str]:
        from sagesplat import cli

        monkeypatch.setattr("sys.argv", ["sagesplat", *map(str, words)])
        code = 0
        try:
            cli.main()
        except SystemExit as end:
            code = int(end.code or 0)
        out = capsys.readouterr()
        return code, out.out + out.err

    return typed


@dataclass(frozen=True)
class DemoRun:
    """A run of the modelled garden on both kinds of levels. Copy its folder before a change."""

    capture: Path
    path: Path
    config: RunConfig
    events: dict[str, list[Event]]  # by ladder; the nested one was made first


DEMO_RUN = RunConfig(
    scene=SceneConfig(calibrate_every=4),
    train=TrainConfig(max_steps=90, level_every=30),
    nest=NestConfig(steps=40, levels=5, smallest=0.1, base_steps=30),
    sample=SampleConfig(views=8, calibration_views=8),
    plan=PlanConfig(target_ssim=0.4),
)


@pytest.fixture(scope="session")
def demo_run(tmp_path_factory: pytest.TempPathFactory) -> DemoRun:
    """The run that tests of the whole flow look at."""

    def make(folder: Path) -> None:
        make_demo_capture(folder / "capture", views=16, width=80, height=60)
        heard: dict[str, list[Event]] = {"nested": [], "snapshots": []}
        for ladder, events in heard.items():
            config = replace(DEMO_RUN, ladder=ladder)
            run_scene(
                folder / "capture", folder / "run", config, on_event=events.append, backend="cpu", threads=1
            )
        (folder / "events").write_bytes(pickle.dumps(heard))

    made = shared(tmp_path_factory, "demo", make)
    run = tmp_path_factory.mktemp("demo") / "run"
    shutil.copytree(made / "run", run)  # each process may lock its own
    return DemoRun(made / "capture", run, DEMO_RUN, pickle.loads((made / "events").read_bytes()))


def cell_text(cell: str) -> str:
    """The text that `text_cell` made a cell of."""
    return cell[1:] if text_cell(cell[1:]) == cell else cell


def wait_for(condition: Callable[[], object], seconds: float = 600.0) -> None:
    """Return once a condition holds; however slow the machine is."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.02)


def damage(content: bytes, data: st.DataObject) -> bytes:
    """A file cut off somewhere, or with a few bytes changed, as hypothesis draws it."""
    if data.draw(st.booleans()):
        return content[: data.draw(st.integers(0, len(content) - 1))]
    changed = bytearray(content)
    for at in data.draw(st.lists(st.integers(0, len(content) - 1), min_size=1, max_size=4)):
        changed[at] = data.draw(st.integers(0, 255))
    return bytes(changed)
