"""Makes label images from the photos, point labels from these, and fused label images from both."""

import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Int16

from sagesplat.core.config import LabelsConfig, MasksConfig
from sagesplat.core.errors import LabelError, RunError
from sagesplat.core.events import Noted, Progress, Warned
from sagesplat.core.limits import LabelId
from sagesplat.io.files import write_json
from sagesplat.io.typed import known_json, read_json_as, refused
from sagesplat.run.executor import split
from sagesplat.run.job import Job
from sagesplat.run.records import file_hash
from sagesplat.run.remote import work_all
from sagesplat.run.run_dir import RunDir
from sagesplat.run.stage import run_stage
from sagesplat.scene.given_masks import holds_masks, masks_of
from sagesplat.segment.display_names import categories, title_of, titles
from sagesplat.segment.edit import Edited, edit_labels, ignored_ids, parse_merge, parse_names
from sagesplat.segment.lift import agreement_in, lift
from sagesplat.segment.mask_files import import_masks
from sagesplat.segment.masks import MAX_LABEL_ID, UNLABELLED, Masks, Taxonomy, write_labels
from sagesplat.segment.registry import SEGMENTERS, segmenter_for
from sagesplat.segment.segmenters import segment_some
from sagesplat.segment.valid import ValidPixels, write_valid
from sagesplat.stages.memory import check_network
from sagesplat.stages.prompts import MASKS, Scores, Timed, load, prompt_lines, settings_of
from sagesplat.stages.scene import check_not_adopted
from sagesplat.train.fuse import fuse

_MARKER = ".network.json"
_DILATION = 3  # px of the training photos by which regions that do not count are grown
_EDIT = "edit.json"


def make_masks(job: Job, config: MasksConfig, labels: LabelsConfig = LabelsConfig()) -> None:
    """Import label images or segment the photos, find the pixels that count, merge and drop categories."""
    run, kind = job.run, segmenter_kind(job.scene.path, config)
    parse_merge(labels.merge)  # what is wrong with it is said before a network begins
    if kind == MASKS and not config.prompts:
        _import(job, config, run.segmented, "segment")
    else:
        _segment(job, config, kind, instances=bool(labels.instances))
    labels = replace(labels, merge=_of_categories(run, labels))
    merge = parse_merge(labels.merge)
    keep, ignore = parse_names(labels.keep, "keep"), parse_names(labels.ignore, "ignore")

    def make() -> list[str]:
        shutil.rmtree(run.masks, ignore_errors=True)
        said = list[str]()
        ignored = _find_valid(job, config, labels, ignore, merge, said)
        edited = edit_labels(
            run.segmented, job.scene.views, run.masks,
            keep=keep, merge=merge, ignore=ignore, min_share=labels.min_share, valid=ValidPixels(run.valid),
            on_view=lambda done, total: job.emit(Progress("masks", done, total)),
        )  # fmt: skip
        write_json(run.masks / _EDIT, {**edited.record, "table": edited.table.tolist()})
        return [*_lines(edited), *said, *_ignored_lines(ignored)]

    settings = {name: value for name, value in asdict(labels).items() if name != "instances"}
    given = masks_of(job.scene, _mask_folder(config))
    if given:
        settings["valid"] = [file_hash(place) for place in given.places]
    inputs = [run.provenance("segment"), run.segmented / "labels.json"]
    inputs += {view.valid_path: None for view in job.scene.views if view.valid_path}
    run_stage(job, "masks", settings, inputs, [run.masks / "labels.json"], make)


def _of_categories(run: RunDir, labels: LabelsConfig) -> str:
    """The pairs of --labels.merge that are of categories; those of instances are for later (`instances`)."""
    later = later_merges(run, labels)
    if not later:
        return labels.merge
    pairs = labels.merge.split(",")
    return ",".join(pair for pair in pairs if pair.partition("=")[0].strip() not in later)


def later_merges(run: RunDir, labels: LabelsConfig) -> dict[str, str]:
    """The pairs of --labels.merge that are of instances: what they merge is no category of the photos."""
    if not labels.instances:
        return {}
    known = Taxonomy.read(run.segmented / "labels.json").names.values()
    return {old: new for old, new in parse_merge(labels.merge).items() if old not in known}


def _find_valid(
    job: Job,
    config: MasksConfig,
    labels: LabelsConfig,
    ignore: Sequence[str],
    merge: Mapping[str, str],
    said: list[str],
) -> Float32[np.ndarray, " V"]:
    """Write which pixels count; the share of each view's pixels that do not. Lines go to `said`."""
    run, views = job.run, job.scene.views
    before = Taxonomy.read(run.segmented / "labels.json")
    ids, unseen = ignored_ids(before, ignore, merge)
    if unseen:
        job.emit(Warned(f"ignore: no photo shows {', '.join(unseen)}"))
    label_ids = Masks(run.segmented, before)
    shares = write_valid(
        job.scene, run.valid, label_ids=label_ids, ignore=ids, dilation=_DILATION,
        folder=_mask_folder(config), say=said.append,
    )  # fmt: skip
    if empty := [view.name for view, share in zip(views, shares, strict=True) if share == 1]:
        names = ", ".join(empty[:5]) + (", ..." if len(empty) > 5 else "")
        job.emit(Warned(f"{len(empty)} of {len(views)} photos have no pixel that counts: {names}"))
    return shares


