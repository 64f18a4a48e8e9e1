"""The names of everything in a run folder."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from sagesplat.core.errors import RunError

LadderKind = Literal["nested", "snapshots"]
# stages that all ladders of a run share
_BEFORE_LADDERS = (
    "adopt",
    "poses",
    "scene",
    "given",
    "segment",
    "masks",
    "lift",
    "blocks",
    "train",
    "clean",
    "fuse",
    "photo_instances",
    "instances",
    "block_categories",
)


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


@dataclass(frozen=True)
class RunDir:
    """Paths inside a run folder. What is made of a ladder lies in a folder of the ladder's name."""

    path: Path
    ladder: LadderKind = "nested"

    @property
    def adapted(self) -> Path:
        """What is made of the ladder."""
        return self.path / self.ladder

    @property
    def scene(self) -> Path:
        """Where the capture is and how it is read."""
        return self.path / "scene.json"

    @property
    def photo_hashes(self) -> Path:
        """Sizes, times and hashes of the photos, when they were last looked at."""
        return self.path / "photos.json"

    @property
    def source_hashes(self) -> Path:
        """The same of the photos, or the video, that the poses were estimated from."""
        return self.path / "source.json"

    @property
    def geometry(self) -> Path:
        """Cameras and points of the capture, so that results can be shown without it."""
        return self.path / "geometry.npz"

    @property
    def cameras(self) -> Path:
        """Poses and exposures of the views, where training refined them."""
        return self.path / "cameras.npz"

    @property
    def refined(self) -> Path:
        """What refining the cameras did, in figures."""
        return self.path / "refined.json"

    @property
    def sky(self) -> Path:
        """The sphere of the sky and the points on it, where photos show sky."""
        return self.path / "sky.npz"

    @property
    def scene_files(self) -> list[Path]:
        """What decides the scene that everything after training uses."""
        return [self.scene, *([self.cameras] if self.cameras.exists() else [])]

    @property
    def masks(self) -> Path:
        """Label images at training size, with labels.json."""
        return self.path / "masks"

    @property
    def valid(self) -> Path:
        """Which pixels count, by view: images of the views with some that do not."""
        return self.path / "valid"

    @property
    def inliers(self) -> Path:
        """The same without the outliers of training photos, where training looked for them."""
        return self.path / "inliers"

    @property
    def capture(self) -> Path:
        """The folder of the capture that was made of photos without poses."""
        return self.path / "capture"

    @property
    def adopted(self) -> Path:
        """The Gaussians of a splat that somebody else trained, as they were read."""
        return self.path / "adopted.npz"

    @property
    def edited(self) -> Path:
        """Of a run made by editing the labels of another one: which edits, and settings of its categories."""
        return self.path / "edited.json"

    @property
    def contact_sheet(self) -> Path:
        """Pictures from the viewpoints that an adopted splat is looked at from."""
        return self.path / "viewpoints.png"

    @property
    def segmented(self) -> Path:
        """Label images as they came, before categories were merged or left out."""
        return self.path / "segmented"

    @property
    def given(self) -> Path:
        """Label images that were given, where prompts are painted over them."""
        return self.path / "given"

    @property
    def segmentation(self) -> Path:
        """How the label images in `segmented` were asked for."""
        return self.segmented / "options.json"

    @property
    def fused(self) -> Path:
        """Label images on which all views agree."""
        return self.path / "fused"

    @property
    def photo_instances(self) -> Path:
        """Instances of single photos, whose numbers mean nothing in another photo."""
        return self.path / "photo_instances"

    @property
    def instances(self) -> Path:
        """Label images in which each 3D instance is a category of its own, with labels.json."""
        return self.path / "instances"

    @property
    def instance_labels(self) -> Path:
        """Instances of the SfM points."""
        return self.instances / "labels.npz"

    @property
    def parents(self) -> Path:
        """The categories that instances are of, by their names."""
        return self.path / "parents.json"

    @property
    def labels(self) -> Path:
        """Labels of the SfM points."""
        return self.path / "labels.npz"

    @property
    def levels(self) -> Path:
        """The recorded levels."""
        return self.path / "levels"

    @property
    def cleaned(self) -> Path:
        """The last level without its floaters, where some were removed."""
        return self.path / "cleaned.npz"

    @property
    def floaters(self) -> Path:
        """How many floaters were found and removed, and what that cost."""
        return self.path / "floaters.json"

    @property
    def floaters_picture(self) -> Path:
        """Views before and after, and what was removed."""
        return self.path / "floaters.png"

    @property
    def checkpoint(self) -> Path:
        """Where training goes on."""
        return self.path / "checkpoint.npz"

    @property
    def cap(self) -> Path:
        """What training began with: its settings, and its cap of Gaussians, lowered to the memory."""
        return self.path / "cap.json"

    @property
    def replacement(self) -> "RunDir":
        """Where a forced training makes its results, until they are whole."""
        return RunDir(self.path / "replacement", self.ladder)

    @property
    def frozen(self) -> Path:
        """Steps at which categories stopped during training."""
        return self.path / "frozen.json"

    @property
    def blocks(self) -> Path:
        """The run folders of a large scene's blocks, with blocks.json."""
        return self.path / "blocks"

    def block(self, number: int) -> "RunDir":
        """The run folder of a block."""
        return RunDir(self.blocks / f"{number:03d}", self.ladder)

    @property
    def interior(self) -> Path:
        """Of a block: what it adds to the nested ladder of the whole."""
        return self.adapted / "interior.npz"

    @property
    def tuned_interior(self) -> Path:
        """Of a block: the same, tuned along its borders."""
        return self.adapted / "tuned_interior.npz"

    @property
    def block_categories(self) -> Path:
        """Label images of the parts of a large scene, a category in a block each, and their points."""
        return self.path / "block_categories"

    @property
    def block_instances(self) -> Path:
        """The same of instances: what nested levels are of where some were asked for."""
        return self.path / "block_instances"

    @property
    def block_labels(self) -> Path:
        """Which of both the levels are of. Snapshots have no instances."""
        apart = self.ladder == "nested" and (self.instances / "labels.json").exists()
        return self.block_instances if apart else self.block_categories

    @property
    def block_category_labels(self) -> Path:
        """Part of each SfM point."""
        return self.block_labels / "labels.npz"

    @property
    def prefixes(self) -> Path:
        """The nested ladder: one ordered set of Gaussians, its levels prefixes of it."""
        return self.adapted / "ladder.npz"

    @property
    def base_model(self) -> Path:
        """The small model that the nested ladder begins with."""
        return self.adapted / "base.npz"

    @property
    def increments(self) -> Path:
        """What each level of each category adds, as it is sent, with index.json."""
        return self.adapted / "increments"

    @property
    def nest_checkpoint(self) -> Path:
        """Where training on compositions goes on."""
        return self.adapted / "checkpoint.npz"

    @property
    def observations(self) -> Path:
        """Quality per category, level and view."""
        return self.adapted / "observations.csv"

    @property
    def viewpoints(self) -> Path:
        """Drawn viewpoints, and the rule that they were drawn by."""
        return self.adapted / "viewpoints.json"

    @property
    def sampled(self) -> Path:
        """Fidelity per category and level at drawn viewpoints."""
        return self.adapted / "fidelity.npz"

    @property
    def fidelity(self) -> Path:
        """Fidelity per category and level at any viewpoint, with its lower bound."""
        return self.adapted / "fidelity.json"

    @property
    def models(self) -> Path:
        """Eq. 3 per category and level."""
        return self.adapted / "models.json"

    @property
    def promises(self) -> Path:
        """SSIM against photos per category and level at any viewpoint, with its lower bound."""
        return self.adapted / "promises.json"

    @property
    def plan(self) -> Path:
        """Levels chosen."""
        return self.adapted / "plan.json"

    @property
    def composed(self) -> Path:
        """The scene that the plan chose."""
        return self.adapted / "composed.ply"

    @property
    def evaluation(self) -> Path:
        """Composed scenes on test views."""
        return self.adapted / "evaluation.csv"

    @property
    def cross_view(self) -> Path:
        """Unseen views, each with a plan of its own."""
        return self.adapted / "cross_view.csv"

    @property
    def same_size(self) -> Path:
        """Compositions and 3DGS of the same size."""
        return self.adapted / "same_size.csv"

    @property
    def report(self) -> Path:
        """The report's folder."""
        return self.adapted / "report"

    @property
    def paper(self) -> Path:
        """The paper's tables and figures."""
        return self.report / "paper"

    def provenance(self, stage: str) -> Path:
        """What a stage's result was made from."""
        folder = self.path if stage in _BEFORE_LADDERS else self.adapted
        return folder / "provenance" / f"{stage}.json"
