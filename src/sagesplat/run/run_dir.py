"""A run folder: the names of everything in it, and what each result was made from."""

import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from sagesplat import __version__
from sagesplat.core.errors import RunError
from sagesplat.io.files import read_json, write_json

FORMAT = 3  # of the run folder; raised when older folders can no longer be read

LadderKind = Literal["nested", "snapshots"]
# stages that all ladders of a run share
_BEFORE_LADDERS = (
    "poses",
    "scene",
    "segment",
    "masks",
    "lift",
    "blocks",
    "train",
    "fuse",
    "block_categories",
)


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
    def geometry(self) -> Path:
        """Cameras and points of the capture, so that results can be shown without it."""
        return self.path / "geometry.npz"

    @property
    def masks(self) -> Path:
        """Label images at training size, with labels.json."""
        return self.path / "masks"

    @property
    def capture(self) -> Path:
        """The folder of the capture that was made of photos without poses."""
        return self.path / "capture"

    @property
    def segmented(self) -> Path:
        """Label images as they came, before categories were merged or left out."""
        return self.path / "segmented"

    @property
    def segmentation(self) -> Path:
        """How the label images in `segmented` were asked for."""
        return self.segmented / "options.json"

    @property
    def soft(self) -> Path:
        """A network's probabilities, of the categories in `segmented`."""
        return self.path / "soft"

    @property
    def fused(self) -> Path:
        """Label images on which all views agree."""
        return self.path / "fused"

    @property
    def labels(self) -> Path:
        """Labels of the SfM points."""
        return self.path / "labels.npz"

    @property
    def levels(self) -> Path:
        """The recorded levels."""
        return self.path / "levels"

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
    def block_category_labels(self) -> Path:
        """Part of each SfM point."""
        return self.block_categories / "labels.npz"

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
    def models(self) -> Path:
        """Eq. 3 per category and level."""
        return self.adapted / "models.json"

    @property
    def promises(self) -> Path:
        """Quality per category and level at any viewpoint, with its lower bound."""
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


def file_hash(path: Path) -> str:
    """SHA-256 of a file, or of all files of a folder with their names."""
    digest = hashlib.sha256()
    for file in sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]:
        if path.is_dir():
            digest.update(str(file.relative_to(path)).encode())
        with file.open("rb") as stream:
            digest.update(hashlib.file_digest(stream, "sha256").digest())
    return digest.hexdigest()


def input_hashes(run: RunDir, inputs: Sequence[Path]) -> dict[str, str]:
    """SHA-256 of each input, by its path relative to the run folder: a run may be moved as a whole.

    Of a stage's record all but its seconds counts: they differ each time that a stage is done.
    """
    return {Path(os.path.relpath(path, run.path)).as_posix(): _input_hash(path) for path in inputs}


def _input_hash(path: Path) -> str:
    if path.parent.name != "provenance":
        return file_hash(path)
    kept = {key: value for key, value in _read_record(path).items() if key != "seconds"}
    return hashlib.sha256(json.dumps(kept, sort_keys=True).encode()).hexdigest()


def checkpoint_key(run: RunDir, settings: Mapping[str, Any], inputs: Sequence[Path]) -> str:
    """What a stage's checkpoint is kept with: training resumes only with these settings and inputs."""
    return json.dumps({"settings": dict(settings), "inputs": input_hashes(run, inputs)})


class _NoRecord(RunError):
    """A file that is not the record of a stage."""


def _read_record(path: Path) -> dict[str, Any]:
    """A stage's record; RunError for anything else, and for a run folder of another format."""
    wrong = _NoRecord(f"{path}: not the record of a stage; run that stage again with --force")
    try:
        made = read_json(path)
    except RunError:
        raise wrong from None
    if not isinstance(made, dict):
        raise wrong
    check_format(path, made)
    if not all(isinstance(made.get(part), dict) for part in ("settings", "inputs")):
        raise wrong
    return made


def check_format(path: Path, made: Mapping[str, Any]) -> None:
    """RunError unless a record, which was read from `path`, is of the format that is read here."""
    if made.get("format") != FORMAT:
        raise RunError(
            f"{path}: from a run folder of format {made.get('format')}, this sagesplat ({__version__}) reads "
            f"{FORMAT}; run again into a new folder"
        )


def is_done(
    run: RunDir,
    stage: str,
    settings: Mapping[str, Any],
    inputs: Sequence[Path] | None,
    outputs: Sequence[Path],
    force: bool,
) -> bool:
    """Whether a stage's result is there, made with exactly these settings from exactly these inputs.

    Without `inputs` only the settings are compared: for a look ahead, before the inputs are made. A result
    made otherwise is never overwritten without `force`: RunError says what differs.
    """
    if not run.provenance(stage).exists():
        return False
    try:
        made = _read_record(run.provenance(stage))
    except _NoRecord:
        if force:
            return False
        raise
    if not all(p.exists() for p in outputs):
        return False
    differs = _differences(made, settings, made["inputs"] if inputs is None else input_hashes(run, inputs))
    if not differs:
        return True
    if not force:
        raise RunError(
            f"{outputs[0]}: made with other {differs}; choose another run folder, or add --force to redo it"
        )
    return False


def settings_of(run: RunDir, stage: str) -> dict[str, Any]:
    """The settings that a finished stage was made with."""
    return _record_of(run, stage)["settings"]


def is_made_from(run: RunDir, stage: str, path: Path) -> bool:
    """Whether a finished stage's result was made from a file as it is now."""
    name, digest = next(iter(input_hashes(run, [path]).items()))
    return _record_of(run, stage)["inputs"].get(name) == digest


def _record_of(run: RunDir, stage: str) -> dict[str, Any]:
    if not run.provenance(stage).exists():
        raise RunError(f"{run.path}: stage {stage} is not done; run `sagesplat {stage}` or `sagesplat run`")
    return _read_record(run.provenance(stage))


def _differences(made: Mapping[str, Any], settings: Mapping[str, Any], inputs: Mapping[str, str]) -> str:
    """A few words on what changed since a result was made; empty = nothing."""
    old, new = made["settings"], settings
    changed = [
        f"{k} ({old.get(k, 'not set')} then, {new.get(k, 'not set')} now)"
        for k in [*new, *(k for k in old if k not in new)]
        if k not in old or k not in new or old[k] != new[k]
    ]
    old, new = made["inputs"], inputs
    changed += [f"{name} (its content changed)" for name in new if name in old and old[name] != new[name]]
    changed += [f"{name} (not used then)" for name in new if name not in old]
    changed += [f"{name} (not used any more)" for name in old if name not in new]
    return ", ".join(changed[:3])


def record(
    run: RunDir, stage: str, settings: Mapping[str, Any], inputs: Sequence[Path], seconds: float
) -> None:
    """Write down what a finished stage's result was made from."""
    write_json(
        run.provenance(stage),
        {
            "format": FORMAT,
            "stage": stage,
            "version": __version__,
            "seconds": round(seconds, 2),
            "settings": dict(settings),
            "inputs": input_hashes(run, inputs),
        },
    )