def _ignored_lines(shares: Float32[np.ndarray, " V"]) -> list[str]:
    if not shares.any():
        return []
    return [f"{shares.mean():.1%} of the pixels are ignored, in {(shares > 0).sum()} of {len(shares)} photos"]


def _lines(edited: Edited) -> list[str]:
    shown = titles(edited.taxonomy.names)
    lines = [f"{categories(len(shown))}: {', '.join(shown.values())}"]
    for what, gone in (("left out", edited.dropped), ("too small", edited.folded)):
        named = ", ".join(f"{title_of(name)} ({share:.1%})" for name, share in gone.items() if share)
        if named:
            lines.append(f"{what}: {named}")
    return lines


def segmenter_kind(capture: Path, config: MasksConfig) -> str:
    """The segmenter that was asked for, or with "auto" the one that the settings and the capture imply."""
    if config.segmenter != "auto":
        return config.segmenter
    folder = config.masks or capture / "masks"
    if not config.model and (config.masks or folder.is_dir()) and not holds_masks(folder):
        return MASKS
    return "text" if config.prompts and not config.model else segmenter_for(config.model)


def _mask_folder(config: MasksConfig) -> Path | None:
    """The folder of --masks, where it holds masks of what counts rather than label images."""
    return config.masks if config.masks is not None and holds_masks(config.masks) else None


def _note_options(job: Job, config: MasksConfig) -> None:
    """Keep how the label images were asked for, paths absolute: the defaults of the next command."""
    options = asdict(config)
    for name in ("masks", "model", "prompt_model", "mask_model", "classes"):
        if options[name] is not None and Path(options[name]).exists():
            options[name] = str(Path(options[name]).resolve())
    write_json(job.run.segmentation, {k: str(v) if isinstance(v, Path) else v for k, v in options.items()})


def _import(job: Job, config: MasksConfig, target: Path, stage: str) -> None:
    """Import existing label images into a folder of the run."""
    run, source = job.run, config.masks or job.scene.path / "masks"
    settings = {"segmenter": "masks", "source": file_hash(source) if source.is_dir() else str(source)}

    def make() -> list[str]:
        shutil.rmtree(target, ignore_errors=True)
        missing = import_masks(job.scene, source, target)
        if missing:
            names = ", ".join(missing[:5]) + (", ..." if len(missing) > 5 else "")
            job.emit(Warned(f"{len(missing)} of {len(job.scene.views)} views have no label image: {names}"))
        if target == run.segmented:
            _note_options(job, config)
        return []

    run_stage(job, stage, settings, [run.scene], [target / "labels.json"], make)


def _segment(job: Job, config: MasksConfig, kind: str, *, instances: bool = False) -> None:
    """Segment the photos; images of an interrupted attempt with the same network are kept."""
    run, inputs = job.run, [job.run.scene]
    own = settings_of(kind, config)
    hashed = {name: file_hash(v) if isinstance(v, Path) else v for name, v in own.items()}
    settings = {"segmenter": kind, **hashed}
    if kind == MASKS:  # prompts over them
        _import(job, config, run.given, "given")
        settings["given"] = file_hash(run.given)
        inputs.append(run.given / "labels.json")
    elif instances and SEGMENTERS[kind].instances is not None:
        settings["instances"] = True

    def make() -> list[str]:
        marker, key = run.segmented / _MARKER, {**settings, "scene": file_hash(run.scene)}
        if not _is(marker, key):
            shutil.rmtree(run.segmented, ignore_errors=True)
            shutil.rmtree(run.photo_instances, ignore_errors=True)
        write_json(marker, key)
        check_network(job, "text" if kind == MASKS else kind, own)
        some = split(range(len(job.scene.views)), job.executor.parallel)  # each loads the network
        found = work_all(job, "segment", _segment_some, [(rows, config, kind, instances) for rows in some])
        taxonomy = found[0][0]
        if any(other != taxonomy for other, _ in found):
            raise LabelError(f"{run.segmented}: the nodes' networks have other categories; make them alike")
        occurring = set[int]().union(*(ids for _, ids in found))
        lines = prompt_lines(run.segmented, taxonomy, occurring, lambda text: job.emit(Warned(text)))
        write_labels(run.segmented, taxonomy, occurring)
        _note_options(job, config)
        return lines

    run_stage(job, "segment", settings, inputs, [run.segmented / "labels.json"], make)


