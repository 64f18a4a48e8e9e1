"""The names of everything in a run folder."""

import os
from dataclasses import dataclass
from pathlib import Path

from sagesplat.core.config import LadderKind
from sagesplat.core.errors import RunError
from sagesplat.run.stage_table import stage_kind


def check_links(folder: Path) -> None:
    """RunError for a link below a run folder that leads out of it.

    Run folders come from other people too: through such a link they would name files to read and to replace.
    What is meant to lie elsewhere is named by an absolute path: the capture, in scene.json.
    """
    root, todo = os.path.join(os.path.realpath(folder), ""), [str(folder)]
    while todo:
        try:
            with os.scandir(todo.pop()) as entries:
                for entry in entries:
                    if entry.is_symlink() and not os.path.realpath(entry.path).startswith(root):
                        raise RunError(
                            f"{entry.path}: a link out of the run folder; put the file or folder itself there"
                        )
                    if entry.is_dir(follow_symlinks=False):
                        todo.append(entry.path)
        except (FileNotFoundError, NotADirectoryError):  # not made yet, or removed by a run at work
            continue


class _In:
    """A path in a run folder: below `path`, or below the folder of another name of `RunDir`."""

    def __init__(self, name: str, folder: str = "path") -> None:
        self._name, self._folder = name, folder

    def __get__(self, run: "RunDir", _: type | None = None) -> Path:
        return getattr(run, self._folder) / self._name


@dataclass(frozen=True)
class RunDir:
    """Paths inside a run folder. What is made of a ladder lies in a folder of the ladder's name."""

    path: Path
    ladder: LadderKind = "nested"

    # the capture
    scene = _In("scene.json")  # where the capture is and how it is read
    photo_hashes = _In("photos.json")  # sizes, times and hashes of the photos, when last looked at
    source_hashes = _In("source.json")  # the same of the photos, or the video, that poses were estimated from
    begun = _In("begun.json")  # settings of a run that did not end
    geometry = _In("geometry.npz")  # cameras and points: results can be shown without the capture
    capture = _In("capture")  # the folder of the capture that was made of photos without poses
    adopted = _In("adopted.npz")  # the Gaussians of a splat that somebody else trained, as they were read
    from_python = _In("from_python")  # a splat and cameras that a script gave, as files, to be adopted
    contact_sheet = _In("viewpoints.png")  # pictures from the viewpoints of an adopted splat
    edited = _In("edited.json")  # of a run made by editing labels: the edits, and settings of its categories

    # label images
    segmented = _In("segmented")  # as they came, before categories were merged or left out
    segmentation = _In("options.json", "segmented")  # how those were asked for
    given = _In("given")  # those that were given, where prompts are painted over them
    masks = _In("masks")  # at training size, with labels.json
    valid = _In("valid")  # which pixels count, by view: images of the views with some that do not
    labels = _In("labels.npz")  # labels of the SfM points
    fused = _In("fused")  # label images on which all views agree
    photo_instances = _In("photo_instances")  # of single photos: a number means nothing in another photo
    instances = _In("instances")  # each 3D instance is a category of its own, with labels.json
    instance_labels = _In("labels.npz", "instances")  # instances of the SfM points
    parents = _In("parents.json")  # the categories that instances are of, by their names

    # training
    levels = _In("levels")  # the recorded levels
    checkpoint = _In("checkpoint.npz")  # where training goes on
    cap = _In("cap.json")  # what training began with: settings, cap of Gaussians, lowered to the memory
    frozen = _In("frozen.json")  # steps at which categories stopped
    cameras = _In("cameras.npz")  # poses and exposures of the views, where training refined them
    refined = _In("refined.json")  # what refining the cameras did, in figures
    inliers = _In("inliers")  # `valid` without the outliers of training photos, where those were looked for
    sky = _In("sky.npz")  # the sphere of the sky and the points on it, where photos show sky
    cleaned = _In("cleaned.npz")  # the last level without its floaters, where some were removed
    floaters = _In("floaters.json")  # how many floaters were found and removed, and what that cost
    floaters_picture = _In("floaters.png")  # views before and after, and what was removed

    # a large scene
    blocks = _In("blocks")  # the run folders of the blocks
    division = _In("blocks.json", "blocks")  # the blocks, and what each has
    interior = _In("interior.npz", "adapted")  # of a block: what it adds to the nested ladder of the whole
    tuned_interior = _In("tuned_interior.npz", "adapted")  # the same, tuned along the block's borders

    # the ladder, and what is made of it
    base_model = _In("base.npz", "adapted")  # the small model that the nested ladder begins with
    nest_checkpoint = _In("checkpoint.npz", "adapted")  # where training on compositions goes on
    prefixes = _In("ladder.npz", "adapted")  # one ordered set of Gaussians: the levels are prefixes of it
    cells = _In("cells.npz", "adapted")  # parts of categories by place, which have levels of their own
    increments = _In("increments", "adapted")  # what each level of each category adds, with index.json
    observations = _In("observations.csv", "adapted")  # quality per category, level and view
    viewpoints = _In("viewpoints.json", "adapted")  # drawn viewpoints, and the rule that they were drawn by
    sampled = _In("fidelity.npz", "adapted")  # fidelity per category and level at drawn viewpoints
    fidelity = _In("fidelity.json", "adapted")  # models of fidelity at any viewpoint, with a lower bound
    promises = _In("promises.json", "adapted")  # the same of SSIM against photos
    models = _In("models.json", "adapted")  # Eq. 3 per category and level
    plan = _In("plan.json", "adapted")  # levels chosen
    composed = _In("composed.ply", "adapted")  # the scene that the plan chose
    evaluation = _In("evaluation.csv", "adapted")  # composed scenes on test views
    cross_view = _In("cross_view.csv", "adapted")  # unseen views, each with a plan of its own
    same_size = _In("same_size.csv", "adapted")  # compositions and 3DGS of the same size
    report = _In("report", "adapted")  # the report's folder
    paper = _In("paper", "report")  # the paper's tables and figures

    @property
    def adapted(self) -> Path:
        """What is made of the ladder."""
        return self.path / self.ladder

    @property
    def scene_files(self) -> list[Path]:
        """What decides the scene that everything after training uses."""
        return [self.scene, *([self.cameras] if self.cameras.exists() else [])]

    @property
    def replacement(self) -> "RunDir":
        """Where a forced training makes its results, until they are whole."""
        return RunDir(self.path / "replacement", self.ladder)

    def block(self, number: int) -> "RunDir":
        """The run folder of a block."""
        return RunDir(self.blocks / f"{number:03d}", self.ladder)

    @property
    def has_instances(self) -> bool:
        """Whether instances are categories of their own: in nested levels alone."""
        return self.ladder == "nested" and (self.instances / "labels.json").exists()

    def provenance(self, stage: str) -> Path:
        """What a stage's result was made from."""
        folder = self.path if stage_kind(stage).of_all_ladders else self.adapted
        return folder / "provenance" / f"{stage}.json"


def check_run(run: RunDir) -> None:
    """RunError for what is no run folder."""
    if not run.scene.exists():
        raise RunError(f"{run.path}: not a run folder (no scene.json); {how_to_begin(run.path)}")


def how_to_begin(path: Path) -> str:
    """The command that makes a run, in the place of a path that is none: of a file, which may be a splat."""
    if path.is_file():
        return f"`sagesplat adopt {path} RUN` makes one of a splat"
    return "begin with `sagesplat run SCENE RUN`"
