"""edited.json of a run folder that was made by editing the labels of another run."""

from dataclasses import dataclass, field
from typing import Any

from sagesplat.core.errors import RunError
from sagesplat.core.typed import check_fields, types_of
from sagesplat.io.files import read_json, write_json
from sagesplat.run.run_dir import RunDir

_FORMAT, _CURE = "sagesplat-edited-run", "apply the edits again"


@dataclass(frozen=True)
class LabelSettings:
    """What edits say of categories besides names and Gaussians, by name."""

    weights: dict[str, float] = field(default_factory=dict)  # of plans within a budget, where it is not 1
    hidden: tuple[str, ...] = ()  # when a viewer opens the scene
    always: tuple[str, ...] = ()  # in full whatever the plan says


def label_settings(run: RunDir) -> LabelSettings:
    """Those of an edited run; none of any other. RunError for a damaged file."""
    if not run.edited.exists():
        return LabelSettings()
    about = read_json(run.edited, _CURE)
    types = types_of(LabelSettings)
    try:
        if not isinstance(about, dict) or about.get("format") != _FORMAT:
            raise ValueError("of another format")
        found = {name: about[name] for name in types}
        check_fields(found, types)
    except (KeyError, ValueError) as error:
        raise RunError(f"{run.edited}: not what was made of edits ({error}); {_CURE}") from None
    weights = {name: float(weight) for name, weight in found["weights"].items()}
    return LabelSettings(weights, tuple(found["hidden"]), tuple(found["always"]))


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