def _is(marker: Path, key: dict[str, Any]) -> bool:
    """Whether a folder of label images was begun with this network and these photos."""
    return known_json(marker, dict) == json.loads(json.dumps(key))


def _segment_some(job: Job, part: tuple[Sequence[int], MasksConfig, str, bool]) -> tuple[Taxonomy, set[int]]:
    """Segment some views: all categories of the network, and the ids that occur.

    `part`: rows, settings, kind of segmenter, and whether instances are wanted.
    """
    rows, config, kind, instances = part
    run, warn, note = job.run, lambda text: job.emit(Warned(text)), lambda text: job.emit(Noted(text))
    given = Masks(run.given, Taxonomy.read(run.given / "labels.json")) if kind == MASKS else None
    below = None if given is None else given.taxonomy
    segmenter = load(kind, config, job.device, job.threads, warn, instances=instances, given=below)
    scores, remaining = Scores(run.segmented, rows[0] if rows else 0, segmenter), len(rows)

    def on_view(done: int, total: int) -> None:
        nonlocal remaining
        remaining = total - done
        scores.keep()
        job.emit(Progress("segment", done, total))

    occurring = segment_some(
        job.scene, job.photos, Timed(segmenter, lambda: remaining, note), run.segmented, rows,
        below=given,
        instances=None if kind == MASKS else run.photo_instances, on_view=on_view,
    )  # fmt: skip
    return segmenter.taxonomy if below is None else below | segmenter.taxonomy, occurring


def lift_labels(job: Job) -> None:
    """Vote the label images onto the SfM points."""
    run = job.run
    check_not_adopted(run)

    def make() -> list[str]:
        if not len(job.given_scene.points.track_points):
            job.emit(Warned("the points have no tracks: all views that a point projects into vote"))
        scene = job.given_scene
        voters = set(scene.train_ids.tolist())
        lifted = lift(scene, job.masks, views=voters, valid=job.valid)
        lifted.write(run.labels)
        lines = [f"{100 * lifted.agreement:.1f} % of the votes agree with the label of their point"]
        if lifted.ignored is not None:
            lines.append(f"{lifted.ignored.sum():,} points show what is ignored, and become no Gaussians")
        return lines

    labels = run.masks / "labels.json"
    run_stage(job, "lift", {}, [run.scene, run.provenance("masks"), labels], [run.labels], make)


def fuse_masks(job: Job) -> None:
    """Let the label images of all training views vote on the trained Gaussians, and draw the votes back."""
    run = job.run
    check_not_adopted(run)

    def make() -> list[str]:
        shutil.rmtree(run.fused, ignore_errors=True)
        g = job.load_last_level()
        fused = fuse(
            g, job.scene, job.masks, run.fused,
            valid=job.valid, antialiased=job.antialiased, backend=job.backend,
            on_view=lambda done, total: job.emit(Progress("fuse", done, total)),
        )  # fmt: skip
        before, after = (_agreement(job, masks) for masks in (job.masks, job.category_masks))
        write_json(run.fused / "fused.json", {**fused.record, "agreement": [before, after]})
        return [
            f"{fused.changed.mean():.1%} of the pixels changed; views that had no vote agree with the points "
            f"in {after:.1%} of what they see ({before:.1%} before)"
        ]

    made = [run.provenance(stage) for stage in ("masks", "train")]
    inputs = [*run.scene_files, run.masks / "labels.json", run.levels, *made]
    run_stage(job, "fuse", {}, inputs, [run.fused / "labels.json"], make)


@dataclass(frozen=True)
class _Edit:
    table: list[LabelId]


def read_edit_table(path: Path, before: Taxonomy) -> Int16[np.ndarray, " T"]:
    """What became of each id of the categories `before`: its new id, or -1. RunError for another file."""
    what, cure = "of these categories", f"delete {path.parent} and run `sagesplat masks` again"
    table = read_json_as(path, _Edit, what, cure, RunError).table
    with refused(path, what, cure, RunError):
        if len(table) <= max(before.names):
            raise ValueError(f"{len(table)} ids")
    return np.array(table, np.int16)


def edit_of(run: RunDir) -> Int16[np.ndarray, " T"]:
    """What became of any id when the label images were edited: -1 for one that none of them has."""
    before = Taxonomy.read(run.segmented / "labels.json")
    edited = read_edit_table(run.masks / _EDIT, before)
    table = np.full(MAX_LABEL_ID + 2, UNLABELLED, np.int16)
    table[list(before.names)] = edited[list(before.names)]
    return table


def _agreement(job: Job, masks: Masks) -> float:
    """Share of what views without a vote show of the points that is the points' label; NaN without any."""
    voters = set(job.scene.train_ids.tolist())
    lifted = lift(job.scene, masks, views=voters)
    others = set(range(len(job.scene.views))) - voters
    return agreement_in(job.scene, masks, lifted.label_ids, others)
