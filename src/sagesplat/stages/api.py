"""What a script calls: the whole pipeline on a capture, and the results of a finished run.

`import sagesplat` exports these names. They do what the commands `sagesplat run`, `adopt`, `plan`, `compose`
and `bundle` do.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory

from sagesplat.adapt.bound_plans import Costs
from sagesplat.adapt.cell_models import FidelityModel
from sagesplat.adapt.plan import Plan
from sagesplat.adapt.viewpoint import ViewModel
from sagesplat.core.config import AdoptConfig, LadderKind, PlanConfig, RunConfig
from sagesplat.core.errors import RunError
from sagesplat.core.events import Emit, Event
from sagesplat.core.gaussians import Gaussians
from sagesplat.core.text_table import aligned
from sagesplat.raster import Backend, prepared, resolve_backend, set_threads
from sagesplat.run.job import Job
from sagesplat.run.run_dir import RunDir, check_links, check_run
from sagesplat.scene.scene import Camera, Scene
from sagesplat.segment.display_names import titles
from sagesplat.stages import label_edits, pipeline
from sagesplat.stages.bundle import BundleMade, bundle
from sagesplat.stages.given import write_given_cameras, write_given_splat
from sagesplat.stages.method import Method
from sagesplat.stages.methods import NestedLevels, method_of
from sagesplat.stages.plan import check_targets
from sagesplat.stages.results import budget_plan_of, plans_of
from sagesplat.viewer.notebook import NotebookViewer


def ignore(event: Event) -> None:
    """The default receiver of events: none."""


def run_scene(
    scene: Path | str,
    folder: Path | str,
    config: RunConfig = RunConfig(),  # noqa: B008 - frozen
    *,
    on_event: Emit = ignore,
    device: str = "auto",
    backend: Backend = "auto",
    threads: int = 0,
    force: bool = False,
) -> "FinishedRun":
    """Run the whole pipeline on a capture: what the command `sagesplat run SCENE RUN` does.

    Stages whose results are in `folder` already, made with the same settings, are skipped. A killed run is
    resumed by the same call.

    Args:
        scene: The capture: a COLMAP workspace, nerfstudio's transforms.json, a Blender scene, a folder of
            photos or a video.
        folder: The run folder; made if it is not there.
        config: Settings of every stage.
        on_event: Called with each event (`StageDone`, `Warned`, ...). Nothing is printed otherwise.
        device: "auto" (a CUDA GPU where there is one that works), "cpu" or "cuda".
        backend: Rasteriser: "auto", "cpu", "cuda" or "reference".
        threads: CPU threads; 0: one per core. Set for the whole process.
        force: Replace results that were made with other settings or from other inputs; those that match are
            kept.

    Returns:
        The finished run.

    Raises:
        SageError: For anything wrong with the capture, the settings, the run folder or the machine. The
            message is one line: path, problem, cure.

    Example:
        >>> from sagesplat import RunConfig, TrainConfig, run_scene
        >>> config = RunConfig(train=TrainConfig(max_steps=3000))
        >>> run = run_scene("captures/garden", "runs/garden", config, on_event=print)  # doctest: +SKIP
        >>> run.plans[0].count  # doctest: +SKIP
    """
    with _working(RunDir(Path(folder), config.ladder), on_event, device, backend, threads, force) as job:
        pipeline.run_all(job, Path(scene), config)
    return open_run(folder, config.ladder)


@contextmanager
def _working(
    run: RunDir, on_event: Emit, device: str, backend: Backend, threads: int, force: bool
) -> Iterator[Job]:
    """A job that works on a run folder, which nobody else writes into between two stages."""
    backend, threads = prepared(device, backend, threads)
    check_links(run.path)
    with ExitStack() as locks:
        yield Job(run, on_event, backend, threads, force, device=device, locks=locks)


def adopt_splat(
    splat: Path | str | Gaussians,
    folder: Path | str,
    adopt: AdoptConfig = AdoptConfig(),
    config: RunConfig = RunConfig(),  # noqa: B008 - frozen
    *,
    cameras: Path | str | Sequence[Camera] | None = None,
    names: Mapping[int, str] | None = None,
    antialiased: bool = False,
    on_event: Emit = ignore,
    device: str = "auto",
    backend: Backend = "auto",
    threads: int = 0,
    force: bool = False,
) -> "FinishedRun":
    """Make a run of a trained splat: levels, promises, plans and a report, as `sagesplat adopt SPLAT RUN`.

    Stages whose results are in `folder` already, made with the same settings, are skipped. A killed run is
    resumed by the same call.

    Args:
        splat: A file of any format that `read_splat` reads, or Gaussians; these are kept in the run folder.
        folder: The run folder; made if it is not there.
        adopt: How the levels are made, and viewpoints drawn. `AdoptConfig(fit="none")` is the fast way.
        config: Settings of scene, masks, labels, sample, fit and plan; training and nesting are not used.
        cameras: Where to look from: a capture, with or without photos, a cameras.json of 3DGS, a
            transforms.json or a viewpoints.json, or cameras, all in the frame of the splat. None:
            `adopt.cameras`, by default viewpoints drawn from the splat.
        names: Of Gaussians: category names by label id. A file has its own.
        antialiased: Of Gaussians: whether they were trained so.
        on_event: Called with each event (`StageDone`, `Progress`, ...). Nothing is printed otherwise.
        device: "auto" (a CUDA GPU where there is one that works), "cpu" or "cuda".
        backend: Rasteriser: "auto", "cpu", "cuda" or "reference".
        threads: CPU threads; 0: one per core. Set for the whole process.
        force: Replace results that were made with other settings or from another splat; those that match are
            kept.

    Returns:
        The finished run.

    Raises:
        SageError: For anything wrong with the splat, the cameras, the settings, the run folder or the
            machine.

    Example:
        >>> from sagesplat import AdoptConfig, Gaussians, adopt_splat
        >>> g = Gaussians.from_gsplat(splats)  # doctest: +SKIP
        >>> run = adopt_splat(g, "runs/garden", AdoptConfig(fit="none"))  # doctest: +SKIP
        >>> run.show()  # doctest: +SKIP
    """
    run = RunDir(Path(folder))
    with _working(run, on_event, device, backend, threads, force) as job:
        if isinstance(splat, Gaussians):
            source = write_given_splat(run, splat, names or {}, antialiased)
        elif names or antialiased:
            raise RunError(f"{splat}: a file says names and antialiasing itself; leave out what was given")
        else:
            source = Path(splat)
        if cameras is not None:
            by_path = isinstance(cameras, Path | str)
            adopt = replace(adopt, cameras=Path(cameras) if by_path else write_given_cameras(run, cameras))
        pipeline.adopt(job, source, adopt, config)
    return open_run(folder)


def open_run(folder: Path | str, ladder: LadderKind = "nested") -> "FinishedRun":
    """Open a finished run; its files are read when they are first asked for.

    Args:
        folder: The run folder.
        ladder: Which levels to look at: "nested" (prefixes of one model) or "snapshots" (the paper's).

    Returns:
        The run's scene, levels, plans and SSIM models.

    Raises:
        RunError: If `folder` is not a run folder.

    Example:
        >>> from sagesplat import open_run
        >>> run = open_run("runs/garden")  # doctest: +SKIP
        >>> plan = run.plan_camera(run.scene.views[0].camera, target_fidelity=0.95)  # doctest: +SKIP
        >>> gaussians = run.compose(plan)  # doctest: +SKIP
    """
    run = RunDir(Path(folder), ladder)
    check_links(run.path)
    check_run(run)
    return FinishedRun(Job(run, ignore))


def apply_labels(
    folder: Path | str,
    edits: Path | str | None = None,
    out: Path | str | None = None,
    *,
    on_event: Emit = ignore,
    backend: Backend = "auto",
    threads: int = 0,
) -> "FinishedRun":
    """Apply edits of labels to a finished run: what the command `sagesplat labels apply` does.

    Nothing is trained; parts of split categories are measured, what changed is calibrated again. The run
    stays as it is.

    Args:
        folder: The run folder, finished with nested levels.
        edits: The file that the viewer saved; None: labels.edit.json of the run folder.
        out: The new run folder; an earlier edited run there is replaced. None: beside the run, as RUN-edited.
        on_event: Called with each event (`StageDone`, `Warned`, ...). Nothing is printed otherwise.
        backend: Rasteriser: "auto", "cpu", "cuda" or "reference".
        threads: CPU threads; 0: one per core. Set for the whole process.

    Returns:
        The new run, with its bundle in `out`/bundle.

    Raises:
        LabelError: For edits that are damaged, of another run, or that cannot be applied.
        RunError: For a run that is not finished or cannot be edited so, and an `out` that holds something
            else.

    Example:
        >>> from sagesplat import apply_labels
        >>> run = apply_labels("runs/garden", "labels.edit.json")  # doctest: +SKIP
        >>> sorted(run.names.values())  # doctest: +SKIP
    """
    run = RunDir(Path(folder))
    check_links(run.path)
    backend, threads = resolve_backend(backend, "auto"), set_threads(threads)
    given = None if edits is None else Path(edits)
    job = Job(run, on_event, backend, threads)
    return open_run(label_edits.apply_labels(job, given, None if out is None else Path(out)).path)


@dataclass(frozen=True, eq=False)
class FinishedRun:
    """The results of a run folder, from `open_run`, `run_scene` or `adopt_splat`; `print` lists its plans."""

    job: Job

    def __repr__(self) -> str:
        return f"FinishedRun({str(self.path)!r})"

    def __str__(self) -> str:
        head = f"{self.path}: {self.job.run.ladder} levels"
        if not self.job.run.plan.exists():
            return f"{head}, not planned yet"
        rows = [(plan.asked, *plan.sizes, plan.verdict) for plan in self.plans]
        return f"{head}\n{aligned(('plan', 'MB', 'Gaussians', 'status'), rows, right=(1, 2))}"

    @property
    def path(self) -> Path:
        """The run folder."""
        return self.job.run.path

    @property
    def scene(self) -> Scene:
        """The capture that the run was made from. SceneError or RunError where it is gone or changed."""
        return self.job.scene

    @cached_property
    def names(self) -> dict[int, str]:
        """Category names by label id; -1 is the unlabelled one."""
        return self.job.names()

    @cached_property
    def titles(self) -> dict[int, str]:
        """Category names for people by label id: "grass" for COCO's grass-merged."""
        return titles(self.names)

    @cached_property
    def parents(self) -> dict[int, str]:
        """Of the label ids that are instances, the names of their categories: "chair" for chair 1."""
        return self.job.parents_by_id

    @property
    def antialiased(self) -> bool:
        """How the run's Gaussians are drawn: pass it to `rasterize` and to `write_ply`."""
        return self.job.antialiased

    @cached_property
    def plans(self) -> tuple[Plan, ...]:
        """The scene's plans: the one for a budget first, then those of the quality that leads.

        RunError before `sagesplat plan`.
        """
        within = budget_plan_of(self.job)
        plans = [*([within] if within else []), *plans_of(self.job)]
        return tuple(replace(plan, titles=self.titles) for plan in plans)

    @cached_property
    def _method(self) -> Method:
        return method_of(self.job)

    @cached_property
    def _nested(self) -> NestedLevels:
        return self._method if isinstance(self._method, NestedLevels) else NestedLevels(self.job)

    @property
    def fidelity(self) -> dict[int, FidelityModel]:
        """Models of fidelity by label id (nested ladder). RunError before `sagesplat fit`."""
        return self._nested.fidelity

    @property
    def promises(self) -> dict[int, ViewModel]:
        """Models of SSIM against photos by label id; otherwise like `fidelity`."""
        return self._nested.promises

    @property
    def costs(self) -> Costs:
        """Gaussians and bytes of each category's levels; of a nested ladder."""
        return self._nested.costs

    def plan_camera(
        self, camera: Camera, *, target_fidelity: float | None = None, target_ssim: float | None = None
    ) -> Plan:
        """The cheapest level of each category that is promised to reach a target from one camera (Eq. 1).

        The camera may be anywhere: no photo has to be taken there. For a nested ladder the promise is a lower
        confidence bound, for the levels of the paper it is Eq. 3 at the category's distance. For fidelity,
        categories whose pixels are worth their bytes then get more, until the image is no worse than with all
        at one level.

        Args:
            camera: The viewer's: pose in the world of `scene`, intrinsics and image size in pixels.
            target_fidelity: SSIM against the full model from the same camera, above 0 and at most 1; of a
                nested ladder. Default: 0.95, where `target_ssim` is not given.
            target_ssim: SSIM against photos instead.

        Returns:
            One level per category; `status` is "infeasible" where a category cannot reach the target, and "no
            promise" where the camera is too far from all that was sampled: there it gets the highest level.

        Raises:
            RunError: For an impossible target, both targets, or before the run has models.
        """
        if target_fidelity is not None and target_ssim is not None:
            raise RunError("a camera is planned for one target; give target_fidelity or target_ssim")
        config = PlanConfig(target_fidelity, target_ssim)
        config = check_targets(config, self.job.run.ladder)
        return replace(self._method.plan_camera(camera, config.target, config.quality), titles=self.titles)

    def show(self, *, height: int = 480) -> NotebookViewer:
        """The viewer in the cell of a notebook (Jupyter, VS Code): the last expression of the cell shows it.

        The whole scene is inside the cell's output, and so in the notebook where that is saved.

        Args:
            height: Of the viewer, px. It is as wide as the cell.

        Raises:
            RunError: For a run without nested levels, or a scene that is too large for one page.
        """
        with TemporaryDirectory() as work:
            page = Path(work) / "scene.html"
            self.bundle(page, single_file=True)
            return NotebookViewer(page.read_text(encoding="utf-8"), height, str(self.path))

    def bundle(self, out: Path | str, *, single_file: bool = False) -> BundleMade:
        """Write the run for browsers: levels, promises and the viewer, as static files.

        Args:
            out: A new or empty folder, or an earlier bundle, which is replaced.
            single_file: Write one HTML page instead, which opens from the disk.

        Returns:
            What it holds, and how large it is.

        Raises:
            RunError: For a run without nested levels, or an `out` that is something else.
        """
        return bundle(self.job, Path(out), single_file=single_file)

    def compose(self, plan: Plan | Mapping[int, int]) -> Gaussians:
        """The Gaussians of a plan: each category at its level.

        Args:
            plan: A plan, or levels by label id.

        Returns:
            All categories merged, on the CPU. `write_splat` saves them.

        Raises:
            RunError: For a level that the ladder does not have.
        """
        return plan.compose(self.job.ladder) if isinstance(plan, Plan) else self.job.ladder.compose(plan)
