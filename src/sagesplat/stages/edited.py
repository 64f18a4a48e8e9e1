"""edited.json of a run folder that was made by editing the labels of another run."""

from dataclasses import dataclass, field
from typing import Any, Literal

from sagesplat.core.errors import RunError
from sagesplat.core.limits import NotNegative, Text
from sagesplat.io.files import write_json
from sagesplat.io.typed import read_json_as
from sagesplat.run.run_dir import RunDir

_FORMAT, _CURE = "sagesplat-edited-run", "apply the edits again"


@dataclass(frozen=True)
class LabelSettings:
    """What edits say of categories besides names and Gaussians, by name."""

    weights: dict[str, NotNegative] = field(default_factory=dict)  # of plans in a budget, where it is not 1
    hidden: tuple[Text, ...] = ()  # when a viewer opens the scene
    always: tuple[Text, ...] = ()  # in full whatever the plan says


@dataclass(frozen=True, kw_only=True)
class _Edited(LabelSettings):
    """Of edited.json what is read; all of it is written."""

    format: Literal["sagesplat-edited-run"]


def label_settings(run: RunDir) -> LabelSettings:
    """Those of an edited run; none of any other. RunError for a damaged file."""
    if not run.edited.exists():
        return LabelSettings()
    found = read_json_as(run.edited, _Edited, "what was made of edits", _CURE, RunError)
    return LabelSettings(found.weights, found.hidden, found.always)


def write_edited(run: RunDir, source: str, edits: Any, settings: LabelSettings) -> None:
    """Write edited.json: the name of the run that was edited, the edits, and the settings of categories."""
    write_json(run.edited, {"format": _FORMAT, "from": source, "edits": edits, **vars(settings)})


def check_not_edited(run: RunDir) -> None:
    """RunError for an edited run: what its levels are made from belongs to the run that was edited."""
    if run.edited.exists():
        raise RunError(
            f"{run.path}: made by editing the labels of another run; change that run, and apply the edits "
            "again: `sagesplat labels apply`"
        )
